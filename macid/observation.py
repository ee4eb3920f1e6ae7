"""What a pedestrian senses: 41 numbers in its own frame (paper, sec. IV-A).

| columns | what | unit |
|---|---|---|
| goal | position of the goal, body frame (x ahead, y left) | m |
| speed | magnitude of the velocity | m/s |
| yaw_rate | counter-clockwise | rad/s |
| collision | 1 when touching anything, else 0 | - |
| rays | 12 rays, of each the distance and the relative velocity | m, m/s, m/s |

The rays are 30 degrees apart, the first ahead, then counter-clockwise. A distance is from the person's centre. The
relative velocity is that of what the ray hits less the person's own, in the body frame. A ray that meets nothing within
7 m reads 7 m and no relative velocity. Walls and obstacles stand still, so that their relative velocity is one's own,
reversed.
"""

import math

from macid import geometry
from macid.geometry import Array
from macid.state import CrowdState

RAYS = 12
RAY_RANGE = 7.0  # [m]
COLUMNS = {"goal": 2, "speed": 1, "yaw_rate": 1, "collision": 1, "rays": 3 * RAYS}
SIZE = sum(COLUMNS.values())
_RAYS = [(math.cos(angle), math.sin(angle)) for angle in (2 * math.pi * ray / RAYS for ray in range(RAYS))]


def cast_rays(state: CrowdState, boxes: Array) -> tuple[Array, Array]:
    """Distances (..., K, RAYS) [m] to the nearest person or box, and the relative velocity (..., K, RAYS, 2), body
    frame.

    state: CrowdState (..., K). boxes: (..., B, 5).
    """
    xp = state.position.__array_namespace__()
    ahead = geometry.heading(state.yaw)[..., None, :]
    directions = geometry.from_frame(xp.asarray(_RAYS, dtype=ahead.dtype), ahead)
    others, boxes = state.position[..., None, :, :], boxes[..., None, :, :]
    radius = state.radius if state.traits.radius is None else state.radius[..., None, :]
    person, who = geometry.first_disc(state.position, directions, others, radius)
    box = xp.min(geometry.ray_box_distance(state.position, directions, boxes), axis=-1)
    distance = xp.minimum(xp.minimum(person, box), xp.full_like(person, RAY_RANGE))
    met = xp.take_along_axis(state.velocity, who.reshape(*who.shape[:-2], -1, 1), axis=-2).reshape(directions.shape)
    met = xp.where((person <= box)[..., None], met, xp.zeros_like(met))
    relative = geometry.to_frame(met - state.velocity[..., None, :], ahead)
    return distance, xp.where((distance < RAY_RANGE)[..., None], relative, xp.zeros_like(relative))


def observe(state: CrowdState, boxes: Array, goals: Array) -> Array:
    """Observations (..., K, SIZE) of CrowdState `state` (..., K) among `boxes` (..., B, 5) with `goals` (..., K, 2)
    [m]."""
    xp = state.position.__array_namespace__()
    distance, relative = cast_rays(state, boxes)
    rays = xp.concatenate([distance[..., None], relative], axis=-1)
    columns = [
        geometry.to_body(goals - state.position, state.yaw),
        geometry.norm(state.velocity)[..., None],
        state.yaw_rate[..., None],
        xp.astype(state.contact, state.position.dtype)[..., None],
        rays.reshape(*rays.shape[:-2], 3 * RAYS),
    ]
    return xp.concatenate(columns, axis=-1)
