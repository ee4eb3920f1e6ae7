"""An occupancy grid, and the cost of a way over it."""

import functools
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy import ndimage

from macid import routing
from macid.layout import Layout

_TOUCH = 1e-9  # a point this close to a line between cells is on the line [cells]


class NoPath(ValueError):
    """There is no way from start to goal, or none was found within the samples."""


@dataclass(frozen=True, eq=False)
class Grid:
    """An occupancy grid (ROS's convention): cell (i, j) is centred at `origin + resolution * (j + 1/2, i + 1/2)`.

    occupied: (rows, columns) bool. resolution: side of a cell [m]. origin: (2,), the outer corner of cell (0, 0), world
    frame [m]. Occupied cells are closed squares: a point that touches one, or the map's edge, is not free. Raises
    ValueError for arguments of other forms.
    """

    occupied: np.ndarray
    resolution: float
    origin: np.ndarray

    def __post_init__(self):
        occupied, origin = np.array(self.occupied, dtype=bool), np.array(self.origin, dtype=float)
        if occupied.ndim != 2 or not occupied.size:
            raise ValueError(f"A grid needs (rows, columns) of cells, not an array of shape {occupied.shape}.")
        if not 0 < self.resolution < np.inf:
            raise ValueError(f"A grid's resolution must be positive, not {self.resolution!r}.")
        if origin.shape != (2,) or not np.isfinite(origin).all():
            raise ValueError(f"A grid's origin must be two finite numbers, not {self.origin!r}.")
        occupied.flags.writeable = origin.flags.writeable = False
        object.__setattr__(self, "occupied", occupied)
        object.__setattr__(self, "origin", origin)

    @classmethod
    def from_layout(cls, layout: Layout, resolution: float = 0.25, radius: float = 0.0) -> Self:
        """The grid of a macid Layout: occupied where a disc of `radius` [m] at the cell's centre touches something.

        resolution [m] is adapted to a whole number of cells a side.
        """
        resolution = layout.size / max(1, round(layout.size / resolution))
        return cls(routing.occupancy_grid(layout, resolution, radius), resolution, np.full(2, -layout.size / 2))

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, columns)."""
        return self.occupied.shape

    def cells(self, points: Any) -> np.ndarray:
        """Cells (..., 2) int (row, column) that `points` (..., 2) [m] lie in, on the map or off it."""
        return np.floor(self.scaled(points)).astype(int)[..., ::-1]

    def centres(self, cells: Any) -> np.ndarray:
        """Centres (..., 2) [m] of `cells` (..., 2) (row, column)."""
        return self.unscaled(np.asarray(cells)[..., ::-1] + 0.5)

    def free(self, points: Any) -> np.ndarray:
        """Whether each of `points` (..., 2) [m] is on the map and touches no occupied cell: (...) bool."""
        return ~self._touches(self.scaled(points))

    def lines_are_free(self, starts: Any, ends: Any) -> np.ndarray:
        """Whether the segments from `starts` to `ends` (..., 2) [m] stay on the map and touch no occupied cell."""
        starts, ends = np.broadcast_arrays(self.scaled(starts), self.scaled(ends))
        costs = line_costs(self, None, starts.reshape(-1, 2), ends.reshape(-1, 2))
        return np.isfinite(costs).reshape(starts.shape[:-1])

    @functools.cached_property
    def clearance(self) -> np.ndarray:
        """Distance (rows, columns) [m] from each cell's centre to the nearest occupied cell or the map's edge."""
        # Of the points of an occupied square the nearest to another cell's centre is one of those that _closed marks.
        return (np.asarray(ndimage.distance_transform_edt(~self._closed)) * (self.resolution / 2))[1::2, 1::2]

    def inflated(self, radius: float) -> "Grid":
        """The grid with obstacles and the map's edge grown by `radius` [m].

        A disc of that radius fits at the centre of each free cell, and one smaller by 0.71 resolutions anywhere in it.
        """
        return Grid(self.occupied | (self.clearance <= radius), self.resolution, self.origin)

    def counted(self, points: np.ndarray) -> np.ndarray:
        """How many of `points` (n, 2) [m] are in each cell (rows, columns); those off the map count nowhere."""
        cells, count = self.cells(points), np.zeros(self.shape)
        np.add.at(count, tuple(cells[((cells >= 0) & (cells < self.shape)).all(axis=-1)].T), 1.0)
        return count

    def nearest_free(self, point: Any) -> np.ndarray:
        """The centre (2,) [m] of the free cell nearest to `point` (2,) [m]; for a free point the point itself. Raises
        NoPath."""
        if self.free(point):
            return np.asarray(point, dtype=float)
        cells = np.argwhere(~self.occupied)
        if not len(cells):
            raise NoPath("The map has no free cell.")
        centres = self.centres(cells)
        return centres[((centres - point) ** 2).sum(axis=-1).argmin()]

    @functools.cached_property
    def regions(self) -> np.ndarray:
        """Numbers (rows, columns) of the connected parts of free space; 0: occupied."""
        # Connected by sides is enough: a diagonal that cuts no corner has a way around by sides.
        regions = np.zeros(self.shape, np.int32)
        ndimage.label(~self.occupied, output=regions)
        return regions

    @functools.cached_property
    def moves(self) -> Any:
        """The result of `macid.routing.grid_graph` for this grid: the free cells' numbers and the graph of moves
        [cells]."""
        return routing.grid_graph(self.occupied)

    @functools.cached_property
    def _closed(self):
        """Whether each cell, line and corner is occupied (2 rows + 1, 2 columns + 1): cells have odd indices, the lines
        and corners around them even ones.

        The map's outermost lines are occupied.
        """
        rows, columns = self.shape
        closed = np.zeros((2 * rows + 1, 2 * columns + 1), dtype=bool)
        for i in range(3):
            for j in range(3):
                closed[i : i + 2 * rows : 2, j : j + 2 * columns : 2] |= self.occupied
        closed[[0, -1]] = closed[:, [0, -1]] = True
        return closed

    def scaled(self, points: Any) -> np.ndarray:
        """`points` (..., 2) [m] as (x, y) in cells from the origin."""
        return (np.asarray(points, dtype=float) - self.origin) / self.resolution

    def unscaled(self, points: Any) -> np.ndarray:
        """`points` (..., 2) in cells from the origin as (x, y) [m], world frame."""
        return points * self.resolution + self.origin

    def _touches(self, points):
        """Whether `points` (..., 2) in cells touch an occupied cell or are off the map: (...) bool."""
        index = np.floor(points + _TOUCH) + np.ceil(points - _TOUCH)  # odd within a cell, even on a line
        rows, columns = self._closed.shape
        index = np.clip(index, 0, (columns - 1, rows - 1)).astype(np.intp)
        return self._closed.ravel()[index[..., 1] * columns + index[..., 0]]


def line_costs(grid: Grid, rate: np.ndarray | None, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Integral (M,) of `rate` along the segments from `starts` (M, 2) or (2,) to `ends` (M, 2); infinite where blocked.

    Points and lengths in cells. rate: (rows, columns), or None for 1.
    """
    step = ends - starts
    if not len(step):
        return np.zeros(0)
    starts = np.broadcast_to(starts, step.shape)
    first = np.ceil(np.minimum(starts, ends))
    count = int((np.floor(np.maximum(starts, ends)) - first).max()) + 1
    lines = first[:, None] + np.arange(count)[:, None]  # lines between cells that each segment may cross: (M, count, 2)
    across = np.where(np.abs(step) < 1e-12, 1e-12, step)
    crossed = (lines - starts[:, None]) / across[:, None]
    parts = np.zeros((len(step), 2 * count + 2))  # shares of each segment's length at which it crosses lines
    parts[:, 1] = 1.0
    parts[:, 2:] = np.clip(crossed, 0.0, 1.0).reshape(len(step), -1)
    # A segment touches every cell that it enters where it crosses a line or ends.
    blocked = grid._touches(starts[:, None] + parts[..., None] * step[:, None]).any(axis=1)
    costs = np.hypot(step[:, 0], step[:, 1])
    if rate is not None:
        parts.sort(axis=1)
        middles = starts[:, None] + (0.5 * (parts[:, 1:] + parts[:, :-1]))[..., None] * step[:, None]
        rows, columns = rate.shape
        cells = np.clip(middles, 0, (columns - 1, rows - 1)).astype(np.intp)  # astype floors, as nothing is below 0
        costs *= (np.diff(parts, axis=1) * rate.ravel()[cells[..., 1] * columns + cells[..., 0]]).sum(axis=1)
    costs[blocked] = np.inf
    return costs


def path_cost(path: np.ndarray, grid: Grid, cost: np.ndarray | None = None) -> float:
    """Integral [m] of `1 + cost` along `path` (N, 2) [m]: its length where cost is None; infinite where it is blocked.

    cost: (rows, columns), at least 0. Raises ValueError for any other cost.
    """
    path = grid.scaled(path)
    return float(line_costs(grid, cost_rate(grid, cost), path[:-1], path[1:]).sum() * grid.resolution)


def cost_rate(grid: Grid, cost: np.ndarray | None) -> np.ndarray | None:
    """1 + cost, or None for None. Raises ValueError for anything but a cost map of the grid."""
    if cost is None:
        return None
    cost = np.asarray(cost, dtype=float)
    if cost.shape != grid.shape or not np.isfinite(cost).all() or (cost < 0).any():
        raise ValueError(f"A cost map of this grid has shape {grid.shape} and finite values of at least 0.")
    return 1.0 + cost
