"""Model predictive path integral control (`bson.agents.mppi`) by the LIDAR alone.

The agent makes its own map: walls that a scan meets stay in it, people are tracked (`bson.agents.tracking`) and kept
out of it, and what was never seen is free, so that the shortest way is planned anew as more is seen (as in D* Lite,
Koenig and Likhachev, AAAI 2002). The robot knows where it is from the goal's place in its frame.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from bson.agents.contract import Setting
from bson.agents.mppi import PATCH, Controller, MppiConfig
from bson.agents.rollout import going_on
from bson.agents.scan_map import MappedTracking
from bson.agents.tracking import TrackingConfig
from bson.planners import Grid
from bson.planners.way_field import FAR, solve_field, way_field


@dataclass(frozen=True)
class MppiLocalConfig(MppiConfig, TrackingConfig):
    """What `MppiLocal` assumes and weighs. Metres, seconds."""

    map_share: float = 1.5  # side of the agent's map, in sides of the world's
    remap: float = 0.3  # between two looks at the whole map, as more of it is seen
    coarse: int = 2  # cells of the map in a side of a cell of the far field


class MppiLocal(MappedTracking):
    """The agent: called with one world's observation each control period, it returns an action (2,) in [-1, 1]."""

    track, sensor = "local", "lidar2d"

    def __init__(self, setting: Setting | None = None, config: MppiLocalConfig = MppiLocalConfig()):
        setting = Setting.default() if setting is None else setting
        super().__init__(setting, config, config.map_share)
        self._controller = _OwnMap(setting, self.config)
        self._remap = setting.steps(config.remap)
        self.reset(0)

    def reset(self, seed: int | None = None) -> None:
        """Begins an episode; samples are drawn from `seed`."""
        self.forget()
        self._controller.reset(seed)

    def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The action (2,) for one world's observation (see bson.interfaces.gym.BsonEnv)."""
        goal, velocity = np.asarray(observation["goal"], float), np.asarray(observation["velocity"], float)
        step = self._steps
        self.see(goal, velocity, observation)
        if step % self._remap == 0 or step < 4:
            assert self._map is not None
            self._controller.set_map(self._map.grid, np.zeros(2), *self.crowd())
        places, velocities = self.people
        near = np.argsort(np.hypot(*places.T), kind="stable")[: self.config.people]
        places = places[near] @ self._rotation.T + self._position
        people = going_on(places, velocities[near] @ self._rotation.T, self._controller.times)
        return self._controller.decide(np.array([*self._position, self._yaw]), velocity, people)


class _OwnMap(Controller):
    """A Controller whose map changes all the time: the far field is coarse, the patch around the robot is solved anew
    at each decision."""

    config: MppiLocalConfig

    def set_map(self, grid: Grid, goal: np.ndarray, people: np.ndarray, standing: np.ndarray) -> None:
        """Takes the map as it is known by now, the goal, and the people who are known of."""
        clear = (np.asarray(ndimage.distance_transform_edt(~grid.occupied)) - 0.5) * grid.resolution
        if not grid.occupied.any():
            clear = np.full(grid.shape, 100.0)
        rate = self.rate(grid.occupied, clear) + self.crowd(grid, people, standing)
        n = self.config.coarse
        least = rate.reshape(grid.shape[0] // n, n, grid.shape[1] // n, n).min(axis=(1, 3))
        rough = Grid(np.zeros(least.shape, bool), n * grid.resolution, grid.origin)
        self._grid, self._goal = grid, np.asarray(goal, np.float32)
        half = PATCH // 2
        far = way_field(rough, goal, least)
        self._far = np.pad(far, half // n, mode="edge")
        self._rates = np.pad(np.asarray(rate, np.float32), half, mode="edge")
        self._clear = np.pad(np.asarray(clear, np.float32), half, mode="edge")

    def _patch(self, row, column):
        n, patch = self.config.coarse, (slice(row, row + PATCH), slice(column, column + PATCH))
        return self._way_around(row, column, self._rates[patch], n), self._clear[patch]

    def _way_around(self, row, column, rate, n):
        """The field in the patch: from its border, which the far field knows, and from the goal."""
        index = (np.arange(PATCH) + 0.5 + np.array([[row], [column]])) / n - 0.5
        border = ndimage.map_coordinates(self._far, np.meshgrid(*index, indexing="ij"), order=1, mode="nearest")
        start = np.full((PATCH, PATCH), FAR, np.float32)
        for edge in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
            start[edge] = border[edge]
        i, j = self._grid.cells(self._goal) + PATCH // 2 - (row, column)
        if 0 <= i < PATCH and 0 <= j < PATCH:
            start[i, j] = 0.0
        return solve_field(rate * self._grid.resolution, start)
