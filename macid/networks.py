"""Networks, on NumPy's or JAX's arrays: a tanh network, and one whose input holds a set of people in no order."""

import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias

from macid import encounters
from macid.geometry import Array
from macid.state import MAX_LCF, MAX_SPEED

Layers: TypeAlias = Sequence[tuple[Array, Array]]  #: [(weight (in, out), bias (out,)), ...]

ENCODED = 24  # numbers that an encoder in training makes of a person, beside its attention
PERSON = encounters.PERSON_SIZE + 1  # numbers of a person in `encounter_inputs`
OWN = encounters.OWN_SIZE + 1  # an observation's own numbers, and the LCF
INPUTS = OWN + encounters.PEOPLE * PERSON


def mlp(layers: Layers, x: Array) -> Array:
    """A tanh network with a linear last layer: x (..., in)."""
    xp = x.__array_namespace__()
    for weight, bias in layers[:-1]:
        x = xp.tanh(x @ weight + bias)
    weight, bias = layers[-1]
    return x @ weight + bias


def encounter_inputs(observed: Array, lcf: Array) -> Array:
    """What `encounter_network` takes of observations (..., encounters.SIZE) and LCFs (...): (..., INPUTS), each of the
    order of 1."""
    xp = observed.__array_namespace__()
    own, people = observed[..., : encounters.OWN_SIZE], observed[..., encounters.OWN_SIZE :]
    walls = own[..., encounters.OWN_SIZE - encounters.WALL_RAYS :]
    scaled = [
        xp.log1p(own[..., :1]) / math.log1p(24.0),
        own[..., 1:3] / MAX_SPEED,
        own[..., 3:4] - encounters.WALKING_SPEED,
        (own[..., 4:5] - 0.3) / 0.1,
        own[..., 5:6],
        1.0 / (1.0 + walls),
        (lcf / MAX_LCF)[..., None],
    ]
    people = people.reshape(*people.shape[:-1], encounters.PEOPLE, encounters.PERSON_SIZE)
    place = people[..., 1:3]
    distance = xp.sqrt(place[..., :1] ** 2 + place[..., 1:] ** 2)
    people = [
        people[..., :1],
        place / (1.0 + distance),
        1.0 / (1.0 + distance),
        people[..., 3:5] / MAX_SPEED,
        xp.exp(-people[..., 5:6] / 2.0),
        people[..., 6:7],
    ]
    people = xp.concatenate(people, axis=-1)
    return xp.concatenate([*scaled, people.reshape(*people.shape[:-2], encounters.PEOPLE * PERSON)], axis=-1)


def encounter_network(layers: Mapping[str, Layers], x: Array) -> Array:
    """Deep sets with attention: each person of x (..., INPUTS) is encoded by the same layers, `layers["person"]`, and
    the mean weighed by attention and the sum of these go, beside one's own numbers, into `layers["head"]`.

    The people's order has no meaning, and nobody counts for nothing.
    """
    xp = x.__array_namespace__()
    own, people = x[..., :OWN], x[..., OWN:]
    people = people.reshape(*people.shape[:-1], encounters.PEOPLE, PERSON)
    encoded = people
    for weight, bias in layers["person"][:-1]:
        encoded = encoded @ weight + bias
        encoded = xp.maximum(encoded, xp.zeros_like(encoded))
    weight, bias = layers["person"][-1]
    encoded = encoded @ weight + bias
    attention = people[..., :1] * xp.exp(10.0 * xp.tanh(encoded[..., :1] / 10.0))
    encoded = xp.maximum(encoded[..., 1:], xp.zeros_like(encoded[..., 1:]))
    mean = xp.sum(attention * encoded, axis=-2) / (1.0 + xp.sum(attention, axis=-2))
    total = xp.sum(people[..., :1] * encoded, axis=-2) / 4.0
    return mlp(layers["head"], xp.concatenate([own, mean, total], axis=-1))
