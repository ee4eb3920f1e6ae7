"""A map that the robot makes itself, of the walls that its LIDAR meets, while it tracks people."""

from typing import Any

import numpy as np
from scipy import ndimage

from bson.agents.contract import Setting
from bson.agents.scan import Scan
from bson.agents.tracking import Tracking
from bson.planners import Grid

_FAR = 25.0  # beams that end farther away are too sparse to tell a wall from a gap [m]
_MOST, _SURE = 8, 3  # the most scans that count for a cell, and how many make it occupied
_LOOK = 12.0  # within which cells are looked at again [m]
_BEYOND = 0.4  # a beam that ends so far beyond a cell has seen through it [m]
_BESIDE = 3  # beams to either side that must have seen through it too


class ScanMap:
    """Which cells of a square of `side` [m] hold something that stands, as far as scans have shown; what no scan has
    shown is free (as in D* Lite, Koenig and Likhachev, AAAI 2002).

    A scan that ends in a cell counts for it, a scan that sees through it counts against it. Any frame that stays will
    do.
    """

    def __init__(self, scan: Scan, side: float, resolution: float, centre: np.ndarray):
        cells = 2 * max(1, round(side / resolution / 2))
        self._scan, self.resolution = scan, resolution
        self.origin = np.asarray(centre, float) - cells * resolution / 2
        self._count = np.zeros((cells, cells), np.int8)

    @property
    def occupied(self) -> np.ndarray:
        """Whether something stands in each cell (rows, columns)."""
        return self._count >= _SURE

    @property
    def grid(self) -> Grid:
        """The map as a Grid."""
        return Grid(self.occupied, self.resolution, self.origin)

    def marked(self, places: np.ndarray) -> np.ndarray:
        """The cells (rows, columns) in which the `places` (n, 2) [m] are."""
        found, cells = np.zeros(self._count.shape, bool), self._cells(places)
        found[tuple(cells[self._inside(cells)].T)] = True
        return found

    def add(self, scan: np.ndarray, people: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> None:
        """Takes in a `scan` (beams,) [m] of which the beams `people` (beams,) meet people. position (2,), rotation (2,
        2): the robot's, in the map's frame."""
        ends = np.flatnonzero((scan < min(self._scan.reach, _FAR)) & ~people)
        cells = self._cells(self._scan.points(scan, ends) @ rotation.T + position)
        hit = np.unique(cells[self._inside(cells)], axis=0)
        self._look_again(scan, position, rotation)
        self._count[tuple(hit.T)] = np.minimum(self._count[tuple(hit.T)] + 1, _MOST)

    def _look_again(self, scan, position, rotation):
        """Counts a `scan` against the cells that it has seen through."""
        reach = int(_LOOK / self.resolution)
        row, column = self._cells(position)
        top, left = max(row - reach, 0), max(column - reach, 0)
        near = np.argwhere(self._count[top : max(row + reach, 0), left : max(column + reach, 0)] > 0)
        near = near + np.array([top, left])
        if not len(near):
            return
        centres = (near[:, ::-1] + 0.5) * self.resolution + self.origin
        offset = (centres - position) @ rotation - self._scan.place
        angle, distance = np.arctan2(offset[:, 1], offset[:, 0]), np.hypot(offset[:, 0], offset[:, 1])
        least = ndimage.minimum_filter1d(scan, 2 * _BESIDE + 1)
        through = self._scan.sees(angle) & (least[self._scan.beam_at(angle)] > distance + _BEYOND)
        self._count[tuple(near[through].T)] -= 1

    def _cells(self, points):
        return np.floor((points - self.origin) / self.resolution).astype(int)[..., ::-1]

    def _inside(self, cells):
        return ((cells >= 0) & (cells < self._count.shape)).all(axis=-1)


class MappedTracking(Tracking):
    """Tracking that also keeps a ScanMap of what is nobody, in the goal-bound frame. share: the side of the map, in
    sides of the world's."""

    _seen: tuple[np.ndarray, np.ndarray]  # the last scan (beams,) [m], and which of its beams (beams,) meet people

    def __init__(self, setting: Setting, config: Any, share: float):
        super().__init__(setting, config)
        self._side, self._resolution = share * setting.map.size, setting.map.resolution

    def forget(self) -> None:
        """Forgets the last episode."""
        super().forget()
        self._map: ScanMap | None = None

    def _look(self, scan):
        if self._map is None:
            self._map = ScanMap(self._scan, self._side, self._resolution, self._position / 2)
        centres, beams = self._find_people(scan)
        self._track(centres @ self._rotation.T + self._position, scan)
        self._map.add(scan, beams, self._position, self._rotation)
        self._seen = scan, beams
        return centres

    def new_walls(self, sector: float, reach: float) -> np.ndarray | None:
        """The nearest point (n, 2) [m], robot frame, of what is nobody in each `sector` [rad] of this step's scan that
        has one within `reach` [m]; None where this step has no scan."""
        if self._old:
            return None
        scan, people = self._seen
        scan = np.where(people, np.inf, scan)
        nearest = self._scan.nearest(scan, self._scan.beams_in(sector))
        return self._scan.points(scan, nearest[scan[nearest] < reach])
