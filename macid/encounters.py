"""What a pedestrian senses, second version: walls by rays, and the people whom it will meet soonest.

The twelve rays of `macid.observation` meet a third of the people with whom somebody is on a collision course; the 16
people met soonest are nearly all of them. Everything is in the goal's frame (x towards the goal, y to the left of it),
so that it turns with the world, and the order of the people has no meaning.

| columns | what | unit |
|---|---|---|
| goal | distance to the goal | m |
| velocity | one's own | m/s |
| preferred_speed | at which one walks where nothing is in the way | m/s |
| radius | of one's own body | m |
| collision | 1 when touching anything, else 0 | - |
| walls | 16 rays, of each the distance from the body's surface to a wall or obstacle; the first to the goal | m |
| people | 16 people, of each the seven numbers of PERSON | |

PERSON: 1 for a person, 0 for nobody; the position of its centre and its velocity, both less one's own [m, m/s]; the
time to the collision of both bodies at these velocities [s]; 1 for a companion, else 0.

A ray that meets nothing within 7 m reads 7 m. People beyond 10 m aren't seen. Who never collides reads 10 s. Nobody
stands 10 m ahead, and reads 10 s.
"""

import math

from macid import geometry
from macid.geometry import Array
from macid.state import RADIUS, CrowdState

WALL_RAYS = 16
WALL_RANGE = 7.0  # [m]
PEOPLE = 16
PEOPLE_RANGE = 10.0  # [m]
MOST_TIME = 10.0  # [s]
WALKING_SPEED = 1.34  # the preferred speed of a person that has none [m/s]
PERSON = {"present": 1, "position": 2, "velocity": 2, "time": 1, "companion": 1}
PERSON_SIZE = sum(PERSON.values())
OWN = {"goal": 1, "velocity": 2, "preferred_speed": 1, "radius": 1, "collision": 1, "walls": WALL_RAYS}
OWN_SIZE = sum(OWN.values())
COLUMNS = {**OWN, "people": PEOPLE * PERSON_SIZE}
SIZE = sum(COLUMNS.values())
_RAYS = [(math.cos(angle), math.sin(angle)) for angle in (2 * math.pi * ray / WALL_RAYS for ray in range(WALL_RAYS))]
_COMFORT = 0.5  # people who come within it, surface to surface, count as met [m]
_SMALL = 1e-6


def observe(state: CrowdState, boxes: Array, goals: Array, others: CrowdState | None = None) -> Array:
    """Observations (..., K, SIZE) of CrowdState `state` (..., K) among `boxes` (..., B, 5) with `goals` (..., K, 2)
    [m].

    others: the same people as everybody else sees them, for gradients of a person's own state alone; default: `state`.
    """
    xp = state.position.__array_namespace__()
    shape, dtype = state.position.shape[:-1], state.position.dtype
    distance, ahead = geometry.norm(goals - state.position), towards(state, goals)

    def trait(value, usual):
        value = xp.asarray(usual if value is None else value, dtype=dtype)
        return xp.broadcast_to(value, shape)

    radius, preferred = trait(state.radius, RADIUS), trait(state.traits.preferred_speed, WALKING_SPEED)
    own = [
        distance[..., None],
        geometry.to_frame(state.velocity, ahead),
        preferred[..., None],
        radius[..., None],
        xp.astype(state.contact, dtype)[..., None],
        _walls(state.position, boxes, ahead, radius),
    ]
    people = _people(state, state if others is None else others, ahead, radius)
    return xp.concatenate([*own, people.reshape(*shape, PEOPLE * PERSON_SIZE)], axis=-1)


def towards(state: CrowdState, goals: Array) -> Array:
    """The unit vectors (..., K, 2) from people to their goals; where they face, for people at their goals."""
    xp = state.position.__array_namespace__()
    to_goal = goals - state.position
    distance = geometry.norm(to_goal)[..., None]
    there = distance < _SMALL
    return xp.where(there, geometry.heading(state.yaw), to_goal / xp.where(there, xp.ones_like(distance), distance))


def _walls(position, boxes, ahead, radius):
    """Distances (..., K, WALL_RAYS) [m] from the bodies' surfaces to the first box."""
    xp = position.__array_namespace__()
    directions = geometry.from_frame(xp.asarray(_RAYS, dtype=ahead.dtype), ahead[..., None, :])
    distance = xp.min(geometry.ray_box_distance(position, directions, boxes[..., None, :, :]), axis=-1)
    distance = distance - radius[..., None]
    return xp.minimum(xp.maximum(distance, xp.zeros_like(distance)), xp.full_like(distance, WALL_RANGE))


def _people(state, others, ahead, radius):
    """(..., K, PEOPLE, PERSON_SIZE): the people whom each person meets soonest."""
    xp = state.position.__array_namespace__()
    dtype, number = state.position.dtype, state.position.shape[-2]
    position = others.position[..., None, :, :] - state.position[..., :, None, :]  # of the second, as the first sees it
    velocity = others.velocity[..., None, :, :] - state.velocity[..., :, None, :]
    reach = radius[..., :, None] + radius[..., None, :]
    distance = geometry.norm(position)
    gap = xp.maximum(distance - reach - _COMFORT, xp.zeros_like(distance))
    soon = geometry.time_to_collision(position, velocity, reach + _COMFORT)
    # First those within one's comfort, the nearest first; then those to be met, the soonest first; then the nearest.
    order = xp.where(gap > 0, 1.0 + xp.minimum(soon, MOST_TIME + gap), distance / (1.0 + distance))
    unseen = xp.eye(number, dtype=bool) | (distance > PEOPLE_RANGE)
    order = xp.where(unseen, xp.full_like(order, math.inf), order)
    chosen, seen = _first(order, min(PEOPLE, number))

    def of_chosen(values):
        index = chosen.reshape(*chosen.shape, *[1] * (values.ndim - chosen.ndim))
        return xp.take_along_axis(values, index, axis=chosen.ndim - 1)

    position, velocity, reach = of_chosen(position), of_chosen(velocity), of_chosen(reach)
    time = geometry.time_to_collision(position, velocity, reach)
    group = state.traits.group
    if group is None:
        companion = xp.zeros_like(time)
    else:
        group = xp.asarray(group)
        together = (group[..., None, :] == group[..., :, None]) & (group[..., :, None] >= 0)
        companion = xp.astype(xp.take_along_axis(together, chosen, axis=-1), dtype)
    frame = ahead[..., None, :]
    nobody = xp.asarray([0.0, PEOPLE_RANGE, 0.0, 0.0, 0.0, MOST_TIME, 0.0], dtype=dtype)
    found = xp.concatenate(
        [
            xp.ones_like(time)[..., None],
            geometry.to_frame(position, frame),
            geometry.to_frame(velocity, frame),
            xp.minimum(time, xp.full_like(time, MOST_TIME))[..., None],
            companion[..., None],
        ],
        axis=-1,
    )
    found = xp.where(seen[..., None], found, nobody)
    missing = PEOPLE - found.shape[-2]
    if missing:
        filler = xp.broadcast_to(nobody, (*found.shape[:-2], missing, PERSON_SIZE))
        found = xp.concatenate([found, filler], axis=-2)
    return found


def _first(order, number):
    """The indices (..., number) of the least of `order` (..., N) >= 0, in their order, and which of these are
    finite.

    A number's last bits give way to its index, so that one sort of whole numbers finds both (as in
    geometry.first_disc): a sort of pairs takes six times as long in XLA.
    """
    xp = order.__array_namespace__()
    integers = {4: xp.int32, 8: xp.int64}[order.dtype.itemsize]
    mask = (1 << max(order.shape[-1] - 1, 1).bit_length()) - 1
    infinite = xp.asarray(math.inf, dtype=order.dtype).view(integers)
    numbered = (order.view(integers) & ~mask) | xp.arange(order.shape[-1], dtype=integers)
    least = xp.sort(numbered, axis=-1)[..., :number]
    return least & mask, (least & ~mask) < (infinite & ~mask)
