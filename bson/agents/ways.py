"""Shortest ways to one goal over an occupancy grid, from anywhere, and what a robot that follows one has to know.

A way is a row of cells, whose farthest one in sight learned robots were trained to see. Planners that go down a slope
have lengths without favourite directions instead (bson.planners.way_field), which cost many sweeps over the whole map.
"""

import numpy as np
from scipy import ndimage
from scipy.sparse import csgraph

from bson.planners import Grid

_FARTHEST = 80  # cells of the way that are looked at for the farthest one in sight
_EVERY = 3  # of these cells, every third is
_STEP = 0.6  # between two looked-at points of a line of sight [cells]
_OWN = 0.4  # a line of sight may begin within an obstacle's margin: this much of it is not looked at [m]
_DETOUR, _SPARE = 1.5, 10.0  # ways are first looked for up to _DETOUR times the straight line and _SPARE [m]
_BEYOND = 3.0  # length of way from the aim to the point that tells the next turn [m]


class Ways:
    """Ways over the free cells of `grid` (bson.planners.Grid, inflated by the robot's radius) to `goal` (2,) [m].

    Places in occupied cells stand for the nearest free cell. One run of Dijkstra's algorithm from the goal serves all
    places.
    """

    def __init__(self, grid: Grid, goal: np.ndarray):
        self.grid, self.goal = grid, np.asarray(goal, float)
        self._size, self._origin = grid.resolution, grid.origin
        self._occupied = np.pad(grid.occupied, 1, constant_values=True)  # so that what is off the map is occupied
        self._solved: _Solved | None = None  # made once it is needed: a goal in sight needs none

    def _solve(self, place):
        """The lengths of ways, from `place` at least."""
        if self._solved is None or (self._solved.reach < np.inf and not self._solved.length_at(place)[1] < np.inf):
            reach = np.inf if self._solved else _DETOUR * float(np.hypot(*(self.goal - place))) + _SPARE
            self._solved = _Solved(self.grid, self.goal, reach)
            if reach < np.inf and not self._solved.length_at(place)[1] < np.inf:
                self._solved = _Solved(self.grid, self.goal, np.inf)
        return self._solved

    def in_sight(self, place: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Whether the lines from `place` (2,) to each of `points` (n, 2) [m] pass no occupied cell: (n,) bool."""
        along = points - place
        longest = float(np.hypot(along[:, 0], along[:, 1]).max())
        number = max(2, int(longest / (self._size * _STEP)))
        shares = np.linspace(0.0, 1.0, number)
        looked = place + shares[:, None, None] * along  # (number, n, 2)
        cells = ((looked - self._origin) / self._size + 1.0).astype(int)
        rows = cells[..., 1].clip(0, self._occupied.shape[0] - 1)
        columns = cells[..., 0].clip(0, self._occupied.shape[1] - 1)
        beyond = shares[:, None] * np.hypot(along[:, 0], along[:, 1]) > _OWN
        return ~np.any(self._occupied[rows, columns] & beyond, axis=0)

    def ahead(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """From `place` (2,) [m]: the farthest point (2,) of the way that is in sight, a point (2,) of the way some
        metres beyond it, and the way's length to the goal [m]. Where there is no way: the goal, twice, and its
        distance."""
        goal, straight = self.goal, float(np.hypot(*(self.goal - place)))
        if self.in_sight(place, goal[None])[0]:
            return goal, goal, straight
        ways = self._solve(place)
        node, length = ways.length_at(place)
        if not length < np.inf:
            return goal, goal, straight
        way = [node]
        while len(way) <= _FARTHEST and ways.next[way[-1]] >= 0:
            way.append(ways.next[way[-1]])
        candidates = way[2::_EVERY] or way[-1:]
        seen = np.flatnonzero(self.in_sight(place, ways.centres[candidates]))
        chosen = candidates[int(seen[-1]) if len(seen) else 0]
        aim, beyond = ways.centres[chosen], chosen
        until = ways.length[chosen] - _BEYOND
        while ways.next[beyond] >= 0 and ways.length[beyond] > until:
            beyond = ways.next[beyond]
        return aim, ways.centres[beyond], float(ways.length[chosen] + np.hypot(*(aim - place)))

    def lead_from(self, place: np.ndarray) -> bool:
        """Whether a way leads from `place` (2,) [m] to the goal."""
        return bool(self.in_sight(place, self.goal[None])[0]) or self._solve(place).length_at(place)[1] < np.inf

    def blocked(self, occupied: np.ndarray, place: np.ndarray) -> bool:
        """Whether the way from `place` (2,) [m] meets one of the cells `occupied` (rows, columns) bool, of a grid of
        the same cells."""
        straight = self.goal - place
        if self.in_sight(place, self.goal[None])[0]:
            number = max(2, int(np.hypot(*straight) / (self._size * _STEP)))
            points = place + np.linspace(0.0, 1.0, number)[:, None] * straight
            rows, columns = self.grid.cells(points).clip(0, np.array(self.grid.shape) - 1).T
            return bool(occupied[rows, columns].any())
        ways = self._solve(place)
        node, found = ways.length_at(place)[0], []
        while node >= 0:
            found.append(node)
            node = ways.next[node]
        return bool(found) and bool(occupied[ways.rows[found], ways.columns[found]].any())


class _Solved:
    """The free cells' places, and the lengths of the ways from them that are at most `reach` [m] long, by Dijkstra's
    algorithm from the goal."""

    def __init__(self, grid, goal, reach):
        self.reach, self._grid = reach, grid
        number, graph = grid.moves
        if grid.occupied.any():
            nearest = ndimage.distance_transform_edt(grid.occupied, return_distances=False, return_indices=True)
            number = number[tuple(np.asarray(nearest))]
        self._node = number  # (rows, columns): the node that each cell stands for
        self.rows, self.columns = np.nonzero(~grid.occupied)
        self.centres = grid.centres(np.stack([self.rows, self.columns], axis=-1))
        self.length, self.next = np.zeros(0), []
        if len(self.rows):
            source, limit = self._node_at(goal), reach / grid.resolution
            length, before = csgraph.dijkstra(graph, indices=source, return_predecessors=True, limit=limit)
            self.length, self.next = length * grid.resolution, before.tolist()

    def _node_at(self, place):
        row, column = self._grid.cells(place).clip(0, np.array(self._grid.shape) - 1)
        return int(self._node[row, column])

    def length_at(self, place):
        """(the node at a place, or -1; the length of the way from there, infinity where there is none)."""
        if not self.next:
            return -1, np.inf
        node = self._node_at(place)
        return node, float(self.length[node])
