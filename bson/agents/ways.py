"""Shortest ways to one goal over an occupancy grid, from anywhere, and what a robot that follows one has to know."""

import numpy as np
from scipy import ndimage
from scipy.sparse import csgraph

from bson.planners import Grid

_FARTHEST = 80  # cells of the way that are looked at for the farthest one in sight
_EVERY = 3  # of these cells, every third is
_STEP = 0.6  # between two looked-at points of a line of sight [cells]
_OWN = 0.4  # a line of sight may begin within an obstacle's margin: this much of it is not looked at [m]
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
        number, graph = grid.moves
        nearest = ndimage.distance_transform_edt(grid.occupied, return_distances=False, return_indices=True)
        self._node = number[tuple(nearest)]  # (rows, columns): the node that each cell stands for
        rows, columns = np.nonzero(~grid.occupied)
        self._centres = (np.stack([columns, rows], axis=-1) + 0.5) * self._size + self._origin
        if not len(rows):
            self._length, self._next = np.zeros(0), []
            return
        length, before = csgraph.dijkstra(graph, indices=self._node_at(self.goal), return_predecessors=True)
        self._length, self._next = length * self._size, before.tolist()

    def _node_at(self, place):
        column, row = ((place - self._origin) / self._size).astype(int).clip(0, np.array(self.grid.shape)[::-1] - 1)
        return int(self._node[row, column])

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
        return ~(self._occupied[rows, columns] & beyond).any(axis=0)

    def ahead(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """From `place` (2,) [m]: the farthest point (2,) of the way that is in sight, a point (2,) of the way some
        metres beyond it, and the way's length to the goal [m]. Where there is no way: the goal, twice, and its
        distance."""
        goal, straight = self.goal, float(np.hypot(*(self.goal - place)))
        if not self._next or self.in_sight(place, goal[None])[0]:
            return goal, goal, straight
        node = self._node_at(place)
        if not np.isfinite(self._length[node]):
            return goal, goal, straight
        way = [node]
        while len(way) <= _FARTHEST and self._next[way[-1]] >= 0:
            way.append(self._next[way[-1]])
        candidates = way[2::_EVERY] or way[-1:]
        seen = np.flatnonzero(self.in_sight(place, self._centres[candidates]))
        chosen = candidates[int(seen[-1]) if len(seen) else 0]
        aim, beyond = self._centres[chosen], chosen
        until = self._length[chosen] - _BEYOND
        while self._next[beyond] >= 0 and self._length[beyond] > until:
            beyond = self._next[beyond]
        return aim, self._centres[beyond], float(self._length[chosen] + np.hypot(*(aim - place)))

    def blocked(self, occupied: np.ndarray, place: np.ndarray) -> bool:
        """Whether the way from `place` (2,) [m] meets one of the cells `occupied` (rows, columns) bool of another grid
        of the same cells."""
        rows, columns = np.nonzero(~self.grid.occupied)
        node = self._node_at(place) if self._next else -1
        for _ in range(len(self._next)):
            if node < 0:
                return False
            if occupied[rows[node], columns[node]]:
                return True
            node = self._next[node]
        return False
