"""Dijkstra's algorithm and A* on the eight-connected cells of an occupancy grid, without cutting corners."""

import heapq
import math
from dataclasses import dataclass

import numpy as np


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


def dijkstra(grid, rate, start, goal, rng, config, known):
    """The path (N, 2) of least cost; points in cells, rate (rows, columns) or None. The others have no effect."""
    return _search(grid, rate, start, goal, np.zeros(grid.shape))


def astar(grid, rate, start, goal, rng, config, known):
    """As `dijkstra`, with AStarConfig's heuristic."""
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
