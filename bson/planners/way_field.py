"""The length of the shortest way to a goal from everywhere: the eikonal equation on an occupancy grid."""

import jax
import jax.numpy as jnp
import numpy as np

from bson.planners.grid import Grid

FAR = 1e6  # what a place reads that no way leads to [m]
_ENOUGH = 1e-3  # a field that changes by no more is the answer [m]
_SWEEPS = 8  # between two looks at the change


def way_field(grid: Grid, goal: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """The least integral (rows, columns) float32 [m] of `rate` along any way from each cell's centre to `goal` (2,)
    [m].

    rate: (rows, columns), above 0: the cost of a metre of way in each cell; 1 where the way's length alone counts. The
    field V solves |grad V| = rate with V = 0 at the goal by Godunov's upwind scheme (Rouy and Tourin, SIAM J. Numer.
    Anal. 1992), to which the fast marching method (Sethian, PNAS 1996) is a faster way on one core; here all cells are
    updated at once until nothing changes. Unlike lengths over a grid's eight neighbours it has no favourite directions.
    A goal off the map stands for the nearest cell.
    """
    rows, columns = grid.shape
    row, column = np.clip(grid.cells(goal), 0, (rows - 1, columns - 1))
    near = np.mgrid[row - 1 : row + 2, column - 1 : column + 2].reshape(2, -1).T
    near = near[((near >= 0) & (near < (rows, columns))).all(axis=-1)]
    start = np.full(grid.shape, FAR, np.float32)
    start[tuple(near.T)] = np.hypot(*(grid.centres(near) - goal).T)
    return solve_field(rate * grid.resolution, start)


def solve_field(step: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The field (rows, columns) float32 [m] that is at most `start` (rows, columns) [m], FAR where it is not known,
    with a slope of `step` (rows, columns) for each cell [m]."""
    return np.asarray(_solve(jnp.asarray(step, jnp.float32), jnp.asarray(start, jnp.float32)))


def rate_by_clearance(
    occupied: np.ndarray, clear: np.ndarray, least: float, comfort: float, cost: float = 0.5, blocked: float = 30.0
) -> np.ndarray:
    """A rate for `way_field` (rows, columns): 1 where a cell is `clear` [m] by `least` + `comfort` [m] of what is
    `occupied`, rising to 1 + `cost` at `least`; 1 + `blocked` below, so that who was pushed there finds out again, and
    ten times `blocked` in what is occupied."""
    beyond = clear - least
    rate = 1.0 + cost * np.clip(1.0 - beyond / comfort, 0.0, 1.0)
    return np.where(occupied, 10.0 * blocked, np.where(beyond <= 0, 1.0 + blocked, rate))


@jax.jit
def _solve(step, start):
    def sweep(field):
        around = jnp.pad(field, 1, constant_values=FAR)
        x = jnp.minimum(around[1:-1, :-2], around[1:-1, 2:])
        y = jnp.minimum(around[:-2, 1:-1], around[2:, 1:-1])
        low, apart = jnp.minimum(x, y), jnp.abs(x - y)
        both = 0.5 * (x + y + jnp.sqrt(jnp.maximum(2.0 * step**2 - apart**2, 0.0)))
        return jnp.minimum(field, jnp.where(apart >= step, low + step, both))

    def sweeps(carried):
        field = before = carried[0]
        for _ in range(_SWEEPS):
            field = sweep(field)
        return field, jnp.any(field < before - _ENOUGH)

    return jax.lax.while_loop(lambda carried: carried[1], sweeps, (start, True))[0]
