"""The MuJoCo scene of a world: people, boxes, the robot and its sensors."""

import functools
from collections.abc import Sequence

import mujoco
import numpy as np

from bson import robot
from bson.sensors import Sensor
from bson.task import TaskConfig
from macid import layout, scene
from macid.maps import load_map


@functools.lru_cache(8)
def _maze(size):
    """An example of a maze of side `size` [m] in which all walls stand."""
    return layout.maze_layout(np.random.default_rng(0), 1.0, size).boxes


def _boxes(config):
    """Boxes (B, 5) of an example episode of `config`: their number and sizes are the same in every episode."""
    if config.map is not None:
        return load_map(config.map).boxes
    boxes = _maze(config.map_size)
    return boxes[: 4 + round(config.obstacle_density * (len(boxes) - 4))]


def build_spec(config: TaskConfig, sensors: Sequence[Sensor], hidden: bool = False) -> mujoco.MjSpec:
    """The MjSpec of a world: pedestrians, boxes (movable: each episode has its own map), then the robot and sensors.
    hidden: whether no sensor sees the robot (bson.robot.hide_robot)."""
    spec = scene.base_spec(config.map_size)
    scene.add_people(spec, config.people, scene.PersonConfig(radius=config.person_radius))
    scene.add_boxes(spec, _boxes(config), movable=True)
    robot.add_robot(spec, robot.describe(config.robot), hidden=hidden)
    for sensor in sensors:
        sensor.mount(spec)
    if hidden:
        robot.hide_robot(spec)  # including the parts that sensors have added
    return spec


def structure(config: TaskConfig) -> tuple:
    """The part of `config` that determines a world's model: worlds of one structure change their setting without a new
    model (World.configure)."""
    sizes, digest = _boxes(config)[:, 2:4], robot.describe(config.robot).digest
    return config.people, config.person_radius, sizes.shape, sizes.tobytes(), config.map_size, config.robot, digest


def build_model(config: TaskConfig, sensors: Sequence[Sensor]) -> mujoco.MjModel:
    """The MjModel of a world as it looks, for films."""
    return build_spec(config, sensors).compile()


def joint_at(model: mujoco.MjModel, addresses: str, number: int) -> str:
    """The name of the joint whose part of the model's `addresses` (jnt_qposadr, jnt_dofadr) has `number`."""
    return model.joint(int(np.searchsorted(getattr(model, addresses), number, "right")) - 1).name
