"""Networks, on NumPy's or JAX's arrays: a tanh network, and one whose input holds a set of people in no order."""

import io
import math
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from macid import encounters
from macid.files import write_bytes, write_json
from macid.geometry import Array
from macid.state import MAX_LCF, MAX_SPEED

Layers: TypeAlias = Sequence[tuple[Array, Array]]  #: [(weight (in, out), bias (out,)), ...]

MOST_WEIGHT = 1e6  # in a network, so that its outputs are finite
MOST_LAYERS = 64
ENCODER = "person_"  # begins the names of an encoder's arrays in a policy's file
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


def relu_mlp(layers: Layers, x: Array) -> Array:
    """A ReLU network with a linear last layer: x (..., in)."""
    xp = x.__array_namespace__()
    for weight, bias in layers[:-1]:
        x = x @ weight + bias
        x = xp.maximum(x, xp.zeros_like(x))
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
    encoded = relu_mlp(layers["person"], people)
    attention = people[..., :1] * xp.exp(10.0 * xp.tanh(encoded[..., :1] / 10.0))
    encoded = xp.maximum(encoded[..., 1:], xp.zeros_like(encoded[..., 1:]))
    mean = xp.sum(attention * encoded, axis=-2) / (1.0 + xp.sum(attention, axis=-2))
    total = xp.sum(people[..., :1] * encoded, axis=-2) / 4.0
    return mlp(layers["head"], xp.concatenate([own, mean, total], axis=-1))


def check_layers(layers: Layers) -> None:
    """Raises ValueError unless `layers`, [(weight (in, out), bias (out,)), ...], follow on each other, finite."""
    if not 1 <= len(layers) <= MOST_LAYERS:
        raise ValueError(f"a network has 1 to {MOST_LAYERS} layers, not {len(layers)}")
    width = None
    for number, layer in enumerate(layers):
        weight, bias = (np.asarray(array) for array in layer)
        if weight.ndim != 2 or bias.shape != weight.shape[1:] or not weight.size:
            raise ValueError(
                f"layer {number} has a weight {weight.shape} and a bias {bias.shape}, not (in, out) and (out,)"
            )
        if width not in (None, weight.shape[0]):
            raise ValueError(f"layer {number} takes {weight.shape[0]} numbers, but the one before gives {width}")
        for name, array in (("weight", weight), ("bias", bias)):
            if array.dtype.kind != "f":
                raise ValueError(f"{name}{number} has numbers of type {array.dtype}, not floats")
            wrong = ~(np.abs(array, dtype=np.float64) <= MOST_WEIGHT)
            if wrong.any():
                told = f"{array[wrong].flat[0]:g}; weights are finite, from -{MOST_WEIGHT:g} to {MOST_WEIGHT:g}"
                raise ValueError(f"{name}{number} holds {told}")
        width = weight.shape[1]


def write_network(path: str | os.PathLike[str], layers: Layers, recipe: dict[str, Any], person: Layers = ()) -> None:
    """Writes `path`.npz (weights and biases of `layers`, and of an encoder of people, `person`) and `path`.json
    (`recipe`), each all or nothing."""
    write_networks(path, {"": layers, ENCODER: person}, recipe)


def write_networks(path: str | os.PathLike[str], parts: Mapping[str, Layers], recipe: dict[str, Any]) -> None:
    """Writes `path`.npz (weights and biases of a network's `parts`, {what their names begin with: layers}) and
    `path`.json (`recipe`), each all or nothing."""
    path = pathlib.Path(path)
    found = {}
    for prefix, each in parts.items():
        for index, (weight, bias) in enumerate(each):
            found[f"{prefix}weight{index}"], found[f"{prefix}bias{index}"] = np.asarray(weight), np.asarray(bias)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **found)
    write_json(path.with_suffix(".json"), recipe)  # first: weights are never without their recipe
    write_bytes(path.with_suffix(".npz"), buffer.getvalue())
