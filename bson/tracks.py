"""What the robot is given: a track is an object with its spaces and its observation."""

import dataclasses

import gymnasium
import numpy as np

from bson.sensors import Imu, Lidar2D
from macid import geometry


def velocity_limit(robot):
    """Bounds (2,) of an observed (v [m/s], w [rad/s]): a push can move the robot faster than its motors do."""
    return np.array([4 * robot.max_speed, 10 * robot.max_yaw_rate], np.float32)


@dataclasses.dataclass(frozen=True)
class LocalTrack:
    """The Local track (paper, sec. VI-A): the relative goal, the robot's own motion, and its sensors."""

    sensors: tuple = (Imu(), Lidar2D())

    def space(self, config):
        """The observation space of one world."""
        reach = config.map_size * np.sqrt(2.0)
        limit = velocity_limit(config.robot)
        return gymnasium.spaces.Dict(
            {
                "goal": gymnasium.spaces.Box(-reach, reach, (2,), np.float32),
                "velocity": gymnasium.spaces.Box(-limit, limit, dtype=np.float32),
                **{sensor.key: sensor.space for sensor in self.sensors},
            }
        )

    def observe(self, world, ids):
        """Observations of the worlds `ids`, each array with a leading axis (len(ids),); copies."""
        pose = world.pose[ids]
        limit = velocity_limit(world.config.robot)
        return {
            "goal": geometry.to_body(world.goal[ids] - pose[:, :2], pose[:, 2]).astype(np.float32),
            "velocity": np.clip(world.velocity[ids], -limit, limit).astype(np.float32),
            **{sensor.key: world.readings[sensor.key][ids].copy() for sensor in self.sensors},
        }


TRACKS = {("local", "lidar2d"): LocalTrack(sensors=(Imu(), Lidar2D()))}


def make_track(track, sensor):
    """The track and sensor set of these names. Raises ValueError, naming the valid ones."""
    tracks, sensors = sorted({t for t, _ in TRACKS}), sorted({s for _, s in TRACKS})
    if track not in tracks:
        raise ValueError(f"Unknown track '{track}'. Choose {' or '.join(map(repr, tracks))}.")
    if sensor not in sensors:
        raise ValueError(f"Unknown sensor '{sensor}'. Choose {' or '.join(map(repr, sensors))}.")
    return TRACKS[track, sensor]
