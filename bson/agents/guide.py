"""What guided robots see (bson.guided) of a world: with the map and people's places, or by the LIDAR alone."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bson import guided
from bson.agents.contract import Setting
from bson.agents.global_view import GlobalView, Standing
from bson.agents.scan_map import MappedTracking
from bson.agents.tracking import TrackingConfig
from bson.agents.ways import Ways
from bson.features import SCANS, closeness
from bson.planners import Grid
from macid import geometry

MARGIN = 0.15  # between the robot's circle and walls on its way [m]
_FIELD = math.radians(135.0)  # to either side of the LIDAR's middle
_SEEN = 0.6  # a person is in sight where the beam ends at most this much nearer than its middle [m]
_MAP_SHARE = 1.5  # side of the map that a robot makes itself, in sides of the world's
_REPLAN = 3.0  # at least so often a way is looked for anew, as walls and who stood there may have gone [s]
_LOOK = 0.2  # between two looks whether walls or people who stand were found on the way [s]


class Memory:
    """The last scans, of which the vector of bson.guided tells beside what is ahead."""

    def __init__(self, setting: Setting):
        self._top = (setting.robot.max_speed, setting.robot.max_yaw_rate)
        self._radii = setting.robot.radius + setting.person_radius
        self._scans: np.ndarray | None = None

    def vector(
        self,
        observation: Mapping[str, np.ndarray],
        ahead: tuple[np.ndarray, np.ndarray, float],
        people: tuple[np.ndarray, np.ndarray],
    ) -> np.ndarray:
        """The vector (guided.SIZE,) of one world. ahead: as Ways.ahead gives it; people: places and velocities (n, 2).
        All in the robot frame [m, m/s]. To be called in each control step."""
        scan = closeness(observation["lidar"])
        if self._scans is None:
            self._scans = np.repeat(scan[None], SCANS[-1] + 1, axis=0)
        else:
            self._scans[1:] = self._scans[:-1]
            self._scans[0] = scan
        aim, beyond, length = ahead
        own_velocity = np.array([observation["velocity"][0], 0.0])
        return np.concatenate(
            [
                guided.own(observation, aim, beyond, np.asarray(length), self._top),
                self._scans[np.array(SCANS)].ravel(),
                guided.people(*people, own_velocity, self._radii).ravel(),
            ]
        )


class Replanning:
    """A way round what stands, looked for anew where walls or standing people were found on the old one (as in D* Lite,
    Koenig and Likhachev, AAAI 2002), or the last look was long ago. Where people stand in all ways, it leads as if they
    were not there."""

    ways: Ways  #: the present ones

    def __init__(self, setting: Setting):
        self._replan, self._look_every = setting.steps(_REPLAN), setting.steps(_LOOK)
        self._planned: int | None = None  # the step of the last plan
        self._part: Any = ()  # of the map, over which the ways lead

    def look(
        self,
        step: int,
        place: np.ndarray,
        seen: Callable[[], tuple[np.ndarray, np.ndarray]],
        around: Callable[[np.ndarray], tuple[Ways, Any]],
    ) -> None:
        """Looks at `step` whether the way from `place` (2,) [m] still leads on. seen: gives the cells (rows, columns)
        bool that walls occupy, and those that standing people do; around: makes the Ways around occupied cells, and the
        part of them that the Ways are of."""
        if self._planned is not None and step % self._look_every:
            return
        walls, standing = seen()
        occupied = walls | standing
        old = self._planned is None or step - self._planned >= self._replan
        if not old and not self.ways.blocked(occupied[self._part], place):
            return
        self._planned = step
        self.ways, self._part = around(occupied)
        if standing.any() and not self.ways.lead_from(place):
            self.ways, self._part = around(walls)


class Guide:
    """The guide of one robot of a `setting` in one episode, with the map's `grid`, inflated by the robot, and its
    `goal` (2,). The way leads round people who stand."""

    def __init__(self, setting: Setting, grid: Grid, goal: np.ndarray):
        self._open, self._memory, self._period = Ways(grid, goal), Memory(setting), setting.control_period
        self._clearance, self._person_radius = setting.robot.radius + MARGIN, setting.person_radius
        self._plan, self._standing = Replanning(setting), Standing(setting.control_period)
        self._steps = 0
        self._people: np.ndarray | None = None
        self.length = 0.0  #: of the way from the last place seen [m]
        self.aim = np.zeros(2)  #: the farthest point of that way in sight, robot frame [m]

    def see(
        self, observation: Mapping[str, np.ndarray], pose: np.ndarray, people: np.ndarray, in_sight: bool = False
    ) -> np.ndarray:
        """The vector (guided.SIZE,) of one world's Local `observation`, of the robot's `pose` (3,) and of people's
        places (K, 2), world frame [m, rad]; to be called in each control step.

        People count as standing until they were seen twice. in_sight: whether only those whom the LIDAR sees are told
        of.
        """
        before = people if self._people is None else self._people
        self._people = people.copy()
        walk = (people - before) / self._period
        self._standing.see(walk)
        self._plan.look(self._steps, pose[:2], self._seen, self._around)
        self._steps += 1
        aim, beyond, self.length = self._plan.ways.ahead(pose[:2])
        velocity = geometry.to_body(walk, pose[2])
        place = geometry.to_body(people - pose[:2], pose[2])
        if in_sight:
            seen = visible(place, observation["lidar"])
            place, velocity = place[seen], velocity[seen]
        self.aim, beyond = geometry.to_body(np.stack([aim, beyond]) - pose[:2], pose[2])
        return self._memory.vector(observation, (self.aim, beyond, self.length), (place, velocity))

    def _seen(self):
        """The cells that walls occupy, with the robot's room, and those that standing people do."""
        assert self._people is not None
        grid, stand = self._open.grid, self._people[self._standing.stands]
        return grid.occupied, grown_by(grid.counted(stand) > 0, self._person_radius, grid.resolution)

    def _around(self, occupied):
        """The ways round what is `occupied`, and the part of the map that they are of: all."""
        grid = self._open.grid
        people = occupied & ~grid.occupied
        if not people.any():
            return self._open, ...
        grown = grid.occupied | grown_by(people, self._clearance, grid.resolution)
        return Ways(Grid(grown, grid.resolution, grid.origin), self._open.goal), ...


def visible(place: np.ndarray, lidar: np.ndarray) -> np.ndarray:
    """Whether the scan `lidar` (beams,) [m] sees the people at `place` (n, 2), robot frame [m]: (n,) bool."""
    angle, distance = np.arctan2(place[:, 1], place[:, 0]), np.hypot(place[:, 0], place[:, 1])
    beam = np.rint((angle + _FIELD) / (2 * _FIELD) * (len(lidar) - 1)).astype(int).clip(0, len(lidar) - 1)
    return (np.abs(angle) < _FIELD) & (lidar[beam] > distance - _SEEN)


def grown_by(occupied: np.ndarray, radius: float, resolution: float) -> np.ndarray:
    """Cells (rows, columns) whose centre is within `radius` [m] of an occupied cell of the side `resolution` [m]: those
    of Grid.inflated but for the map's edge, sooner where few cells are occupied."""
    reach = int(radius / resolution + 0.5)
    offsets = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).T
    gaps = np.maximum(np.abs(offsets) - 0.5, 0.0) * resolution
    offsets = offsets[np.hypot(*gaps.T) <= radius]
    cells = (np.argwhere(occupied)[:, None] + offsets).reshape(-1, 2)
    cells = cells[((cells >= 0) & (cells < occupied.shape)).all(axis=-1)]
    grown = np.zeros_like(occupied)
    grown[tuple(cells.T)] = True
    return grown


class MapSight:
    """Sees by the map and people's places of the Global track. Call `reset` as an episode begins, then `see`."""

    track = "global"

    def __init__(self, setting: Setting):
        self._setting, self._view = setting, GlobalView(setting)
        self.reset()

    def reset(self) -> None:
        """Begins an episode."""
        self._view.reset()
        self._guide: Guide | None = None

    def see(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The vector (guided.SIZE,) of one world's observation."""
        view = self._view
        view.see(observation)
        if self._guide is None:
            self._guide = Guide(self._setting, view.map.inflated(self._setting.robot.radius + MARGIN), view.goal)
        return self._guide.see(observation, view.pose, view.people)

    @property
    def aim(self) -> np.ndarray:
        """The farthest point (2,) in sight of the way ahead, robot frame [m]."""
        assert self._guide is not None, "nothing was seen yet"
        return self._guide.aim


class ScanSight(MappedTracking):
    """Sees by the LIDAR alone: people are tracked, and the way leads over a map that the robot makes of the walls that
    it has met; what it has not seen is free."""

    track = "local"
    aim: np.ndarray  #: the farthest point (2,) in sight of the way ahead, robot frame [m]

    def __init__(self, setting: Setting):
        super().__init__(setting, TrackingConfig(), _MAP_SHARE)
        self._setting = setting
        self.reset()

    def reset(self) -> None:
        """Begins an episode."""
        self.forget()
        self._memory, self._plan = Memory(self._setting), Replanning(self._setting)

    def see(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:  # type: ignore[override]
        """The vector (guided.SIZE,) of one world's observation."""
        return self._memory.vector(observation, self.look_ahead(observation), self.people)

    def look_ahead(self, observation: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, float]:
        """The way ahead as Ways.ahead gives it, in the robot frame, after one world's observation; instead of `see`,
        for who needs no vector."""
        step = self._steps
        super().see(np.asarray(observation["goal"], float), np.asarray(observation["velocity"], float), observation)
        self._plan.look(step, self._position, self._found, self._ways_around)
        aim, beyond, length = self._plan.ways.ahead(self._position)
        self.aim, beyond = (np.stack([aim, beyond]) - self._position) @ self._rotation
        return self.aim, beyond, length

    def _found(self):
        """The cells of the map that walls and standing people occupy."""
        assert self._map is not None
        people, stand = self.crowd()
        standing = self._map.marked(people[stand])
        return self._map.occupied, grown_by(standing, self.config.person_radius, self._map.resolution)

    def _ways_around(self, occupied):
        """The ways around what is `occupied`, a (rows, columns) of the map, and the part of it that they are of."""
        # No shortest way leaves the rectangle around its ends and all walls by more than it keeps off them.
        assert self._map is not None
        radius, size = self._setting.robot.radius + MARGIN, self._map.resolution
        ends = np.floor((np.stack([self._position, np.zeros(2)]) - self._map.origin) / size).astype(int)[:, ::-1]
        inside = np.concatenate([np.argwhere(occupied), ends.clip(0, np.array(occupied.shape) - 1)])
        border = 2 + int(np.ceil(radius / size))
        low = np.maximum(inside.min(axis=0) - border, 0)
        part = tuple(map(slice, low, inside.max(axis=0) + border + 1))
        grown = grown_by(occupied[part], radius, size)
        return Ways(Grid(grown, size, self._map.origin + low[::-1] * size), np.zeros(2)), part
