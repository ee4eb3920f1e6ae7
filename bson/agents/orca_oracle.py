"""ORCA on ground truth: an agent that knows where everybody is and how they walk (Global track).

The agent uses the half-planes and linear programmes of the pedestrians' ORCA (macid.pedestrians.orca). The robot
differs from a pedestrian in three things.

- It can't step aside. So ORCA moves a point `ahead` of its centre: speed and yaw rate (v, w) give that point the
  velocity (v, ahead w) in the robot's frame, so that it can be moved to any side (Snape et al., "Smooth and
  collision-free navigation for multiple robots under differential-drive constraints", IROS 2010). The limits are
  further half-planes, and the disc around the point covers the whole footprint.
- People don't know that the robot follows ORCA, and needn't give way: the robot takes the share `responsibility` of
  each avoidance.
- Walls are the rectangles of the map's occupied cells, and the preferred velocity leads to the next corner of an A*
  path, as ORCA alone finds no way out of a dead end.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from bson.agents.contract import Setting
from bson.agents.global_view import GlobalView
from bson.planners import NoPath, plan, shortcut
from bson.planners.grid import Grid
from macid import geometry
from macid.pedestrians.orca import ORCA, best_velocity
from macid.pedestrians.social_force import left_of
from macid.state import parking_place


@dataclass(frozen=True)
class OrcaOracleConfig:
    """What `OrcaOracle` assumes. Metres and seconds."""

    ahead: float = 0.2  # distance from the robot's centre to the point that ORCA moves
    preferred_speed: float = 1.8  # at most the robot's top speed [m/s]
    max_back_speed: float = 0.6  # likewise [m/s]
    responsibility: float = 1.0  # the robot's share of an avoidance; 0.5 counts on people's half
    neighbors: int = 10  # number of the nearest people who count
    horizon: float = 2.0  # looked ahead for people
    margin: float = 0.05  # extra distance kept from people and walls
    walls: int = 8  # number of the nearest walls that count
    wall_horizon: float = 1.0
    path_clearance: float = 0.15  # extra distance between the path and walls, beside the disc's radius
    replan: float = 1.0  # least time between two plans
    longest_period: float = 0.5  # between decisions: a person walks 0.7 m meanwhile


class OrcaOracle:
    """The agent: called with a world's Global observation each control period, it returns an action (2,) in [-1, 1]."""

    track, sensor = "global", "lidar2d"

    def __init__(self, setting: Setting | None = None, config: OrcaOracleConfig = OrcaOracleConfig()):
        setting = Setting.default("global") if setting is None else setting
        setting.check_period(config.longest_period)
        self._robot = robot = setting.robot
        self._person_radius = setting.person_radius
        self._period, self._replan = setting.control_period, setting.steps(config.replan)
        self.config = dataclasses.replace(
            config,
            preferred_speed=min(config.preferred_speed, robot.max_speed),
            max_back_speed=min(config.max_back_speed, robot.max_speed),
        )
        self.radius = math.hypot(robot.half_length + config.ahead, robot.half_width)  # of the point's disc
        self._view = GlobalView(setting)
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Forgets the last episode. The agent draws nothing, so the seed has no effect."""
        self._view.reset()
        self._grid = self._boxes = self._path = None
        self._planned = 0  # decisions since the last plan

    def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The action (2,) for one world's Global observation (see bson.interfaces.gym.BsonEnv)."""
        view, robot = self._view, self._robot
        view.see(observation)
        if self._grid is None or self._boxes is None:
            self._grid = view.map.inflated(self.radius + self.config.path_clearance)
            self._boxes = occupied_boxes(view.map)
        yaw = view.pose[2]
        point = view.pose[:2] + geometry.rotate(np.array([self.config.ahead, 0.0]), yaw)
        v, w = np.asarray(observation["velocity"], float)
        velocity = geometry.rotate(np.array([v, self.config.ahead * w]), yaw)
        people = np.column_stack([view.people, view.people_velocity])
        people = nearest_rows(people, np.hypot(*(view.people - point).T), self.config.neighbors)
        walls = nearest_rows(self._boxes, geometry.point_box_distance(point, self._boxes), self.config.walls)
        position, velocity = np.vstack([point, people[:, :2]]), np.vstack([velocity, people[:, 2:]])
        chosen = _choose(
            self.config,
            self._period,
            self.radius,
            self._person_radius,
            robot,
            position,
            velocity,
            yaw,
            self._waypoint(self._grid, point),
            walls,
        )
        forward, aside = geometry.to_body(np.asarray(chosen, float), yaw)
        return np.clip([forward / robot.max_speed, aside / self.config.ahead / robot.max_yaw_rate], -1.0, 1.0)

    def _waypoint(self, grid, point):
        """The place (2,) on the free `grid` to go to from `point` (2,): the farthest corner of the path that is in
        sight."""
        path = self._path
        while path is not None and len(path) > 1 and grid.lines_are_free(point, path[1]):
            path = path[1:]
        lost = path is None or not grid.lines_are_free(point, path[0])
        if path is None or (lost and self._planned >= self._replan):
            path, self._planned = self._plan(grid, point), 0
        self._planned += 1
        self._path = path
        return path[0]

    def _plan(self, grid, point):
        """The corners (N, 2) of a shortest path from `point` (2,) to the goal; the goal alone where there is no
        path."""
        goal = self._view.goal
        try:
            path = plan("astar", grid, grid.nearest_free(point), grid.nearest_free(goal))
        except NoPath:
            return goal[None]
        return np.concatenate([shortcut(path, grid)[1:-1], goal[None]])


def nearest_rows(rows: np.ndarray, distance: np.ndarray, count: int) -> np.ndarray:
    """The `count` of `rows` (N, n) with the least `distance` (N,), filled up with rows that are out of reach."""
    nearest = rows[np.argsort(distance, kind="stable")[:count]]
    missing = np.zeros((count - len(nearest), rows.shape[1]))
    missing[:, :2] = parking_place(np.arange(len(missing)))
    return np.vstack([nearest, missing])


@functools.partial(jax.jit, static_argnums=(0, 1, 2, 3, 4))
def _choose(config, period, radius, person_radius, robot, position, velocity, yaw, waypoint, boxes):
    """The velocity (2,) [m/s] of the point, which is row 0 of `position` and `velocity` (1 + neighbors, 2)."""
    people = ORCA(
        period,
        preferred_speed=config.preferred_speed,
        radius=(radius + person_radius) / 2,  # the mean of both radii, as ORCA takes one radius for everybody
        margin=config.margin / 2,
        max_neighbors=config.neighbors,
        horizon=config.horizon,
    )
    walls = ORCA(
        period,
        max_speed=robot.max_speed,
        radius=radius,
        margin=config.margin,
        max_obstacles=config.walls,
        obstacle_horizon=config.wall_horizon,
    )
    normal, offset = people.neighbor_half_planes(position, velocity)
    normal, half = normal[0], offset[0]
    now = normal @ velocity[0]
    offset = now + 2.0 * config.responsibility * (half - now)  # the pedestrians' ORCA gives each half an avoidance
    wall_normal, wall_offset = walls.obstacle_half_planes(position[:1], velocity[:1], boxes)
    ahead = geometry.heading(yaw)
    left = left_of(ahead)
    aside = config.ahead * robot.max_yaw_rate
    normal = jnp.concatenate([wall_normal[0], jnp.stack([ahead, left, -left]), normal])
    own = -jnp.asarray([config.max_back_speed, aside, aside])
    offset = jnp.concatenate([wall_offset[0], own, offset])
    target = people.preferred_velocity(position[:1], waypoint[None])
    return best_velocity(normal[None], offset[None], config.walls + 3, target, robot.max_speed)[0]


def occupied_boxes(grid: Grid) -> np.ndarray:
    """Rectangles (N, 5), as in `macid.geometry`, that cover the occupied cells of `grid`, and the map's edge.

    Neighbouring cells of a row share a rectangle, and so do equal stretches of rows above each other.
    """
    padded = np.pad(grid.occupied, 1, constant_values=True)
    done = np.zeros_like(padded)
    boxes = []
    for i, j in np.argwhere(padded):
        if done[i, j]:
            continue
        run = padded[i, j:] & ~done[i, j:]
        to_j = j + (len(run) if run.all() else int(run.argmin()))
        to_i = i + 1
        while to_i < len(padded) and (padded[to_i, j:to_j] & ~done[to_i, j:to_j]).all():
            to_i += 1
        done[i:to_i, j:to_j] = True
        corners = grid.unscaled(np.array([[j, i], [to_j, to_i]]) - 1.0)
        boxes.append([*corners.mean(axis=0), *(np.diff(corners, axis=0)[0] / 2), 0.0])
    return np.array(boxes)
