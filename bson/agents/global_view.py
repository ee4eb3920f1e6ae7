"""The map as a grid, and people's velocities, worked out from the observations of the Global track."""

from collections.abc import Mapping

import numpy as np

from bson.agents.contract import Setting, Unsuited
from bson.planners import Grid
from macid import geometry


class Standing:
    """Who stands: whose running mean of velocities, of the time constant `time` [s], is slower than `speed` [m/s].
    period: between two looks [s]."""

    def __init__(self, period: float, time: float = 1.5, speed: float = 0.3):
        self._share, self._speed = min(1.0, period / time), speed
        self.forget()

    def forget(self) -> None:
        """Forgets the last episode."""
        self._mean: np.ndarray | None = None

    def see(self, velocity: np.ndarray) -> None:
        """Takes in people's velocities (n, 2) [m/s]. At the first look nobody stands."""
        if self._mean is None:
            self._mean = np.full(velocity.shape, self._speed)
        else:
            self._mean += self._share * (velocity - self._mean)

    @property
    def stands(self) -> np.ndarray:
        """Who stands (n,) bool."""
        assert self._mean is not None, "nobody was seen yet"
        return np.hypot(*self._mean.T) < self._speed


class GlobalView:
    """The present state of a world, in the world frame [m, m/s, rad]. Call `see` with each observation of an episode in
    turn.

    Raises Unsuited on another track than the Global one.
    """

    def __init__(self, setting: Setting):
        if setting.track == "local":
            raise Unsuited("needs the map and people's places: choose --track global.")
        self._period = setting.control_period
        self.reset()

    def reset(self) -> None:
        """Forgets the last episode."""
        self._map: Grid | None = None
        self.pose, self.goal = np.zeros(3), np.zeros(2)  # (x, y, yaw), (x, y)
        self.people, self.people_velocity = np.zeros((0, 2)), np.zeros((0, 2))

    @property
    def map(self) -> Grid:
        """The map, from the episode's first observation on."""
        assert self._map is not None, "nothing was seen yet"
        return self._map

    def see(self, observation: Mapping[str, np.ndarray]) -> None:
        """Takes in a Global observation (see bson.interfaces.gym.BsonEnv). People count as standing until they were
        seen twice."""
        first = self._map is None
        if first:
            resolution = float(observation["map_resolution"][0])
            self._map = Grid(observation["map"] > 0, resolution, observation["map_origin"])
        self.pose = np.asarray(observation["pose"], float)
        self.goal = self.pose[:2] + geometry.rotate(np.asarray(observation["goal"], float), self.pose[2])
        people = np.asarray(observation["people"], float)
        before = people if first else self.people
        self.people, self.people_velocity = people, (people - before) / self._period
