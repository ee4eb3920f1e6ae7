"""A planner of one's own: one step aside at most. In Python: bson.planners.plan("own_planner.py:aside", grid, start,
goal)."""

import numpy as np

from bson.planners import NoPath
from bson.planners.grid import line_costs


def aside(grid, rate, start, goal, rng, config, known):
    """The straight line, or the cheapest with one corner among points beside its middle. All in cells, (x, y)."""
    middle, along = (start + goal) / 2, goal - start
    across = np.array([-along[1], along[0]]) / max(np.hypot(*along), 1e-9)
    best, least = None, np.inf
    for offset in np.linspace(-20, 20, 21):
        path = np.array([start, middle + offset * across, goal])
        cost = line_costs(grid, rate, path[:-1], path[1:]).sum()
        if cost < least:
            best, least = path, cost
    if best is None:
        raise NoPath("no way with one corner")
    return best
