"""Path planners on an occupancy grid with pedestrians as costs, and a follower, for the robot's Global track.

Points and paths are in the world frame [m]. A path's cost is the integral of `1 + cost` along it [m]: its length, and
what it costs people. Cost maps are constant within a cell, so lines are checked and integrated cell by cell, exactly.

`plan` runs every planner:

- `dijkstra` (Dijkstra 1959) on the eight-connected grid, without cutting corners; `astar` (Hart, Nilsson and Raphael
  1968) is the same plus a heuristic;
- `rrt` (LaValle 1998) grows a tree towards random samples; `rrt-star` (Karaman and Frazzoli, IJRR 2011) also chooses
  the best parent and rewires; `carrt-star` (cost-aware RRT*: Suh, Gong and Oh, "Fast sampling-based cost-aware path
  planning with nonmyopic extensions using cross entropy", T-RO 2017) also chooses each extension by the cross-entropy
  method, here as one turn and one length.

All but `rrt`, which stops at its first path, heed the cost map.
"""

import functools
import heapq
import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from macid import routing

_TOUCH = 1e-9  # how close to a line between cells is on it [cells]


class NoPath(ValueError):
    """There is no way from start to goal, or none was found within the samples."""


@dataclass(frozen=True, eq=False)
class Grid:
    """An occupancy grid (ROS's convention): cell (i, j) is centred at `origin + resolution * (j + 1/2, i + 1/2)`.

    occupied: (rows, columns) bool. resolution: side of a cell [m]. origin: (2,), the outer corner of cell (0, 0), world
    frame [m]. Occupied cells are closed squares: who touches one is in it; so is who touches the map's edge.
    Raises ValueError for anything else.
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
    def from_layout(cls, layout, resolution=0.25, radius=0.0):
        """The grid of a macid Layout: occupied where a disc of `radius` [m] at the cell's centre touches something.

        resolution [m] is adapted to a whole number of cells a side.
        """
        resolution = layout.size / max(1, round(layout.size / resolution))
        return cls(routing.occupancy_grid(layout, resolution, radius), resolution, (-layout.size / 2,) * 2)

    @property
    def shape(self):
        """(rows, columns)."""
        return self.occupied.shape

    def cells(self, points):
        """Cells (..., 2) int (row, column) that `points` (..., 2) [m] lie in, on the map or off it."""
        return np.floor(self._scaled(points)).astype(int)[..., ::-1]

    def centres(self, cells):
        """Centres (..., 2) [m] of `cells` (..., 2) (row, column)."""
        return self._unscaled(np.asarray(cells)[..., ::-1] + 0.5)

    def free(self, points):
        """Whether each of `points` (..., 2) [m] is on the map and touches no occupied cell: (...) bool."""
        return ~self._touches(self._scaled(points))

    def lines_are_free(self, starts, ends):
        """Whether the segments from `starts` to `ends` (..., 2) [m] stay on the map and touch no occupied cell."""
        starts, ends = np.broadcast_arrays(self._scaled(starts), self._scaled(ends))
        costs = _line_costs(self, None, starts.reshape(-1, 2), ends.reshape(-1, 2))
        return np.isfinite(costs).reshape(starts.shape[:-1])

    @functools.cached_property
    def clearance(self):
        """Distance (rows, columns) [m] from each cell's centre to the nearest occupied cell or the map's edge."""
        # The point of an occupied square that is nearest to another cell's centre is one of those that _closed marks.
        return (ndimage.distance_transform_edt(~self._closed) * (self.resolution / 2))[1::2, 1::2]

    def inflated(self, radius):
        """The grid with obstacles and the map's edge grown by `radius` [m].

        A disc of that radius fits at the centre of each free cell, and one smaller by 0.71 resolutions anywhere in it.
        """
        return Grid(self.occupied | (self.clearance <= radius), self.resolution, self.origin)

    def nearest_free(self, point):
        """The centre (2,) [m] of the free cell nearest to `point` (2,) [m]; a free point is its own. Raises NoPath."""
        if self.free(point):
            return np.asarray(point, dtype=float)
        cells = np.argwhere(~self.occupied)
        if not len(cells):
            raise NoPath("The map has no free cell.")
        centres = self.centres(cells)
        return centres[((centres - point) ** 2).sum(axis=-1).argmin()]

    @functools.cached_property
    def regions(self):
        """Numbers (rows, columns) of the connected parts of free space; 0: occupied."""
        return ndimage.label(~self.occupied)[0]  # by sides: a diagonal that cuts no corner has a way around by sides

    @functools.cached_property
    def _closed(self):
        """What is occupied (2 rows + 1, 2 columns + 1): cells at odd indices, the lines and points around them at even.

        The map's outermost lines are occupied.
        """
        rows, columns = self.shape
        closed = np.zeros((2 * rows + 1, 2 * columns + 1), dtype=bool)
        for i in range(3):
            for j in range(3):
                closed[i : i + 2 * rows : 2, j : j + 2 * columns : 2] |= self.occupied
        closed[[0, -1]] = closed[:, [0, -1]] = True
        return closed

    def _scaled(self, points):
        """`points` (..., 2) [m] as (x, y) in cells from the origin."""
        return (np.asarray(points, dtype=float) - self.origin) / self.resolution

    def _unscaled(self, points):
        return points * self.resolution + self.origin

    def _touches(self, points):
        """Whether `points` (..., 2) in cells touch an occupied cell or are off the map: (...) bool."""
        index = np.floor(points + _TOUCH) + np.ceil(points - _TOUCH)  # odd within a cell, even on a line
        rows, columns = self._closed.shape
        index = np.clip(index, 0, (columns - 1, rows - 1)).astype(np.intp)
        return self._closed.ravel()[index[..., 1] * columns + index[..., 0]]


def _line_costs(grid, rate, starts, ends):
    """Integral (M,) of `rate` along the segments from `starts` (M, 2) or (2,) to `ends` (M, 2); infinite where blocked.

    Points and lengths in cells. rate: (rows, columns), or None for 1.
    """
    step = ends - starts
    if not len(step):
        return np.zeros(0)
    starts = np.broadcast_to(starts, step.shape)
    first = np.ceil(np.minimum(starts, ends))
    count = int((np.floor(np.maximum(starts, ends)) - first).max()) + 1
    lines = first[:, None] + np.arange(count)[:, None]  # between cells, that each segment may cross: (M, count, 2)
    across = np.where(np.abs(step) < 1e-12, 1e-12, step)
    crossed = (lines - starts[:, None]) / across[:, None]
    parts = np.zeros((len(step), 2 * count + 2))  # of each segment's length, where it crosses
    parts[:, 1] = 1.0
    parts[:, 2:] = np.clip(crossed, 0.0, 1.0).reshape(len(step), -1)
    # Whatever cell a segment enters, it touches where it crosses a line or ends.
    blocked = grid._touches(starts[:, None] + parts[..., None] * step[:, None]).any(axis=1)
    costs = np.hypot(step[:, 0], step[:, 1])
    if rate is not None:
        parts.sort(axis=1)
        middles = starts[:, None] + (0.5 * (parts[:, 1:] + parts[:, :-1]))[..., None] * step[:, None]
        rows, columns = rate.shape
        cells = np.clip(middles, 0, (columns - 1, rows - 1)).astype(np.intp)  # which floors, as nothing is below 0
        costs *= (np.diff(parts, axis=1) * rate.ravel()[cells[..., 1] * columns + cells[..., 0]]).sum(axis=1)
    costs[blocked] = np.inf
    return costs


def path_cost(path, grid, cost=None):
    """Integral [m] of `1 + cost` along `path` (N, 2) [m]: its length where cost is None; infinite where it is blocked.

    cost: (rows, columns), at least 0. Raises ValueError for another.
    """
    path = grid._scaled(path)
    return float(_line_costs(grid, _rate(grid, cost), path[:-1], path[1:]).sum() * grid.resolution)


def _rate(grid, cost):
    """1 + cost, or None for None. Raises ValueError for what is no cost map of the grid."""
    if cost is None:
        return None
    cost = np.asarray(cost, dtype=float)
    if cost.shape != grid.shape or not np.isfinite(cost).all() or (cost < 0).any():
        raise ValueError(f"A cost map of this grid has shape {grid.shape} and finite values of at least 0.")
    return 1.0 + cost


@dataclass(frozen=True)
class SocialCostConfig:
    """What being near a person costs."""

    weight: float = 10.0  # at the person's place, per metre of way
    sigma: float = 0.6  # to the sides, behind, and all around who stands [m]
    stretch: float = 1.0  # by which sigma grows ahead, per speed [s]

    def __post_init__(self):
        if not (self.weight >= 0 and self.sigma > 0 and self.stretch >= 0):
            raise ValueError(f"weight and stretch must be at least 0 and sigma above, not {self}.")


def social_cost(grid, people, velocity, config=SocialCostConfig()):
    """The cost (rows, columns) >= 0 of each cell's nearness to people, at its centre.

    people (K, 2) [m] and velocity (K, 2) [m/s], world frame. With (x, y) the centre seen from a person, x along the
    velocity v, the cost is the sum over people of

        weight * exp(-(x / s)^2 / 2 - (y / sigma)^2 / 2),  s = sigma + stretch * |v| where x > 0, sigma elsewhere,

    an asymmetric Gaussian as in Kirby, "Social robot navigation" (2010). Below a thousandth of the weight it is 0.
    """
    people, velocity = np.reshape(people, (-1, 2)).astype(float), np.reshape(velocity, (-1, 2)).astype(float)
    if people.shape != velocity.shape or not (np.isfinite(people).all() and np.isfinite(velocity).all()):
        raise ValueError("People and their velocities need the same number of finite rows (x, y).")
    cost = np.zeros(grid.shape)
    rows, columns = grid.shape
    cut = math.sqrt(2.0 * math.log(1000.0))
    for place, (vx, vy) in zip(grid._scaled(people), velocity, strict=True):
        speed = math.hypot(vx, vy)
        ahead = config.sigma + config.stretch * speed
        reach = cut * ahead / grid.resolution
        (j, i), (to_j, to_i) = np.clip([place - reach, place + reach + 1], 0, (columns, rows)).astype(int)
        dx = (np.arange(j, to_j) + 0.5 - place[0]) * grid.resolution
        dy = (np.arange(i, to_i)[:, None] + 0.5 - place[1]) * grid.resolution
        c, s = (vx / speed, vy / speed) if speed else (1.0, 0.0)
        x, y = c * dx + s * dy, c * dy - s * dx
        squared = (x / np.where(x > 0, ahead, config.sigma)) ** 2 + (y / config.sigma) ** 2
        cost[i:to_i, j:to_j] += np.where(squared <= cut**2, config.weight * np.exp(-0.5 * squared), 0.0)
    return cost


# --- planners on the grid


@dataclass(frozen=True)
class DijkstraConfig:
    """Dijkstra's algorithm has nothing to set."""


@dataclass(frozen=True)
class AStarConfig(DijkstraConfig):
    """A*: the heuristic is the octile distance times `weight`. Up to 1 the path's cost is least, above at most `weight`
    times that, and found faster."""

    weight: float = 1.0

    def __post_init__(self):
        if not 0 <= self.weight < np.inf:
            raise ValueError(f"weight must be at least 0, not {self.weight!r}.")


def _dijkstra(grid, rate, start, goal, rng, config):
    return _search(grid, rate, start, goal, np.zeros(grid.shape))


def _astar(grid, rate, start, goal, rng, config):
    (x, y), (rows, columns) = np.floor(goal), grid.shape
    dx, dy = np.abs(np.arange(columns) - x), np.abs(np.arange(rows) - y)[:, None]
    octile = np.maximum(dx, dy) + (math.sqrt(2.0) - 1.0) * np.minimum(dx, dy)
    return _search(grid, rate, start, goal, config.weight * octile)


def _search(grid, rate, start, goal, heuristic):
    """The path (N, 2) of least cost over the centres of cells, in cells; start and goal stand for their cells' centres.

    A step to one of eight neighbours costs its length times the mean of both cells' rates.
    """
    columns = grid.shape[1]
    width = columns + 2  # with a rim of occupied cells, so that no step needs to look for the map's edge

    def flat(array, rim):
        return np.pad(array, 1, constant_values=rim).ravel().tolist()

    free, heuristic = flat(~grid.occupied, False), flat(heuristic, 0.0)
    rate = flat(np.ones(grid.shape) if rate is None else rate, 1.0)
    still_open = free.copy()
    first, last = ((int(y) + 1) * width + int(x) + 1 for x, y in (start, goal))
    cost, before = [math.inf] * len(free), {}
    cost[first] = 0.0
    heap = [(heuristic[first], first)]
    while True:
        _, cell = heapq.heappop(heap)
        if not still_open[cell]:
            continue
        still_open[cell] = False
        if cell == last:
            break
        here, half = cost[cell], 0.5 * rate[cell]
        up, down, right, left = free[cell + width], free[cell - width], free[cell + 1], free[cell - 1]
        for step, length, allowed in (
            (width, 1.0, up),
            (-width, 1.0, down),
            (1, 1.0, right),
            (-1, 1.0, left),
            (width + 1, math.sqrt(2.0), up and right),
            (width - 1, math.sqrt(2.0), up and left),
            (1 - width, math.sqrt(2.0), down and right),
            (-1 - width, math.sqrt(2.0), down and left),
        ):
            neighbour = cell + step
            if allowed and still_open[neighbour]:
                there = here + length * (half + 0.5 * rate[neighbour])
                if there < cost[neighbour]:
                    cost[neighbour] = there
                    before[neighbour] = cell
                    heapq.heappush(heap, (there + heuristic[neighbour], neighbour))
    cells = [last]
    while cells[-1] != first:
        cells.append(before[cells[-1]])
    cells = np.array(cells[::-1])
    # The two cells of a straight step, and the four around a diagonal one, are free and convex: any point there does.
    between = np.stack([cells % width, cells // width], axis=-1)[1:-1] - 0.5
    return np.concatenate([start[None], between, goal[None]])


# --- trees


@dataclass(frozen=True)
class RrtConfig:
    """RRT: at most `samples` samples, the goal itself with probability `goal_bias` until it is reached."""

    samples: int = 10000
    step: float = 2.0  # the longest extension, and from how far the goal is reached [m]
    goal_bias: float = 0.05

    def __post_init__(self):
        if not self.samples >= 1:
            raise ValueError(f"samples must be at least 1, not {self.samples!r}.")
        if not 0 < self.step < np.inf:
            raise ValueError(f"step must be positive, not {self.step!r}.")
        if not 0 <= self.goal_bias <= 1:
            raise ValueError(f"goal_bias must be between 0 and 1, not {self.goal_bias!r}.")


@dataclass(frozen=True)
class RrtStarConfig(RrtConfig):
    """RRT*: a path that was found is improved until `enough` samples were drawn; more never make it worse.

    Among n nodes, neighbours are within `radius_factor` times Karaman and Frazzoli's least radius for optimality,
    `(6 A / pi)^(1/2) (log n / n)^(1/2)` on a free area A, and at most within `max_radius` [m].
    """

    enough: int = 1500
    radius_factor: float = 1.0
    max_radius: float = 4.0


@dataclass(frozen=True)
class CarrtStarConfig(RrtStarConfig):
    """CARRT*: RRT* whose extensions (turn from the sample's direction, length) are drawn from a Gaussian, refitted
    `iterations` times to the `elites` best of `candidates`.

    The best have the least accumulated cost plus `distance_weight` times the distance that is left to the sample.
    """

    candidates: int = 12
    elites: int = 4
    iterations: int = 2
    turn: float = 0.6  # first standard deviation of the turn [rad]
    least_length: float = 0.5  # of an extension, as a share of the straight one: near people the shortest is cheapest
    distance_weight: float = 2.0  # above 1: what is left will cost something too

    def __post_init__(self):
        super().__post_init__()
        if not 1 <= self.elites <= self.candidates:
            raise ValueError(f"elites must be between 1 and candidates, {self.candidates}, not {self.elites!r}.")


def _polar(angles, lengths):
    """Vectors (M, 2) of `lengths` (M,) or () in the directions `angles` (M,) [rad]."""
    return np.stack([lengths * np.cos(angles), lengths * np.sin(angles)], axis=-1)


class _Rrt:
    """A tree of free, straight edges that grows from the start. Points and lengths in cells."""

    def __init__(self, grid, rate, start, goal, rng, config):
        self.grid, self.rate, self.goal, self.rng, self.config = grid, rate, goal, rng, config
        self.step = config.step / grid.resolution
        row, column = np.floor(start[::-1]).astype(int)
        self.free = np.argwhere(grid.regions == grid.regions[row, column])[:, ::-1]  # corners of reachable cells
        self.points = np.empty((config.samples + 1, 2))
        self.costs = np.zeros(config.samples + 1)
        self.parents, self.children, self.at_goal = [], [], []
        self.add(start, None, 0.0)

    def path(self):
        """The cheapest path (N, 2) found. Raises NoPath."""
        for drawn in range(self.config.samples):
            if self.at_goal and drawn >= self.enough():
                break
            sample = self.sample()
            nearest = int(self.squared_distances(sample).argmin())
            grown = self.extend(nearest, sample)
            if grown is not None:
                self.join(nearest, *grown)
        if not self.at_goal:
            raise NoPath(f"No path was found within {self.config.samples} samples.")
        _, node = min((self.costs[node] + cost, node) for node, cost in self.at_goal)
        nodes = []
        while node is not None:
            nodes.append(node)
            node = self.parents[node]
        return np.concatenate([self.points[nodes[::-1]], self.goal[None]])

    def enough(self):
        """How many samples to draw even where a path was found."""
        return 0

    def sample(self):
        """A point (2,) of the free space that the start is in, or the goal."""
        bias, which, *offset = self.rng.random(4)
        if not self.at_goal and bias < self.config.goal_bias:
            return self.goal
        return self.free[int(which * len(self.free))] + offset

    def squared_distances(self, point):
        """From each node (n,) to `point` (2,)."""
        offset = self.points[: len(self.parents)] - point
        return np.einsum("ni,ni->n", offset, offset)

    def line_costs(self, start, ends):
        return _line_costs(self.grid, self.rate, start, ends)

    def straight(self, nearest, sample):
        """Direction [rad] and length of the straight extension from node `nearest` towards `sample` (2,)."""
        x, y = sample - self.points[nearest]
        return math.atan2(y, x), min(self.step, math.hypot(x, y))

    def extend(self, nearest, sample):
        """The end (2,) and the cost of an edge from node `nearest` towards `sample` (2,); None: it is blocked."""
        angle, length = self.straight(nearest, sample)
        end = self.points[nearest] + _polar(np.array([angle]), length)
        cost = self.line_costs(self.points[nearest], end)[0]
        return (end[0], cost) if 0 < cost < np.inf else None

    def join(self, nearest, point, cost):
        """Adds the node `point` (2,) to which an edge of `cost` leads from node `nearest`."""
        self.add(point, nearest, cost)

    def add(self, point, parent, cost):
        node = len(self.parents)
        self.points[node] = point
        self.parents.append(parent)
        self.children.append([])
        if parent is not None:
            self.costs[node] = self.costs[parent] + cost
            self.children[parent].append(node)
        if math.dist(point, self.goal) <= self.step:
            cost = self.line_costs(point, self.goal[None])[0]
            if cost < np.inf:
                self.at_goal.append((node, cost))
        return node


class _RrtStar(_Rrt):
    """RRT, but a new node takes the parent that makes it cheapest, and becomes the parent of whom it makes cheaper."""

    def enough(self):
        return self.config.enough

    def join(self, nearest, point, cost):
        is_near = self.squared_distances(point) <= self.radius() ** 2
        is_near[nearest] = True
        near = np.flatnonzero(is_near)
        costs = self.line_costs(point, self.points[near])  # the same in both directions
        costs[near == nearest] = cost  # where rounding says that it touches something on the way back
        through = self.costs[near] + costs
        best = int(through.argmin())
        node = self.add(point, int(near[best]), costs[best])
        cheaper = self.costs[node] + costs < self.costs[near] - 1e-9
        for other, edge in zip(near[cheaper].tolist(), costs[cheaper], strict=True):
            self.children[self.parents[other]].remove(other)
            self.parents[other] = node
            self.children[node].append(other)
            self.lower(other, self.costs[node] + edge - self.costs[other])

    def radius(self):
        """Karaman and Frazzoli's, for the nodes that there are, in cells."""
        count, config = len(self.parents) + 1, self.config
        least = math.sqrt(6.0 * len(self.free) / math.pi * math.log(count) / count)
        return min(config.radius_factor * least, config.max_radius / self.grid.resolution)

    def lower(self, node, change):
        """Adds `change` to the costs of `node` and all behind it."""
        behind = [node]
        for one in behind:
            behind += self.children[one]
        self.costs[behind] += change


class _CarrtStar(_RrtStar):
    """RRT*, but the cross-entropy method chooses each extension."""

    def __init__(self, grid, rate, start, goal, rng, config):
        self.noise = rng.spawn(1)[0]  # leaves the samples as RRT*'s
        super().__init__(grid, rate, start, goal, rng, config)

    def extend(self, nearest, sample):
        config, start = self.config, self.points[nearest]
        angle, length = self.straight(nearest, sample)
        if length == 0:
            return None
        mean, spread = np.array([0.0, length]), np.array([config.turn, length / 4])
        best = np.inf, None, np.inf
        for _ in range(config.iterations + 1):
            turns, lengths = (mean + spread * self.noise.standard_normal((config.candidates, 2))).T
            turns[0], lengths[0] = mean  # the straight one first, so that no extension is worse than RRT*'s
            lengths = np.clip(lengths, config.least_length * length, length)
            ends = start + _polar(angle + turns, lengths)
            costs = self.line_costs(start, ends)
            scores = costs + config.distance_weight * np.hypot(*(ends - sample).T)
            order = scores.argsort(kind="stable")[: config.elites]
            order = order[scores[order] < np.inf]
            if not len(order):
                continue
            if scores[order[0]] < best[0]:
                best = scores[order[0]], ends[order[0]], costs[order[0]]
            elites = np.stack([turns[order], lengths[order]], axis=-1)
            mean, spread = elites.mean(axis=0), elites.std(axis=0)
        return best[1:] if best[0] < np.inf else None


def _tree(kind):
    return lambda grid, rate, start, goal, rng, config: kind(grid, rate, start, goal, rng, config).path()


_PLANNERS = {
    "dijkstra": (_dijkstra, DijkstraConfig),
    "astar": (_astar, AStarConfig),
    "rrt": (_tree(_Rrt), RrtConfig),
    "rrt-star": (_tree(_RrtStar), RrtStarConfig),
    "carrt-star": (_tree(_CarrtStar), CarrtStarConfig),
}
PLANNERS = tuple(_PLANNERS)


def plan(name, grid, start, goal, cost=None, rng=None, config=None):
    """A path (N, 2) [m] from `start` (2,) to `goal` (2,) [m], both included, that touches no occupied cell of `grid`.

    name: one of PLANNERS. cost: (rows, columns), at least 0, as of `social_cost`. rng: what the trees draw from, a
    numpy Generator or a seed; None: seed 0. config: the planner's own (AStarConfig, ...); None: its defaults.
    Raises NoPath where there is none or none was found, and ValueError where start or goal is off the map or in an
    obstacle (`Grid.nearest_free` helps) and for what is no planner, cost map or config.
    """
    if name not in _PLANNERS:
        raise ValueError(f"Unknown planner {name!r}. Choose one of {', '.join(PLANNERS)}.")
    planner, kind = _PLANNERS[name]
    config = kind() if config is None else config
    if type(config) is not kind:
        raise ValueError(f"Planner '{name}' is configured by a {kind.__name__}, not {config!r}.")
    rate = _rate(grid, cost)
    ends, regions = [], []
    for what, point in (("start", start), ("goal", goal)):
        point = np.asarray(point, dtype=float)
        if point.shape != (2,) or not np.isfinite(point).all():
            raise ValueError(f"The {what} must be two finite numbers [m], not {point.tolist()}.")
        row, column = grid.cells(point)
        if not (0 <= row < grid.shape[0] and 0 <= column < grid.shape[1]):
            raise ValueError(f"The {what} {np.round(point, 2).tolist()} is off the map.")
        if not grid.free(point):
            raise ValueError(f"The {what} {np.round(point, 2).tolist()} is in an obstacle or touches one.")
        ends.append(point)
        regions.append(grid.regions[row, column])
    if regions[0] != regions[1]:
        places = " to ".join(str(np.round(point, 2).tolist()) for point in ends)
        raise NoPath(f"There is no way from {places}.")
    scaled = grid._scaled(ends)
    rng = np.random.default_rng(0 if rng is None else rng)
    path = grid._unscaled(planner(grid, rate, *scaled, rng, config))
    path[0], path[-1] = ends  # without the rounding
    return path


def shortcut(path, grid, cost=None):
    """`path` (N, 2) [m] with straight lines for its detours: from each point on to the farthest one that can be reached
    straight, without touching an occupied cell and at no higher cost. Returns (M, 2), M <= N, cost as in `plan`.

    Raises ValueError where the path itself is blocked.
    """
    points, rate = grid._scaled(path), _rate(grid, cost)
    along = np.concatenate([[0.0], _line_costs(grid, rate, points[:-1], points[1:]).cumsum()])
    if not np.isfinite(along[-1]):
        raise ValueError("The path to shorten touches an occupied cell or leaves the map.")
    kept = [0]
    while kept[-1] < len(points) - 1:
        here = kept[-1]
        straight = _line_costs(grid, rate, points[here], points[here + 1 :])
        kept.append(here + 1 + int(np.flatnonzero(straight <= along[here + 1 :] - along[here] + 1e-9)[-1]))
    return np.asarray(path, dtype=float)[kept]


# --- following


@dataclass(frozen=True)
class PurePursuit:
    """Follows a path by pure pursuit (Coulter, "Implementation of the pure pursuit path tracking algorithm", 1992).

    The robot steers on the arc, of curvature 2 y / d^2, to a point of the path `lookahead` farther along than the point
    that is nearest to it. It has no memory: of a path that comes back to itself, it may skip the loop.
    """

    lookahead: float = 0.8  # along the path [m]
    max_speed: float = 1.5  # [m/s]
    max_yaw_rate: float = 2.0  # [rad/s]
    max_lateral_acceleration: float = 2.0  # slows down in curves [m/s2]
    slow_distance: float = 1.0  # to the end, from which on the speed falls in proportion [m]
    min_speed: float = 0.15  # that it falls to [m/s]
    tolerance: float = 0.1  # to the end: closer is there [m]
    turn_angle: float = 0.8  # farther than this off the way ahead it turns on the spot [rad]
    turn_time: float = 0.3  # time constant of such a turn [s]

    def __post_init__(self):
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"{name} must be positive, not {value!r}.")

    def __call__(self, pose, path):
        """The command (v [m/s], w [rad/s]) at `pose` (3,) (x, y, yaw) for `path` (N, 2); (0, 0) at its end.

        Both are in the world frame [m, rad].
        """
        x, y, yaw = (float(value) for value in pose)
        path = np.asarray(path, dtype=float).reshape(-1, 2)
        target, left = self._target(np.array([x, y]), path)
        if left <= self.tolerance:
            return 0.0, 0.0
        dx, dy = target[0] - x, target[1] - y
        ahead, side = math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx
        bearing, distance = math.atan2(side, ahead), math.hypot(dx, dy)
        if abs(bearing) > self.turn_angle:
            return 0.0, math.copysign(min(abs(bearing) / self.turn_time, self.max_yaw_rate), bearing)
        curvature = 2.0 * side / distance**2
        bend = max(abs(curvature), 1e-9)
        speed = min(
            self.max_speed,
            max(self.min_speed, self.max_speed * left / self.slow_distance),
            self.max_yaw_rate / bend,
            math.sqrt(self.max_lateral_acceleration / bend),
        )
        return speed, speed * curvature

    def _target(self, place, path):
        """The point (2,) of `path` to steer to from `place` (2,), and how far it is to the path's end [m]."""
        if len(path) == 1:
            return path[0], math.dist(place, path[0])
        legs = np.diff(path, axis=0)
        squared = (legs**2).sum(axis=-1)
        part = np.clip(((place - path[:-1]) * legs).sum(axis=-1) / np.maximum(squared, 1e-12), 0.0, 1.0)
        off = np.hypot(*(path[:-1] + part[:, None] * legs - place).T)
        nearest = int(off.argmin())
        ends = np.concatenate([[0.0], np.sqrt(squared).cumsum()])
        along = ends[nearest] + part[nearest] * (ends[nearest + 1] - ends[nearest])
        reach = along + self.lookahead
        target = np.array([np.interp(reach, ends, path[:, 0]), np.interp(reach, ends, path[:, 1])])
        return target, float(ends[-1] - along + off[nearest])
