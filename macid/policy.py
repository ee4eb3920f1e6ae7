"""Learned pedestrians: what the networks see, what they are, and how they are kept.

A policy maps the 41 numbers of `macid.observation` and the LCF to (v, w): speed ahead [m/s] and yaw rate [rad/s]. The
same forward pass serves NumPy, JAX (both through the array API) and, exported, torch.
"""

import dataclasses
import functools
import io
import json
import math
import pathlib

import numpy as np

from macid import assets, observation
from macid.files import write_bytes, write_json
from macid.state import MAX_LCF, MAX_SPEED, MAX_YAW_RATE

HIDDEN = (64, 64, 64)
ACTIONS = 2
FEATURES = observation.SIZE + 1  # the goal's two columns become three
_GOAL_SCALE = math.log1p(24.0)


def features(observed):
    """What the networks see of observations (..., 41): (..., FEATURES), each of the order of 1.

    The goal's direction (x, y) and log distance, speed, yaw rate, collision, and a ray's closeness 1 - d / 7 m and
    relative velocity, in shares of a pedestrian's top speeds.
    """
    xp = observed.__array_namespace__()
    goal, rest, rays = observed[..., :2], observed[..., 2:5], observed[..., 5:]
    distance = xp.sqrt(goal[..., 0] ** 2 + goal[..., 1] ** 2)[..., None]
    rest = rest / xp.asarray([MAX_SPEED, MAX_YAW_RATE, 1.0], dtype=observed.dtype)
    rays = rays.reshape(*rays.shape[:-1], observation.RAYS, 3)
    closeness = 1.0 - rays[..., :1] / observation.RAY_RANGE
    rays = xp.concatenate([closeness, rays[..., 1:] / MAX_SPEED], axis=-1).reshape(*rays.shape[:-2], -1)
    return xp.concatenate([goal / (distance + 1e-6), xp.log1p(distance) / _GOAL_SCALE, rest, rays], axis=-1)


def inputs(seen, lcf):
    """Network inputs (..., N + 1): what is `seen` (..., N), and the LCF (...), as a share of the greatest."""
    xp = seen.__array_namespace__()
    return xp.concatenate([seen, (lcf / MAX_LCF)[..., None]], axis=-1)


def as_observed(observed):
    """The 41 numbers as they are, as the paper feeds them."""
    return observed


# What networks see of an observation (..., 41): {a recipe's "inputs": (the function, how many numbers it gives)}.
INPUTS = {"features": (features, FEATURES), "observation": (as_observed, observation.SIZE)}


def mlp(layers, x):
    """A tanh network with a linear last layer: `layers` is [(weight (in, out), bias (out,)), ...], x (..., in)."""
    xp = x.__array_namespace__()
    for weight, bias in layers[:-1]:
        x = xp.tanh(x @ weight + bias)
    weight, bias = layers[-1]
    return x @ weight + bias


def to_velocity(action):
    """(v, w) (..., 2) [m/s, rad/s] of network outputs `action` (..., 2): clipped to [-1, 1]; -1 stands, +1 is top speed."""
    xp = action.__array_namespace__()
    clipped = xp.minimum(xp.maximum(action, -xp.ones_like(action)), xp.ones_like(action))
    return xp.stack([(clipped[..., 0] + 1.0) * (MAX_SPEED / 2), clipped[..., 1] * MAX_YAW_RATE], axis=-1)


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """A trained policy: `policy(observation, lcf) -> (v, w)`.

    layers: the network's weights and biases, float32 NumPy. recipe: how it was made and how it scores.
    """

    layers: tuple
    recipe: dict

    def __call__(self, observed, lcf):
        """(v, w) (..., 2) [m/s, rad/s] for observations (..., 41) and LCFs (...); NumPy or JAX, as the input is."""
        return to_velocity(self.action(observed, lcf))

    def action(self, observed, lcf):
        """The same as actions (..., 2), unclipped, as `to_velocity` reads them."""
        if not hasattr(observed, "__array_namespace__"):
            observed = np.asarray(observed, np.float32)
        xp = observed.__array_namespace__()
        if observed.shape[-1] != observation.SIZE:
            raise ValueError(
                f"An observation has {observation.SIZE} columns (macid.observation), not {observed.shape[-1]}."
            )
        observed = xp.asarray(observed, dtype=np.float32)
        lcf = xp.broadcast_to(xp.asarray(lcf, dtype=np.float32), observed.shape[:-1])
        return mlp(self.layers, inputs(self.see(observed), lcf))

    @property
    def see(self):
        """What the network sees of an observation: a function of INPUTS."""
        return INPUTS[self.recipe.get("inputs", "features")][0]

    @property
    def period(self):
        """Time between the decisions that it was trained with [s]."""
        return self.recipe["period"]

    def save(self, path):
        """Writes `path`.npz (weights) and `path`.json (recipe), each all or nothing."""
        write_network(path, self.layers, self.recipe)

    def to_torch(self):
        """The same policy as a torch.nn.Module: forward(observation (..., 41), lcf (...)) -> (..., 2). Needs torch."""
        import torch

        layers, goal_scale, scaled = self.layers, _GOAL_SCALE, self.see is features

        class TorchPolicy(torch.nn.Module):
            def __init__(self):
                super().__init__()
                self.linear = torch.nn.ModuleList()
                for weight, bias in layers:
                    linear = torch.nn.Linear(*weight.shape)
                    linear.weight.data = torch.as_tensor(np.array(weight).T.copy())
                    linear.bias.data = torch.as_tensor(np.array(bias))
                    self.linear.append(linear)

            def forward(self, observed, lcf):
                observed = torch.as_tensor(observed, dtype=self.linear[0].weight.dtype)
                x = self.features(observed) if scaled else [observed]
                lcf = torch.as_tensor(lcf, dtype=observed.dtype, device=observed.device) / MAX_LCF
                x = torch.cat([*x, lcf.expand(observed.shape[:-1])[..., None]], dim=-1)
                for linear in self.linear[:-1]:
                    x = torch.tanh(linear(x))
                x = self.linear[-1](x).clamp(-1.0, 1.0)
                return torch.stack([(x[..., 0] + 1.0) * (MAX_SPEED / 2), x[..., 1] * MAX_YAW_RATE], dim=-1)

            def features(self, observed):
                goal, rest, rays = observed[..., :2], observed[..., 2:5], observed[..., 5:]
                distance = goal.norm(dim=-1, keepdim=True)
                rest = rest / rest.new_tensor([MAX_SPEED, MAX_YAW_RATE, 1.0])
                rays = rays.unflatten(-1, (observation.RAYS, 3))
                rays = torch.cat([1.0 - rays[..., :1] / observation.RAY_RANGE, rays[..., 1:] / MAX_SPEED], dim=-1)
                return [goal / (distance + 1e-6), distance.log1p() / goal_scale, rest, rays.flatten(-2)]

        return TorchPolicy()


def policy_names():
    """Names of the shipped policies: `macid-0` is method macid's seed 0; `macid` alone means its first seed."""
    return assets.names("policies", ".npz")


def load_policy(name):
    """The policy `name`: a shipped one ("macid", "macid-3"), or a .npz file. Raises ValueError, naming the valid ones."""
    path = pathlib.Path(name)
    if path.suffix != ".npz":
        shipped = policy_names()
        matching = [n for n in shipped if n == name or n.rpartition("-")[0] == name]
        if not matching:
            raise ValueError(f"Unknown policy '{name}'. Choose one of {', '.join(shipped) or 'none'}, or a .npz file.")
        path = assets.path("policies", f"{matching[0]}.npz")
    elif not path.is_file():
        raise ValueError(f"There is no policy file '{name}'.")
    return _read(path.resolve(), path.stat().st_mtime_ns)


@functools.lru_cache(64)
def _read(path, _changed):
    """One Policy a file, so that what was compiled for it serves again."""
    policy = Policy(*read_network(path))
    seen = policy.recipe.get("inputs", "features")
    if seen not in INPUTS:
        raise ValueError(f"'{path}': its json has \"inputs\" {seen!r}, which is none of {', '.join(INPUTS)}.")
    wanted, given = INPUTS[seen][1] + 1, policy.layers[0][0].shape[0]
    if given != wanted:
        raise ValueError(f"'{path}' is no pedestrians' policy: it takes {given} numbers, not {wanted}.")
    for array in (array for layer in policy.layers for array in layer):
        array.flags.writeable = False
    return policy


def write_network(path, layers, recipe):
    """Writes `path`.npz (weights and biases of `layers`) and `path`.json (`recipe`), each all or nothing."""
    path = pathlib.Path(path)
    arrays = {}
    for index, (weight, bias) in enumerate(layers):
        arrays[f"weight{index}"], arrays[f"bias{index}"] = np.asarray(weight), np.asarray(bias)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_json(path.with_suffix(".json"), recipe)  # first: weights are never without their recipe
    write_bytes(path.with_suffix(".npz"), buffer.getvalue())


def read_network(path):
    """What `write_network` wrote to `path` (.npz): (layers, recipe). Raises ValueError for what is none."""
    path = pathlib.Path(path)
    if not path.is_file():
        raise ValueError(f"There is no policy file '{path}'.")
    try:
        with np.load(path, allow_pickle=False) as arrays:
            count = max(1, len(arrays.files) // 2)
            layers = tuple((arrays[f"weight{i}"], arrays[f"bias{i}"]) for i in range(count))
        return layers, json.loads(path.with_suffix(".json").read_text())
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"'{path}' is not a policy (npz with its json beside it): {error}") from None
