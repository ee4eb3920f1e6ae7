"""A robot's wheels, pose, velocity and footprint. Where no robot is given, they are the Jackal's."""

from typing import Any

import mujoco
import numpy as np

from bson.robot.description import Robot, RobotConfig
from bson.robot.loading import load_robot
from macid import geometry
from macid.geometry import Array


def _namespace(array):
    """The array module: NumPy, or JAX for JAX's arrays."""
    return array.__array_namespace__() if hasattr(array, "__array_namespace__") else np


def wheel_speeds(command: Array, robot: Robot | None = None) -> Array:
    """Speeds (..., W) [rad/s] of the Robot's hinges, ordered as its `wheels`, for `command` (..., 2): (v [m/s], w
    [rad/s]), which is clipped. robot: None for the Jackal."""
    robot = robot or load_robot("jackal")
    config, xp = robot.config, _namespace(command)
    limit = np.array([config.max_speed, config.max_yaw_rate])
    speed, yaw_rate = xp.moveaxis(xp.clip(command, -limit, limit), -1, 0)
    difference = yaw_rate * config.effective_track / 2
    left, right = speed - difference, speed + difference
    sides = [left] * len(robot.left) + [right] * len(robot.right)
    return xp.stack(sides, axis=-1) / config.rolling_radius * np.array(robot.forwards)


def wheel_actuators(model: mujoco.MjModel, robot: Robot | None = None, name: str = "robot") -> np.ndarray:
    """The indices (W,) in the MjModel's ctrl of the Robot's wheels, ordered as its `wheels`. robot: None for the
    Jackal."""
    robot = robot or load_robot("jackal")
    hinges = [model.joint(f"{name}/{wheel}").id for wheel in robot.wheels]
    return np.array([np.flatnonzero(model.actuator_trnid[:, 0] == hinge)[0] for hinge in hinges])


def wheel_dofs(model: mujoco.MjModel, robot: Robot, name: str = "robot") -> np.ndarray:
    """The indices (W,) in the MjModel's qvel of the Robot's wheels, ordered as its `wheels`."""
    return np.array([model.joint(f"{name}/{wheel}").dofadr[0] for wheel in robot.wheels])


def planar_pose(qpos: Array) -> Array:
    """Pose (..., 3), world frame [m, m, rad], of a free joint's `qpos` (..., 7)."""
    xp = _namespace(qpos)
    qpos = xp.asarray(qpos)
    w, x, y, z = qpos[..., 3], qpos[..., 4], qpos[..., 5], qpos[..., 6]
    yaw = xp.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    return xp.stack([qpos[..., 0], qpos[..., 1], yaw], axis=-1)


def planar_velocity(qpos: Array, qvel: Array) -> Array:
    """Speed ahead [m/s] and yaw rate [rad/s] (..., 2) of a free joint's `qpos` (..., 7) and `qvel` (..., 6).

    MuJoCo gives a free joint's linear velocity in the world frame and its angular velocity in the body frame.
    """
    xp = _namespace(qvel)
    qvel = xp.asarray(qvel)
    yaw = planar_pose(qpos)[..., 2]
    ahead = xp.cos(yaw) * qvel[..., 0] + xp.sin(yaw) * qvel[..., 1]
    return xp.stack([ahead, qvel[..., 5]], axis=-1)


def spawn_qpos(x: Any, y: Any, yaw: Any, config: RobotConfig | None = None) -> np.ndarray:
    """`qpos` (..., 7) of a robot that stands on the ground at `x`, `y` [m] (...), `yaw` [rad] (...). config: None for
    the Jackal."""
    config = config or load_robot("jackal").config
    x, y, yaw = np.broadcast_arrays(x, y, yaw)
    place = np.stack([x, y, np.full(yaw.shape, config.spawn_height)], axis=-1)
    return np.concatenate([place, geometry.yaw_quaternion(np.asarray(yaw, dtype=float))], axis=-1)


def footprint(pose: Array, config: RobotConfig | None = None) -> Array:
    """The footprint of a robot at `pose` (..., 3) as box rows (..., 5) of `macid.geometry`. config: None for the
    Jackal."""
    config = config or load_robot("jackal").config
    xp = _namespace(pose)
    pose = xp.asarray(pose)
    half_x, half_y = xp.full(pose.shape[:-1], config.half_length), xp.full(pose.shape[:-1], config.half_width)
    return xp.stack([pose[..., 0], pose[..., 1], half_x, half_y, pose[..., 2]], axis=-1)
