"""Rays through the robot's scene as formulas: floor, upright cylinders (people) and upright boxes (walls, obstacles).

They meet what MuJoCo's own rays meet, and nothing of the robot itself. The functions take NumPy or JAX arrays and
answer in kind. World frame, z up [m]; a box is a row of `macid.geometry.BOX_COLUMNS` that stands on the floor.
"""

from typing import Any, NamedTuple

import numpy as np

from macid.geometry import Array
from macid.scene import OUTER_WALL_HEIGHT, WALL_HEIGHT
from macid.state import HEIGHT, RADIUS

_TINY = 1e-12  # of a squared length: below it a ray counts as upright
NOTHING = np.inf


class Solids(NamedTuple):
    """The parts of a world that rays meet."""

    people: Any  #: (K, 2) [m]
    boxes: Any  #: (B, 5); the first four are the outer walls
    half: float  #: half the side of the floor [m]
    radius: float = RADIUS  #: of people [m]


def box_heights(number: int) -> np.ndarray:
    """Heights (number,) of a world's boxes [m]."""
    return np.where(np.arange(number) < 4, OUTER_WALL_HEIGHT, WALL_HEIGHT).astype(np.float32)


def slab(origin: Array, direction: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """The distances (enter, leave) between which rays are within low <= x <= high along an axis."""
    xp = direction.__array_namespace__()
    safe = xp.where(xp.abs(direction) < 1e-9, xp.full_like(direction, 1e-9), direction)
    one, other = (low - origin) / safe, (high - origin) / safe
    return xp.minimum(one, other), xp.maximum(one, other)


def _met(enter, leave):
    """The distance at which rays that are inside from `enter` to `leave` meet a solid; NOTHING for those that don't."""
    xp = enter.__array_namespace__()
    return xp.where((enter <= leave) & (enter > 0), enter, xp.full_like(enter, NOTHING))


def to_people(origin: Array, direction: Array, people: Array, radius: float = RADIUS) -> Array:
    """Distances (..., K) [m] from `origin` (3,) along `direction` (..., 3) to people of `radius` [m] at `people` (K,
    2)."""
    xp = direction.__array_namespace__()
    x, y, z = direction[..., 0, None], direction[..., 1, None], direction[..., 2, None]
    level = xp.maximum(x**2 + y**2, xp.full_like(x, _TINY))  # squared length, along the floor, of a unit step
    offset = origin[:2] - people
    closest = -(x * offset[:, 0] + y * offset[:, 1]) / level
    # Computed from the offset at the closest point: this loses far fewer digits than b^2 - a c.
    aside = (offset[:, 0] + closest * x) ** 2 + (offset[:, 1] + closest * y) ** 2
    inside = radius**2 - aside
    reach = xp.sqrt(xp.maximum(inside, xp.zeros_like(inside)) / level)
    low, high = slab(origin[2], z, 0.0, HEIGHT)
    distance = _met(xp.maximum(closest - reach, low), xp.minimum(closest + reach, high))
    return xp.where(inside >= 0, distance, xp.full_like(distance, NOTHING))


def to_boxes(origin: Array, direction: Array, boxes: Array) -> Array:
    """Distances (..., B) [m] from `origin` (3,) along `direction` (..., 3) to `boxes` (B, 5)."""
    xp = direction.__array_namespace__()
    cos, sin = xp.cos(boxes[:, 4]), xp.sin(boxes[:, 4])
    offset = origin[:2] - boxes[:, :2]
    x, y, z = direction[..., 0, None], direction[..., 1, None], direction[..., 2, None]
    ahead = slab(cos * offset[:, 0] + sin * offset[:, 1], cos * x + sin * y, -boxes[:, 2], boxes[:, 2])
    aside = slab(cos * offset[:, 1] - sin * offset[:, 0], cos * y - sin * x, -boxes[:, 3], boxes[:, 3])
    up = slab(origin[2], z, 0.0, xp.asarray(box_heights(boxes.shape[0])))
    enter = xp.maximum(xp.maximum(ahead[0], aside[0]), up[0])
    return _met(enter, xp.minimum(xp.minimum(ahead[1], aside[1]), up[1]))


def to_floor(origin: Array, direction: Array, half: Any) -> Array:
    """Distances (...) [m] from `origin` (3,) along `direction` (..., 3) to the floor, a square of half a side
    `half`."""
    xp = direction.__array_namespace__()
    down = direction[..., 2]
    distance = -origin[2] / xp.where(down < 0, down, xp.full_like(down, -1e-9))
    x, y = origin[0] + distance * direction[..., 0], origin[1] + distance * direction[..., 1]
    hit = (down < 0) & (distance > 0) & (xp.maximum(xp.abs(x), xp.abs(y)) <= half)
    return xp.where(hit, distance, xp.full_like(distance, NOTHING))


def first(origin: Array, direction: Array, solids: Any) -> Array:
    """Distances (...) [m] from `origin` (3,) along `direction` (..., 3) to the first of the Solids; NOTHING for a miss.

    Distances are in lengths of `direction`.
    """
    xp = direction.__array_namespace__()
    found = xp.minimum(
        to_floor(origin, direction, solids.half), xp.min(to_boxes(origin, direction, solids.boxes), axis=-1)
    )
    if solids.people.shape[0]:
        found = xp.minimum(found, xp.min(to_people(origin, direction, solids.people, solids.radius), axis=-1))
    return found
