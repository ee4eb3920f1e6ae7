"""Robots on driven wheels, left and right, that follow a commanded `(v, w)`, open loop: the Jackal, and any other robot
with a drive description and an MJCF or URDF model.

A command is `(v, w)`: speed ahead [m/s] and yaw rate [rad/s], counter-clockwise. A pose is `(x, y, yaw)` of the robot's
base in the world frame. The base's frame has x ahead, y left, z up, and its origin in the middle of the footprint.

A description is a TOML file, `assets/robots/NAME.toml` or the user's own file:

| key | what |
|---|---|
| model | the MJCF (.xml) or URDF (.urdf) file, beside the description |
| base | the body (link) that carries the rest |
| spawn_height | of the base's frame above the ground when the robot stands still [m] |
| drive.kind | "differential", or "skid-steer", which needs `effective_track` |
| drive.left, .right | names of the hinges (continuous joints) of the driven wheels |
| drive.max_speed, .max_yaw_rate | limits of the command [m/s], [rad/s] |
| drive.wheel_radius, .track | of a driven wheel, and between left and right [m] |
| drive.rolling_radius, .effective_track | what they amount to in motion [m]; without: the above |
| drive.gain, .max_torque | velocity motors for the wheels [N m s/rad], [N m], instead of the model's |
| footprint.half_length, .half_width | of the box that counts in collisions [m] |
| footprint.bottom, .top | that box's height above the ground [m], unless the model has a geom `hull` of its own |
| mounts.NAME.position, .rpy | a place for a sensor in the base's frame [m], roll, pitch and yaw [rad] if it is turned |

Mounts are `lidar`, `lidar3d`, `camera`, `imu`, unless the model has sites of these names, and any others that a
sensor's `site` names. Numbers outside the range of such robots are refused, in the description and in the model as
MuJoCo compiles it (masses, inertias, shapes). Wheels touch the floor only. The rest of the model touches the floor only
as well, and slides, as casters do. People and walls touch the hull. Where the model has MuJoCo's defaults, contacts and
armature are as the Jackal's (robots/jackal.xml).
"""

from bson.robot.description import MAX_RADIUS, MAX_SPEED, Robot, RobotConfig
from bson.robot.loading import ROBOTS, describe, load_robot, robot_config, robot_names
from bson.robot.model import MOUNTS, add_robot, hide_robot, site_pose
from bson.robot.motion import (
    footprint,
    planar_pose,
    planar_velocity,
    spawn_qpos,
    wheel_actuators,
    wheel_dofs,
    wheel_speeds,
)

__all__ = [
    "MAX_RADIUS",
    "MAX_SPEED",
    "MOUNTS",
    "ROBOTS",
    "Robot",
    "RobotConfig",
    "add_robot",
    "describe",
    "footprint",
    "hide_robot",
    "load_robot",
    "planar_pose",
    "planar_velocity",
    "robot_config",
    "robot_names",
    "site_pose",
    "spawn_qpos",
    "wheel_actuators",
    "wheel_dofs",
    "wheel_speeds",
]


def __getattr__(name):
    """JACKAL, the Robot with which others are compared. It is read when it is first asked for, as reading compiles
    it."""
    if name != "JACKAL":
        raise AttributeError(f"module 'bson.robot' has no attribute '{name}'")
    return load_robot("jackal")
