"""The Dynamic Window Approach on synthetic scans, and an ideal unicycle that it drives."""

import numpy as np
import pytest

from bson.agents.dwa import Dwa, DwaConfig
from bson.robot import JACKAL, footprint
from bson.sensors import Lidar2D
from macid import geometry
from macid.state import RADIUS

LIDAR, CONFIG, MOUNT = Lidar2D(), DwaConfig(), 0.12
PERIOD, TOP = 0.1, np.array([2.0, 2.0])
WALL = np.array([[6.0, 0.0, 0.1, 9.0, 0.0]])  # across the way, at x = 5.9


def observe(pose=(0.0, 0.0, 0.0), goal=(20.0, 0.0), people=(), boxes=(), velocity=(0.0, 0.0)):
    """What a robot at `pose` observes of `goal`, `people` (K, 2) and `boxes` (B, 5) in the world frame."""
    pose, people, boxes = (np.asarray(each, float) for each in (pose, people, boxes))
    eye = pose[:2] + geometry.rotate(np.array([MOUNT, 0.0]), pose[2])
    rays = geometry.heading(pose[2] + LIDAR.angles)
    met = geometry.ray_disc_distance(eye, rays, people.reshape(-1, 2), RADIUS)
    hit = geometry.ray_box_distance(eye, rays, boxes.reshape(-1, 5))
    scan = np.concatenate([met, hit], axis=-1).min(axis=-1, initial=LIDAR.range_max)
    return {
        "goal": geometry.to_body(np.asarray(goal, float) - pose[:2], pose[2]).astype(np.float32),
        "velocity": np.array(velocity, np.float32),
        "lidar": np.maximum(scan, LIDAR.range_min).astype(np.float32),
    }


def mirrored(observation):
    sign = np.array([1.0, -1.0], np.float32)
    goal, velocity = observation["goal"] * sign, observation["velocity"] * sign
    return {"goal": goal, "velocity": velocity, "lidar": observation["lidar"][::-1].copy()}


def touch(pose, people, boxes):
    """The least gap [m] between the footprint at `pose` (3,) and `people` (K, 2) and `boxes` (B, 5)."""
    box = footprint(pose, JACKAL.config)
    to_people = geometry.point_box_distance(people, box[None]).min(initial=np.inf) - RADIUS
    return min(to_people, geometry.box_box_gap(box, boxes).min(initial=np.inf))


def scenes(number):
    """People (4, 2), boxes (3, 5), and what a robot at the origin observes of them."""
    rng = np.random.default_rng(0)
    for _ in range(number):
        boxes = rng.uniform([-4, -6, 0.1, 0.1, 0], [9, 6, 0.4, 3, 3], (3, 5))
        boxes[:, 0] += np.where(np.hypot(boxes[:, 0], boxes[:, 1]) < 4, 6, 0)
        people = rng.uniform([1, -4], [6, 4], (4, 2))
        goal, velocity = rng.uniform(-15, 15, 2), rng.uniform([-1, -2.5], [2, 2.5])
        yield people, boxes, observe((0, 0, 0), goal, people, boxes, velocity)


def drive(steps, goal=(20.0, 0.0), people=(), boxes=()):
    """Poses (n, 3) of an ideal unicycle from the origin, until it arrives, and the least gap to anything [m]."""
    agent, poses, velocity, gap = Dwa(), [np.zeros(3)], np.zeros(2), np.inf
    people, boxes = np.reshape(people, (-1, 2)), np.reshape(boxes, (-1, 5))
    while len(poses) <= steps and np.hypot(*(goal - poses[-1][:2])) > 0.5:
        velocity = agent(observe(poses[-1], goal, people, boxes, velocity)) * TOP
        x, y, yaw = poses[-1]
        middle = yaw + velocity[1] * PERIOD / 2
        way = velocity[0] * PERIOD
        poses.append(np.array([x + way * np.cos(middle), y + way * np.sin(middle), yaw + velocity[1] * PERIOD]))
        gap = min(gap, touch(poses[-1], people, boxes))
    return np.array(poses), gap


def test_in_the_open_it_drives_straight_to_the_goal_at_full_speed():
    assert Dwa()(observe(velocity=(2.0, 0.0))) == pytest.approx([1.0, 0.0])
    assert Dwa()(observe()) == pytest.approx([CONFIG.acceleration * PERIOD, 0.0])  # as fast as it can
    poses, _ = drive(120)
    assert len(poses) < 110 and np.abs(poses[:, 1]).max() < 1e-6


@pytest.mark.parametrize("bearing", [0.3, 1.2, 2.5])
def test_it_turns_towards_the_goal(bearing):
    for side in (1, -1):
        goal = (20 * np.cos(bearing), side * 20 * np.sin(bearing))
        assert side * Dwa()(observe(goal=goal))[1] > 0.3


def test_the_window_is_what_the_motors_reach_in_a_period():
    agent = Dwa()
    speed, rate = agent.window(np.array([1.0, -0.5]), bearing=3.0)
    assert (speed.min(), speed.max()) == pytest.approx((0.35, 1.65))
    assert (rate.min(), rate.max()) == pytest.approx((-2.0, 1.3))
    speed, rate = agent.window(np.array([1.9, 2.6]))  # pushed beyond what it may command
    assert (speed.min(), speed.max()) == pytest.approx((1.25, 2.0))
    assert (rate.min(), rate.max()) == pytest.approx((0.2, 2.0))


def test_gaps_along_arcs_are_those_of_the_moved_footprint():
    rng = np.random.default_rng(0)
    points, agent = rng.uniform(-2, 3, (30, 2)), Dwa()
    speed, rate = np.array([[1.5], [0.8], [0.0], [-0.6]]), np.array([[0.0], [-1.5], [2.0], [1.0]])
    time = np.tile([0.0, 0.3, 1.1], (4, 1))
    gaps = agent._gaps(speed, rate, time, points)
    for row, (v, w) in enumerate(zip(speed[:, 0], rate[:, 0], strict=True)):
        pose, moments = np.zeros(3), np.rint(time[row] / 1e-3).astype(int)
        for step in range(moments[-1] + 1):  # Euler's method
            if step in moments:
                box = footprint(pose, JACKAL.config)[None]
                outside = np.abs(geometry.in_box_frame(points, box)[:, 0]) - box[0, 2:4]
                expected = outside.max(axis=-1).min()
                assert gaps[row, list(moments).index(step)] == pytest.approx(expected, abs=2e-3)
            pose = pose + 1e-3 * np.array([v * np.cos(pose[2]), v * np.sin(pose[2]), w])


def test_it_can_always_stop_on_its_arc():
    driving = 0
    for people, boxes, scene in scenes(60):
        gap = touch(np.zeros(3), people, boxes)
        speed, rate = Dwa()(scene) * TOP
        if gap < 0.3 or speed <= 0:
            continue
        driving += 1
        duration = PERIOD + speed / (2 * CONFIG.braking * TOP[0])  # at the present speed, as long as it takes to stop
        for time in np.linspace(0, duration, 12):
            chord = speed * time * np.sinc(rate * time / 2 / np.pi)
            pose = np.array([chord * np.cos(rate * time / 2), chord * np.sin(rate * time / 2), rate * time])
            assert touch(pose, people, boxes) > 0
    assert driving > 20


def test_it_never_touches_a_wall_and_finds_its_end():
    poses, gap = drive(300, goal=(12.0, 3.0), boxes=WALL - [0, 4, 0, 0, 0])  # it ends at y = 5
    assert gap > 0.02
    assert np.hypot(*(poses[-1, :2] - [12.0, 3.0])) < 0.5


def test_before_a_wall_without_end_it_does_not_touch_it():
    _, gap = drive(150, boxes=np.concatenate([WALL, [[3.0, 4.0, 3.0, 0.1, 0.0], [3.0, -4.0, 3.0, 0.1, 0.0]]]))
    assert 0.02 < gap < 1.5


def test_it_passes_who_stands_in_the_way():
    poses, gap = drive(150, people=[[5.0, 0.05], [9.0, -0.6]])
    assert gap > 0.1 and np.hypot(*(poses[-1, :2] - [20.0, 0.0])) < 0.5


def test_enclosed_it_turns_on_the_spot_and_backs_out_where_it_cannot():
    ahead = [[0.9, 0.0, 0.1, 2.0, 0.0]]
    speed, rate = Dwa()(observe(goal=(20.0, 5.0), boxes=ahead))
    assert speed == 0 and rate > 0
    beside = [[0.5, s * 0.36, 0.6, 0.1, 0.0] for s in (1, -1)]  # 5 cm to either side
    assert Dwa()(observe(boxes=[[0.5, 0.0, 0.1, 2.0, 0.0], *beside]))[0] < 0


def test_a_mirrored_scan_gives_the_mirrored_action():
    moving = 0
    for _, _, scene in scenes(40):
        action = Dwa()(scene)
        assert Dwa()(mirrored(scene)) == pytest.approx(action * [1, -1], abs=1e-5)
        moving += action[0] > 0
    assert moving > 20


def test_any_scan_gives_an_action_within_the_limits_and_the_agent_is_deterministic():
    rng = np.random.default_rng(0)
    seen = [
        *(scene for _, _, scene in scenes(20)),
        *({**observe(), "lidar": rng.uniform(0.1, top, 720)} for top in (0.2, 1.0, 5.0, 30.0)),
    ]
    agent = Dwa()
    first = np.array([agent(scene) for scene in seen])
    assert np.isfinite(first).all() and (np.abs(first) <= 1).all()
    agent.reset(3)
    np.testing.assert_array_equal(first, [agent(scene) for scene in seen])
