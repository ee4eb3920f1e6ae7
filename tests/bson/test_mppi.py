"""Path integral control on an ideal unicycle among people who give no way: with the map, and by the LIDAR alone."""

import math

import numpy as np
import pytest

from bson.agents import Setting
from bson.agents.mppi import Mppi
from bson.agents.mppi_local import MppiLocal
from bson.agents.mppi_policy import MppiPolicy
from bson.agents.rollout import going_on
from bson.agents.scan import Scan
from bson.agents.scan_map import ScanMap
from bson.agents.sfm_planner import SfmPlanner
from bson.agents.tracking import Tracking, TrackingConfig
from bson.episodes.tracks import make_track
from bson.planners import Grid, path_cost, plan, shortcut
from bson.planners.way_field import way_field
from bson.robot import JACKAL, footprint, load_robot
from bson.sensors import Lidar2D
from bson.task import TaskConfig
from macid import geometry
from macid.layout import Layout
from macid.routing import occupancy_grid
from macid.state import RADIUS

PERIOD, TOP, GOAL, SIZE = 0.1, np.array([2.0, 2.0]), np.array([10.0, 0.0]), 26.0
NOBODY, NOTHING = np.zeros((0, 2)), np.zeros((0, 5))
# Open towards the robot: a wall across the way at x = 5, and one along each side.
TRAP = np.array([[5.0, 0.0, 0.2, 2.5, 0.0], [3.5, 2.5, 1.7, 0.2, 0.0], [3.5, -2.5, 1.7, 0.2, 0.0]])
# Across the way at x = 5, with a door straight ahead and another one aside.
DOORS = np.array([[5.0, -7.1, 0.125, 5.9, 0.0], [5.0, 3.1, 0.125, 1.9, 0.0], [5.0, 10.5, 0.125, 2.5, 0.0]])
JAM = np.array([[x, y] for x in (4.4, 5.2) for y in (-0.8, 0.0, 0.8)])
LIDAR = Lidar2D()
SCAN = Scan(Setting.default())
KINDS = {"mppi": Mppi, "mppi-policy": MppiPolicy, "mppi-local": MppiLocal}


def layout_of(walls):
    return Layout(SIZE, walls)


def observe(pose, goal, people, velocity, walls, occupied):
    """A Global observation, with a scan."""
    origin = pose[:2] + geometry.rotate(SCAN.place, pose[2])
    rays = geometry.heading(pose[2] + LIDAR.angles)
    distance = geometry.ray_box_distance(origin, rays, layout_of(walls).boxes).min(axis=-1)
    if len(people):
        distance = np.minimum(distance, geometry.ray_disc_distance(origin, rays, people, RADIUS).min(axis=-1))
    return {
        "goal": geometry.to_body(goal - pose[:2], pose[2]).astype(np.float32),
        "velocity": np.asarray(velocity, np.float32),
        "lidar": np.clip(distance, LIDAR.range_min, LIDAR.range_max).astype(np.float32),
        "map": occupied.astype(np.uint8),
        "map_origin": np.full(2, -SIZE / 2, np.float32),
        "map_resolution": np.array([0.25], np.float32),
        "pose": np.asarray(pose, np.float32),
        "people": np.asarray(people, np.float32),
    }


def drive(agent, people=NOBODY, walk=NOBODY, walls=NOTHING, steps=200, seed=0):
    """Poses (n, 3) from the origin until the GOAL, and the least gaps [m] to people, who walk straight on, and to
    walls."""
    agent.reset(seed)
    pose, velocity, gaps = np.zeros(3), np.zeros(2), [np.inf, np.inf]
    poses, people = [pose], np.reshape(people, (-1, 2)).astype(float)
    occupied = occupancy_grid(layout_of(walls), 0.25, 0.0)
    while len(poses) <= steps and math.dist(GOAL, pose[:2]) > 0.5:
        wanted = np.asarray(agent(observe(pose, GOAL, people, velocity, walls, occupied)), float) * TOP
        speed = velocity[0] + np.clip(wanted[0] - velocity[0], -0.65, 0.65)
        middle = pose[2] + wanted[1] * PERIOD / 2
        ahead = (velocity[0] + speed) / 2 * PERIOD * np.array([np.cos(middle), np.sin(middle)])
        pose, people = (
            np.append(pose[:2] + ahead, pose[2] + wanted[1] * PERIOD),
            people + PERIOD * np.reshape(walk, (-1, 2)),
        )
        velocity = np.array([speed, wanted[1]])
        poses.append(pose)
        box = footprint(pose, JACKAL.config)
        gaps[0] = min(gaps[0], geometry.point_box_distance(people, box[None]).min(initial=np.inf) - RADIUS)
        gaps[1] = min(gaps[1], geometry.box_box_gap(box, layout_of(walls).boxes).min())
    return np.array(poses), *gaps


@pytest.fixture(scope="module")
def agents():
    return {name: kind() for name, kind in KINDS.items()}


# --- the field


def test_in_the_open_the_way_is_the_straight_line():
    grid = Grid(np.zeros((60, 80), bool), 0.25, (-3.0, 1.0))
    goal = np.array([4.1, 6.3])
    field = way_field(grid, goal, np.ones(grid.shape))
    straight = np.hypot(*(grid.centres(np.argwhere(~grid.occupied)) - goal).T).reshape(grid.shape)
    assert np.abs(field - straight).max() < 0.3
    far = straight > 4.0
    assert (np.abs(field - straight)[far] / straight[far]).max() < 0.05


@pytest.mark.parametrize("seed", [0, 1])
def test_around_walls_the_way_is_no_longer_than_a_planners_and_hardly_shorter(seed):
    rng = np.random.default_rng(seed)
    occupied = np.zeros((60, 60), bool)
    for _ in range(12):
        i, j, tall = *rng.integers(0, 60, 2), rng.random() < 0.5
        occupied[i : i + (20 if tall else 2), j : j + (2 if tall else 20)] = True
    grid = Grid(occupied, 0.25, (0.0, 0.0))
    free = grid.centres(np.argwhere(grid.regions == np.bincount(grid.regions[~occupied]).argmax()))
    goal, starts = free[0], free[rng.integers(0, len(free), 10)]
    field = way_field(grid, goal, np.where(occupied, 1e4, 1.0))
    for start in starts:
        planned = path_cost(shortcut(plan("astar", grid, start, goal), grid), grid)
        here = float(field[tuple(grid.cells(start))])
        assert 0.93 * planned - 0.3 < here < 1.05 * planned + 0.3


def test_a_dearer_region_is_gone_round():
    grid = Grid(np.zeros((40, 40), bool), 0.25, (0.0, 0.0))
    rate = np.ones(grid.shape)
    rate[15:25, 10:30] = 50.0
    field = way_field(grid, np.array([5.0, 9.0]), rate)
    around = 2 * np.hypot(2.5, 2.75) + 2.5  # from (5, 1) past the corners at x = 2.5
    assert field[tuple(grid.cells([5.0, 1.0]))] == pytest.approx(around, rel=0.06)


# --- driving


@pytest.mark.parametrize("name", KINDS)
def test_in_the_open_it_drives_straight_at_top_speed(agents, name):
    poses, _, _ = drive(agents[name])
    assert len(poses) - 1 <= 9.5 / 2.0 / PERIOD + 5
    assert np.abs(poses[:, 1]).max() < 0.3


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("aside", [0.0, 0.3])
def test_who_stands_in_the_way_is_never_touched(agents, name, aside):
    poses, gap, _ = drive(agents[name], [[4.0, aside], [7.0, -aside]], np.zeros((2, 2)))
    assert gap > 0.05
    assert math.dist(poses[-1, :2], GOAL) <= 0.5


@pytest.mark.parametrize("name", ["mppi", "mppi-local"])
def test_it_keeps_clear_of_people_who_come_and_cross(agents, name):
    people, walk = (
        [[9.0, 0.1], [5.0, -4.0], [8.0, 5.0], [3.0, 5.0]],
        [[-1.4, 0.0], [0.0, 1.3], [0.0, -1.0], [0.3, -1.4]],
    )
    poses, gap, _ = drive(agents[name], people, walk)
    assert gap > 0.05
    assert math.dist(poses[-1, :2], GOAL) <= 0.5


@pytest.mark.parametrize("name", ["mppi", "mppi-local", "sfm-planner"])
def test_out_of_a_trap_it_arrives_without_touching_a_wall(agents, name):
    agent = agents.get(name) or SfmPlanner()
    poses, _, gap = drive(agent, walls=TRAP, steps=300)
    assert math.dist(poses[-1, :2], GOAL) <= 0.5
    assert gap > 0.01
    if name == "mppi":  # which knows the map: around it from the first
        assert len(poses) - 1 < 75


@pytest.mark.parametrize("name", KINDS)
def test_round_a_long_thin_wall_it_drives_however_near_the_goal_is_behind_it(agents, name):
    poses, _, gap = drive(agents[name], walls=np.array([[1.5, 2.0, 0.125, 11.0, 0.0]]), steps=400)
    assert math.dist(poses[-1, :2], GOAL) <= 0.5
    assert gap > 0.01


@pytest.mark.parametrize("name", KINDS)
def test_where_people_stand_in_a_door_it_takes_another(agents, name):
    poses, gap, _ = drive(agents[name], JAM, np.zeros_like(JAM), walls=DOORS, steps=300)
    assert math.dist(poses[-1, :2], GOAL) <= 0.5
    assert poses[:, 1].max() > 5.0 and gap > 0.05
    poses, _, _ = drive(agents[name], walls=DOORS)
    assert np.abs(poses[:, 1]).max() < 1.0


def test_a_mirrored_world_gives_the_mirrored_action(agents):
    agent = agents["mppi"]
    rng, flip = np.random.default_rng(0), np.array([1.0, -1.0])
    occupied = occupancy_grid(layout_of(NOTHING), 0.25, 0.0)
    for _ in range(3):
        people, walk = rng.uniform([1, -4], [6, 4], (5, 2)), rng.normal(0, 1, (5, 2))
        actions = []
        for sign in (np.ones(2), flip):
            agent.reset(0)
            for when in (-PERIOD, 0.0):
                pose = np.array([0.125, 0.125, 0.2]) * [*sign, sign[1]]  # in a cell's middle: so is its mirror image
                seen = observe(pose, sign * [9, 1], sign * (people + when * walk), sign * [1.0, 0.3], NOTHING, occupied)
                action = agent(seen)
            actions.append(action * sign)
        assert actions[1] == pytest.approx(actions[0], abs=0.05)


@pytest.mark.parametrize("name", KINDS)
def test_the_same_seed_gives_the_same_actions_within_the_limits_in_any_crowd(agents, name):
    rng, agent = np.random.default_rng(0), agents[name]
    occupied = occupancy_grid(layout_of(TRAP), 0.25, 0.0)
    for number in (0, 3, 120):
        people = rng.uniform(-9, 9, (number, 2))
        poses = [np.array([0.1 * step, 0.0, 0.1]) for step in range(3)]
        seen = [observe(pose, GOAL, people, [1.0, 0.0], TRAP, occupied) for pose in poses]
        runs = []
        for seed in (1, 1, 2):
            agent.reset(seed)
            runs.append(np.array([agent(each) for each in seen]))
        np.testing.assert_array_equal(runs[0], runs[1])
        assert np.isfinite(runs).all() and (np.abs(runs) <= 1).all()


@pytest.mark.parametrize("robot", ["diffbot", "courier"])
def test_a_plan_keeps_to_the_robots_own_limits(robot):
    agent = Mppi(Setting.of(TaskConfig(robot=robot), make_track("global", "lidar2d")))
    agent(observe(np.zeros(3), GOAL, NOBODY, [0.0, 0.0], TRAP, occupancy_grid(layout_of(TRAP), 0.25, 0.0)))
    way, top = agent._controller.planned, load_robot(robot).config.max_speed
    assert way is not None and np.hypot(*np.diff(way, axis=0).T).max() <= top * PERIOD + 1e-4


# --- what it knows


def test_people_are_foreseen_as_they_walk():
    ways = going_on(np.array([[1.0, 2.0]]), np.array([[1.0, -0.5]]), np.array([0.1, 1.0]))
    np.testing.assert_allclose(ways, [[[1.1, 1.95], [2.0, 1.5]]])


def test_by_the_policy_a_lone_person_goes_on_and_one_before_a_wall_does_not_walk_through_it(agents):
    agent = agents["mppi-policy"]
    agent.reset(0)
    wall = np.array([[4.0, 3.0, 0.2, 3.0, 0.0]])
    occupied = occupancy_grid(layout_of(wall), 0.25, 0.0)
    for when in (-PERIOD, 0.0):
        people = np.array([[-6.0 + 1.4 * when, -6.0], [2.6 + 1.4 * when, 3.0]])
        agent(observe(np.zeros(3), GOAL, people, [0.0, 0.0], wall, occupied))
    ways = agent._predicted(np.arange(2))
    after = np.array([-6.0 + 1.4, -6.0])
    np.testing.assert_allclose(ways[0, 9], after, atol=0.2)
    assert ways[1, 9, 0] < 4.0 - 0.2


def test_the_map_of_its_scans_has_the_walls_and_forgets_what_was_no_wall():
    walls, position, rotation = layout_of(TRAP).boxes, np.zeros(2), np.eye(2)
    own = ScanMap(SCAN, 1.5 * SIZE, 0.25, np.zeros(2))
    nobody, occupied = np.zeros(LIDAR.beams, bool), occupancy_grid(layout_of(TRAP), 0.25, 0.0)
    with_people = observe(np.zeros(3), GOAL, np.array([[2.0, 0.5]]), [0, 0], TRAP, occupied)["lidar"].astype(float)
    without = observe(np.zeros(3), GOAL, NOBODY, [0, 0], TRAP, occupied)["lidar"].astype(float)
    for _ in range(4):
        own.add(with_people, nobody, position, rotation)
    places = own.grid.centres(np.argwhere(own.occupied))
    stands = np.hypot(*(places - [2.0, 0.5]).T) < RADIUS + 0.2
    assert stands.any()
    assert geometry.point_box_distance(places[~stands], walls).min(axis=-1).max() < 0.2  # half a cell's diagonal
    for _ in range(4):
        own.add(without, nobody, position, rotation)
    places = own.grid.centres(np.argwhere(own.occupied))
    assert not (np.hypot(*(places - [2.0, 0.5]).T) < RADIUS + 0.2).any()
    across = np.abs(places - [4.8, 0.0]).max(axis=-1) < 0.3
    assert across.any()


def test_who_stands_is_remembered_out_of_sight_until_seen_to_be_gone_or_long_ago():
    occupied = occupancy_grid(layout_of(NOTHING), 0.25, 0.0)
    tracking = Tracking(Setting.default(), TrackingConfig())
    stands, steps = np.array([3.0, 1.0]), round(TrackingConfig().standing_memory / PERIOD)

    def look(yaw, people):
        """Where people stand, in the world's frame, and how many are known; the robot turns on the spot."""
        seen = observe(np.array([0.0, 0.0, yaw]), GOAL, people, [0.0, 0.0], NOTHING, occupied)
        tracking.see(seen["goal"].astype(float), seen["velocity"].astype(float), seen)
        places, standing = tracking.crowd()
        return places[standing] + GOAL, len(places)

    yaws = [*np.zeros(10), *np.linspace(0.0, math.pi, 16)]  # in the end away from them: the LIDAR has 270 degrees
    for step, yaw in enumerate(yaws):
        found, known = look(yaw, np.array([stands, [6.0, -3.0 + 1.3 * PERIOD * step]]))
        if step == 9:
            assert found == pytest.approx(stands[None], abs=0.05) and known == 2
    for _ in range(30):
        found, known = look(math.pi, NOBODY)
    assert found == pytest.approx(stands[None], abs=0.15) and known == 1
    for _ in range(steps):
        known = look(math.pi, NOBODY)[1]
    assert known == 0
    tracking.forget()
    for _ in range(10):
        known = look(0.0, stands[None])[1]
    assert known == 1
    for _ in range(6):
        known = look(0.0, NOBODY)[1]
    assert known == 0
