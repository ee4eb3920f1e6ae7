"""Ways through a map: waypoints on a shortest path of its occupancy grid."""

import functools

import numpy as np
from scipy import sparse, spatial
from scipy.sparse import csgraph

from macid import geometry
from macid.state import RADIUS

RESOLUTION = 0.5  # side of a grid cell [m]
_DETOUR, _DETOUR_LENGTH = 1.3, 3.0  # a way is first looked for up to this share of the bee line and this length [m]
_MARGIN = 0.1  # kept from obstacles beside the radius, where there is room [m]


class NoFreeSpace(ValueError):
    """A map has no room for what was to be put on it, or no way to where it is to go."""


def occupancy_grid(layout, resolution=RESOLUTION, radius=RADIUS):
    """Whether a disc of `radius` [m] at each cell's centre touches something: (rows, columns) bool.

    Row i, column j is centred at x = (j + 1/2) resolution - size/2, y = (i + 1/2) resolution - size/2.
    """
    cells = max(1, round(layout.size / resolution))
    axis = (np.arange(cells) + 0.5) * resolution - layout.size / 2
    occupied = np.zeros((cells, cells), dtype=bool)
    for box in layout.boxes:
        ahead, aside = np.abs(np.cos(box[4])), np.abs(np.sin(box[4]))
        reach = np.array([aside * box[2] + ahead * box[3], ahead * box[2] + aside * box[3]]) + radius + resolution  # y, x
        (i, j), (to_i, to_j) = np.searchsorted(axis, [box[1::-1] - reach, box[1::-1] + reach])
        centres = np.stack(np.meshgrid(axis[j:to_j], axis[i:to_i]), axis=-1)
        occupied[i:to_i, j:to_j] |= geometry.point_box_distance(centres, box[None])[..., 0] <= radius
    return occupied


def lines_are_free(start, goals, boxes, radius=RADIUS):
    """Whether a disc of `radius` [m] can move straight from `start` (2,) to each of `goals` (M, 2) among `boxes` (B, 5).

    Boxes grow by the radius on each side, which is a little strict at their corners. A box that `start` is closer to
    grows up to `start` only, so that it still bars the way through it, but not the way along it or away from it.
    """
    step = goals - start
    length = np.maximum(np.linalg.norm(step, axis=-1), 1e-9)
    beyond = (np.abs(geometry.in_box_frame(start, boxes)) - boxes[:, 2:4]).max(axis=-1)
    grown = boxes.copy()
    grown[:, 2:4] += np.clip(beyond - 1e-9, 0.0, radius)[:, None]
    distance = geometry.ray_box_distance(start, step / length[:, None], grown)
    return (distance >= length[:, None]).all(axis=-1)


def refuse_blocked_routes(layout):
    """Raises NoFreeSpace for a route of `layout` whose points leave no room for a person, or between which none can go."""
    for number, route in enumerate(layout.routes):
        room = geometry.point_box_distance(route, layout.boxes).min(axis=-1)
        if (room < RADIUS - 1e-9).any():
            point = int(np.argmin(room))
            raise NoFreeSpace(
                f"Layout '{layout.name}': routes[{number}][{point}], {np.round(route[point], 2).tolist()}, is "
                f"{room[point]:.2f} m from a box or wall, but a person needs {RADIUS} m."
            )
    router = Router(layout) if layout.routed else None
    parts, resolution = _parts(layout)
    for number, route in enumerate(layout.routes):
        column, row = np.minimum((route + layout.size / 2) // resolution, len(parts) - 1).astype(int).T
        part = parts[row, column]
        joined = part[1:] == part[:-1]
        if router is not None and joined.all():
            joined = router.joins(route[:-1], route[1:])
        if not joined.all():
            first = int(np.argmin(joined))
            start, end = np.round(route[first : first + 2], 2).tolist()
            raise NoFreeSpace(
                f"Layout '{layout.name}': routes[{number}] has no way for a person, of radius {RADIUS} m, from {start} to "
                f"{end}."
            )


def _parts(layout):
    """The connected parts of a layout for persons: a number for each cell (rows, columns), and the cells' side [m].

    Boxes grow by a little less than RADIUS, so that every cell with a point where a person has room is free.
    """
    import cv2

    resolution = max(0.05, layout.size / 4000)
    cells = max(1, int(np.ceil(layout.size / resolution)))
    free = np.ones((cells, cells), np.uint8)
    grown, shift = max(RADIUS - 2 * resolution, 0.0), 8
    for side in ((grown, 0.0), (0.0, grown)):
        boxes = layout.boxes + np.array([0.0, 0.0, *side, 0.0])
        corners = (geometry.box_corners(boxes) + layout.size / 2) / resolution - 0.5
        for polygon in np.rint(np.clip(corners, -1e6, 1e6) * (1 << shift)).astype(np.int32):
            cv2.fillConvexPoly(free, polygon, 0, lineType=cv2.LINE_8, shift=shift)
    centres = (geometry.box_corners(layout.boxes) + layout.size / 2) / resolution - 0.5
    for centre in np.rint(np.clip(centres.reshape(-1, 2), -1e6, 1e6) * (1 << shift)).astype(np.int32):
        cv2.circle(free, centre.tolist(), int(grown / resolution * (1 << shift)), 0, -1, shift=shift)
    return cv2.connectedComponents(free, connectivity=8)[1], resolution


class Router:
    """Shortest paths on one layout. The grid's graph is made on first need: straight ways don't need it."""

    def __init__(self, layout, radius=RADIUS):
        self.layout, self.radius = layout, radius
        self._boxes = layout.boxes

    @functools.cached_property
    def _grid(self):
        """Centres (N, 2) of the free cells and the sparse graph of moves to the eight neighbours, to and fro, in metres."""
        occupied = occupancy_grid(self.layout, radius=self.radius + _MARGIN)
        cells = len(occupied)
        number = np.full(occupied.shape, -1)
        rows, columns = np.nonzero(~occupied)
        number[rows, columns] = np.arange(len(rows))
        padded = np.pad(number, 1, constant_values=-1)
        sources, targets, lengths = [], [], []
        for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
            neighbour = padded[1 + di : 1 + di + cells, 1 + dj : 1 + dj + cells]
            joined = (number >= 0) & (neighbour >= 0)
            if di and dj:  # no cutting of corners
                joined &= (padded[1 + di : 1 + di + cells, 1:-1] >= 0) & (padded[1:-1, 1 + dj : 1 + dj + cells] >= 0)
            sources.append(number[joined])
            targets.append(neighbour[joined])
            lengths.append(np.full(joined.sum(), RESOLUTION * np.hypot(di, dj)))
        edges = (np.concatenate(lengths), (np.concatenate(sources), np.concatenate(targets)))
        graph = sparse.coo_matrix(edges, shape=(len(rows),) * 2).tocsr()
        graph = graph + graph.T
        centres = (np.stack([columns, rows], axis=-1) + 0.5) * RESOLUTION - self.layout.size / 2
        if not len(centres):
            raise NoFreeSpace(f"Map '{self.layout.name}' has no free cell.")
        return centres, graph

    @functools.cached_property
    def _nearest(self):
        """A tree of the free cells' centres, and the connected part of the map that each belongs to."""
        centres, graph = self._grid
        return spatial.cKDTree(centres), csgraph.connected_components(graph, directed=False)[1]

    def joins(self, starts, goals):
        """Whether there is a way from each of `starts` (N, 2) to its of `goals` (N, 2): (N,) bool. Where this holds, `path`
        finds one."""
        starts, goals = np.broadcast_arrays(np.asarray(starts, dtype=float), np.asarray(goals, dtype=float))
        tree, parts = self._nearest
        joined = parts[tree.query(starts)[1]] == parts[tree.query(goals)[1]]
        for row in np.flatnonzero(~joined):
            joined[row] = lines_are_free(starts[row], goals[row, None], self._boxes, self.radius)[0]
        return joined

    def path(self, start, goal):
        """Waypoints (W, 2) [m] from `start` (2,) to `goal` (2,), the goal last, pulled straight where the view is free.

        Raises macid.layout.NoFreeSpace when the goal can't be reached.
        """
        start, goal = np.asarray(start, dtype=float), np.asarray(goal, dtype=float)
        if lines_are_free(start, goal[None], self._boxes, self.radius)[0]:
            return goal[None]
        centres, graph = self._grid
        first, last = self._nearest[0].query([start, goal])[1]
        for reach in (_DETOUR * np.hypot(*(goal - start)) + _DETOUR_LENGTH, np.inf):  # mostly the near part will do
            lengths, before = csgraph.dijkstra(graph, indices=last, return_predecessors=True, limit=reach)
            if np.isfinite(lengths[first]):
                break
        if not np.isfinite(lengths[first]):
            raise NoFreeSpace(
                f"Map '{self.layout.name}': no way from {np.round(start, 2).tolist()} to {np.round(goal, 2).tolist()}."
            )
        path = []
        while first != last:
            path.append(centres[first])
            first = before[first]
        path = np.array([*path, centres[last], goal])
        corners = []
        while len(path) > 1:  # walk straight to the farthest point that is seen before the first unseen one
            free = lines_are_free(start, path, self._boxes, self.radius + _MARGIN / 2)
            seen = len(path) if free.all() else max(1, int(np.argmin(free)))
            start, path = path[seen - 1], path[seen:]
            corners.append(start)
        return np.array([*corners, *path])


def rest_of_route(route, place, end):
    """What is left of `route` (W, 2) [m] for who stands at `place` (2,) and walks to its end nearer to `end` (2,): (V, 2)."""
    if ((route[0] - end) ** 2).sum() < ((route[-1] - end) ** 2).sum():
        route = route[::-1]
    step = np.diff(route, axis=0)
    share = ((place - route[:-1]) * step).sum(axis=-1) / np.maximum((step**2).sum(axis=-1), 1e-12)
    nearest = route[:-1] + np.clip(share, 0.0, 1.0)[:, None] * step
    return route[1 + int(((nearest - place) ** 2).sum(axis=-1).argmin()) :]
