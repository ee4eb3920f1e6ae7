"""Trees that grow through the free space of an occupancy grid: RRT, RRT* and CARRT*."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bson.planners.grid import Grid, NoPath, line_costs


@dataclass(frozen=True)
class RrtConfig:
    """RRT: at most `samples` samples, the goal itself with probability `goal_bias` until it is reached."""

    samples: int = 10000
    step: float = 2.0  # the longest extension; the goal is reached from within this distance [m]
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
    """RRT*: a path that was found is improved until `enough` samples were drawn; more samples never make it worse.

    Among n nodes, neighbours are within `radius_factor` times Karaman and Frazzoli's least radius for optimality,
    `(6 A / pi)^(1/2) (log n / n)^(1/2)` on a free area A, and at most within `max_radius` [m].
    """

    enough: int = 1500
    radius_factor: float = 1.0
    max_radius: float = 4.0


@dataclass(frozen=True)
class CarrtStarConfig(RrtStarConfig):
    """CARRT*: RRT* whose extensions (turn from the sample's direction, length) are drawn from a Gaussian, refitted
    `iterations` times to the `elites` best of `candidates` draws.

    The best have the least accumulated cost plus `distance_weight` times the remaining distance to the sample.
    """

    candidates: int = 12
    elites: int = 4
    iterations: int = 2
    turn: float = 0.6  # first standard deviation of the turn [rad]
    least_length: float = 0.5  # of an extension, as a share of the straight one: near people the shortest is cheapest
    distance_weight: float = 2.0  # above 1, as the remaining distance will cost people something too

    def __post_init__(self):
        super().__post_init__()
        if not 1 <= self.elites <= self.candidates:
            raise ValueError(f"elites must be between 1 and candidates, {self.candidates}, not {self.elites!r}.")


def _polar(angles, lengths):
    """Vectors (M, 2) of `lengths` (M,) or () in the directions `angles` (M,) [rad]."""
    return np.stack([lengths * np.cos(angles), lengths * np.sin(angles)], axis=-1)


class Rrt:
    """A tree of free, straight edges that grows from the start. Points and lengths in cells.

    known: a path (N, 2) whose free beginning is the tree's first branch, or None.
    """

    def __init__(
        self,
        grid: Grid,
        rate: np.ndarray | None,
        start: np.ndarray,
        goal: np.ndarray,
        rng: np.random.Generator,
        config: Any,
        known: np.ndarray | None = None,
    ):
        self.grid, self.rate, self.goal, self.rng, self.config = grid, rate, goal, rng, config
        self.step = config.step / grid.resolution
        row, column = np.floor(start[::-1]).astype(int)
        self.free = np.argwhere(grid.regions == grid.regions[row, column])[:, ::-1]  # corners of reachable cells
        branch = np.zeros((0, 2)) if known is None else self.branch(start, known)
        most = config.samples + len(branch) + 1
        self.points, self.costs = np.empty((most, 2)), np.zeros(most)
        self.parents, self.children, self.at_goal = [], [], []
        node = self.add(start, None, 0.0)
        for point, cost in zip(branch, self.line_costs(np.vstack([start, branch[:-1]]), branch), strict=True):
            if not cost < np.inf:
                break
            node = self.add(point, node, cost)

    def branch(self, start: np.ndarray, path: np.ndarray) -> np.ndarray:
        """Points (M, 2) from `start` (2,), left out, along `path` (N, 2) at most `step` apart, without the goal."""
        corners = np.vstack([start, path])
        parts = np.ceil(np.hypot(*np.diff(corners, axis=0).T) / self.step).astype(int)  # 0 for a leg without length
        legs = [
            a + (b - a) * np.arange(1, n + 1)[:, None] / n
            for a, b, n in zip(corners[:-1], corners[1:], parts, strict=True)
            if n
        ]
        points = np.concatenate([np.zeros((0, 2)), *legs])
        return points[:-1] if len(points) and np.allclose(points[-1], self.goal) else points

    def path(self) -> np.ndarray:
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

    def enough(self) -> int:
        """How many samples to draw even where a path was found."""
        return 0

    def sample(self) -> np.ndarray:
        """A point (2,) of the free space that the start is in, or the goal."""
        bias, which, *offset = self.rng.random(4)
        if not self.at_goal and bias < self.config.goal_bias:
            return self.goal
        return self.free[int(which * len(self.free))] + offset

    def squared_distances(self, point: np.ndarray) -> np.ndarray:
        """Squared distances (n,) from each node to `point` (2,)."""
        offset = self.points[: len(self.parents)] - point
        return np.einsum("ni,ni->n", offset, offset)

    def line_costs(self, start: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """The costs of the lines from `start` (2,) to each of `ends` (n, 2); infinity where one is not free."""
        return line_costs(self.grid, self.rate, start, ends)

    def straight(self, nearest: int, sample: np.ndarray) -> tuple[float, float]:
        """Direction [rad] and length of the straight extension from node `nearest` towards `sample` (2,)."""
        x, y = sample - self.points[nearest]
        return math.atan2(y, x), min(self.step, math.hypot(x, y))

    def extend(self, nearest: int, sample: np.ndarray) -> tuple[np.ndarray, float] | None:
        """The end (2,) and the cost of an edge from node `nearest` towards `sample` (2,); None where it is blocked."""
        angle, length = self.straight(nearest, sample)
        end = self.points[nearest] + _polar(np.array([angle]), length)
        cost = self.line_costs(self.points[nearest], end)[0]
        return (end[0], cost) if 0 < cost < np.inf else None

    def join(self, nearest: int, point: np.ndarray, cost: float) -> None:
        """Adds the node `point` (2,), with an edge of `cost` from node `nearest`."""
        self.add(point, nearest, cost)

    def add(self, point: np.ndarray, parent: int | None, cost: float) -> int:
        """Adds the node `point` (2,) below node `parent`, with an edge of `cost`; returns its number."""
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


class RrtStar(Rrt):
    """RRT, but a new node takes the parent that makes it cheapest, and becomes the parent of nodes that it makes
    cheaper."""

    def enough(self) -> int:
        """As Rrt.enough: the configuration's `enough`."""
        return self.config.enough

    def join(self, nearest: int, point: np.ndarray, cost: float) -> None:
        """Adds the node `point` (2,) below the node near it that makes it cheapest; `nearest` is one of these nodes, at
        `cost`."""
        is_near = self.squared_distances(point) <= self.radius() ** 2
        is_near[nearest] = True
        near = np.flatnonzero(is_near)
        costs = self.line_costs(point, self.points[near])  # a line costs the same in both directions
        costs[near == nearest] = cost  # here rounding may say that the line back touches something
        through = self.costs[near] + costs
        best = int(through.argmin())
        node = self.add(point, int(near[best]), costs[best])
        cheaper = self.costs[node] + costs < self.costs[near] - 1e-9
        for other, edge in zip(near[cheaper].tolist(), costs[cheaper], strict=True):
            change = self.costs[node] + edge - self.costs[other]
            if change < 0:  # still cheaper: a node before may have made it cheaper already
                self.children[self.parents[other]].remove(other)
                self.parents[other] = node
                self.children[node].append(other)
                self.lower(other, change)

    def radius(self) -> float:
        """Karaman and Frazzoli's radius for the present number of nodes, in cells."""
        count, config = len(self.parents) + 1, self.config
        least = math.sqrt(6.0 * len(self.free) / math.pi * math.log(count) / count)
        return min(config.radius_factor * least, config.max_radius / self.grid.resolution)

    def lower(self, node: int, change: float) -> None:
        """Adds `change` to the costs of `node` and all behind it."""
        behind = [node]
        for one in behind:
            behind += self.children[one]
        self.costs[behind] += change


class CarrtStar(RrtStar):
    """RRT*, but the cross-entropy method chooses each extension."""

    def __init__(
        self,
        grid: Grid,
        rate: np.ndarray | None,
        start: np.ndarray,
        goal: np.ndarray,
        rng: np.random.Generator,
        config: Any,
        known: np.ndarray | None = None,
    ):
        self.noise = rng.spawn(1)[0]  # a stream of its own leaves the samples equal to RRT*'s
        super().__init__(grid, rate, start, goal, rng, config, known)

    def extend(self, nearest: int, sample: np.ndarray) -> tuple[np.ndarray, float] | None:
        """As Rrt.extend, with the best of the drawn extensions."""
        config, start = self.config, self.points[nearest]
        angle, length = self.straight(nearest, sample)
        if length == 0:
            return None
        mean, spread = np.array([0.0, length]), np.array([config.turn, length / 4])
        best: tuple[np.ndarray, Any] | None = None
        least = np.inf
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
            if scores[order[0]] < least:
                best, least = (ends[order[0]], costs[order[0]]), scores[order[0]]
            elites = np.stack([turns[order], lengths[order]], axis=-1)
            mean, spread = elites.mean(axis=0), elites.std(axis=0)
        return best
