"""What a pedestrian senses: 41 numbers in its own frame (paper, sec. IV-A).

| columns | what | unit |
|---|---|---|
| goal | position of the goal, body frame (x ahead, y left) | m |
| speed | magnitude of the velocity | m/s |
| yaw_rate | counter-clockwise | rad/s |
| collision | 1 when touching anything, else 0 | - |
| rays | 12 rays, 30 degrees apart, the first ahead, then counter-clockwise; for each its distance from the centre and the velocity of what it hits less one's own, body frame | m, m/s, m/s |

A ray that meets nothing within 7 m reads 7 m and no relative velocity. Walls and obstacles stand still, so that their
relative velocity is one's own, reversed.
"""

import math

import numpy as np

from macid import geometry
from macid.state import RADIUS

RAYS = 12
RAY_RANGE = 7.0  # [m]
COLUMNS = {"goal": 2, "speed": 1, "yaw_rate": 1, "collision": 1, "rays": 3 * RAYS}
SIZE = sum(COLUMNS.values())


def ray_directions(yaw):
    """Unit vectors (..., RAYS, 2) of the rays of people facing `yaw` (...) [rad], world frame."""
    xp = yaw.__array_namespace__()
    angle = yaw[..., None] + xp.asarray(np.arange(RAYS) * (2 * math.pi / RAYS), dtype=yaw.dtype)
    return xp.stack([xp.cos(angle), xp.sin(angle)], axis=-1)


def cast_rays(state, boxes):
    """Distances (..., K, RAYS) [m] to the nearest person or box, and the relative velocity (..., K, RAYS, 2), world frame.

    state: CrowdState (..., K). boxes: (..., B, 5).
    """
    xp = state.position.__array_namespace__()
    directions = ray_directions(state.yaw)
    others = state.position[..., None, :, :]
    to_people = geometry.ray_disc_distance(state.position, directions, others, RADIUS)  # (..., K, RAYS, K)
    myself = xp.eye(state.position.shape[-2], dtype=bool)[:, None, :]
    to_people = xp.where(myself, xp.full_like(to_people, geometry.NO_HIT), to_people)
    to_boxes = xp.min(geometry.ray_box_distance(state.position, directions, boxes[..., None, :, :]), axis=-1)
    person = xp.min(to_people, axis=-1)
    distance = xp.minimum(xp.minimum(person, to_boxes), xp.full_like(person, RAY_RANGE))
    # The velocity of whom a ray meets, as a sum over all people with one of them marked: a gather costs more.
    met = (to_people == person[..., None]) & (person[..., None] < RAY_RANGE)
    met = xp.astype(met, state.position.dtype)
    met = met / xp.maximum(xp.sum(met, axis=-1, keepdims=True), xp.ones_like(person)[..., None])
    hit_velocity = met @ state.velocity[..., None, :, :]
    is_person = (person <= to_boxes)[..., None]
    hit_velocity = xp.where(is_person, hit_velocity, xp.zeros_like(hit_velocity))
    relative = hit_velocity - state.velocity[..., None, :]
    return distance, xp.where((distance < RAY_RANGE)[..., None], relative, xp.zeros_like(relative))


def observe(state, boxes, goals):
    """Observations (..., K, SIZE) of CrowdState `state` (..., K) among `boxes` (..., B, 5) with `goals` (..., K, 2) [m]."""
    xp = state.position.__array_namespace__()
    distance, relative = cast_rays(state, boxes)
    relative = geometry.to_body(relative, state.yaw[..., None])
    rays = xp.concatenate([distance[..., None], relative], axis=-1)
    columns = [
        geometry.to_body(goals - state.position, state.yaw),
        geometry.norm(state.velocity)[..., None],
        state.yaw_rate[..., None],
        xp.astype(state.contact, state.position.dtype)[..., None],
        rays.reshape(*rays.shape[:-2], 3 * RAYS),
    ]
    return xp.concatenate(columns, axis=-1)
