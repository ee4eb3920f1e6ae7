"""Recurrent networks for robots: a gated recurrent unit (Cho et al., EMNLP 2014) on what an eye makes of the present.

The unit remembers what left the robot's view, and how what is seen moves. A network is a dict of parts, each [(weight
(in, out), bias (out,)), ...]:

| part | what |
|---|---|
| EYE | of a guided robot (bson.guided) the people's encoder; of one with a camera the convolutions, a linear layer |
| MEMORY | the unit's input and recurrent weights (in, 3 units), (units, 3 units); gates: reset, update, new |
| HEAD | layers with ReLU between, from the unit's state to the action |

The functions take NumPy or JAX arrays; bson.learning.dagger has the torch twin.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from bson import guided
from macid.geometry import Array

EYE, MEMORY, HEAD = "eye_", "memory_", ""  # what the parts' names in a policy's file begin with
UNITS = 64
MOTION = 6
PICTURE = (24, 40)  # rows and columns of a depth picture as the network sees it
CHANNELS = (8, 16)  # of the convolutions, 3 x 3 with a stride of 2, one row and column of zeros around
SEEN = 48  # numbers that the eye makes of a picture
DEPTH_RANGE = 6.0  # closeness in a picture is 1 - depth / DEPTH_RANGE, at least 0 [m]
_KERNEL, _STRIDE = 3, 2


def shapes(pictures: bool) -> dict[str, list[tuple[int, int]]]:
    """The shapes of the weights of each part, for a network on pictures, or on bson.guided."""
    eye, inputs = [(guided.OWN + guided.PERSON, guided.HIDDEN), (guided.HIDDEN, 1 + guided.ENCODED)], guided.ATTENDED
    if pictures:
        eye, width, (rows, columns) = [], 1, PICTURE
        for channels in CHANNELS:
            eye.append((_KERNEL**2 * width, channels))
            rows, columns, width = -(-rows // _STRIDE), -(-columns // _STRIDE), channels
        eye.append((rows * columns * width, SEEN))
        inputs = MOTION + SEEN
    return {EYE: eye, MEMORY: [(inputs, 3 * UNITS), (UNITS, 3 * UNITS)], HEAD: [(UNITS, UNITS), (UNITS, 2)]}


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


def step(network: Mapping[str, Any], vector: Array, pictures: Array | None, state: Array) -> tuple[Array, Array]:
    """(actions before clipping (N, 2), the state after (N, UNITS)) of a control step. vector: (N, bson.guided.SIZE), or
    with `pictures` (N, *PICTURE) the motion (N, MOTION), as bson.features.motion gives it."""
    xp = vector.__array_namespace__()
    if pictures is None:
        x = guided.attended(network[EYE], vector)
    else:
        x = xp.concatenate([vector, look(network[EYE], pictures)], axis=-1)
    state = remember(network[MEMORY], x, state)
    x = state
    for weight, bias in network[HEAD][:-1]:
        x = xp.maximum(x @ weight + bias, 0.0)
    weight, bias = network[HEAD][-1]
    return x @ weight + bias, state
