"""One call for every planner, and one that takes the detours out of a path."""

from collections.abc import Callable
from typing import Any

import numpy as np

from bson.planners.grid import Grid, NoPath, cost_rate, line_costs
from bson.planners.search import AStarConfig, DijkstraConfig, astar, dijkstra
from bson.planners.trees import CarrtStar, CarrtStarConfig, Rrt, RrtConfig, RrtStar, RrtStarConfig
from macid.files import UsageError
from macid.registry import Kind


def _tree(kind):
    return lambda *arguments: kind(*arguments).path()


def _own(found, name):
    """The user's own planner, `planner(grid, rate, start, goal, rng, config, known) -> (N, 2)` in cells, and its
    Config."""
    if not callable(found):
        raise UsageError(
            f"Planner '{name}' is not callable: it is a function of (grid, rate, start, goal, rng, config, known)."
        )

    def planner(*arguments):
        with KIND.running(name, "planning"):
            return np.asarray(found(*arguments), float)

    return planner, getattr(found, "config", None)


_PLANNERS = {
    "dijkstra": (dijkstra, DijkstraConfig),
    "astar": (astar, AStarConfig),
    "rrt": (_tree(Rrt), RrtConfig),
    "rrt-star": (_tree(RrtStar), RrtStarConfig),
    "carrt-star": (_tree(CarrtStar), CarrtStarConfig),
}
PLANNERS = tuple(_PLANNERS)
#: a name stands for (planner, the class of its configuration or None)
KIND: Kind[tuple[Callable, type | None]] = Kind("planner", _PLANNERS, own="function", check=_own)


def plan(
    name: str,
    grid: Grid,
    start: Any,
    goal: Any,
    cost: Any = None,
    rng: Any = None,
    config: Any = None,
    known: Any = None,
) -> np.ndarray:
    """A path (N, 2) [m] from `start` (2,) to `goal` (2,) [m], both included, that touches no occupied cell of `grid`.

    name: one of PLANNERS, or the user's own planner, `module:function` or `file.py:function` (see _own). cost: (rows,
    columns), at least 0, as of `social_cost`. rng: the random numbers of the trees, a numpy Generator or a seed; None:
    seed 0. config: the planner's own (AStarConfig, ...); None: its defaults. known: a path (N, 2) [m] that the trees
    begin with, as far as it is free, such as the rest of the last path (anytime RRT*: Karaman et al., ICRA 2011). If
    the known path leads to the goal, RRT returns it, and the other trees return no worse path. Raises NoPath where
    there is no path or none was found. Raises ValueError where start or goal is off the map or in an obstacle
    (`Grid.nearest_free` helps), and for a faulty planner, cost map, config or path.
    """
    planner, kind = KIND.load(name)
    config = kind() if config is None and kind is not None else config
    if kind is not None and type(config) is not kind:
        raise ValueError(f"Planner '{name}' is configured by a {kind.__name__}, not {config!r}.")
    rate = cost_rate(grid, cost)
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
    scaled = grid.scaled(ends)
    rng = np.random.default_rng(0 if rng is None else rng)
    if known is not None:
        known = np.asarray(known, dtype=float)
        if known.ndim != 2 or known.shape[1] != 2 or not np.isfinite(known).all():
            raise ValueError(f"A known path is (N, 2) finite numbers [m], not of shape {known.shape}.")
        known = grid.scaled(known)
    path = grid.unscaled(planner(grid, rate, *scaled, rng, config, known))
    path[0], path[-1] = ends  # the exact ends, without rounding
    return path


def shortcut(path: Any, grid: Grid, cost: Any = None) -> np.ndarray:
    """`path` (N, 2) [m] with straight lines in place of its detours: each point is joined to the farthest point that
    can be reached straight, without touching an occupied cell and at no higher cost. Returns (M, 2), M <= N, cost as in
    `plan`.

    Raises ValueError where the path itself is blocked.
    """
    points, rate = grid.scaled(path), cost_rate(grid, cost)
    along = np.concatenate([[0.0], line_costs(grid, rate, points[:-1], points[1:]).cumsum()])
    if not np.isfinite(along[-1]):
        raise ValueError("The path to shorten touches an occupied cell or leaves the map.")
    kept = [0]
    while kept[-1] < len(points) - 1:
        here = kept[-1]
        straight = line_costs(grid, rate, points[here], points[here + 1 :])
        kept.append(here + 1 + int(np.flatnonzero(straight <= along[here + 1 :] - along[here] + 1e-9)[-1]))
    return np.asarray(path, dtype=float)[kept]
