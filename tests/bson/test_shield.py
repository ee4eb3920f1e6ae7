"""The shield before learned robots, on an ideal unicycle among people who give no way."""

from typing import Any

import numpy as np
import pytest
import torch

from bson.agents import AgentError, Setting, Unsuited, act, learned, load_agent, reset_agent
from bson.agents.guide import ScanSight
from bson.agents.shield import Shield
from bson.episodes.tracks import make_track
from bson.robot import JACKAL, footprint
from bson.sensors import Lidar2D
from bson.task import TaskConfig
from macid import geometry
from macid.state import RADIUS

LIDAR, MOUNT, PERIOD, TOP, GOAL = Lidar2D(), np.array([0.12, 0.0]), 0.1, np.array([2.0, 2.0]), np.array([20.0, 0.0])
NOBODY, NOTHING, FLIP = np.zeros((0, 2)), np.zeros((0, 5)), np.array([1.0, -1.0])
WALL = np.array([[4.0, 0.0, 0.2, 9.0, 0.0]])  # across the way, at x = 3.8


class Always:
    """A policy that always gives the same action."""

    def __init__(self, *action):
        self.action = np.array(action)

    def __call__(self, observation):
        return self.action


def shielded(*action):
    agent = Shield(Always(*action), Setting.default())
    agent.reset(0)
    return agent


def observe(pose, people, boxes, velocity):
    """What a robot at `pose` observes of `people` (K, 2) and `boxes` (B, 5) in the world frame."""
    eye, rays = pose[:2] + geometry.rotate(MOUNT, pose[2]), geometry.heading(pose[2] + LIDAR.angles)
    met = geometry.ray_disc_distance(eye, rays, people, RADIUS)
    hit = geometry.ray_box_distance(eye, rays, boxes)
    scan = np.concatenate([met, hit], axis=-1).min(axis=-1, initial=LIDAR.range_max)
    return {
        "goal": geometry.to_body(GOAL - pose[:2], pose[2]).astype(np.float32),
        "velocity": np.asarray(velocity, np.float32),
        "lidar": np.maximum(scan, LIDAR.range_min).astype(np.float32),
    }


def drive(agent, people: Any = NOBODY, walk: Any = NOBODY, boxes=NOTHING, steps=60):
    """Poses (n, 3), from the origin, and the least gap to anything [m]; people walk straight on."""
    pose, velocity, least, poses = np.zeros(3), np.zeros(2), np.inf, []
    people, walk = (np.reshape(each, (-1, 2)).astype(float) for each in (people, walk))
    for _ in range(steps):
        wanted = act(agent, observe(pose, people, boxes, velocity)) * TOP
        speed = velocity[0] + np.clip(wanted[0] - velocity[0], -0.65, 0.65)
        middle = pose[2] + wanted[1] * PERIOD / 2
        way = (velocity[0] + speed) / 2 * PERIOD
        pose = pose + np.array([way * np.cos(middle), way * np.sin(middle), wanted[1] * PERIOD])
        velocity, people = np.array([speed, wanted[1]]), people + PERIOD * walk
        box = footprint(pose, JACKAL.config)
        least = min(least, geometry.point_box_distance(people, box[None]).min(initial=np.inf) - RADIUS)
        least = min(least, geometry.box_box_gap(box, boxes).min(initial=np.inf))
        poses.append(pose)
    return np.array(poses), least


@pytest.mark.parametrize("action", [(1.0, 0.0), (0.5, 0.0), (1.0, 0.2)])
@pytest.mark.parametrize("ahead", ["wall", "person"])
def test_what_stands_in_the_way_is_not_touched(ahead, action):
    people, boxes = ([[3.0, 0.0]], NOTHING) if ahead == "person" else (NOBODY, WALL)
    poses, gap = drive(shielded(*action), people, np.zeros_like(people), boxes)
    assert gap > 0.01
    assert poses[:, 0].max() > 2.0  # it goes there all the same


def test_it_does_not_back_into_a_wall_that_it_saw_before_it_turned():
    policy = Always(0.0, 1.0)
    agent = Shield(policy, Setting.default())
    agent.reset(0)
    beside, pose = np.array([[0.0, -1.0, 9.0, 0.2, 0.0]]), np.zeros(3)
    for step in range(9):  # to the left, until the wall on its right is behind it
        pose = np.array([0.0, 0.0, np.radians(10.0 * step)])
        assert np.array_equal(agent(observe(pose, NOBODY, beside, [0.0, 1.75])), policy.action)
    policy.action, velocity = np.array([-1.0, 0.0]), np.zeros(2)
    for _ in range(30):
        speed = velocity[0] + np.clip(
            agent(observe(pose, NOBODY, beside, velocity))[0] * TOP[0] - velocity[0], -0.65, 0.65
        )
        pose = pose + np.append(PERIOD * (velocity[0] + speed) / 2 * geometry.heading(pose[2]), 0.0)
        velocity = np.array([speed, 0.0])
    assert -0.55 < pose[1] < -0.3  # it went as far as it can
    assert geometry.box_box_gap(footprint(pose, JACKAL.config), beside).min() > 0.01


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("along", [3.5, 4.7])
def test_who_crosses_from_the_side_is_let_by(along, side):
    start, walk = np.array([along, side * 3.0]), np.array([0.0, -side * 1.2])
    _, gap = drive(Always(1.0, 0.0), start, walk, steps=40)
    poses, shielded_gap = drive(shielded(1.0, 0.0), start, walk, steps=40)
    assert gap < 0 < 0.01 < shielded_gap
    assert poses[-1, 0] > 4.0


def test_far_from_everything_the_action_is_the_policys_bit_for_bit():
    bare, agent = load_agent("gru")(), load_agent("gru-shield")()
    rng = np.random.default_rng(0)
    for each in (bare, agent):
        reset_agent(each, 0)
    far = np.array([[9.0, 6.0], [-8.0, 5.0]])
    for step in range(8):
        seen = observe(np.array([0.1 * step, 0.0, 0.0]), far, NOTHING, rng.uniform([0, -1], [1, 1]))
        np.testing.assert_array_equal(agent(seen), bare(seen))


def test_a_mirrored_world_gives_the_mirrored_action():
    rng, overruled = np.random.default_rng(1), 0
    for _ in range(12):
        people, walk = rng.uniform([0.6, -1.5], [2.5, 1.5], (3, 2)), rng.normal(0, 1, (3, 2))
        boxes, wish = np.array([[2.5, rng.uniform(-2, 2), 0.3, 0.8, rng.uniform(0, 3)]]), rng.uniform(-1, 1, 2)
        actions = []
        for sign in (np.ones(2), FLIP):
            agent = shielded(*(wish * sign))
            mirrored = boxes * [1, sign[1], 1, 1, sign[1]]
            for when in (-PERIOD, 0.0):
                seen = observe(np.zeros(3), sign * (people + when * walk), mirrored, sign * [1.0, 0.5])
                seen["goal"] = seen["goal"] * [1.0, sign[1]]
                action = act(agent, seen)
            actions.append(action * sign)
        np.testing.assert_allclose(actions[1], actions[0], atol=1e-6)
        overruled += not np.array_equal(actions[0], wish)
    assert overruled >= 3


def test_it_gets_round_who_stands_in_the_way_for_ever():
    poses, gap = drive(shielded(1.0, 0.0), [[3.0, 0.0]], [[0.0, 0.0]], steps=200)
    assert gap > 0.01
    assert poses[-1, 0] > 5.0


def test_the_same_seed_gives_the_same_actions_and_an_episode_forgets_the_last_one():
    agent = load_agent("gru-shield")()
    runs = []
    for _ in range(2):
        reset_agent(agent, 3)
        poses, _ = drive(agent, [[3.0, 0.1], [2.0, -2.0]], [[-0.5, 0.0], [0.0, 1.0]], WALL, steps=40)
        runs.append(poses)
    np.testing.assert_array_equal(runs[0], runs[1])


def test_it_takes_what_any_agent_may_give_and_refuses_what_none_may():
    view = observe(np.zeros(3), NOBODY, NOTHING, np.zeros(2))
    tensor = torch.tensor([0.5, 0.25], requires_grad=True)
    for given in (tensor, list(tensor), (0.5, 0.25), np.array([0.5, 0.25], np.float16)):
        assert np.array_equal(Shield(lambda _, given=given: given, Setting.default())(view), [0.5, 0.25])
    for given in (None, [np.nan, 0.0], [0.1, 0.2, 0.3], [[0.5, 0.25]], "ab", [1j, 0.0]):
        with pytest.raises(AgentError, match="^Agent 'agent' returned"):
            Shield(lambda _, given=given: given, Setting.default())(view)


def test_a_wish_beyond_the_limits_is_the_limit():
    near = observe(np.array([GOAL[0] - 1.0, 0.0, 0.0]), NOBODY, NOTHING, [2.0, 0.0])
    most, more = (Shield(Always(speed, 0.0), Setting.default())(near) for speed in (1.0, 3.0))
    assert np.array_equal(most, more) and most[0] < 1.0  # the last step leads deep into the goal's circle


def test_it_shares_its_policys_sight_and_has_its_own_for_who_has_none():
    setting = Setting.default()
    gru, tac = learned.load("gru")(setting), learned.load("tac")(setting)
    assert Shield(gru, setting).sight is gru.eyes
    assert isinstance(Shield(tac, setting).sight, ScanSight)
    agent = Shield(tac, setting)
    agent.reset(0)
    assert drive(agent, boxes=WALL, steps=30)[1] > 0.01


@pytest.mark.parametrize(
    ("its", "told"),
    [
        (
            {"sensor": "lidar3d"},
            "Agent 'gru-shield' needs a Lidar2D with the key \"lidar\"; the sensors are: Imu, Lida",
        ),
        ({"robot": "diffbot"}, "Agent 'gru-shield' was trained with robot jackal, not with robot diffbot"),
    ],
)
def test_where_it_cannot_drive_it_says_so_in_one_line(its, told):
    sensor = its.pop("sensor", "lidar2d")
    setting = Setting.of(TaskConfig(**its), make_track("local", sensor))
    with pytest.raises(Unsuited) as caught:
        load_agent("gru-shield")(setting)
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)
