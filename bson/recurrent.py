"""Recurrent networks for robots: a gated recurrent unit (Cho et al., EMNLP 2014) on what an eye makes of the present.

The unit remembers what left the robot's view, and how what is seen moves. A network is a dict of parts, each [(weight
(in, out), bias (out,)), ...]:

| part | what |
|---|---|
| EYE | of a guided robot (bson.guided) the people's encoder; of one with a camera the convolutions, a linear layer |
| MEMORY | the unit's input and recurrent weights (in, 3 units), (units, 3 units); gates: reset, update, new |
| HEAD | layers with ReLU between, from the unit's state to the action |

A robot whose input is bson.features has no eye. The functions take NumPy or JAX arrays;
bson.learning.recurrent_network has the torch twin, which learns by imitation and by SAC and TAC;
bson.learning.pieces trains them by PPO.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from bson import guided
from bson.features import FEATURES
from macid.geometry import Array
from macid.networks import relu_mlp

EYE, MEMORY, HEAD = "eye_", "memory_", ""  # what the parts' names in a policy's file begin with
EYES = ("people", "picture", "none")  # what a network may see: bson.guided, depth pictures, or bson.features as it is
UNITS = 64
MOTION = 6
PICTURE = (24, 40)  # rows and columns of a depth picture as the network sees it
CHANNELS = (8, 16)  # of the convolutions, 3 x 3 with a stride of 2, one row and column of zeros around
SEEN = 48  # numbers that the eye makes of a picture
DEPTH_RANGE = 6.0  # closeness in a picture is 1 - depth / DEPTH_RANGE, at least 0 [m]
_KERNEL, _STRIDE = 3, 2


def shapes(eye: str, outputs: int = 2) -> dict[str, list[tuple[int, int]]]:
    """The shapes of the weights of each part, for a network with an `eye` of EYES that gives `outputs` numbers."""
    layers, inputs = [(guided.OWN + guided.PERSON, guided.HIDDEN), (guided.HIDDEN, 1 + guided.ENCODED)], guided.ATTENDED
    if eye == "picture":
        layers, width, (rows, columns) = [], 1, PICTURE
        for channels in CHANNELS:
            layers.append((_KERNEL**2 * width, channels))
            rows, columns, width = -(-rows // _STRIDE), -(-columns // _STRIDE), channels
        layers.append((rows * columns * width, SEEN))
        inputs = MOTION + SEEN
    if eye == "none":
        layers, inputs = [], FEATURES
    return {EYE: layers, MEMORY: [(inputs, 3 * UNITS), (UNITS, 3 * UNITS)], HEAD: [(UNITS, UNITS), (UNITS, outputs)]}


def size(eye: str) -> int:
    """The numbers that a robot with this `eye` sees, in one vector: what `parted` takes."""
    return {"people": guided.SIZE, "picture": MOTION + PICTURE[0] * PICTURE[1], "none": FEATURES}[eye]


def parted(eye: str, x: Array) -> tuple[Array, Array | None]:
    """What `see` takes, of x (..., size(eye)): vectors, and the pictures behind them."""
    if eye != "picture":
        return x, None
    return x[..., :MOTION], x[..., MOTION:].reshape(*x.shape[:-1], *PICTURE)


def picture(depth: Array) -> Array:
    """Depth pictures (..., height, width) [m] as (..., *PICTURE): of each block the nearest pixel's closeness."""
    *rest, height, width = depth.shape
    rows, columns = PICTURE
    blocks = depth.reshape(*rest, rows, height // rows, columns, width // columns).min(axis=(-3, -1))
    xp = depth.__array_namespace__()
    return xp.maximum(1.0 - blocks / DEPTH_RANGE, 0.0).astype(np.float32)


def look(eye: Any, pictures: Array) -> Array:
    """What the eye makes (N, SEEN) of `pictures` (N, *PICTURE)."""
    x = pictures[..., None]
    xp = x.__array_namespace__()
    for weight, bias in eye[:-1]:
        x = xp.maximum(_patches(xp, x) @ weight + bias, 0.0)
    weight, bias = eye[-1]
    return xp.maximum(x.reshape(len(x), -1) @ weight + bias, 0.0)


def _patches(xp, x):
    """The kernels' inputs (N, rows / 2, columns / 2, 9 channels) of x (N, rows, columns, channels)."""
    rows, columns = x.shape[1:3]
    x = xp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
    shifted = [x[:, i : i + rows : _STRIDE, j : j + columns : _STRIDE] for i in range(_KERNEL) for j in range(_KERNEL)]
    return xp.concatenate(shifted, axis=-1)


def remember(memory: Any, x: Array, state: Array) -> Array:
    """The unit's state (N, UNITS) after the inputs x (N, inputs)."""
    xp = x.__array_namespace__()
    (weight, bias), (recurrent, other) = memory
    given, kept = x @ weight + bias, state @ recurrent + other
    reset = _sigmoid(xp, given[..., :UNITS] + kept[..., :UNITS])
    update = _sigmoid(xp, given[..., UNITS : 2 * UNITS] + kept[..., UNITS : 2 * UNITS])
    new = xp.tanh(given[..., 2 * UNITS :] + reset * kept[..., 2 * UNITS :])
    return (1.0 - update) * new + update * state


def _sigmoid(xp, x):
    return 0.5 * (xp.tanh(0.5 * x) + 1.0)


def see(network: Mapping[str, Any], vector: Array, pictures: Array | None) -> Array:
    """What the unit reads (N, inputs). vector: (N, bson.guided.SIZE), or without an eye (N, bson.features.FEATURES), or
    with `pictures` (N, *PICTURE) the motion (N, MOTION), as bson.features.motion gives it."""
    if pictures is not None:
        return vector.__array_namespace__().concatenate([vector, look(network[EYE], pictures)], axis=-1)
    return guided.attended(network[EYE], vector) if network[EYE] else vector


def decide(network: Mapping[str, Any], state: Array) -> Array:
    """What the head makes (..., out) of the unit's state (..., UNITS): actions before clipping."""
    return relu_mlp(network[HEAD], state)


def step(network: Mapping[str, Any], vector: Array, pictures: Array | None, state: Array) -> tuple[Array, Array]:
    """(actions before clipping (N, 2), the state after (N, UNITS)) of a control step; vector and pictures: see
    `see`."""
    state = remember(network[MEMORY], see(network, vector, pictures), state)
    return decide(network, state), state
