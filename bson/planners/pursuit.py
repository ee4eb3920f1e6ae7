"""A follower of paths: pure pursuit."""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from bson.robot import RobotConfig


def nearest_on(path: np.ndarray, place: np.ndarray) -> tuple[int, np.ndarray]:
    """The leg (an index) of `path` (N, 2), N >= 2, that is nearest to `place` (2,), and the nearest point (2,) on
    it."""
    legs = np.diff(path, axis=0)
    part = ((place - path[:-1]) * legs).sum(axis=-1) / np.maximum((legs**2).sum(axis=-1), 1e-12)
    feet = path[:-1] + np.clip(part, 0.0, 1.0)[:, None] * legs
    leg = int(np.hypot(*(feet - place).T).argmin())
    return leg, feet[leg]


@dataclass(frozen=True)
class PurePursuit:
    """Follows a path by pure pursuit (Coulter, "Implementation of the pure pursuit path tracking algorithm", 1992).

    The robot steers on the arc, of curvature 2 y / d^2, to a point of the path `lookahead` farther along than the point
    nearest to the robot. The follower has no memory: where a path comes back to itself, it may skip the loop.
    """

    lookahead: float = 0.8  # distance along the path [m]
    max_speed: float = 1.5  # [m/s]
    max_yaw_rate: float = 2.0  # [rad/s]
    max_lateral_acceleration: float = 2.0  # the robot slows down in curves to keep it [m/s2]
    slow_distance: float = 1.0  # from the path's end, within which the speed falls in proportion [m]
    min_speed: float = 0.15  # the least speed near the end [m/s]
    tolerance: float = 0.1  # a robot this close to the path's end has arrived [m]
    turn_angle: float = 0.8  # farther than this off the way ahead the robot turns on the spot [rad]
    turn_time: float = 0.3  # time constant of such a turn [s]

    def __post_init__(self):
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"{name} must be positive, not {value!r}.")

    @classmethod
    def of(cls, robot: RobotConfig, period: float) -> Self:
        """The follower for a RobotConfig that decides every `period` [s]: it keeps the robot's limits, and looks so far
        ahead, and turns so slowly, that it decides again in time."""
        speed = min(cls.max_speed, robot.max_speed)
        return cls(
            lookahead=max(cls.lookahead, 2.5 * speed * period),
            max_speed=speed,
            max_yaw_rate=robot.max_yaw_rate,
            min_speed=min(cls.min_speed, speed),
            turn_time=max(cls.turn_time, 1.5 * period),
        )

    def __call__(self, pose: np.ndarray, path: np.ndarray) -> tuple[float, float]:
        """The command (v [m/s], w [rad/s]) at `pose` (3,) (x, y, yaw) for `path` (N, 2); (0, 0) at its end.

        Both are in the world frame [m, rad].
        """
        x, y, yaw = (float(value) for value in pose)
        path = np.asarray(path, dtype=float).reshape(-1, 2)
        target, left = self._target(np.array([x, y]), path)
        if left <= self.tolerance:
            return 0.0, 0.0
        dx, dy = target[0] - x, target[1] - y
        ahead, side = math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx
        bearing, distance = math.atan2(side, ahead), math.hypot(dx, dy)
        if distance < 1e-9:  # the path comes back to here
            return self.min_speed, 0.0
        if abs(bearing) > self.turn_angle:
            return 0.0, math.copysign(min(abs(bearing) / self.turn_time, self.max_yaw_rate), bearing)
        curvature = 2.0 * side / distance**2
        bend = max(abs(curvature), 1e-9)
        speed = min(
            self.max_speed,
            max(self.min_speed, self.max_speed * left / self.slow_distance),
            self.max_yaw_rate / bend,
            math.sqrt(self.max_lateral_acceleration / bend),
        )
        return speed, speed * curvature

    def _target(self, place, path):
        """The point (2,) of `path` to steer to from `place` (2,), and the length that is left to the path's end [m]."""
        if len(path) == 1:
            return path[0], math.dist(place, path[0])
        leg, foot = nearest_on(path, place)
        ends = np.concatenate([[0.0], np.hypot(*np.diff(path, axis=0).T).cumsum()])
        along = ends[leg] + math.dist(path[leg], foot)
        reach = along + self.lookahead
        target = np.array([np.interp(reach, ends, path[:, 0]), np.interp(reach, ends, path[:, 1])])
        return target, float(ends[-1] - along + math.dist(foot, place))
