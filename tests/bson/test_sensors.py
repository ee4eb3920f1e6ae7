import dataclasses
import math
import os
import subprocess
import sys

import cv2
import mujoco
import numpy as np
import pytest

from bson.sensors import Camera, DepthCamera, Imu, Lidar2D, Lidar3D, RgbCamera
from bson.simulation.renderer import Renderer
from bson.simulation.world import World
from bson.task import TaskConfig
from macid.drawing.gl import gl_problem
from macid.state import HEIGHT, RADIUS

CROWD = TaskConfig(num_pedestrians=8, map_size=16.0, goal_distance=(4, 12), pedestrian_model="social-force")
MAZE = CROWD.replace(obstacle_density=0.7, map_size=24.0)
EMPTY = TaskConfig(num_pedestrians=0)
draws = pytest.mark.skipif(gl_problem() is not None, reason="needs OpenGL")


def make(config, *sensors, seeds=(0,)):
    """A world for each seed, at the beginning of its episode."""
    world = World(config, len(seeds), sensors)
    world.reset(range(len(seeds)), seeds)
    return world


def put(world, pose=None, people=None):
    """Robot and people of world 0 to given places, at rest."""
    world.place([0], pose=None if pose is None else [pose], people=None if people is None else [people])


def truth(world, index=0):
    """The model as sensors see it, and the data, of one world."""
    data = world.engine.data(index)
    mujoco.mj_forward(world.model, data)
    return world.model, data


def ray(model, data, origin, direction, exclude=-1):
    return mujoco.mj_ray(model, data, origin, direction, None, 1, exclude, np.zeros(1, np.int32))


def optics(world, camera):
    """The camera's place (3,) and its frame (3, 3): columns ahead, left, up."""
    _, data = truth(world)
    seen = data.camera(f"robot/{camera.key}")
    right, up, back = seen.xmat.reshape(3, 3).T
    return seen.xpos, np.stack([-back, -right, up], axis=-1)


def project(world, camera, points):
    """Pixels (N, 2) x, y, continuous, of `points` (N, 3) [m]."""
    place, frame = optics(world, camera)
    ahead, left, up = ((points - place) @ frame).T
    fx, fy = camera.focal
    return np.stack([camera.width / 2 - fx * left / ahead, camera.height / 2 - fy * up / ahead], axis=-1)


@pytest.mark.parametrize("config", [CROWD, MAZE])
def test_each_beam_of_the_3d_lidar_agrees_with_mj_ray(config):
    lidar = Lidar3D(columns=60)
    world = make(config, lidar, seeds=(1, 2))
    for _ in range(10):
        world.step([0, 1], [[0.6, 0.8], [-0.3, -1.0]])
    people = walls = 0
    for index in range(2):
        model, data = truth(world, index)
        site = model.site("robot/lidar3d").id
        origin, frame = data.site_xpos[site], data.site_xmat[site].reshape(3, 3)
        base, hit = model.body("robot/base").id, np.zeros(1, np.int32)
        oracle = np.zeros(lidar.space.shape)
        for row in range(lidar.rows):
            for column in range(lidar.columns):
                up, around = math.radians(-15 + 2 * row), math.radians(-180 + 6 * column)
                beam = [math.cos(up) * math.cos(around), math.cos(up) * math.sin(around), math.sin(up)]
                distance = mujoco.mj_ray(model, data, origin, frame @ beam, None, 1, base, hit)
                oracle[row, column] = lidar.range_max if distance < 0 else distance
                name = model.geom(hit[0]).name if hit[0] >= 0 else ""
                people, walls = people + name.startswith("person"), walls + name.startswith("box")
        np.testing.assert_allclose(world.readings["lidar3d"][index], oracle, atol=1e-5)
    assert people > 20 and walls > 500


def test_the_3d_lidar_sits_at_its_height_and_its_points_lie_on_the_ground():
    lidar = Lidar3D()
    world = make(EMPTY, lidar)
    for _ in range(5):
        world.step([0], [[0.0, 0.0]])
    put(world, (0.0, 0.0, 0.3))
    reading = world.readings["lidar3d"][0]
    assert reading.shape == (16, 360) and reading.dtype == np.float32
    _, data = truth(world)
    height = data.site("robot/lidar3d").xpos[2]
    assert height == pytest.approx(0.385, abs=0.005)
    np.testing.assert_allclose(reading[0], height / math.sin(math.radians(15)), rtol=1e-4)
    assert (reading[-1] == lidar.range_max).all()  # above the walls, which are 25 m away
    points = lidar.points(reading)
    assert points.shape == ((reading < lidar.range_max).sum(), 3)
    low = points[:, 2] < -0.3
    np.testing.assert_allclose(points[low, 2], -height, atol=1e-4)


def test_columns_run_from_behind_over_the_right_to_the_left():
    lidar = Lidar3D(columns=36, rows=3, elevation=(-0.02, 0.02))
    world = make(EMPTY.replace(num_pedestrians=2), lidar, Lidar2D(beams=28))
    put(world, (0.0, 0.0, 1.0), [[5 * math.cos(2.0), 5 * math.sin(2.0), 0.0], [-8, 0, 0]])
    side = lidar.azimuths[world.readings["lidar3d"][0][1].argmin()]
    assert side == pytest.approx(1.0, abs=0.1)  # on the left
    assert lidar.azimuths[0] == -math.pi and lidar.azimuths[18] == 0
    planar = Lidar2D(beams=28).angles[world.readings["lidar"][0].argmin()]
    assert planar == pytest.approx(1.0, abs=0.2)


def test_lidars_see_people_as_their_cylinders():
    world = make(EMPTY.replace(num_pedestrians=1), Lidar2D(), Lidar3D())
    put(world, (0.0, 0.0, 0.0), [[4.0, 0.0, 0.0]])
    assert world.readings["lidar"][0][359:361] == pytest.approx(4.0 - RADIUS - 0.12, abs=2e-3)
    level = world.readings["lidar3d"][0][8]  # 1 degree upwards
    assert level[180] * math.cos(math.radians(1)) == pytest.approx(4.0 - RADIUS, abs=2e-3)
    seen = (np.abs(world.readings["lidar3d"][0][8] - 3.7) < 0.3).sum()
    assert seen == pytest.approx(2 * math.degrees(math.asin(RADIUS / 4.0)), abs=1.5)


@pytest.mark.parametrize("height", [0.05, 0.1, 0.25])
def test_lidars_do_not_see_their_own_robot(height):
    world = make(EMPTY, Lidar2D(position=(0.0, 0.0, height), field=2 * math.pi), Lidar3D())
    put(world, (0.0, 0.0, 0.0))
    assert world.readings["lidar"][0].min() > 10.0  # beams through chassis and wheels
    assert world.readings["lidar3d"][0].min() > 1.4  # the ground


def test_mounts_shift_and_turn_a_sensor():
    sensors = (
        Lidar2D(),
        Lidar2D(key="turned", yaw=math.pi / 2),
        Lidar2D(key="moved", position=(0.5, 0.0, 0.3365)),
        Lidar2D(key="down", pitch=math.pi / 4, beams=3, field=0.2),
    )
    world = make(EMPTY.replace(map_size=20.0, goal_distance=(4, 12)), *sensors)
    put(world, (1.0, 2.0, 0.4))
    reading = {sensor.key: world.readings[sensor.key][0] for sensor in sensors}
    quarter = round(90 / (270 / 719))
    between = np.interp(Lidar2D().angles + math.pi / 2, Lidar2D().angles, reading["lidar"])
    np.testing.assert_allclose(reading["turned"][: 719 - quarter], between[: 719 - quarter], atol=0.05)
    ahead = {key: reading[key][359:361].mean() for key in ("lidar", "moved")}
    assert ahead["lidar"] - ahead["moved"] == pytest.approx(0.38, abs=0.01)
    assert reading["down"][1] == pytest.approx(0.40 * math.sqrt(2), abs=0.01)


@draws
def test_a_box_covers_the_pixels_that_geometry_predicts(tmp_path):
    camera, depth = RgbCamera(), DepthCamera()
    place, turn, worlds = np.array([3.2, 2.6]), 0.4, []
    for number, obstacles in enumerate(([], [[*place.tolist(), 2.0, 0.1, turn]])):
        file = tmp_path / f"map{number}.toml"
        file.write_text(f"size = 50.0\nobstacles = {obstacles}\n")
        worlds.append(make(EMPTY.replace(map=str(file)), camera, depth))
        put(worlds[-1], (0.0, 0.0, 0.7))
    without, world = worlds[0].readings, worlds[1]
    half = world.model.geom("box4").size
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    c, s = math.cos(turn), math.sin(turn)
    corners = corners @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [*place, half[2]]
    outline = cv2.convexHull(project(world, camera, corners).astype(np.float32))
    middles = np.mgrid[:120, :160].reshape(2, -1).T[:, ::-1] + 0.5
    inside = np.array([cv2.pointPolygonTest(outline, pixel, True) for pixel in middles.tolist()]).reshape(120, 160)
    assert 500 < (inside > 0).sum() < 15_000
    for key, changed in (
        ("rgb", (world.readings["rgb"][0] != without["rgb"][0]).any(axis=-1)),
        ("depth", np.abs(world.readings["depth"][0] - without["depth"][0]) > 1e-3),
    ):
        assert changed[inside > 1].mean() > 0.999, key  # a pixel's colour may be the same by chance
        assert not changed[inside < -1].any(), key


@draws
def test_the_camera_looks_ahead_from_the_robots_front():
    camera = RgbCamera()
    world = make(EMPTY, camera)
    put(world, (1.0, -2.0, 0.5))
    place, frame = optics(world, camera)
    np.testing.assert_allclose(place, [1 + 0.216 * math.cos(0.5), -2 + 0.216 * math.sin(0.5), 0.272], atol=1e-3)
    np.testing.assert_allclose(frame[:, 0], [math.cos(0.5), math.sin(0.5), 0.0], atol=1e-6)
    edges = project(world, camera, place + np.array([[1, math.tan(math.radians(69 / 2)), 0.0]]) @ frame.T)
    assert edges[0, 0] == pytest.approx(0.0, abs=1e-6)
    upper = project(world, camera, place + np.array([[1, 0.0, math.tan(math.radians(42 / 2))]]) @ frame.T)
    assert upper[0, 1] == pytest.approx(0.0, abs=1e-6)


@draws
@pytest.mark.parametrize(
    "camera",
    [
        DepthCamera(),
        DepthCamera(field=(math.radians(85), math.radians(58)), width=106, height=60, range_max=40.0),
        DepthCamera(position=(-0.1, 0.1, 0.5), yaw=2.5, pitch=0.3),
    ],
)
def test_depth_agrees_with_mj_ray_within_a_centimetre(camera):
    world = make(MAZE, camera, seeds=(3,))
    near = [[2.0, 0.4, 0.0], [4.0, -1.0, 0.0], [-1.5, 1.0, 0.0], [-3.0, -2.0, 0.0]]
    put(world, (0.0, 0.0, 0.0), near + [[8.0, float(y), 0.0] for y in range(-3, 1)])
    reading = world.readings["depth"][0]
    assert reading.shape == (camera.height, camera.width) and reading.dtype == np.float32
    model, data = truth(world)
    place, frame = optics(world, camera)
    compared = people = 0
    for row in range(1, camera.height - 1, 4):
        for column in range(1, camera.width - 1, 4):
            directions = camera.directions[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3) @ frame.T
            oracle = np.array([ray(model, data, place, one) for one in directions])  # 1 along the optical axis
            oracle = np.clip(np.where(oracle < 0, np.inf, oracle), camera.range_min, camera.range_max)
            if np.ptp(oracle) < 0.05 * oracle[4]:  # no edge runs by
                compared += 1
                assert reading[row, column] == pytest.approx(oracle[4], abs=0.01), (row, column)
                people += 0.5 < oracle[4] < 5.0
    assert compared > 0.5 * (camera.height // 4) * (camera.width // 4)
    assert people > 20


@draws
def test_a_person_is_seen_as_a_true_cylinder():
    camera = DepthCamera()
    world = make(EMPTY.replace(num_pedestrians=1), camera, RgbCamera())
    put(world, (0.0, 0.0, 0.0), [[3.216, 0.0, 0.0]])
    seen = np.abs(world.readings["depth"][0] - 3.0 + RADIUS / 2) < 0.3
    columns = np.flatnonzero(seen[30])
    half = camera.focal[0] * math.tan(math.asin(RADIUS / 3.0))
    assert abs(columns[0] - (80 - half)) <= 1 and abs(columns[-1] + 1 - (80 + half)) <= 1
    assert world.readings["depth"][0][60, 80] == pytest.approx(3.0 - RADIUS, abs=0.01)
    foot = np.flatnonzero(seen[:, 80])[-1] + 1
    assert abs(foot - project(world, camera, np.array([[3.216 - RADIUS, 0.0, 0.0]]))[0, 1]) <= 1
    assert 3.0 * math.tan(math.radians(21)) < HEIGHT  # the head is above the picture
    green = world.readings["rgb"][0][60, 80].astype(int)
    assert green[1] > green[0] + 20 and green[1] > green[2] + 20


@draws
def test_whom_the_front_touches_fills_the_picture():
    world = make(EMPTY.replace(num_pedestrians=1), DepthCamera(), RgbCamera())
    put(world, (0.0, 0.0, 0.0), [[world.robot.config.half_length + RADIUS - 0.005, 0.0, 0.0]])
    assert (world.readings["depth"][0] == DepthCamera().range_min).all()
    red, green, blue = world.readings["rgb"][0].reshape(-1, 3).astype(int).T
    assert (green > red + 20).all() and (green > blue + 20).all()


@draws
def test_pictures_have_no_shadows_and_no_robot_in_them():
    around = RgbCamera(position=(0.0, 0.0, 0.1), pitch=0.5, field=(2.0, 2.0))  # inside the chassis
    world = make(EMPTY.replace(num_pedestrians=1), around)
    put(world, (0.0, 0.0, 0.0), [[-3.0, 0.0, 0.0]])
    rgb = world.readings["rgb"][0][80:]  # the ground
    assert rgb.min() > 100 and np.ptp(rgb.mean(axis=-1)) < 60
    put(world, (0.0, 0.0, 0.0), [[-0.9, -0.6, 0.0]])  # between the sun and the ground ahead
    np.testing.assert_array_equal(world.readings["rgb"][0][80:], rgb)


@draws
def test_cameras_of_one_view_share_one_drawing(monkeypatch):
    drawn, draw = [], Renderer._draw
    monkeypatch.setattr(Renderer, "_draw", lambda self, *args: (drawn.append(args[1:3]), draw(self, *args)))
    wide = DepthCamera(key="wide", field=(math.radians(85), math.radians(58)), width=64, height=48)
    world = make(CROWD, RgbCamera(), DepthCamera(), wide, seeds=(0, 1))
    assert len(drawn) == 4  # two views of two worlds
    world.step([1], [[1.0, 0.0]])
    assert len(drawn) == 6 and all(index == 1 for _, index in drawn[4:])


@draws
def test_a_depth_reading_gives_its_points():
    camera = DepthCamera()
    world = make(CROWD, camera)
    reading = world.readings["depth"][0]
    points = camera.points(reading)
    place, frame = optics(world, camera)
    ground = place + points @ frame.T
    assert len(points) == (reading < camera.range_max).sum() > 1000
    assert ground[:, 2].min() == pytest.approx(0.0, abs=0.02)
    np.testing.assert_allclose(points[:, 0], reading[reading < camera.range_max], rtol=1e-6)


ALL = (Imu(), Lidar2D(beams=90), Lidar3D(columns=24))
if gl_problem() is None:
    ALL += (RgbCamera(width=40, height=30), DepthCamera(width=40, height=30))
NOISY = tuple(dataclasses.replace(sensor, noise=1.0) for sensor in ALL)


@pytest.mark.parametrize("sensors", [ALL, NOISY])
def test_readings_of_a_batch_equal_those_of_the_world_alone_bit_for_bit(sensors):
    many = World(CROWD, 4, sensors)
    many.reset(range(4), [11, 12, 13, 14])
    alone = make(CROWD, *sensors, seeds=(13,))
    for step in range(8):
        command = [0.8, math.sin(step)]
        if step == 4:  # a neighbour begins anew
            many.reset([0, 3], [5, 6])
        many.step([0, 1, 2] if step % 2 else [2, 3], np.array([command] * (3 if step % 2 else 2)))
        alone.step([0], [command])
        for sensor in sensors:
            reading = many.readings[sensor.key]
            assert reading.dtype == sensor.space.dtype
            np.testing.assert_array_equal(reading[2], alone.readings[sensor.key][0])
            assert all(sensor.space.contains(reading[index]) for index in range(4))
            assert not np.array_equal(reading[1], reading[2])


def test_noise_is_off_by_default_and_the_same_for_the_same_seed():
    exact, first, again, other = (make(CROWD, *sensors, seeds=(2,)) for sensors in (ALL, NOISY, NOISY, NOISY[1:2]))
    for key, reading in exact.readings.items():
        assert not np.array_equal(first.readings[key], reading)
        assert np.array_equal(first.readings[key], again.readings[key])
    assert np.array_equal(first.readings["lidar"], other.readings["lidar"])  # whatever other sensors there are
    before = first.readings["lidar"].copy()
    assert np.array_equal(first.qpos, exact.qpos)
    first.place([0])
    assert not np.array_equal(first.readings["lidar"], before)  # drawn anew each time
    first.reset([0], [2])
    assert np.array_equal(first.readings["lidar"], before)


def measured_noise(sensor, steps=40):
    """Exact reading, and the mean and standard deviation (same shape) of noisy ones."""
    exact = np.full(sensor.space.shape, 5.0 if sensor.key != "rgb" else 128, sensor.space.dtype)
    rng = sensor.generator(0)
    rows = np.array([sensor.noisy(exact, rng) for _ in range(steps)], float)
    return exact, rows.mean(axis=0), rows.std(axis=0)


@pytest.mark.parametrize(
    ("sensor", "sigma"),
    [
        (Lidar2D(noise=1.0), 0.001),
        (Lidar2D(noise=1.0, sigma=0.012), 0.012),
        (Lidar3D(noise=2.0), 0.016),
        (DepthCamera(noise=1.0), 0.00377 * 25),
        (RgbCamera(noise=5.0), 5 * 0.007 * 255),
        (RgbCamera(noise=1.0), math.hypot(0.007 * 255, 1 / math.sqrt(12))),  # and rounded
    ],
)
def test_noise_has_the_published_deviation(sensor, sigma):
    exact, mean, deviation = measured_noise(sensor)
    assert math.sqrt((deviation**2).mean()) == pytest.approx(sigma, rel=0.05)
    assert mean.mean() == pytest.approx(exact.mean(), abs=0.1 * sigma)


def test_noise_of_the_imu_has_the_published_deviation():
    imu = Imu(noise=1.0, sigma_rate=0.02)
    rng = imu.generator(1)
    rows = np.array([imu.noisy(np.zeros(6, np.float32), rng) for _ in range(2000)])
    np.testing.assert_allclose(rows.std(axis=0), [0.005] * 3 + [0.02] * 3, rtol=0.1)


def test_depth_noise_grows_with_the_square_of_the_depth_and_misses_have_none():
    camera = DepthCamera(noise=1.0)
    deviation = []
    for depth in (1.0, 2.0, 4.0):
        rng = camera.generator(0)
        deviation.append(camera.noisy(np.full((120, 160), depth, np.float32), rng).std())
    assert deviation[1] / deviation[0] == pytest.approx(4, rel=0.01)
    assert deviation[2] / deviation[1] == pytest.approx(4, rel=0.01)
    for sensor in (camera, Lidar2D(noise=1.0), Lidar3D(noise=1.0)):
        miss = np.full(sensor.space.shape, sensor.range_max, np.float32)
        assert np.array_equal(sensor.noisy(miss, camera.generator(0)), miss)
        edge = sensor.noisy(np.full(sensor.space.shape, sensor.range_min, np.float32), camera.generator(0))
        assert sensor.space.contains(edge)


def test_a_rate_keeps_the_reading_in_between():
    slow, fast = Lidar2D(key="slow", rate=2.5, noise=1.0), Lidar2D(beams=30)
    world = make(CROWD, slow, fast, Imu(rate=5))
    changes = {key: [] for key in world.readings}
    for _ in range(12):
        before = {key: reading.copy() for key, reading in world.readings.items()}
        world.step([0], [[0.8, 0.5]])
        for key, reading in world.readings.items():
            changes[key].append(not np.array_equal(reading, before[key]))
    assert np.flatnonzero(changes["slow"]).tolist() == [3, 7, 11]
    assert np.flatnonzero(changes["imu"]).tolist() == [1, 3, 5, 7, 9, 11]
    assert all(changes["lidar"])
    world.step([0], [[0.0, 0.0]])
    before = world.readings["slow"].copy()
    world.reset([0], [9])  # reads at once
    assert not np.array_equal(world.readings["slow"], before)


@pytest.mark.parametrize(
    ("kind", "wrong", "domain"),
    [
        (Lidar2D, {"beams": 1}, "from 2 to"),
        (Lidar2D, {"beams": 10.5}, "a whole number"),
        (Lidar2D, {"field": 7.0}, r"\(0, 2 pi\]"),
        (Lidar2D, {"range_min": -1}, "at least 0 m"),
        (Lidar2D, {"range_max": 0.05}, r"above range_min \(0.1 m\)"),
        (Lidar2D, {"sigma": float("nan")}, "at least 0 m"),
        (Lidar2D, {"rate": 0}, "above 0 Hz"),
        (Lidar2D, {"noise": -0.5}, "at least 0"),
        (Lidar2D, {"key": "2d lidar"}, "an identifier"),
        (Lidar2D, {"position": (1.0, 2.0)}, "three numbers"),
        (Lidar2D, {"yaw": "left"}, r"\[-pi, pi\]"),
        (Lidar3D, {"rows": 1}, "from 2 to 128"),
        (Lidar3D, {"columns": 1801}, "from 4 to 1800"),
        (Lidar3D, {"elevation": (0.2, -0.2)}, "two rising angles"),
        (RgbCamera, {"width": 0}, "from 1 to 4096"),
        (RgbCamera, {"field": (1.0, 3.1)}, "170"),
        (RgbCamera, {"sigma": 2}, "share of white"),
        (DepthCamera, {"range_max": 0.2}, r"above range_min \(0.3 m\)"),
        (Imu, {"max_rate": 0}, "above 0 rad/s"),
        (Imu, {"sigma_force": -1}, "at least 0 m/s2"),
    ],
)
def test_a_value_outside_its_domain_is_told_with_the_domain(kind, wrong, domain):
    with pytest.raises(ValueError, match=rf"{kind.__name__}: {next(iter(wrong))} must be .*{domain}"):
        kind(**wrong)


def test_sensors_that_do_not_fit_the_world_are_refused_before_any_stepping():
    with pytest.raises(ValueError, match="15 Hz does not fit the control period of 0.1 s.* 10, 5, 3.333"):
        World(CROWD, 1, (Imu(rate=15),))
    with pytest.raises(ValueError, match="rate of 20 Hz"):
        World(CROWD, 1, (Imu(rate=20),))
    World(CROWD.replace(control_period=0.02, pedestrian_period=0.02), 1, (Imu(rate=10),))
    with pytest.raises(ValueError, match="share a key: imu, imu"):
        World(CROWD, 1, (Imu(), Imu()))
    with pytest.raises(ValueError, match="no site 'roof' for its 'lidar': give the sensor a position"):
        World(CROWD, 1, (Lidar2D(site="roof"),))


@draws
def test_a_camera_may_have_any_size_and_pictures_stay_the_same_beside_others():
    small, large = RgbCamera(width=80, height=60), RgbCamera(key="large", width=240, height=180)
    both, alone = make(CROWD, small, large), make(CROWD, small)
    assert both.readings["large"].shape == (1, 180, 240, 3)
    assert np.array_equal(both.readings["rgb"], alone.readings["rgb"])
    middle = both.readings["large"][0][1::3, 1::3].astype(int)  # the same rays
    assert (np.abs(middle - both.readings["rgb"][0]).max(axis=-1) < 12).mean() > 0.97


@draws
def test_closed_cameras_say_so():
    world = make(EMPTY, RgbCamera())
    world.engine.renderer.close()
    world.engine.renderer.close()  # once more does no harm
    with pytest.raises(ValueError, match="Renderer is closed"):
        world.step([0], [[0.0, 0.0]])


def test_without_opengl_a_camera_says_so_and_lidars_work():
    code = """
import numpy as np
from bson.sensors import *
from bson.task import TaskConfig
from bson.simulation.world import World
from macid.drawing.gl import Unavailable
config = TaskConfig(num_pedestrians=0)
for camera in (RgbCamera(), DepthCamera()):
    try:
        World(config, 1, (Imu(), camera))
    except Unavailable as error:
        print(error)
world = World(config, 1, (Imu(), Lidar2D(), Lidar3D()))
world.reset([0], [0])
print(world.readings["lidar"].max() > 1, world.readings["lidar3d"].max() > 1)
"""
    environment = {**os.environ, "MUJOCO_GL": "disable"}
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    lines = run.stdout.splitlines()
    assert run.returncode == 0, run.stderr
    assert [line.split()[2] for line in lines[:2]] == ["'rgb'", "'depth'"]
    assert all("MUJOCO_GL=disable: unset it" in line for line in lines[:2])
    assert lines[2] == "True True"


@draws
def test_a_process_forked_after_drawing_is_told_instead_of_hanging():
    code = """
import os
from bson.sensors import RgbCamera
from bson.task import TaskConfig
from bson.simulation.world import World
world = World(TaskConfig(num_pedestrians=0), 1, (RgbCamera(),))
if os.fork() == 0:
    try:
        World(TaskConfig(num_pedestrians=0), 1, (RgbCamera(),))
    except RuntimeError as error:
        print(error, flush=True)
    os._exit(0)
os.wait()
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert run.returncode == 0 and "spawn" in run.stdout, run.stderr


def test_every_camera_is_a_frozen_config():
    camera = DepthCamera(position=[0.2, 0, 0.5])
    assert isinstance(camera, Camera) and camera == DepthCamera(position=(0.2, 0.0, 0.5))
    with pytest.raises(dataclasses.FrozenInstanceError):
        camera.width = 3
