"""The input of learned robots: the Local track's goal, motion and 2D LIDAR as one short vector.

720 beams are more than an MLP needs: each sector of 7.5 degrees keeps its nearest beam, since a robot runs into the
nearest thing. The beam is given as closeness, which is 0 from RANGE on. One scan does not tell who is coming closer, so
two scans of the last control steps are given too. The functions take NumPy or JAX arrays.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from macid.geometry import Array

SECTORS = 36
RANGE = 8.0  # closeness is 1 - distance / RANGE, at least 0 [m]
SCANS = (0, 2, 4)  # ages of the scans in the vector, in control steps
FEATURES = 6 + len(SCANS) * SECTORS
TOP = (2.0, 2.0)  # the Jackal's top speed and yaw rate [m/s, rad/s]
_GOAL_RANGE = 20.0  # [m]


def closeness(lidar: Array) -> Array:
    """Scans (..., beams) [m] as (..., SECTORS) in [0, 1], from right to left: 0 for RANGE and more, 1 at the sensor."""
    xp = lidar.__array_namespace__()
    sectors = lidar.reshape(*lidar.shape[:-1], SECTORS, -1).min(axis=-1)
    return xp.maximum(1.0 - sectors / RANGE, 0.0).astype(np.float32)


def motion(observation: Mapping[str, Array], top: Any = TOP) -> Array:
    """(..., 6): the goal's direction (2) in the robot frame, its distance on two scales, speed and yaw rate as shares
    of `top` (2,) [m/s, rad/s]."""
    goal = observation["goal"]
    xp = goal.__array_namespace__()
    distance = xp.linalg.norm(goal, axis=-1, keepdims=True)
    near, far = xp.exp(-distance), xp.minimum(distance / _GOAL_RANGE, 1.0)
    columns = [goal / xp.maximum(distance, 1e-6), near, far, observation["velocity"] / np.asarray(top, np.float32)]
    return xp.concatenate(columns, axis=-1).astype(np.float32)


class Features:
    """Features of `count` robots, with a memory of their last scans. top: the top speed and yaw rate, see `motion`."""

    def __init__(self, count: int, top: Any = TOP):
        self._top = top
        self._scans = np.zeros((count, SCANS[-1] + 1, SECTORS), np.float32)  # the latest first

    def begin(self, rows: Any, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """Features (len(rows), FEATURES) of the robots `rows` at an episode's start; observations with a leading
        axis."""
        self._scans[rows] = closeness(observation["lidar"])[:, None]
        return self._vector(rows, observation)

    def step(self, rows: Any, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """Features (len(rows), FEATURES) of the robots `rows` after a control step."""
        self._scans[rows, 1:] = self._scans[rows, :-1]
        self._scans[rows, 0] = closeness(observation["lidar"])
        return self._vector(rows, observation)

    def _vector(self, rows, observation):
        return vector(self._scans[rows], observation, self._top)


def remember(scans: Array, lidar: Array, began: Array) -> Array:
    """Scans (N, SCANS[-1] + 1, SECTORS), the latest first, after the `lidar` readings (N, beams); a robot whose episode
    `began` (N,) in that step has this reading in all scans."""
    xp = lidar.__array_namespace__()
    new = closeness(lidar)[:, None]
    longer = xp.concatenate([new, scans[:, :-1]], axis=1)
    return xp.where(began[:, None, None], xp.broadcast_to(new, longer.shape), longer)


def vector(scans: Array, observation: Mapping[str, Array], top: Any = TOP) -> Array:
    """Features (N, FEATURES) of robots with the `scans` (N, SCANS[-1] + 1, SECTORS) and `observation`; top: see
    `motion`."""
    xp = scans.__array_namespace__()
    seen = scans[:, np.array(SCANS)].reshape(-1, len(SCANS) * SECTORS)
    return xp.concatenate([motion(observation, top), seen], axis=-1)
