"""Rays and pictures as formulas, against MuJoCo's rays and OpenGL's pictures."""

import mujoco
import numpy as np
import pytest

from bson.sensors import DepthCamera, Lidar2D, Lidar3D, RgbCamera
from bson.simulation import pictures, rays
from bson.simulation.world import World
from bson.task import TaskConfig
from macid.drawing.gl import Unavailable

CONFIG = TaskConfig(num_pedestrians=20, obstacle_density=0.4, map_size=24.0, goal_distance=(6.0, 15.0))


def _body(world):
    """Where the robot of world 0 is: position (3,) and quaternion (4,), a view."""
    first = 3 * world.config.people
    return world.engine.qpos[0, first : first + 7]


def _tilted(world, seed):
    """Begins an episode, and tilts the robot by up to some ten degrees."""
    world.reset([0], [seed])
    body = _body(world)
    turn = np.random.default_rng(seed).uniform(-0.1, 0.1, 4) + body[3:]
    body[3:] = turn / np.linalg.norm(turn)
    world.place([0])  # where it is
    return rays.Solids(world.people[0, :, :2].copy(), world.boxes[0], CONFIG.map_size / 2 + 1.0)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_beams_are_those_of_mujoco(seed):
    sensors = Lidar2D(), Lidar3D(elevation=(-0.6, 0.6))
    world = World(CONFIG, 1, sensors)
    solids = _tilted(world, seed)
    for sensor in sensors:
        site = world.model.site(f"robot/{sensor.key}_beams").id
        data = world.engine.data(0)
        mujoco.mj_forward(world.model, data)
        place, frame = data.site_xpos[site], data.site_xmat[site].reshape(3, 3)
        found = rays.first(place, sensor.directions @ frame.T, solids)
        found = np.clip(found, sensor.range_min, sensor.range_max)
        np.testing.assert_allclose(found, world.readings[sensor.key][0], atol=1e-5)


def test_pictures_are_those_of_opengl():
    sensors = RgbCamera(), DepthCamera(range_max=15.0)
    try:
        world = World(CONFIG, 1, sensors)
    except Unavailable:
        pytest.skip("no OpenGL")
    for seed in (1, 2):
        solids = _tilted(world, seed)
        body = _body(world)
        w, x, y, z = body[3:]
        frame = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        place = body[:3] + frame @ world.model.cam_pos[world.model.camera("robot/rgb").id]
        rgb, depth = pictures.look(place, sensors[0].directions @ frame.T, frame[:, 0], solids, 1 / sensors[0].focal[1])
        seen, far = world.readings["rgb"][0].astype(int), world.readings["depth"][0]
        off = np.abs(rgb - seen)
        assert off.mean() < 2.0
        assert (off.max(axis=-1) > 16).mean() < 0.01  # edges
        depth = np.clip(depth, 0.3, 15.0)
        assert np.mean(np.abs(depth - far) > 0.01 + 3e-4 * far**2) < 0.01  # OpenGL's depth has steps
