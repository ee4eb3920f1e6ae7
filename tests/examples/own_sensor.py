"""A sensor of one's own: where the nearest person is, as a leg detector would tell, and an agent that uses it.

bson evaluate --agent own_sensor.py --sensor own_sensor.py:SENSORS --suite smoke
"""

import dataclasses

import gymnasium
import numpy as np

from bson.sensors import Imu, Lidar2D, Sensor


@dataclasses.dataclass(frozen=True, kw_only=True)
class NearestPerson(Sensor):
    """x, y [m] in the robot's frame of the nearest person's centre; beyond `reach` both are `reach`. sigma: 0.05 m."""

    key: str = "nearest"
    reach: float = 8.0

    @property
    def space(self):
        return gymnasium.spaces.Box(-2 * self.reach, 2 * self.reach, (2,), np.float32)

    def mount(self, spec, robot="robot"):
        """It needs nothing in the scene."""

    def bind(self, world, robot="robot"):
        def read(world, ids):
            pose, people = world.pose[ids], world.people[ids]
            away = people[..., :2] - pose[:, None, :2]
            nearest = away[np.arange(len(away)), np.hypot(away[..., 0], away[..., 1]).argmin(axis=1)]
            sin, cos = np.sin(pose[:, 2]), np.cos(pose[:, 2])
            seen = np.stack([cos * nearest[:, 0] + sin * nearest[:, 1], cos * nearest[:, 1] - sin * nearest[:, 0]], -1)
            far = np.hypot(*seen.T) > self.reach
            return np.where(far[:, None], self.reach, seen).astype(np.float32)

        return read

    def noisy(self, reading, rng):
        return (reading + self.noise * rng.normal(0.0, 0.05, 2)).astype(np.float32)


SENSORS = (Imu(), Lidar2D(), NearestPerson(noise=1.0))


def agent(observation):
    """Drives to the goal, and stops while somebody is right ahead."""
    goal, (x, y) = observation["goal"], observation["nearest"]
    blocked = 0.0 < x < 1.5 and abs(y) < 0.7
    return np.clip([0.0 if blocked else 0.6, np.arctan2(goal[1], goal[0])], -1.0, 1.0)
