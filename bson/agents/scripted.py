"""Agents of a few lines: the floor of every comparison."""

from collections.abc import Mapping

import numpy as np

from bson.agents.contract import Setting, Unsuited
from bson.agents.scan import Scan

_NEAR = 1.491  # distance from the robot's front; 1.6 m from the Jackal's LIDAR [m]
_AHEAD = np.radians(30.0)  # half of the sector ahead that StopAndGo watches
_TURN = 1.5  # share of the top yaw rate for each radian off the goal


def stop(observation: Mapping[str, np.ndarray]) -> np.ndarray:
    """Stands still."""
    return np.zeros(2)


class Random:
    """A new random action each control step."""

    def reset(self, seed: int | None) -> None:
        """Begins the episode of `seed`."""
        self._rng = np.random.default_rng(seed)

    def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The action (2,), whatever the observation."""
        return self._rng.uniform(-1.0, 1.0, 2)


def goal(observation: Mapping[str, np.ndarray], speed: float = 0.8, turn: float = _TURN) -> np.ndarray:
    """The action straight to the goal, whatever stands in the way; it turns on the spot while the goal is behind.

    speed: share of the top speed (0.8 is 1.6 m/s for the Jackal). turn: share of the top yaw rate for each radian off
    the goal.
    """
    x, y = observation["goal"]
    bearing = np.arctan2(y, x)
    return np.array([speed * max(0.0, np.cos(bearing)) ** 2, np.clip(turn * bearing, -1.0, 1.0)])


class Goal:
    """Drives as `goal` does, but never so fast that the robot reaches the goal, or looks the other way, before it
    decides again.

    turn: share of the top yaw rate for each radian off the goal; reach: the way at top speed in a control step [m].
    """

    speed = 0.8  # share of the top speed

    def __init__(self, setting: Setting | None = None):
        setting = Setting.default() if setting is None else setting
        in_a_step = setting.control_period * setting.top
        self.turn, self.reach = min(_TURN, 1.0 / in_a_step[1]), in_a_step[0]

    def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The action (2,) for one world's observation."""
        return goal(observation, min(self.speed, np.hypot(*observation["goal"]) / self.reach), self.turn)


class StopAndGo(Goal):
    """Stands while anything is within 1.5 m of its front in the 60 degrees ahead of the LIDAR; else drives as Goal
    does, at top speed."""

    speed = 1.0

    def __init__(self, setting: Setting | None = None):
        setting = Setting.default() if setting is None else setting
        super().__init__(setting)
        self._scan = Scan(setting)
        self._near = round(_NEAR + setting.robot.half_length - float(self._scan.place[0]), 3)  # from the LIDAR [m]
        self._ahead = np.abs(self._scan.angles) <= _AHEAD
        if not self._ahead.any():
            raise Unsuited(f"needs a Lidar2D that looks ahead; '{self._scan.key}' doesn't.")

    def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The action (2,) for one world's observation."""
        near = self._scan.read(observation)[self._ahead].min() < self._near
        return stop(observation) if near else super().__call__(observation)
