import os
import warnings

import mujoco
import numpy as np
import pytest

from bson.sensors import Imu, Lidar2D
from bson.simulation import contacts
from bson.simulation.world import World
from bson.task import TaskConfig
from macid import geometry
from macid.layout import NoFreeSpace
from macid.state import HEIGHT, RADIUS

SENSORS = (Imu(), Lidar2D())
MAZE = TaskConfig(num_pedestrians=8, obstacle_density=0.6)


def drive(world, ids, steps, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        command = np.stack([rng.uniform(-0.5, 2.0, world.nworld), rng.uniform(-1.5, 1.5, world.nworld)], axis=-1)
        world.step(ids, command[ids])


@pytest.mark.parametrize("model", ["social-force", "orca"])
@pytest.mark.parametrize("obstacle_density", [0.0, 0.5])
def test_a_world_of_a_batch_equals_the_same_world_alone_bit_for_bit(model, obstacle_density):
    config = TaskConfig(num_pedestrians=12, map_size=20.0, goal_distance=(8, 18), obstacle_density=obstacle_density,
                        pedestrian_model=model, pedestrian_period=0.02)  # fmt: skip
    many, alone = World(config, 5, SENSORS), World(config, 1, SENSORS)
    many.reset(range(5), [11, 12, 13, 14, 15])
    alone.reset([0], [14])
    for step in range(40):
        command = np.array([1.0, np.sin(step)])
        many.step(np.arange(5), np.tile(command, (5, 1)) * np.array([[0.2], [0.5], [0.9], [1.0], [-1.0]]))
        alone.step([0], command[None])
    assert np.array_equal(many.qpos[3], alone.qpos[0])
    assert np.array_equal(many.readings["lidar"][3], alone.readings["lidar"][0])
    assert np.array_equal(many.readings["imu"][3], alone.readings["imu"][0])
    assert many.collisions[3] == alone.collisions[0]
    assert not np.array_equal(many.qpos[2], alone.qpos[0])


def test_the_same_seed_is_the_same_episode_and_another_seed_another():
    first, second = (World(MAZE, 2, SENSORS) for _ in range(2))
    first.reset([0, 1], [5, 6])
    second.reset([0, 1], [6, 5])
    drive(first, [0, 1], 3, seed=3)
    first.reset([0, 1], [5, 6])  # a used world begins as a fresh one does
    for world, commands in ((first, [[1.0, 0.2], [0.5, -0.4]]), (second, [[0.5, -0.4], [1.0, 0.2]])):
        for _ in range(20):
            world.step([0, 1], commands)
    assert np.array_equal(first.qpos[0], second.qpos[1])
    assert np.array_equal(first.boxes[0], second.boxes[1])
    assert not np.array_equal(first.boxes[0], first.boxes[1])


def test_each_lidar_beam_agrees_with_mj_ray_and_with_the_analytic_ray():
    world = World(MAZE, 3, SENSORS)
    world.reset(range(3), [1, 2, 3])
    drive(world, np.arange(3), 15)
    lidar = SENSORS[1]
    compared = 0
    for index in range(3):
        model, data = world.model, world.engine.data(index)
        mujoco.mj_forward(model, data)
        site = model.site("robot/lidar").id
        origin, frame = data.site_xpos[site], data.site_xmat[site].reshape(3, 3)
        base = model.body("robot/base").id
        beams = np.stack([np.cos(lidar.angles), np.sin(lidar.angles), 0 * lidar.angles], axis=-1) @ frame.T
        hit = np.zeros(1, np.int32)
        oracle = np.array([mujoco.mj_ray(model, data, origin, beam, None, 1, base, hit) for beam in beams])
        oracle = np.clip(np.where(oracle < 0, lidar.range_max, oracle), lidar.range_min, lidar.range_max)
        reading = world.readings["lidar"][index]
        np.testing.assert_allclose(reading, oracle, atol=1e-5)
        level = beams[:, :2] / np.linalg.norm(beams[:, :2], axis=-1, keepdims=True)
        people = geometry.ray_disc_distance(origin[:2], level, world.people[index, :, :2], RADIUS).min(axis=-1)
        boxes = geometry.ray_box_distance(origin[:2], level, world.boxes[index]).min(axis=-1)
        planar = np.clip(np.minimum(people, boxes), lidar.range_min, lidar.range_max)
        # A wheel on a bump pitches the scanner, so that far beams meet the ground or pass obliquely.
        near = planar < 5.0
        np.testing.assert_allclose(reading[near], planar[near], atol=0.05)
        compared += near.sum()
    assert compared > 100


def test_lidar_sits_at_its_true_height_and_turns_with_the_robot():
    world = World(TaskConfig(num_pedestrians=0), 1, SENSORS)
    world.reset([0], [0])
    for _ in range(10):
        world.step([0], [[0.0, 0.0]])
    data = world.engine.data(0)
    mujoco.mj_forward(world.model, data)
    assert data.site("robot/lidar").xpos[2] == pytest.approx(0.40, abs=0.01)
    x, y, yaw = world.pose[0]
    ahead = np.array([[np.cos(yaw), np.sin(yaw)]])
    origin = np.array([x, y]) + 0.12 * ahead[0]
    expected = geometry.ray_box_distance(origin, ahead, world.boxes[0]).min()
    middle = world.readings["lidar"][0][359:361].mean()
    assert middle == pytest.approx(min(expected, 30.0), abs=0.05)


def test_imu_reads_gravity_at_rest_and_the_yaw_rate_in_a_turn():
    world = World(TaskConfig(num_pedestrians=0), 1, SENSORS)
    world.reset([0], [0])
    for _ in range(10):
        world.step([0], [[0.0, 0.0]])
    np.testing.assert_allclose(world.readings["imu"][0], [0, 0, 9.81, 0, 0, 0], atol=0.05)
    rates = []
    for _ in range(20):
        world.step([0], [[0.0, 1.0]])
        rates.append(world.readings["imu"][0][5])
    assert np.mean(rates[10:]) == pytest.approx(1.0, rel=0.1)


def put(world, pose, people):
    """Robot and people of world 0 to given places, at rest."""
    world.place([0], pose=[pose], people=np.reshape(people, (1, -1, 3)))


@pytest.mark.parametrize(("gap", "touched"), [(0.008, True), (0.03, False)])
def test_a_collision_is_counted_in_physics_steps_by_the_surface_gap(gap, touched):
    world = World(TaskConfig(num_pedestrians=1, pedestrian_model="standing"), 1)
    world.reset([0], [0])
    half = world.config.robot.half_length
    put(world, (0.0, 0.0, 0.0), [[half + RADIUS + gap, 0.0, 0.0]])
    assert world.nearest_person[0] == pytest.approx(gap, abs=1e-9)
    world.step([0], [[0.0, 0.0]])
    assert world.collisions[0] == world.collisions_person[0] == (5 if touched else 0)


@pytest.mark.parametrize(
    ("move", "robot_on_person"),
    [((0.02, 0.0), 5), ((0.0, 0.0), 0), ((-0.005, 0.0), 0), ((0.0, 0.02), 0), ((0.0004, 0.0), 0), ((0.002, 0.01), 5)],
)
def test_who_ran_into_whom_is_told_by_the_robots_move(move, robot_on_person):
    jackal = TaskConfig().robot
    shift = np.arange(1, 6)[:, None] * np.array(move)  # people slide along, so that the contact stays
    pose = np.column_stack([shift, np.zeros(5)])
    ahead, beside = [jackal.half_length + RADIUS + 0.005, 0.0], [0.0, 3.0]  # the second is not touched
    touched, towards = contacts.touches_people(pose, np.tile(move, (5, 1)), shift[:, None] + [ahead, beside], jackal)
    assert touched.sum() == 5 and towards.sum() == robot_on_person


def test_driving_into_a_wall_counts_as_wall_and_pushing_on_counts_on():
    world = World(TaskConfig(num_pedestrians=0), 1)
    world.reset([0], [0])
    put(world, (23.0, 3.0, 0.0), [])
    for _ in range(30):
        world.step([0], [[1.5, 0.0]])
    assert 0 < world.collisions_wall[0] == world.collisions[0] <= 150
    assert world.collisions_person[0] == world.collisions_obstacle[0] == 0
    assert world.pose[0, 0] < 25.0 - 0.2
    halted = world.collisions[0]
    world.step([0], [[1.5, 0.0]])
    assert world.collisions[0] - halted == 5


def test_collision_count_does_not_depend_on_the_control_period():
    counts = []
    for period in (0.02, 0.1):
        world = World(TaskConfig(num_pedestrians=0, control_period=period), 1)
        world.reset([0], [0])
        put(world, (23.0, 3.0, 0.0), [])
        for _ in range(round(3.0 / period)):
            world.step([0], [[1.5, 0.0]])
        counts.append(world.collisions_wall[0])
    assert counts[0] == counts[1] > 0


def test_people_take_notice_of_the_robot():
    config = TaskConfig(num_pedestrians=1, pedestrian_model="orca")
    ways = []
    for place in ((0.0, 0.0), (0.0, 20.0)):
        world = World(config, 1)
        world.reset([0], [0])
        put(world, (*place, 0.0), [[5.0, 0.05, np.pi]])
        world.people_goals[0] = [[-5.0, 0.0]]
        side, nearest = 0.0, np.inf
        for _ in range(60):
            world.step([0], [[0.0, 0.0]])
            side = max(side, abs(world.people[0, 0, 1]))
            nearest = min(nearest, world.nearest_person[0])
        ways.append(side)
        assert world.collisions[0] == 0
    assert ways[0] > 0.5 > 0.2 > ways[1]


def test_people_reach_goals_and_get_new_ones_where_they_stand():
    world = World(TaskConfig(num_pedestrians=6, map_size=20.0, goal_distance=(8, 18)), 1)
    world.reset([0], [4])
    first = world.people_goals[0].copy()
    places = [world.people[0, :, :2].copy()]
    for _ in range(300):
        world.step([0], [[0.0, 0.0]])
        places.append(world.people[0, :, :2].copy())
    changed = (world.people_goals[0] != first).any(axis=-1)
    assert changed.sum() >= 5
    assert np.linalg.norm(np.diff(places, axis=0), axis=-1).max() < 0.2  # nobody is moved by hand


def test_people_in_a_maze_follow_waypoints_and_stay_off_the_walls():
    world = World(TaskConfig(num_pedestrians=10, obstacle_density=1.0), 1)
    world.reset([0], [2])
    assert (world.people_goals[0] != world.destinations(0)).any()
    start = world.people[0, :, :2].copy()
    for _ in range(150):
        world.step([0], [[0.0, 0.0]])
        clear = geometry.point_box_distance(world.people[0, :, :2], world.boxes[0][None]).min(axis=-1)
        assert clear.min() > RADIUS - 0.05
    moved = np.linalg.norm(world.people[0, :, :2] - start, axis=-1)
    assert np.median(moved) > 3.0


def test_pedestrians_may_decide_more_often_than_the_robot():
    fast = World(TaskConfig(num_pedestrians=4, pedestrian_period=0.02), 1)
    slow = World(TaskConfig(num_pedestrians=4, pedestrian_period=0.1), 1)
    for world in (fast, slow):
        world.reset([0], [0])
        for _ in range(10):
            world.step([0], [[0.0, 0.0]])
    assert np.abs(fast.people - slow.people).max() < 0.3
    assert not np.array_equal(fast.people, slow.people)


def test_rays_pass_the_robot_but_films_show_it():
    world = World(TaskConfig(num_pedestrians=0), 1, SENSORS)
    for model, seen in ((world.model, False), (world.scene, True)):
        own = [i for i in range(model.ngeom) if model.body(model.geom_bodyid[i]).name.startswith("robot/")]
        rgba = np.where(model.geom_matid[own, None] < 0, model.geom_rgba[own], model.mat_rgba[model.geom_matid[own]])
        assert (rgba[:, 3] > 0).any() == seen
    assert (world.model.nq, world.model.nsensordata) == (world.scene.nq, world.scene.nsensordata)


def test_the_scene_has_people_as_tall_as_the_paper_says():
    world = World(TaskConfig(num_pedestrians=1), 1)
    assert world.model.geom("person0/cylinder").size[:2] == pytest.approx([RADIUS, HEIGHT / 2])


def test_a_process_forked_after_the_first_decision_is_told_instead_of_hanging():
    world = World(TaskConfig(num_pedestrians=1), 1)
    world.reset([0], [0])
    world.step([0], [[0.0, 0.0]])
    reader, writer = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Python and JAX warn of the fork
        child = os.fork()
    if child == 0:
        try:
            world.step([0], [[0.0, 0.0]])
        except RuntimeError as error:
            os.write(writer, str(error).encode())
        os._exit(0)
    os.waitpid(child, 0)
    assert b"spawn" in os.read(reader, 1000)


def test_small_maps_run_on_and_a_failed_reset_changes_nothing():
    world = World(TaskConfig(num_pedestrians=6, map_size=12.0, goal_distance=(4, 8)), 2)
    world.reset([0, 1], [1, 3])
    for _ in range(240):
        world.step([0, 1], np.zeros((2, 2)))
    crowded = World(TaskConfig(num_pedestrians=60, map_size=14.0, goal_distance=(4, 8)), 1)
    crowded.reset([0], [0])
    before = crowded.qpos[0].copy()
    crowded.config = crowded.config.replace(goal_distance=(30, 40))
    with pytest.raises(NoFreeSpace):
        crowded.reset([0], [1])
    assert crowded.seed[0] == 0 and np.array_equal(crowded.qpos[0], before)


CALM = TaskConfig(num_pedestrians=4, map_size=20.0, goal_distance=(6, 15), pedestrian_model="social-force")


@pytest.fixture(scope="module")
def calm():
    """Two worlds after two control steps, and how the second one goes on: (world, its (3, nq) qpos)."""
    world = World(CALM, 2, SENSORS)
    world.reset([0, 1], [1, 2])
    expected = []
    for _ in range(5):
        world.step([0, 1], np.ones((2, 2)))
        expected.append(world.qpos[1].copy())
    return world, expected


@pytest.mark.parametrize(
    ("field", "place", "value", "told"),
    [
        ("qvel", 0, np.nan, "QVEL at DOF 0, person0/x"),
        ("qvel", 5, np.inf, "QVEL at DOF 5, person1/yaw"),
        ("qvel", 12, 1e30, "QVEL at DOF 12, robot"),
        ("qvel", 19, np.nan, "QVEL at DOF 19, robot/rear_left_wheel"),
        ("qpos", 4, np.nan, "QPOS at DOF 4, person1/y"),
        ("qvel", 3, 1e4, "person1/x moves at"),  # finite, and absurd
        ("people_goals", 2, np.nan, "CTRL at ACTUATOR"),  # whoever decides says what is no number
    ],
)
def test_failed_physics_is_named_and_stays_in_its_world(calm, field, place, value, told, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings there
    world, expected = calm
    world.reset([0, 1], [1, 2])
    for _ in range(2):
        world.step([0, 1], np.ones((2, 2)))
    before = world.qpos[0].copy(), world.readings["lidar"][0].copy(), world.pose[0].copy()
    broken = world.people_goals if field == "people_goals" else getattr(world.engine, field)
    broken[0].reshape(-1)[place] = value
    for step in range(2, 5):
        world.step([0, 1], np.ones((2, 2)))
        assert told in world.fault[0] and world.fault[1] == ""
        assert np.array_equal(world.qpos[1], expected[step])
        assert (world.steps[0], world.time[0]) == (2, 0.2)
        for now, then in zip((world.qpos[0], world.readings["lidar"][0], world.pose[0]), before, strict=True):
            assert np.array_equal(now, then)
    world.reset([0], [2])
    for _ in range(5):
        world.step([0], np.ones((1, 2)))
    assert world.fault[0] == "" and np.array_equal(world.qpos[0], expected[4])


@pytest.mark.parametrize("period", [0.02, 0.1])
def test_physics_that_fails_everywhere_is_named(period, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings there
    world = World(TaskConfig(num_pedestrians=2, map_size=20.0, goal_distance=(6, 15), pedestrian_period=period))
    world.reset([0], [1])
    world.engine.qvel[0, 0] = 1e9
    for _ in range(2):
        world.step([0], np.ones((1, 2)))
        assert world.fault[0] and world.steps[0] == 0


def test_a_world_without_its_robot_has_the_same_people_who_see_none():
    config = TaskConfig(num_pedestrians=4, map_size=20.0, goal_distance=(6, 15))
    with_one, without = World(config), World(config, with_robot=False)
    for world in (with_one, without):
        world.reset([0], [4])
    assert np.array_equal(with_one.people, without.people)
    assert np.array_equal(with_one.destinations(0), without.destinations(0))
    state = with_one.people[0, 0, :2] + [0.75, 0.0]
    put(with_one, (*state, 0.0), with_one.people[0])  # in somebody's face
    for world in (with_one, without):
        for _ in range(10):
            world.step([0], [[0.0, 0.0]])
    assert np.abs(with_one.people[0, 0] - without.people[0, 0]).max() > 0.01
    assert without.nearest_person[0] > 500.0 and without.collisions[0] == 0 and without.fault[0] == ""


def test_people_walk_to_and_fro_on_their_routes():
    config = TaskConfig(map="hall", num_pedestrians=3, pedestrian_model="social-force-bodies")
    world = World(config)
    world.reset([0], [2])
    routes = world.layouts[0].routes
    ends, seen = np.array([route[[0, -1]] for route in routes]), [set() for _ in routes]
    for _ in range(450):
        world.step([0], [[0.0, 0.0]])
        distance = np.linalg.norm(ends - world.people[0, :, None, :2], axis=-1)
        for person, end in np.argwhere(distance < 1.0):
            seen[person].add(int(end))
    assert all(both == {0, 1} for both in seen)


def test_in_a_mixed_crowd_each_person_moves_as_its_model_does():
    mixed = TaskConfig(num_pedestrians=6, map_size=20.0, goal_distance=(5.0, 15.0))
    mixed = mixed.replace(pedestrian_model={"orca": 0.5, "social-force": 0.5})
    world = World(mixed)
    world.reset([0], [4])
    assert 0 < world.models[0].sum() < 6
    world.step([0], [[0.0, 0.0]])
    for number, name in enumerate(("orca", "social-force")):
        alone = World(mixed.replace(pedestrian_model=name))
        alone.reset([0], [4])
        alone.step([0], [[0.0, 0.0]])
        of_it = world.models[0] == number
        np.testing.assert_allclose(world.people[0, of_it], alone.people[0, of_it], atol=1e-5)
        assert np.abs(world.people[0, ~of_it] - alone.people[0, ~of_it]).max() > 1e-3
