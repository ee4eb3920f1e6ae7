"""Ways through a map: waypoints on a shortest path of its occupancy grid."""

import functools
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse, spatial
from scipy.sparse import csgraph

from macid import geometry
from macid.state import RADIUS

RESOLUTION = 0.5  # side of a grid cell [m]
_DETOUR, _DETOUR_LENGTH = 1.3, 3.0  # a way is first looked for up to this share of the bee line and this length [m]
_MOST_CELLS = 200_000  # looked at in one go, for memory's sake
_LOOK_AHEAD = 16  # points of a way that are looked at in one go
_MOVES = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])  # of cells, in the order of their numbers
_MARGIN = 0.1  # paths keep so far from obstacles beside the radius, where there is room [m]


class NoFreeSpace(ValueError):
    """A map has no room for what was to be put on it, or no way to where it is to go."""


def occupancy_grid(layout: Any, resolution: float = RESOLUTION, radius: float = RADIUS) -> np.ndarray:
    """Whether a disc of `radius` [m] at each cell's centre touches something: (rows, columns) bool.

    Row i, column j is centred at x = (j + 1/2) resolution - size/2, y = (i + 1/2) resolution - size/2.
    """
    cells = max(1, round(layout.size / resolution))
    axis = (np.arange(cells) + 0.5) * resolution - layout.size / 2
    occupied = np.zeros((cells, cells), dtype=bool)
    boxes = layout.boxes
    ahead, aside = np.abs(np.cos(boxes[:, 4])), np.abs(np.sin(boxes[:, 4]))
    reach = np.stack([aside * boxes[:, 2] + ahead * boxes[:, 3], ahead * boxes[:, 2] + aside * boxes[:, 3]], axis=-1)
    reach += radius + resolution  # y, x
    low, high = np.searchsorted(axis, boxes[:, 1::-1] - reach), np.searchsorted(axis, boxes[:, 1::-1] + reach)
    sides = high - low
    for part in _parts_of(sides.prod(axis=-1), _MOST_CELLS):
        which, cell = _spread(sides[part].prod(axis=-1))
        which += part.start
        row, column = np.divmod(cell, np.maximum(sides[which, 1], 1))
        row, column = row + low[which, 0], column + low[which, 1]
        centres = np.stack([axis[column], axis[row]], axis=-1)
        touched = geometry.point_box_distance(centres, boxes[which, None])[:, 0] <= radius
        occupied[row[touched], column[touched]] = True
    return occupied


def grid_graph(occupied: np.ndarray) -> tuple[np.ndarray, sparse.csr_matrix]:
    """The moves over a grid: `number` (rows, columns) of each free cell, -1 where `occupied` (rows, columns), and the
    sparse graph (N, N) of moves to the eight neighbours, to and fro, without cutting of corners, with their lengths
    [cells].

    The cells are numbered row by row.
    """
    rows, columns = np.nonzero(~occupied)
    number = np.full(np.add(occupied.shape, 2), -1, np.int32)
    number[rows + 1, columns + 1] = np.arange(len(rows))
    neighbours = np.empty((len(rows), 8), np.int32)
    for place, (di, dj) in enumerate(_MOVES):
        neighbours[:, place] = number[rows + 1 + di, columns + 1 + dj]
        if di and dj:
            cut = (number[rows + 1 + di, columns + 1] < 0) | (number[rows + 1, columns + 1 + dj] < 0)
            neighbours[cut, place] = -1
    joined = neighbours >= 0
    ends = np.concatenate([[0], np.cumsum(joined.sum(axis=-1))]).astype(np.int32)
    lengths = np.broadcast_to(np.hypot(*_MOVES.T), joined.shape)[joined]
    return number[1:-1, 1:-1], sparse.csr_matrix((lengths, neighbours[joined], ends), shape=(len(rows),) * 2)


def shortest(graph: sparse.csr_matrix, source: int, target: int, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Lengths (N,) of the shortest ways from `source` over a sparse `graph` (N, N), and the last node before each,
    (N,).

    Only ways up to the length `reach` are looked for where `target` is among them; others are infinite.
    """
    for limit in (reach, np.inf):
        found = csgraph.dijkstra(graph, indices=source, return_predecessors=True, limit=limit)
        if np.isfinite(found[0][target]):
            break
    return found


def _spread(counts):
    """N owners have `counts` (N,) things. For each thing: its owner's index, and its number among the owner's
    things."""
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)


def _parts_of(counts, most):
    """Slices that divide `counts` (N,) so that each has a sum of at most `most`, or one element."""
    start, total = 0, 0
    for end, count in enumerate(counts):
        if end > start and total + count > most:
            yield slice(start, end)
            start, total = end, 0
        total += count
    if start < len(counts):
        yield slice(start, len(counts))


def lines_are_free(start: np.ndarray, goals: np.ndarray, boxes: np.ndarray, radius: float = RADIUS) -> np.ndarray:
    """Whether a disc of `radius` [m] can move straight from `start` (2,) to each of `goals` (M, 2) among `boxes` (B,
    5).

    Boxes grow by the radius on each side, which is a little strict at their corners. A box that `start` is closer to
    grows up to `start` only, so that it still bars the way through it, but not the way along it or away from it.
    """
    return ~_barred(np.broadcast_to(start, goals.shape), goals, boxes, radius)


def _barred(starts, goals, boxes, radius):
    """Whether each of the lines from `starts` to `goals` (N, 2) is barred by one of `boxes` (B, 5): (N,) bool.

    `lines_are_free` says what bars a line."""
    barred, most = np.zeros(len(starts), bool), max(1, _MOST_CELLS // max(1, len(boxes)))
    if len(starts) > most:
        for begin in range(0, len(starts), most):
            part = slice(begin, begin + most)
            barred[part] = _barred(starts[part], goals[part], boxes, radius)
        return barred
    ahead, aside = np.abs(np.cos(boxes[:, 4])), np.abs(np.sin(boxes[:, 4]))
    clear = np.zeros((len(starts), len(boxes)), bool)  # of boxes to one side of the whole line
    for axis, (cos, sin) in enumerate(((ahead, aside), (aside, ahead))):
        reach = cos * boxes[:, 2] + sin * boxes[:, 3] + 1.5 * radius + 1e-6
        low, high = boxes[:, axis] - reach, boxes[:, axis] + reach
        clear |= np.minimum(starts[:, axis], goals[:, axis])[:, None] > high
        clear |= np.maximum(starts[:, axis], goals[:, axis])[:, None] < low
    which, box = np.nonzero(~clear)
    step = goals - starts
    length = np.maximum(np.linalg.norm(step, axis=-1), 1e-9)
    start, grown = starts[which], boxes[box]
    beyond = (np.abs(geometry.in_box_frame(start, grown[:, None])[:, 0]) - grown[:, 2:4]).max(axis=-1)
    grown[:, 2:4] += np.clip(beyond - 1e-9, 0.0, radius)[:, None]
    distance = geometry.ray_box_distance(start, (step / length[:, None])[which, None], grown[:, None])[:, 0, 0]
    barred[which[~(distance >= length[which])]] = True
    return barred


def refuse_blocked_routes(layout: Any, radius: float = RADIUS) -> None:
    """Raises NoFreeSpace for a route of `layout` that has a point without room for a person of `radius` [m], or points
    between which no such person can walk."""
    for number, route in enumerate(layout.routes):
        room = geometry.point_box_distance(route, layout.boxes).min(axis=-1)
        if (room < radius - 1e-9).any():
            point = int(np.argmin(room))
            raise NoFreeSpace(
                f"Layout '{layout.name}': routes[{number}][{point}], {np.round(route[point], 2).tolist()}, is "
                f"{room[point]:.2f} m from a box or wall, but a person needs {radius} m."
            )
    router = Router(layout, radius) if layout.routed else None
    parts, resolution = _parts(layout, radius)
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
                f"Layout '{layout.name}': routes[{number}] has no way for a person, of radius {radius} m, from {start} "
                f"to {end}."
            )


def _parts(layout, radius):
    """The connected parts of a layout for persons of `radius`: a number for each cell (rows, columns), and the cells'
    side [m].

    Boxes grow by a little less than the radius, so that every cell with a point where a person has room is free.
    """
    import cv2

    resolution = max(0.05, layout.size / 4000)
    cells = max(1, int(np.ceil(layout.size / resolution)))
    free = np.ones((cells, cells), np.uint8)
    grown, shift = max(radius - 2 * resolution, 0.0), 8
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

    def __init__(self, layout: Any, radius: float = RADIUS):
        self.layout, self.radius = layout, radius
        self._boxes = layout.boxes

    @functools.cached_property
    def _grid(self):
        """Centres (N, 2) of the free cells and the sparse graph of moves to the eight neighbours, to and fro, in
        metres."""
        occupied = occupancy_grid(self.layout, radius=self.radius + _MARGIN)
        if occupied.all():
            raise NoFreeSpace(f"Map '{self.layout.name}' has no free cell.")
        rows, columns = np.nonzero(~occupied)
        centres = (np.stack([columns, rows], axis=-1) + 0.5) * RESOLUTION - self.layout.size / 2
        return centres, grid_graph(occupied)[1] * RESOLUTION

    @functools.cached_property
    def _tree(self):
        """A tree of the free cells' centres, which finds the centre nearest to a place."""
        return spatial.cKDTree(self._grid[0])  # pyright: ignore[reportAttributeAccessIssue] (compiled, without a stub)

    @functools.cached_property
    def _parts(self):
        """The connected part of the map that each free cell belongs to: (N,)."""
        return csgraph.connected_components(self._grid[1], directed=False)[1]

    def joins(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Whether there is a way from each of `starts` (N, 2) to its own of `goals` (N, 2): (N,) bool. Where there is,
        `path` finds one."""
        starts, goals = np.broadcast_arrays(np.asarray(starts, dtype=float), np.asarray(goals, dtype=float))
        tree, parts = self._tree, self._parts
        joined = parts[tree.query(starts)[1]] == parts[tree.query(goals)[1]]
        for row in np.flatnonzero(~joined):
            joined[row] = lines_are_free(starts[row], goals[row, None], self._boxes, self.radius)[0]
        return joined

    def path(self, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Waypoints (W, 2) [m] from `start` (2,) to `goal` (2,), the goal last, pulled straight where the view is free.

        Raises macid.layout.NoFreeSpace when the goal can't be reached.
        """
        return self.paths([start], [goal])[0]

    def paths(self, starts: ArrayLike, goals: ArrayLike) -> list[np.ndarray]:
        """What `path` finds from each of `starts` (N, 2) to its own of `goals` (N, 2): a list of N arrays.

        Quicker than one by one."""
        starts, goals = (np.reshape(np.asarray(ends, dtype=float), (-1, 2)) for ends in (starts, goals))
        ways = [goal[None] for goal in goals]
        blocked = np.flatnonzero(_barred(starts, goals, self._boxes, self.radius))
        if not len(blocked):
            return ways
        firsts, lasts = self._tree.query(np.stack([starts[blocked], goals[blocked]]))[1]
        cells = [self._cells(*each) for each in zip(starts[blocked], goals[blocked], firsts, lasts, strict=True)]
        for row, way in zip(blocked, self._pulled(starts[blocked], cells), strict=True):
            ways[row] = way
        return ways

    def _cells(self, start, goal, first, last):
        """The centres of the cells on a shortest way from cell `first` to cell `last`, then `goal`: (W, 2) [m]."""
        centres, graph = self._grid
        reach = _DETOUR * np.hypot(*(goal - start)) + _DETOUR_LENGTH  # mostly the near part will do
        lengths, before = shortest(graph, last, first, reach)
        if not np.isfinite(lengths[first]):
            raise NoFreeSpace(
                f"Map '{self.layout.name}': no way from {np.round(start, 2).tolist()} to {np.round(goal, 2).tolist()}."
            )
        way = []
        while first != last:
            way.append(first)
            first = before[first]
        return np.vstack([centres[[*way, last]], goal])

    def _pulled(self, starts, ways):
        """`ways`, arrays (W, 2) [m], from `starts` (N, 2), pulled straight.

        A person walks straight to the farthest point that is seen before the first unseen point, and on from there."""
        corners, starts, ways = [[] for _ in ways], starts.copy(), list(ways)
        wide = self.radius + _MARGIN / 2
        ahead = np.zeros(len(ways), int)  # points of a way that are known to be seen
        going = [row for row, way in enumerate(ways) if len(way) > 1]
        while going:
            looked = [ways[row][ahead[row] : ahead[row] + _LOOK_AHEAD] for row in going]
            still, counts = [], [len(points) for points in looked]
            barred = _barred(starts[going].repeat(counts, axis=0), np.concatenate(looked), self._boxes, wide)
            for row, hidden in zip(going, np.split(barred, np.cumsum(counts)[:-1]), strict=True):
                way, any_hidden = ways[row], hidden.any()
                ahead[row] += int(np.argmax(hidden)) if any_hidden else len(hidden)
                if any_hidden or ahead[row] == len(way):
                    seen = max(1, ahead[row])
                    starts[row], ways[row], ahead[row] = way[seen - 1], way[seen:], 0
                    corners[row].append(way[seen - 1])
                if len(ways[row]) > 1:
                    still.append(row)
            going = still
        return [np.array([*passed, *way]) for passed, way in zip(corners, ways, strict=True)]


def rest_of_route(route: np.ndarray, place: np.ndarray, end: np.ndarray) -> np.ndarray:
    """What is left of `route` (W, 2) [m] for a person who stands at `place` (2,) and walks to the route's end that is
    nearer to `end` (2,): (V, 2)."""
    if ((route[0] - end) ** 2).sum() < ((route[-1] - end) ** 2).sum():
        route = route[::-1]
    step = np.diff(route, axis=0)
    share = ((place - route[:-1]) * step).sum(axis=-1) / np.maximum((step**2).sum(axis=-1), 1e-12)
    nearest = route[:-1] + np.clip(share, 0.0, 1.0)[:, None] * step
    return route[1 + int(((nearest - place) ** 2).sum(axis=-1).argmin()) :]
