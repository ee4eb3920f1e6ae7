"""The pictures of the robot's cameras, as formulas: rays through the pixels' middles, and the light of `macid.scene` on
the surfaces that they meet. NumPy or JAX arrays in, the same out.

Depth is exact. Colours agree with the native engine's pictures to a few of 255 steps. They include light from afar and
from the camera, the floor's tiles and the sky's gradient, but no shadows. Highlights, fainter than those few steps, are
left out.
"""

from typing import Any

import numpy as np

from bson.simulation import rays
from macid.geometry import Array
from macid.scene import OBSTACLE_RGBA, PERSON_RGBA, WALL_RGBA
from macid.state import HEIGHT, RADIUS

_AMBIENT = np.array([0.48, 0.48, 0.50], np.float32)
_HEADLIGHT = np.array([0.30, 0.30, 0.30], np.float32)
_SUN = np.array([0.46, 0.45, 0.42], np.float32)
_TO_SUN = -np.array([0.35, 0.25, -0.9], np.float32) / np.float32(np.linalg.norm([0.35, 0.25, -0.9]))
_TILES = np.array([[0.60, 0.61, 0.62], [0.65, 0.66, 0.67]], np.float32)
_TILE = 1.0  # side of a floor tile [m]
_MARK, _LINE = np.array([0.53, 0.54, 0.55], np.float32), 4 / 256  # lines every two tiles: colour, width [m]
_SKY = np.array([[0.75, 0.83, 0.92], [0.96, 0.97, 0.98]], np.float32)  # colours above and below
_SKY_SLOPE = 1.16  # at the horizon, as MuJoCo's gradient has it


def normals_of_person(point: Array, centre: Array, radius: float = RADIUS) -> Array:
    """Normals (..., 3) of the cylinders of `radius` [m] at `centre` (..., 2) where `point` (..., 3) lies on them."""
    xp = point.__array_namespace__()
    outwards = (point[..., :2] - centre) / radius
    side = xp.concatenate([outwards, xp.zeros_like(outwards[..., :1])], axis=-1)
    return xp.where(point[..., 2:] >= HEIGHT - 1e-4, xp.asarray([0.0, 0.0, 1.0], dtype=point.dtype), side)


def normals_of_box(point: Array, box: Array, height: Array) -> Array:
    """Normals (..., 3) of the boxes `box` (..., 5), of `height` (...), where `point` (..., 3) lies on them."""
    xp = point.__array_namespace__()
    cos, sin = xp.cos(box[..., 4]), xp.sin(box[..., 4])
    x, y = point[..., 0] - box[..., 0], point[..., 1] - box[..., 1]
    ahead, aside = cos * x + sin * y, cos * y - sin * x
    beyond = xp.stack([xp.abs(ahead) - box[..., 2], xp.abs(aside) - box[..., 3], point[..., 2] - height], axis=-1)
    face = xp.argmax(beyond, axis=-1)
    zero, one = xp.zeros_like(x), xp.ones_like(x)
    along = xp.where(face == 0, xp.sign(ahead), zero)
    across = xp.where(face == 1, xp.sign(aside), zero)
    return xp.stack([cos * along - sin * across, sin * along + cos * across, xp.where(face == 2, one, zero)], axis=-1)


def floor_colour(point: Array, spread: Array) -> Array:
    """The floor's colour (..., 3) at `point` (..., 3), for a pixel that spans `spread` (...) [m] of the floor."""
    xp = point.__array_namespace__()
    cell = xp.floor(point[..., 0] / _TILE) + xp.floor(point[..., 1] / _TILE) + 1
    bright = xp.where(cell % 2 == 1, xp.ones_like(cell), xp.zeros_like(cell))
    sharp = xp.clip(1.5 - spread / _TILE, 0.0, 1.0)
    share = 0.5 + (bright - 0.5) * sharp
    tiles = _TILES[0] + (_TILES[1] - _TILES[0]) * share[..., None]
    beside = point[..., :2] - 2 * _TILE * xp.round(point[..., :2] / (2 * _TILE))  # distance from the nearest line
    beside = xp.min(xp.abs(beside), axis=-1)
    wide = xp.maximum(spread, xp.full_like(spread, _LINE))
    marked = xp.where(beside <= wide / 2, _LINE / wide, xp.zeros_like(wide))
    return tiles + (_MARK - tiles) * marked[..., None]


def sky_colour(direction: Array) -> Array:
    """The sky's colour (..., 3) along `direction` (..., 3)."""
    xp = direction.__array_namespace__()
    length = xp.sqrt((direction**2).sum(axis=-1))
    up = xp.arcsin(xp.clip(direction[..., 2] / length, -1.0, 1.0))
    share = xp.clip(0.5 - _SKY_SLOPE * up / np.pi, 0.0, 1.0)
    return _SKY[0] + (_SKY[1] - _SKY[0]) * share[..., None]


def look(origin: Array, direction: Array, ahead: Array, solids: Any, pixel: float) -> tuple[Array, Array]:
    """The picture of a camera at `origin` (3,) along `direction` (H, W, 3), vectors that reach 1 m along the camera's
    axis `ahead` (3,): colours (H, W, 3) uint8, and distances (H, W) in lengths of `direction`, that is along the axis
    [m].

    pixel: the height of a pixel at a distance of 1 m [m].
    """
    xp = direction.__array_namespace__()
    to_box = rays.to_boxes(origin, direction, solids.boxes)
    box = xp.argmin(to_box, axis=-1)
    to_box, to_floor = xp.min(to_box, axis=-1), rays.to_floor(origin, direction, solids.half)
    distance = xp.minimum(to_box, to_floor)
    person = who = None
    if solids.people.shape[0]:
        to_person = rays.to_people(origin, direction, solids.people, solids.radius)
        who, to_person = xp.argmin(to_person, axis=-1), xp.min(to_person, axis=-1)
        distance, person = xp.minimum(distance, to_person), to_person < distance
    reach = xp.where(xp.isfinite(distance), distance, xp.zeros_like(distance))
    point = origin + reach[..., None] * direction
    on_box, on_floor = to_box < to_floor, xp.isfinite(distance)

    heights = xp.asarray(rays.box_heights(solids.boxes.shape[0]))
    normal = xp.where(on_box[..., None], normals_of_box(point, solids.boxes[box], heights[box]), _up(direction))
    walls = xp.where((box < 4)[..., None], _rgb(WALL_RGBA), _rgb(OBSTACLE_RGBA))
    spread = reach**2 * pixel / xp.maximum(xp.abs(origin[2]), 1e-3)
    colour = xp.where(on_box[..., None], walls, floor_colour(point, spread))
    if person is not None:
        upright = normals_of_person(point, solids.people[who], solids.radius)
        normal = xp.where(person[..., None], upright, normal)
        colour = xp.where(person[..., None], _rgb(PERSON_RGBA), colour)

    def facing(light):  # (...,)
        cosine = normal[..., 0] * light[0] + normal[..., 1] * light[1] + normal[..., 2] * light[2]
        return xp.maximum(cosine, xp.zeros_like(cosine))[..., None]

    light = _AMBIENT + _SUN * facing(_TO_SUN) + _HEADLIGHT * facing(-ahead)
    colour = xp.where(on_floor[..., None], colour * xp.clip(light, 0.0, 1.0), sky_colour(direction))
    return xp.astype(xp.rint(255 * xp.clip(colour, 0.0, 1.0)), xp.uint8), distance


def _up(like):
    xp = like.__array_namespace__()
    return xp.asarray([0.0, 0.0, 1.0], dtype=like.dtype)


def _rgb(rgba):
    return np.array(rgba[:3], np.float32)
