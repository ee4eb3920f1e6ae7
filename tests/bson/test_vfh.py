"""The scripted avoider drives to the goal, around walls and people, on synthetic scans and in the benchmark."""

import math

import numpy as np
import pytest

from bson.agents import load_agent
from bson.agents.vfh import Vfh
from bson.episodes.tracks import make_track
from bson.evaluation.metrics import sns
from bson.evaluation.play import run_episodes
from bson.sensors import Lidar2D
from bson.task import TaskConfig

LIDAR = Lidar2D()
MOUNT = 0.12  # of the LIDAR ahead of the robot's centre [m]
PERIOD, RADIUS = 0.1, 0.35


def observe(goal=(20.0, 0.0), discs=(), walls=(), velocity=(0.0, 0.0)):
    """The observation of discs (x, y) of a person's radius and wall segments (x0, y0, x1, y1), robot frame."""
    direction = np.stack([np.cos(LIDAR.angles), np.sin(LIDAR.angles)], axis=-1)
    scan = np.full(LIDAR.beams, LIDAR.range_max)
    for disc in discs:
        offset = np.array(disc) - [MOUNT, 0.0]
        along = direction @ offset
        squared = RADIUS**2 - (offset @ offset - along**2)
        hit = (squared >= 0) & (along > 0)
        scan = np.where(hit, np.minimum(scan, along - np.sqrt(np.maximum(squared, 0.0))), scan)
    for x0, y0, x1, y1 in walls:
        start, edge = np.array([x0 - MOUNT, y0]), np.array([x1 - x0, y1 - y0])
        across = direction[:, 0] * edge[1] - direction[:, 1] * edge[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (start[0] * edge[1] - start[1] * edge[0]) / across
            share = (start[0] * direction[:, 1] - start[1] * direction[:, 0]) / across
        hit = (distance > 0) & (share >= 0) & (share <= 1)
        scan = np.where(hit, np.minimum(scan, distance), scan)
    return {
        "goal": np.array(goal, np.float32),
        "velocity": np.array(velocity, np.float32),
        "imu": np.array([0.0, 0.0, 9.81, 0.0, 0.0, 0.0], np.float32),
        "lidar": np.clip(scan, LIDAR.range_min, LIDAR.range_max).astype(np.float32),
    }


def mirrored(observation):
    sign = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0], np.float32)
    return {
        "goal": observation["goal"] * sign[:2],
        "velocity": observation["velocity"] * sign[:2],
        "imu": observation["imu"] * sign,
        "lidar": observation["lidar"][::-1].copy(),
    }


def test_in_the_open_it_drives_straight_to_the_goal_at_full_speed():
    action = Vfh()(observe())
    assert action == pytest.approx([1.0, 0.0], abs=1e-6)


@pytest.mark.parametrize("bearing", [0.3, 1.2, 2.5])
def test_it_turns_towards_the_goal(bearing):
    for side in (1, -1):
        goal = (20 * math.cos(bearing), side * 20 * math.sin(bearing))
        assert side * Vfh()(observe(goal))[1] > 0.3


def test_it_heads_for_the_gap_in_a_wall():
    walls = [(4, -15, 4, 1.5), (4, 3.5, 4, 15)]  # the gap is at 26 to 41 degrees on the left
    agent = Vfh()
    action = agent(observe(walls=walls))
    assert action[0] > 0 and action[1] > 0.5
    assert 0.3 < agent._steered < 0.75


def test_it_estimates_a_crossing_persons_velocity_and_keeps_clear():
    """A person from the right would meet the robot, were it to go on: 4 m ahead of it, in 2 s."""
    agent = Vfh()
    person, velocity = np.array([5.0, -3.5]), np.array([0.0, 1.34])
    x = 0.0
    for _ in range(6):
        action = agent(observe((20.0 - x, 0.0), [person - [x, 0.0]], velocity=(1.0, 0.0)))
        x, person = x + 1.0 * PERIOD, person + velocity * PERIOD
    (place,), (estimate,) = agent.people
    assert np.linalg.norm(estimate - velocity) < 0.15 * np.linalg.norm(velocity)
    assert place == pytest.approx(person - velocity * PERIOD - [x - 0.1, 0.0], abs=0.05)

    heading, position = 0.0, np.array([x, 0.0])
    gap = np.inf
    for _ in range(40):  # a unicycle that does at once what it is told
        speed, rate = 2.0 * action
        heading += rate * PERIOD
        position = position + speed * PERIOD * np.array([math.cos(heading), math.sin(heading)])
        person = person + velocity * PERIOD
        gap = min(gap, np.linalg.norm(person - position) - RADIUS - agent.radius)
        c, s = math.cos(heading), math.sin(heading)
        into = np.array([[c, s], [-s, c]])
        goal, seen = into @ (np.array([20.0, 0.0]) - position), into @ (person - position)
        action = agent(observe(goal, [seen], velocity=(speed, rate)))
    assert gap > 0.1
    assert position[0] > 4.0  # and it went on


def test_people_it_cannot_see_are_remembered_for_a_while():
    agent = Vfh()
    for k in range(12):  # somebody walks from beside the robot to behind it, into the blind sector
        agent(observe(discs=[(-0.5 - 0.1 * k, 1.2)]))
    assert len(agent.people[0]) == 1
    assert agent.people[0][0] == pytest.approx([-1.6, 1.2], abs=0.1)
    for _ in range(30):
        agent(observe())
    assert len(agent.people[0]) == 0


def test_blocked_all_around_it_does_not_drive_ahead():
    walls = [(0.55, -1, 0.55, 1), (-1, 0.55, 1, 0.55), (-1, -0.55, 1, -0.55)]
    assert Vfh()(observe(walls=walls))[0] <= 0


def test_a_mirrored_scan_gives_the_mirrored_action():
    rng = np.random.default_rng(0)
    for _ in range(20):
        discs = rng.uniform([1.0, -4.0], [7.0, 4.0], (3, 2))
        walls = rng.uniform(-6, 6, (2, 4)) + np.array([8, 0, 8, 0])
        here = observe(rng.uniform([3, -8], [20, 8]), discs, walls, rng.uniform([0, -1], [2, 1]))
        action, image = Vfh()(here), Vfh()(mirrored(here))
        assert image == pytest.approx(action * [1, -1], abs=1e-5)


def test_any_scan_gives_a_finite_action_within_bounds():
    rng = np.random.default_rng(0)
    agent = Vfh()
    scans = [np.full(LIDAR.beams, LIDAR.range_min), np.full(LIDAR.beams, LIDAR.range_max)]
    scans += [rng.uniform(0.1, high, LIDAR.beams) for high in (0.2, 1.0, 5.0, 30.0) for _ in range(10)]
    for scan in scans:
        here = observe(rng.uniform(-20, 20, 2), velocity=rng.uniform(-2, 2, 2))
        action = agent({**here, "lidar": scan.astype(np.float32)})
        assert action.shape == (2,) and np.isfinite(action).all() and (np.abs(action) <= 1).all()


def test_reset_forgets_and_the_agent_is_deterministic():
    scenes = [observe(discs=[(4.0, 0.1 * k - 1.0)], velocity=(0.5, 0.0)) for k in range(10)]
    agent = Vfh()
    first = [agent(scene) for scene in scenes]
    agent.reset(3)
    assert np.array_equal(first, [agent(scene) for scene in scenes])


def test_it_scores_well_above_driving_straight():
    """In a maze: among the open map's polite people driving straight already scores near 100."""
    seeds, config = list(range(30000, 30006)), TaskConfig(obstacle_density=0.7, num_pedestrians=6, horizon=250)
    track = make_track("local", "lidar2d")
    score = {
        name: np.mean([sns(episode) for episode in run_episodes(load_agent(name), config, track, seeds, name)])
        for name in ("vfh", "goal")
    }
    assert score["vfh"] > 45
    assert score["vfh"] > score["goal"] + 30
