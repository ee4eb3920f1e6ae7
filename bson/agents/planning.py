"""Agents of the Global track: a planner on the map with people as costs, and a follower that replans."""

import numpy as np

from bson.planners import CarrtStarConfig, Grid, NoPath, PurePursuit, RrtStarConfig, plan, shortcut, social_cost
from macid import geometry

_CLEARANCE = 0.40  # kept from walls: the Jackal's circle of 0.31 m, and what a follower cuts of a corner [m]
_PERIOD = 0.1  # between decisions, from which people's velocities are guessed [s]


class _Planning:
    """Plans every `replan` decisions, or when the way is blocked, and follows; stops where there is no way."""

    track, sensor = "global", "lidar2d"
    planner, replan, config = "astar", 3, None
    top = np.array([2.0, 2.0])  # that an action of 1 stands for [m/s, rad/s]

    def __init__(self):
        self._follower = PurePursuit()
        self.reset(0)

    def reset(self, seed):
        """Begins an episode."""
        self._rng = np.random.default_rng(seed)
        self._grid = self._path = self._people = None
        self._age = 0

    def __call__(self, observation):
        """The action for a Global observation (see bson.env.BsonEnv)."""
        pose = np.asarray(observation["pose"], float)
        goal = pose[:2] + geometry.rotate(np.asarray(observation["goal"], float), pose[2])
        if self._grid is None:
            raw = Grid(observation["map"] > 0, float(observation["map_resolution"][0]), observation["map_origin"])
            self._grid = raw.inflated(_CLEARANCE)
        people = np.asarray(observation["people"], float)
        velocity = np.zeros_like(people) if self._people is None else (people - self._people) / _PERIOD
        self._people = people
        if self._path is None or self._age >= self.replan:
            self._plan(pose, goal, people, velocity)
        self._age += 1
        if self._path is None:
            return np.zeros(2)
        return np.clip(np.array(self._follower(pose, self._path)) / self.top, -1.0, 1.0)

    def _plan(self, pose, goal, people, velocity):
        self._age = 0
        cost = social_cost(self._grid, people, velocity)
        start, end = self._grid.nearest_free(pose[:2]), self._grid.nearest_free(goal)
        try:
            path = plan(self.planner, self._grid, start, end, cost, self._rng, self.config)
        except NoPath:
            return  # the last path, if there is one, is better than none
        path = shortcut(path, self._grid, cost)
        self._path = np.concatenate([path[:-1], goal[None]])


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
