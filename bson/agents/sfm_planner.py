"""A social-force planner (Ferrer, Garrell and Sanfeliu, "Robot companion: a social-force based approach with human
awareness-navigation in crowded environments", IROS 2013), on the Global track.

The robot moves as the social force model (Helbing and Molnar, Phys. Rev. E 1995) moves a pedestrian: by a force towards
where it wants to go, and forces away from people and walls. The forces are those of the pedestrians
(macid.pedestrians.social_force). The robot differs from a pedestrian in three things.

- It wants to go along the shortest way around the walls: down the field of `bson.planners.way_field`.
- It is faster, and people count from surface to surface.
- It can't step aside: as in `bson.agents.orca_oracle` the force acts on a point `ahead` of its centre, and speed and
  yaw rate (v, w) give that point the velocity (v, ahead w).

Nobody looks ahead here beyond the forces' own anticipation of a step: in a crowd the robot is pushed about.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from bson.agents.contract import Setting
from bson.agents.global_view import GlobalView
from bson.agents.orca_oracle import nearest_rows, occupied_boxes
from bson.planners import Grid
from bson.planners.way_field import rate_by_clearance, way_field
from macid import geometry
from macid.pedestrians.social_force import SocialForce
from macid.state import CrowdState, Traits


@dataclass(frozen=True)
class SfmConfig:
    """What `SfmPlanner` assumes. Metres and seconds."""

    ahead: float = 0.2  # distance from the robot's centre to the point that the force moves
    desired_speed: float = 1.9  # at most the robot's top speed [m/s]
    relaxation_time: float = 0.3  # in which the robot takes up its desired velocity
    step_time: float = 1.0  # how far ahead another's step reaches
    person_strength: float = 2.1  # [m2/s2]
    person_range: float = 0.3
    obstacle_strength: float = 1.0  # [m2/s2]
    obstacle_range: float = 0.15
    people: int = 16  # number of the nearest people who count
    walls: int = 12  # likewise
    margin: float = 0.12  # beside the radius: the least distance between ways and walls where there is room
    comfort: float = 0.5  # further distance from walls within which a metre of way costs more
    max_back_speed: float = 0.6  # at most the robot's top speed [m/s]
    longest_period: float = 0.2  # between decisions: forces change faster than people walk


class SfmPlanner:
    """The agent: called with a world's Global observation each control period, it returns an action (2,) in [-1, 1]."""

    track, sensor = "global", "lidar2d"

    def __init__(self, setting: Setting | None = None, config: SfmConfig = SfmConfig()):
        setting = Setting.default("global") if setting is None else setting
        setting.check_period(config.longest_period)
        self.config, self._top, self._period = config, setting.top, setting.control_period
        self._radius, self._person_radius = setting.robot.radius, setting.person_radius
        self._back = min(config.max_back_speed, setting.robot.max_speed)
        self._force = SocialForce(
            setting.control_period,
            desired_speed=min(config.desired_speed, setting.robot.max_speed),
            max_speed=setting.robot.max_speed,
            relaxation_time=max(config.relaxation_time, 1.5 * setting.control_period),
            person_strength=config.person_strength,
            person_range=config.person_range,
            step_time=config.step_time,
            obstacle_strength=config.obstacle_strength,
            obstacle_range=config.obstacle_range,
            step_by_progress=True,
            veer=0.0,
            body_radius=setting.person_radius,
        )
        self._view = GlobalView(setting)
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Forgets the last episode. The agent draws nothing, so the seed has no effect."""
        self._view.reset()
        self._slopes = self._boxes = None

    def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The action (2,) for one world's Global observation (see bson.interfaces.gym.BsonEnv)."""
        view, c = self._view, self.config
        view.see(observation)
        if self._slopes is None or self._boxes is None:
            rate = rate_by_clearance(view.map.occupied, view.map.clearance, self._radius + c.margin, c.comfort)
            field = way_field(view.map, view.goal, rate)
            down, across = np.gradient(field)
            self._slopes, self._boxes = np.stack([across, down], axis=-1), occupied_boxes(view.map)
        yaw = view.pose[2]
        point = view.pose[:2] + geometry.rotate(np.array([c.ahead, 0.0]), yaw)
        v, w = np.asarray(observation["velocity"], float)
        velocity = geometry.rotate(np.array([v, c.ahead * w]), yaw)
        people = np.column_stack([view.people, view.people_velocity])
        people = nearest_rows(people, np.hypot(*(view.people - point).T), c.people)
        walls = nearest_rows(self._boxes, geometry.point_box_distance(point, self._boxes), c.walls)
        place, speed = np.vstack([point, people[:, :2]]), np.vstack([velocity, people[:, 2:]])
        goal = point + self._towards(view.map, point)
        radii = np.array([self._radius, *[self._person_radius] * c.people])
        wanted = np.asarray(_velocity(self._force, *map(jnp.asarray, (place, speed, goal, walls, radii))), float)
        forward, aside = geometry.to_body(wanted, yaw)
        return np.clip([max(forward, -self._back) / self._top[0], aside / c.ahead / self._top[1]], -1.0, 1.0)

    def _towards(self, grid: Grid, point):
        """The direction (2,) of the shortest way from `point` (2,); straight to the goal near it."""
        straight = self._view.goal - point
        if np.hypot(*straight) < 1.0:
            return straight
        assert self._slopes is not None
        row, column = np.clip(grid.cells(point), 0, np.subtract(grid.shape, 1))
        slope = self._slopes[row, column]
        return -slope / max(float(np.hypot(*slope)), 1e-9)


@functools.partial(jax.jit, static_argnums=0)
def _velocity(force, place, velocity, goal, boxes, radii):
    """The velocity (2,) [m/s] that the force gives the first of the people `place`, `velocity` (n, 2) for `goal`."""
    n, still = place.shape[0], jnp.zeros(place.shape[0])
    state = CrowdState(place, still, velocity, still, jnp.zeros(n, bool), Traits(radius=radii))
    goals = (place + velocity).at[0].set(goal)  # people want to go on as they walk
    grown = boxes.at[:, 2:4].add(radii[0])
    wanted = velocity[0] + force.acceleration(state, grown, goals)[0] * force.period
    return wanted * jnp.minimum(1.0, force.max_speed / jnp.maximum(geometry.norm(wanted), 1e-6))
