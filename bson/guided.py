"""The input of guided robots: goal and motion, the way ahead on a map, three scans, and the nearest people, as one
vector; and the network that reads it, with attention over the people.

A guided robot is told what a planner knows: the farthest point of its way that is in sight, the turn after it, and the
way's length; it learns to drive there among people. The people are a set, in no order: each is encoded by the same
layers with the robot's own motion, and their mean, weighed by attention, and their sum go on beside the rest, as in
SARL (Chen et al., "Crowd-robot interaction: crowd-aware robot navigation with attention-based deep reinforcement
learning", ICRA 2019). The functions take NumPy or JAX arrays.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bson.features import FEATURES, SCANS, SECTORS, motion
from macid.geometry import Array
from macid.networks import relu_mlp

PEOPLE = 12  # who are told of: those who are, or will soon be, nearest
PERSON = 7  # numbers of a person
OWN = 14  # numbers of goal, motion and way
SCANNED = len(SCANS) * SECTORS
SIZE = OWN + SCANNED + PEOPLE * PERSON
HIDDEN, ENCODED = 48, 32  # width of the people's encoder, and numbers that it makes of a person, beside its attention
ENCODER_LAYERS = 2
ATTENDED = OWN + SCANNED + 2 * ENCODED  # numbers that the head reads
RANGE = 9.0  # people farther off are not told of [m]
_SOON = 1.5  # for so long people are thought to keep their velocity [s]
_LONG = 50.0  # a long way [m]
assert SCANNED + 6 == FEATURES


def own(observation: Mapping[str, Array], aim: Array, beyond: Array, length: Array, top: Any) -> Array:
    """(..., OWN): `bson.features.motion`, then of the way: direction and distance on two scales of its `aim` (..., 2),
    the direction from there to `beyond` (..., 2), both in the robot frame [m], its `length` (...) [m], and the share
    of it that the straight line has."""
    xp = aim.__array_namespace__()
    distance, turn = _norm(xp, aim), beyond - aim
    straight = _norm(xp, observation["goal"])
    way = xp.maximum(length[..., None], 1e-3)
    told = [
        motion(observation, top),
        aim / xp.maximum(distance, 1e-6),
        xp.exp(-distance / 2.0),
        xp.minimum(distance / 10.0, 1.0),
        turn / xp.maximum(_norm(xp, turn), 1e-6),
        xp.minimum(way / _LONG, 2.0),
        xp.minimum(straight / way, 1.0),
    ]
    return xp.concatenate(told, axis=-1).astype(np.float32)


def people(place: Array, velocity: Array, own_velocity: Array, radii: Any) -> Array:
    """(PEOPLE, PERSON) of the people at `place` (n, 2) who walk with `velocity` (n, 2), in the axes of the robot, which
    moves with `own_velocity` (2,) [m, m/s]: presence (1 or 0), place and closeness, velocity relative to the robot's,
    and how soon they meet. radii: the sum of the robot's and a person's [m].

    Rows are sorted by the nearest approach within _SOON and by the distance; people beyond RANGE are left out.
    """
    relative = velocity - own_velocity
    distance = np.hypot(place[:, 0], place[:, 1])
    soon = _soonest(place, relative)
    chosen = np.argsort(soon + 0.5 * distance, kind="stable")
    chosen = chosen[distance[chosen] < RANGE][:PEOPLE]
    place, relative, distance = place[chosen], relative[chosen], distance[chosen, None]
    told = np.zeros((PEOPLE, PERSON), np.float32)
    told[: len(chosen)] = np.concatenate(
        [
            np.ones_like(distance),
            place / (1.0 + distance),
            1.0 / (1.0 + np.maximum(distance - radii, 0.0)),
            np.clip(relative, -4.0, 4.0) / 2.0,
            np.exp(-time_to_meet(place, relative, radii)[:, None] / 2.0),
        ],
        axis=-1,
    )
    return told


def _soonest(place, relative):
    """The nearest approach (n,) [m] within _SOON."""
    squared = (relative**2).sum(axis=-1)
    when = np.clip(-(place * relative).sum(axis=-1) / np.maximum(squared, 1e-6), 0.0, _SOON)
    at = place + when[:, None] * relative
    return np.hypot(at[:, 0], at[:, 1])


def time_to_meet(place: np.ndarray, relative: np.ndarray, radii: float) -> np.ndarray:
    """(n,) [s]: when discs whose radii sum to `radii` [m] touch, from their offset `place` (n, 2) [m] and relative
    velocity (n, 2) [m/s]; 0 where they overlap, infinity where they never will."""
    a, b = (relative**2).sum(axis=-1), (place * relative).sum(axis=-1)
    c = (place**2).sum(axis=-1) - radii**2
    root = b**2 - a * c
    meets = (b < 0) & (root >= 0) & (a > 1e-9)
    when = np.where(meets, (-b - np.sqrt(np.maximum(root, 0.0))) / np.maximum(a, 1e-9), np.inf)
    return np.where(c <= 0, 0.0, np.maximum(when, 0.0))


def attended(person: Sequence[tuple[Array, Array]], x: Array) -> Array:
    """What the head reads of x (..., SIZE): its own numbers and scans, the mean of the encoded people weighed by
    attention, and their sum. person: the encoder's layers; the first of its outputs is the attention's logarithm."""
    xp = x.__array_namespace__()
    rest, each = x[..., : OWN + SCANNED], x[..., OWN + SCANNED :]
    each = each.reshape(*each.shape[:-1], PEOPLE, PERSON)
    mine = xp.broadcast_to(rest[..., None, :OWN], (*each.shape[:-1], OWN))
    encoded, present = xp.concatenate([mine, each], axis=-1), each[..., :1]
    encoded = relu_mlp(person, encoded)
    attention = present * xp.exp(10.0 * xp.tanh(encoded[..., :1] / 10.0))
    encoded = xp.maximum(encoded[..., 1:], 0.0)
    mean = (attention * encoded).sum(axis=-2) / (1.0 + attention.sum(axis=-2))
    return xp.concatenate([rest, mean, (present * encoded).sum(axis=-2) / 4.0], axis=-1)


def _norm(xp, vector):
    return xp.linalg.norm(vector, axis=-1, keepdims=True)
