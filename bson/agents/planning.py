"""Agents of the Global track: a planner on the map with people as costs, and a follower that replans."""

import numpy as np

from bson.agents.contract import Setting
from bson.agents.global_view import GlobalView
from bson.planners import (
    CarrtStarConfig,
    NoPath,
    PurePursuit,
    RrtConfig,
    RrtStarConfig,
    nearest_on,
    path_cost,
    plan,
    shortcut,
    social_cost,
)

_CORNER = 0.09  # extra distance from walls beside the robot's circle: a follower cuts corners by about as much [m]
_LONGEST = 0.5  # between decisions: a person walks 0.7 m meanwhile [s]
_REPLAN = 0.3  # between plans [s]
_NEAR = 10.0  # length of way whose detours are taken out: the rest is planned anew long before it is driven [m]
_AHEAD, _QUIET = 4.0, 2.0  # RRT plans anew when the next _AHEAD [m] of way cost more than _QUIET times their length


def _reaching(path, length):
    """How many points of `path` (N, 2), N >= 2, make up its first `length` [m]; all points if the path is shorter."""
    ends = np.hypot(*np.diff(path, axis=0).T).cumsum()
    return min(2 + int(np.searchsorted(ends, length)), len(path))


class _Planning:
    """Plans every 0.3 s, or when there is no path, and follows; stops where there is no way.

    config: the configuration of the planner's first plan; again: of the later plans, which begin with the rest of the
    last path.
    """

    track, sensor = "global", "lidar2d"
    planner, config, again = "astar", None, None

    def __init__(self, setting: Setting | None = None):
        setting = Setting.default("global") if setting is None else setting
        setting.check_period(_LONGEST)
        self._top, self._replan = setting.top, setting.steps(_REPLAN)
        self._clearance = round(setting.robot.radius + _CORNER, 2)
        self._follower = PurePursuit.of(setting.robot, setting.control_period)
        self._view = GlobalView(setting)
        self.reset(0)

    def reset(self, seed):
        """Begins an episode."""
        self._rng = np.random.default_rng(seed)
        self._view.reset()
        self._grid = self._path = None
        self._age = 0

    def __call__(self, observation):
        """The action for a Global observation (see bson.interfaces.gym.BsonEnv)."""
        self._view.see(observation)
        if self._grid is None:
            self._grid = self._view.map.inflated(self._clearance)
        if self._path is None or self._age >= self._replan:
            self._plan(self._grid)
        self._age += 1
        if self._path is None:
            return np.zeros(2)
        return np.clip(np.array(self._follower(self._view.pose, self._path)) / self._top, -1.0, 1.0)

    def _plan(self, grid):
        self._age = 0
        view = self._view
        cost = social_cost(grid, view.people, view.people_velocity)
        start, end = grid.nearest_free(view.pose[:2]), grid.nearest_free(view.goal)
        config = self.config if self._path is None else self.again
        try:
            path = plan(self.planner, grid, start, end, cost, self._rng, config, self._known(grid, cost))
        except NoPath:
            return  # the last path, if there is one, is better than none
        near = _reaching(path, _NEAR)
        path = np.concatenate([shortcut(path[:near], grid, cost), path[near:]])
        self._path = np.concatenate([path[:-1], view.goal[None]])

    def _known(self, grid, cost):
        """The rest of the last path (N, 2), to begin a plan with; None if nothing of it is of use."""
        if self._path is None or len(self._path) < 2:
            return None
        leg, foot = nearest_on(self._path, self._view.pose[:2])
        return np.concatenate([foot[None], self._path[leg + 1 :]])


class AStar(_Planning):
    """A* (Hart et al. 1968)."""


class Rrt(_Planning):
    """RRT (LaValle 1998), which heeds no cost: the agent keeps its path until people are on it."""

    planner, again = "rrt", RrtConfig(samples=1000)

    def _known(self, grid, cost):
        known = super()._known(grid, cost)
        if known is None:
            return None
        ahead = known[: _reaching(known, _AHEAD)]
        length = np.hypot(*np.diff(ahead, axis=0).T).sum()
        return known if path_cost(ahead, grid, cost) <= _QUIET * length else None


class RrtStar(_Planning):
    """RRT* (Karaman and Frazzoli 2011)."""

    planner = "rrt-star"
    config = again = RrtStarConfig(enough=100)  # a plan is replaced before more samples would pay


class CarrtStar(_Planning):
    """Cost-aware RRT*."""

    planner = "carrt-star"
    config = again = CarrtStarConfig(enough=70)
