"""The robot: a Clearpath Jackal on four skid-steered wheels that follows a commanded `(v, w)`, open loop.

A command is `(v, w)`: speed ahead [m/s] and yaw rate [rad/s], counter-clockwise. A pose is `(x, y, yaw)` in the world
frame. The model is `assets/jackal.xml`, which says why its contacts and motors are as they are.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from macid import assets, geometry

WHEELS = ("front_left_wheel", "rear_left_wheel", "front_right_wheel", "rear_right_wheel")  # the actuators' order


@dataclass(frozen=True)
class RobotConfig:
    """What the Jackal can do and how large it is.

    `effective_track` is the track that a robot without sideways slip would need in order to turn as this one does. Four
    equally loaded wheels at (+-a, +-b) that scrub with isotropic friction turn where the friction has no moment, at
    `2 (a^2 + b^2) / b`: here 0.559 m, 1.5 tracks, Clearpath's own figure. Checked in simulation at a step of 0.02 s:
    it gives 0.96, 1.00 and 1.02 of the yaw rates 0.5, 1 and 2 rad/s on the spot, 1.04 at (1 m/s, 1 rad/s) and 1.09 at
    (2, 1). Where speed and yaw rate are both high the outer wheels carry more and it turns in: 1.3 at (2, 2).
    """

    max_speed: float = 2.0  # [m/s], ahead and back (Clearpath's limit)
    max_yaw_rate: float = 2.0  # [rad/s]; Clearpath allows 4
    wheel_radius: float = 0.098  # [m]
    rolling_radius: float = 0.0962  # of the loaded tyre: the wheel's less half the 3.5 mm by which it sinks in [m]
    track: float = 0.37559  # between the left and the right wheels [m]
    effective_track: float = 0.563  # [m]
    half_length: float = 0.229  # of the footprint, the outline of the wheels [m]
    half_width: float = 0.2078  # [m]
    spawn_height: float = 0.060  # of the robot's frame above the ground when it stands still [m]

    @property
    def radius(self):
        """Of the circle around the footprint [m]."""
        return float(np.hypot(self.half_length, self.half_width))


def add_robot(spec: mujoco.MjSpec, name="robot") -> None:
    """Attach a Jackal to the world of `spec`, under a free joint `name`; its elements are called `name/...`.

    Joints and actuators of bodies that `spec` already has come before the robot's.
    """
    jackal = mujoco.MjSpec.from_file(str(assets.path("jackal.xml")))
    base = spec.worldbody.add_frame().attach_body(jackal.body("base"), f"{name}/", "")
    base.add_freejoint(name=name)


def wheel_speeds(command, config=RobotConfig()):
    """Wheel speeds (..., 4) [rad/s], ordered as `WHEELS`, for `command` (..., 2): (v [m/s], w [rad/s]), clipped."""
    limit = np.array([config.max_speed, config.max_yaw_rate])
    speed, yaw_rate = np.moveaxis(np.clip(command, -limit, limit), -1, 0)
    difference = yaw_rate * config.effective_track / 2
    left, right = speed - difference, speed + difference
    return np.stack([left, left, right, right], axis=-1) / config.rolling_radius


def planar_pose(qpos):
    """Pose (..., 3), world frame [m, m, rad], of a free joint's `qpos` (..., 7)."""
    qpos = np.asarray(qpos)
    w, x, y, z = qpos[..., 3], qpos[..., 4], qpos[..., 5], qpos[..., 6]
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    return np.stack([qpos[..., 0], qpos[..., 1], yaw], axis=-1)


def planar_velocity(qpos, qvel):
    """Speed ahead [m/s] and yaw rate [rad/s] (..., 2) of a free joint's `qpos` (..., 7) and `qvel` (..., 6).

    MuJoCo gives a free joint's linear velocity in the world frame and its angular velocity in the body frame.
    """
    qvel = np.asarray(qvel)
    yaw = planar_pose(qpos)[..., 2]
    ahead = np.cos(yaw) * qvel[..., 0] + np.sin(yaw) * qvel[..., 1]
    return np.stack([ahead, qvel[..., 5]], axis=-1)


def spawn_qpos(x, y, yaw, config=RobotConfig()):
    """`qpos` (..., 7) of a robot that stands on the ground at `x`, `y` [m] (...), `yaw` [rad] (...)."""
    x, y, yaw = np.broadcast_arrays(x, y, yaw)
    place = np.stack([x, y, np.full(yaw.shape, config.spawn_height)], axis=-1)
    return np.concatenate([place, geometry.yaw_quaternion(np.asarray(yaw, dtype=float))], axis=-1)


def footprint(pose, config=RobotConfig()):
    """Box rows (..., 5), as in `macid.geometry`, that a robot at `pose` (..., 3) covers."""
    pose = np.asarray(pose)
    half_x, half_y = np.full(pose.shape[:-1], config.half_length), np.full(pose.shape[:-1], config.half_width)
    return np.stack([pose[..., 0], pose[..., 1], half_x, half_y, pose[..., 2]], axis=-1)
