"""Agents of the Global track: a planner on the map with people as costs, and a follower that replans."""

import numpy as np

from bson.agents.global_view import GlobalView
from bson.planners import CarrtStarConfig, NoPath, PurePursuit, RrtStarConfig, plan, shortcut, social_cost

_CLEARANCE = 0.40  # kept from walls: the Jackal's circle of 0.31 m, and what a follower cuts of a corner [m]


class _Planning:
    """Plans every `replan` decisions, or when the way is blocked, and follows; stops where there is no way."""

    track, sensor = "global", "lidar2d"
    planner, replan, config = "astar", 3, None
    top = np.array([2.0, 2.0])  # that an action of 1 stands for [m/s, rad/s]

    def __init__(self):
        self._follower, self._view = PurePursuit(), GlobalView()
        self.reset(0)

    def reset(self, seed):
        """Begins an episode."""
        self._rng = np.random.default_rng(seed)
        self._view.reset()
        self._grid = self._path = None
        self._age = 0

    def __call__(self, observation):
        """The action for a Global observation (see bson.env.BsonEnv)."""
        self._view.see(observation)
        if self._grid is None:
            self._grid = self._view.map.inflated(_CLEARANCE)
        if self._path is None or self._age >= self.replan:
            self._plan()
        self._age += 1
        if self._path is None:
            return np.zeros(2)
        return np.clip(np.array(self._follower(self._view.pose, self._path)) / self.top, -1.0, 1.0)

    def _plan(self):
        self._age = 0
        view = self._view
        cost = social_cost(self._grid, view.people, view.people_velocity)
        start, end = self._grid.nearest_free(view.pose[:2]), self._grid.nearest_free(view.goal)
        try:
            path = plan(self.planner, self._grid, start, end, cost, self._rng, self.config)
        except NoPath:
            return  # the last path, if there is one, is better than none
        path = shortcut(path, self._grid, cost)
        self._path = np.concatenate([path[:-1], view.goal[None]])


class AStar(_Planning):
    """A* (Hart et al. 1968)."""


class Rrt(_Planning):
    """RRT (LaValle 1998)."""

    planner, replan = "rrt", 10


class RrtStar(_Planning):
    """RRT* (Karaman and Frazzoli 2011)."""

    planner, replan, config = "rrt-star", 10, RrtStarConfig(enough=300)  # it plans anew before more would pay


class CarrtStar(_Planning):
    """Cost-aware RRT*."""

    planner, replan, config = "carrt-star", 10, CarrtStarConfig(enough=200)
