"""ORCA on ground truth: the map's rectangles, and an ideal unicycle that it drives among people who give no way."""

import numpy as np
import pytest

from bson.agents.orca_oracle import OrcaOracle, OrcaOracleConfig, occupied_boxes
from bson.planners import Grid
from bson.robot import JACKAL, footprint
from macid import geometry
from macid.pedestrians.orca import ORCA
from macid.state import RADIUS

PERIOD, TOP = 0.1, np.array([2.0, 2.0])
NOTHING = np.zeros((120, 120), np.uint8)  # 30 x 30 m
NOBODY = np.zeros((0, 2))


def observe(pose, goal, people=NOBODY, velocity=(0.0, 0.0), walls=NOTHING):
    return {
        "goal": geometry.to_body(np.asarray(goal, float) - pose[:2], pose[2]).astype(np.float32),
        "velocity": np.array(velocity, np.float32),
        "map": walls,
        "map_origin": np.full(2, -15.0, np.float32),
        "map_resolution": np.array([0.25], np.float32),
        "pose": np.asarray(pose, np.float32),
        "people": np.asarray(people, np.float32),
    }


def drive(people, walk, goal=(12.0, 0.0), steps=250, walls=NOTHING):
    """Poses (n, 3) from the origin until the goal, and the least gap to people [m] who walk straight on by `walk`."""
    agent, pose, velocity, gap = OrcaOracle(), np.zeros(3), np.zeros(2), np.inf
    poses, people, walk = [pose], np.reshape(people, (-1, 2)).astype(float), np.reshape(walk, (-1, 2))
    while len(poses) <= steps and np.hypot(*(goal - pose[:2])) > 0.5:
        velocity = agent(observe(pose, goal, people, velocity, walls)) * TOP
        middle = pose[2] + velocity[1] * PERIOD / 2
        ahead = velocity[0] * PERIOD * np.array([np.cos(middle), np.sin(middle)])
        pose, people = np.append(pose[:2] + ahead, pose[2] + velocity[1] * PERIOD), people + PERIOD * walk
        poses.append(pose)
        box = footprint(pose, JACKAL.config)[None]
        gap = min(gap, geometry.point_box_distance(people, box).min(initial=np.inf) - RADIUS)
    return np.array(poses), gap


def test_rectangles_cover_the_occupied_cells_and_the_edge():
    rng = np.random.default_rng(0)
    grid = Grid(rng.random((14, 9)) < 0.4, 0.5, (-3.0, 1.0))
    boxes = occupied_boxes(grid)
    centres = grid.centres(np.argwhere(np.ones((16, 11), bool)) - 1)  # with a ring of cells around the map
    inside = geometry.point_box_distance(centres, boxes) == 0
    occupied = np.pad(grid.occupied, 1, constant_values=True).ravel()
    np.testing.assert_array_equal(inside.sum(axis=-1), occupied)  # in one each
    assert (4 * boxes[:, 2] * boxes[:, 3]).sum() == pytest.approx(occupied.sum() * 0.25)
    assert len(boxes) < 0.6 * occupied.sum()


def test_alone_its_point_moves_as_orca_prefers():
    """(v, w) give the point `ahead` of the centre the velocity (v, ahead w): what a pedestrian would prefer there."""
    config = OrcaOracleConfig()
    for bearing in (0.0, 0.15, -0.15):
        goal = 10.0 * np.array([np.cos(bearing), np.sin(bearing)])
        v, w = OrcaOracle()(observe(np.zeros(3), goal, velocity=(1.8, 0.0))) * TOP
        prefers = ORCA(PERIOD, preferred_speed=config.preferred_speed).preferred_velocity
        expected = prefers(np.array([[config.ahead, 0.0]]), goal[None])[0]
        np.testing.assert_allclose([v, config.ahead * w], expected, atol=1e-4)


def test_in_the_open_it_goes_straight():
    poses, _ = drive(NOBODY, NOBODY)
    assert len(poses) < 12.0 / 1.8 / PERIOD + 3
    assert np.abs(poses[:, 1]).max() < 0.2


@pytest.mark.parametrize("aside", [-0.3, 0.0, 0.3])
def test_who_comes_head_on_is_passed_on_a_side(aside):
    poses, gap = drive([[10.0, aside]], [[-1.4, 0.0]])
    assert gap > 0.02
    assert np.abs(poses[:, 1]).max() > 0.2 and poses[-1, 0] > 11.0


def test_it_keeps_clear_of_people_who_cross():
    poses, gap = drive([[6.0, -4.0], [9.0, 5.0], [4.0, 6.0]], [[0.0, 1.3], [0.0, -1.0], [0.3, -1.4]])
    assert gap > 0.02 and poses[-1, 0] > 11.0


def test_who_stands_is_passed_and_a_wall_is_gone_round():
    walls = NOTHING.copy()
    walls[40:80, 80:82] = 1  # at x = 5 to 5.5, y = -5 to 5
    poses, gap = drive([[2.5, 0.1], [4.0, 5.0]], np.zeros((2, 2)), steps=300, walls=walls)
    assert gap > 0.02 and np.hypot(*(poses[-1, :2] - [12.0, 0.0])) < 0.5
    wall = np.array([[5.25, 0.0, 0.25, 5.0, 0.0]])
    assert min(geometry.box_box_gap(footprint(pose, JACKAL.config), wall)[0] for pose in poses) > 0.02


def test_a_mirrored_scene_gives_the_mirrored_turn():
    """But for the pedestrians' ORCA's own turn by a hundredth to the right."""
    rng = np.random.default_rng(0)
    for _ in range(10):
        people, walk = rng.uniform([1, -4], [6, 4], (5, 2)), rng.normal(0, 1, (5, 2))
        pose, mirror = np.array([0.0, 0.0, 0.2]), np.array([1.0, -1.0])
        actions = []
        for sign in (np.ones(2), mirror):
            agent = OrcaOracle()
            for when in (-PERIOD, 0.0):
                seen = observe(pose * [*sign, sign[1]], sign * [9, 1], sign * (people + when * walk), sign * [1.0, 0.3])
                action = agent(seen)
            actions.append(action * sign)
        assert actions[1] == pytest.approx(actions[0], abs=0.12)


def test_crowds_of_any_size_give_actions_within_the_limits_and_the_agent_is_deterministic():
    rng = np.random.default_rng(0)
    agent = OrcaOracle()
    for number in (0, 3, 200):
        agent.reset(1)
        seen = [observe(rng.uniform(-3, 3, 3), [9, 9], rng.uniform(-9, 9, (number, 2))) for _ in range(5)]
        first = np.array([agent(each) for each in seen])
        assert np.isfinite(first).all() and (np.abs(first) <= 1).all()
        agent.reset(2)
        np.testing.assert_array_equal(first, [agent(each) for each in seen])
