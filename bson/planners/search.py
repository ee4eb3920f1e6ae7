"""Dijkstra's algorithm and A* on the eight-connected cells of an occupancy grid, without cutting corners."""

import heapq
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from bson.planners.grid import Grid
from macid.routing import shortest

_TIE = 1e-9  # ways whose costs differ by less than this share are equal
_DETOUR = 1.3  # a way is first looked for among those up to this times the straight line's length


@dataclass(frozen=True)
class DijkstraConfig:
    """Dijkstra's algorithm has nothing to set."""


@dataclass(frozen=True)
class AStarConfig(DijkstraConfig):
    """A*: the heuristic is the octile distance times `weight`. With a weight up to 1 the path's cost is the least;
    above 1 it is at most `weight` times the least, and found faster."""

    weight: float = 1.0

    def __post_init__(self):
        if not 0 <= self.weight < np.inf:
            raise ValueError(f"weight must be at least 0, not {self.weight!r}.")


def dijkstra(
    grid: Grid, rate: np.ndarray | None, start: np.ndarray, goal: np.ndarray, rng: Any, config: Any, known: Any
) -> np.ndarray:
    """The path (N, 2) of least cost; points in cells, rate (rows, columns) or None. The other arguments have no
    effect."""
    return _search(grid, rate, start, goal, 0.0)


def astar(
    grid: Grid, rate: np.ndarray | None, start: np.ndarray, goal: np.ndarray, rng: Any, config: Any, known: Any
) -> np.ndarray:
    """As `dijkstra`, with AStarConfig's heuristic."""
    return _search(grid, rate, start, goal, config.weight)


def _search(grid, rate, start, goal, weight):
    """The path (N, 2) of least cost over the centres of cells, in cells; start and goal stand for the centres of their
    cells.

    A step to one of eight neighbours costs its length times the mean of both cells' rates. weight: factor on the
    heuristic, the octile distance. Up to 1 the heuristic only chooses among ways of equal cost; above 1 it also bends
    the search.
    """
    number, moves = grid.moves
    rows, columns = np.nonzero(~grid.occupied)
    first, last = (int(number[int(y), int(x)]) for x, y in (start, goal))
    graph = moves if rate is None else _priced(moves, rate[rows, columns])
    dx, dy = np.abs(columns - np.floor(goal[0])), np.abs(rows - np.floor(goal[1]))
    octile = np.maximum(dx, dy) + (math.sqrt(2.0) - 1.0) * np.minimum(dx, dy)
    to_look_at = np.ones(len(octile), bool)
    if weight <= 1:  # then the search finds the least cost, and only cells on ways of that cost matter
        there, _ = shortest(graph, first, last, _DETOUR * octile[first])
        least = (1 + _TIE) * there[last]
        back, _ = shortest(graph, last, first, least)
        to_look_at = there + back <= least
    cells = _way(graph, first, last, weight * octile, to_look_at)
    # The two cells of a straight step, and the four around a diagonal step, are free and form a rectangle: a straight
    # line between any points in them stays free.
    between = np.stack([columns[cells], rows[cells]], axis=-1)[1:-1] + 0.5
    return np.concatenate([start[None], between, goal[None]])


def _priced(moves, rate):
    """The graph of the costs of `moves` between cells with the rates `rate` (N,)."""
    half = 0.5 * rate
    costs = moves.data * (half.repeat(np.diff(moves.indptr)) + half[moves.indices])
    return sparse.csr_matrix((costs, moves.indices, moves.indptr), shape=moves.shape)


def _way(graph, first, last, heuristic, to_look_at):
    """The nodes from `first` to `last` that A* finds over a sparse `graph` (N, N), with its `heuristic` (N,).

    to_look_at: (N,) bool, whether a node is looked at. Of equal nodes the one with the least number comes first.
    """
    heuristic, still_open = heuristic.tolist(), to_look_at.tolist()
    ends, neighbours, costs = graph.indptr, graph.indices, graph.data
    cost, before, heap = {first: 0.0}, {}, [(heuristic[first], first)]
    while True:
        _, node = heapq.heappop(heap)
        if not still_open[node]:
            continue
        still_open[node] = False
        if node == last:
            break
        here, row = cost[node], slice(ends[node], ends[node + 1])
        for neighbour, step in zip(neighbours[row].tolist(), costs[row].tolist(), strict=True):
            if still_open[neighbour]:
                there = here + step
                if there < cost.get(neighbour, math.inf):
                    cost[neighbour], before[neighbour] = there, node
                    heapq.heappush(heap, (there + heuristic[neighbour], neighbour))
    way = [last]
    while way[-1] != first:
        way.append(before[way[-1]])
    return way[::-1]
