"""Learned pedestrians: what the networks see, what they are, and how they are kept.

A policy maps the 41 numbers of `macid.observation` and the LCF to (v, w): speed ahead [m/s] and yaw rate [rad/s]. The
same forward pass serves NumPy, JAX (both through the array API) and, exported, torch.
"""

import dataclasses
import functools
import io
import math
import os
import pathlib
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from macid import arrays, assets, observation
from macid.documents import convert, parse, read_bytes
from macid.encounter_policy import EncounterPolicy
from macid.files import UsageError
from macid.geometry import Array
from macid.networks import ENCODER, check_layers, mlp, write_network
from macid.readings import MOST_READING, as_readings, check_lcf, check_shapes, is_traced, within
from macid.state import MAX_LCF, MAX_SPEED, MAX_YAW_RATE, PHYSICS_STEP, RADII, TOP_SPEED, physics_steps

HIDDEN = (64, 64, 64)
ACTIONS = 2
FEATURES = observation.SIZE + 1  # the goal's two columns become three
MOST_POLICY_BYTES = 1 << 26  # a policy's weights, packed and unpacked [bytes]
MOST_RECIPE_BYTES = 1 << 24  # its recipe [bytes]
_GOAL_SCALE = math.log1p(24.0)
_RAYS, _DISTANCES = slice(5, observation.SIZE), slice(5, observation.SIZE, 3)  # columns


def features(observed: Array) -> Array:
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
    rays = xp.concatenate([closeness, rays[..., 1:] / MAX_SPEED], axis=-1)
    rays = rays.reshape(*rays.shape[:-2], 3 * observation.RAYS)
    return xp.concatenate([goal / (distance + 1e-6), xp.log1p(distance) / _GOAL_SCALE, rest, rays], axis=-1)


def inputs(seen: Array, lcf: Array) -> Array:
    """Network inputs (..., N + 1): what is `seen` (..., N), and the LCF (...), as a share of the greatest."""
    xp = seen.__array_namespace__()
    return xp.concatenate([seen, (lcf / MAX_LCF)[..., None]], axis=-1)


def as_observed(observed: Array) -> Array:
    """The 41 numbers as they are, as the paper feeds them."""
    return observed


# What networks see of an observation (..., 41): {a recipe's "inputs": (the function, how many numbers it gives)}.
INPUTS = {"features": (features, FEATURES), "observation": (as_observed, observation.SIZE)}
ENCOUNTERS = "encounters"  # the "inputs" in the recipe of an EncounterPolicy, which sees `macid.encounters` instead


def to_velocity(action: Array) -> Array:
    """(v, w) (..., 2) [m/s, rad/s] of network outputs `action` (..., 2): clipped to [-1, 1]; -1 stands, +1 is top
    speed."""
    xp = action.__array_namespace__()
    clipped = xp.minimum(xp.maximum(action, -xp.ones_like(action)), xp.ones_like(action))
    return xp.stack([(clipped[..., 0] + 1.0) * (MAX_SPEED / 2), clipped[..., 1] * MAX_YAW_RATE], axis=-1)


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """A trained policy: `policy(observation, lcf) -> (v, w)`.

    layers: the network's weights and biases, float32 NumPy. recipe: how it was made and how it scores. Raises
    ValueError where the layers don't follow on each other, or hold a weight that is not finite or beyond MOST_WEIGHT.

    Its inputs are checked (`understood` says how), so that its outputs are finite.
    """

    layers: tuple
    recipe: dict

    def __post_init__(self):
        check_layers(self.layers)

    def __call__(self, observed: Array, lcf: Array) -> Array:
        """(v, w) (..., 2) [m/s, rad/s] for observations (..., 41) and LCFs (...); NumPy or JAX, as the input is.

        Raises ValueError as `understood` does.
        """
        return to_velocity(self.action(observed, lcf))

    def action(self, observed: Array, lcf: Array) -> Array:
        """The network's outputs (..., 2), unclipped, as `to_velocity` reads them."""
        return self.act(*understood(observed, lcf))

    def act(self, observed: Array, lcf: Array) -> Array:
        """`action` for float32 observations (..., 41) that `observe` made and for LCFs (...), without checking
        either."""
        lcf = observed.__array_namespace__().broadcast_to(lcf, observed.shape[:-1])
        return mlp(self.layers, inputs(self.see(observed), lcf))

    @property
    def see(self) -> Callable[[Array], Array]:
        """What the network sees of an observation: a function of INPUTS."""
        return INPUTS[self.recipe.get("inputs", "features")][0]

    @property
    def period(self) -> float:
        """The time between decisions in the policy's training [s]; a physics step where the recipe doesn't tell."""
        return self.recipe.get("period", PHYSICS_STEP)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes `path`.npz (weights) and `path`.json (recipe), each all or nothing."""
        write_network(path, self.layers, self.recipe)

    def to_torch(self) -> Any:
        """The same policy as a torch.nn.Module: forward(observation (..., 41), lcf (...)) -> (..., 2). Needs torch.

        It refuses what `understood` refuses, and reads the rest alike; where torch compiles, traces or maps it, nothing
        can be refused, and its outputs are those of the policy under jax.jit.
        """
        import torch

        layers, goal_scale, scaled = self.layers, _GOAL_SCALE, self.see is features

        def seen(tensor):
            """A tensor's values as NumPy; None where it has none to look at."""
            # torch documents is_tracing as public, but its types don't.
            if torch.compiler.is_compiling() or torch.jit.is_tracing():  # pyright: ignore[reportPrivateImportUsage]
                return None
            try:
                return tensor.detach().double().cpu().numpy()
            except (RuntimeError, NotImplementedError):  # torch.func.vmap; the device "meta"
                return None

        def taken(values, what, like):
            try:
                tensor = values if isinstance(values, torch.Tensor) else torch.as_tensor(values)
            except (ValueError, TypeError, RuntimeError) as error:
                raise ValueError(f"{what} is no tensor of numbers: {' '.join(str(error).split())[:200]}") from None
            if tensor.is_complex():
                raise ValueError(f"{what} has real numbers, not {tensor.dtype}.")
            return tensor.to(like)

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
                weight = self.linear[0].weight
                observed, lcf = taken(observed, "An observation", weight), taken(lcf, "An LCF", weight)
                # Tracing takes a shape for values. (torch documents is_tracing as public, but its types don't.)
                if not torch.jit.is_tracing():  # pyright: ignore[reportPrivateImportUsage]
                    check_shapes(observed.shape, lcf.shape, observation.SIZE, "macid.observation")
                if (values := seen(observed)) is not None:
                    _check_observed(values)
                if (values := seen(lcf)) is not None:
                    check_lcf(values)
                rays = observed[..., _RAYS].unflatten(-1, (observation.RAYS, 3))
                distance, relative = rays[..., :1], rays[..., 1:].nan_to_num().clamp(-MOST_READING, MOST_READING)
                met = distance < observation.RAY_RANGE
                distance = torch.where(met, distance.clamp(min=0.0), observation.RAY_RANGE)
                rays = torch.cat([distance, torch.where(met, relative, 0.0)], dim=-1).flatten(-2)
                rest = observed[..., :5].nan_to_num().clamp(-MOST_READING, MOST_READING)
                observed = torch.cat([rest, rays], dim=-1)
                x = self.features(observed) if scaled else [observed]
                lcf = lcf.nan_to_num().clamp(-MAX_LCF, MAX_LCF) / MAX_LCF
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


def understood(observed: Array, lcf: Array) -> tuple[Array, Array]:
    """Observations (..., 41) and LCFs (...) as a policy takes them, float32 arrays, NumPy or JAX, as `observed` is.

    observed, lcf: arrays, lists or numbers; flags and whole numbers count as numbers. A ray's distance of RAY_RANGE or
    more, infinity included, reads as RAY_RANGE with no relative velocity, as `observe` has it. Everything else is taken
    as it is: a speed or yaw rate beyond a person's own, a collision flag between 0 and 1, a goal where one stands.

    Raises ValueError for what can't be understood: NaN, a negative distance, any other number that is infinite or
    beyond MOST_READING, an LCF outside [-MAX_LCF, MAX_LCF], what is no number, a wrong shape.

    Under jax.jit (and vmap, grad) only shapes and types can be refused. Another number then takes the place of one that
    isn't understood: RAY_RANGE of an unknown distance, 0 of a negative one, 0 of another NaN, and the nearer end of its
    range of a number outside it.
    """
    observed, lcf, xp = as_readings(observed, lcf, observation.SIZE, "macid.observation")
    if is_traced(observed):
        ray = [0.0, -MOST_READING, -MOST_READING]
        least = xp.asarray([-MOST_READING] * 5 + ray * observation.RAYS, dtype=np.float32)
        known = observed[..., _DISTANCES] < observation.RAY_RANGE
        observed = within(xp, observed, least, MOST_READING)
    else:
        values = np.asarray(observed)
        _check_observed(values)
        known = values[..., _DISTANCES] < observation.RAY_RANGE
        if known.all():
            return xp.asarray(observed), xp.asarray(lcf)
    rays = observed[..., _RAYS].reshape(*observed.shape[:-1], observation.RAYS, 3)
    miss = xp.asarray([observation.RAY_RANGE, 0.0, 0.0], dtype=np.float32)
    rays = xp.where(known[..., None], rays, miss).reshape(*observed.shape[:-1], 3 * observation.RAYS)
    return xp.concatenate([observed[..., :5], rays], axis=-1), xp.asarray(lcf)


def _check_observed(observed):
    """Raises ValueError unless the NumPy observations (..., 41) can be understood; it names the column and the
    number."""
    good = np.abs(observed) <= MOST_READING
    good[..., _DISTANCES] = observed[..., _DISTANCES] >= 0.0
    if good.all():
        return
    missed = np.repeat(observed[..., _DISTANCES] >= observation.RAY_RANGE, 3, axis=-1)
    good[..., _RAYS] |= missed & np.isfinite(observed[..., _RAYS])  # what a miss says of a velocity is not read
    if good.all():
        return
    place = tuple(int(i) for i in np.argwhere(~good)[0])
    column, value = place[-1], observed[place]
    name, wanted = "", f"a number from -{MOST_READING:g} to {MOST_READING:g}"
    if column >= _RAYS.start:
        ray, part = divmod(column - _RAYS.start, 3)
        name = f"the {'relative velocity' if part else 'distance'} of ray {ray}"
        wanted = wanted if part else f"0 or more (infinity: nothing within {observation.RAY_RANGE:g} m)"
    else:
        name = ("the goal's x", "the goal's y", "the speed", "the yaw rate", "the collision flag")[column]
    where = f"column {column}, {name}" + (f", of observation {list(place[:-1])}" if place[:-1] else "")
    raise ValueError(f"An observation can't be understood: {where}, is {value:g}; {wanted} is wanted.")


def policy_names() -> list[str]:
    """Names of the shipped policies: `macid-0` is method macid's seed 0; `macid` alone means its first seed."""
    return assets.names("policies", ".npz")


def load_policy(name: str) -> Policy | EncounterPolicy:
    """The policy `name`: a shipped one ("macid", "macid-3"), or a .npz file. Raises ValueError, naming the valid
    ones."""
    path = pathlib.Path(name)
    if path.suffix != ".npz":
        shipped = policy_names()
        matching = [n for n in shipped if n == name or n.rpartition("-")[0] == name]
        if not matching:
            raise ValueError(f"Unknown policy '{name}'. Choose one of {', '.join(shipped) or 'none'}, or a .npz file.")
        path = assets.path("policies", f"{matching[0]}.npz")
    return _made(path, *_contents(path))


@functools.lru_cache(64)
def _made(path, weights, recipe):
    """One Policy for the same content (bytes) of its two files, so that what was compiled for it serves again."""
    parts, document = _parsed(path, weights, recipe)
    layers, person = parts[""], parts[ENCODER]
    seen = document.get("inputs", "features")
    # A robot's policy is told by its size before its recipe is looked at.
    width = INPUTS[seen][1] + 1 if isinstance(seen, str) and seen in INPUTS else FEATURES + 1
    taken, given = layers[0][0].shape[0], layers[-1][0].shape[1]
    for does, found, wanted in (("takes", taken, width), ("gives", given, ACTIONS)):
        if not person and found != wanted:
            raise UsageError(f"'{path}' is no pedestrians' policy: it {does} {found} numbers, not {wanted}.")
    convert(document, _Recipe, f"the recipe '{path.with_suffix('.json')}'")
    if (seen == ENCOUNTERS) != bool(person):
        raise UsageError(f"'{path}' is not a policy: its recipe's inputs are '{seen}', but its weights are others'.")
    if "period" in document:
        try:
            physics_steps(document["period"])
        except ValueError as error:
            raise UsageError(f"The recipe '{path.with_suffix('.json')}': {error}") from None
    for array in (array for layer in (*layers, *person) for array in layer):
        array.flags.writeable = False
    if not person:
        return Policy(layers, document)
    try:
        return EncounterPolicy(layers, document, person)
    except ValueError as error:
        raise UsageError(f"'{path}' is not a policy: {error}.") from None


_Name = Annotated[str, msgspec.Meta(pattern=r"^[ -~]{1,200}\Z")]  # on one line of any terminal


_Speed = Annotated[float, msgspec.Meta(gt=0, le=TOP_SPEED)]


class _Recipe(msgspec.Struct):
    """The keys of a pedestrian policy's recipe that are read. All other keys were noted for people."""

    name: _Name | msgspec.UnsetType = msgspec.UNSET
    method: _Name | msgspec.UnsetType = msgspec.UNSET
    seed: int | msgspec.UnsetType = msgspec.UNSET
    inputs: Literal["features", "observation", "encounters"] | msgspec.UnsetType = msgspec.UNSET  # INPUTS, ENCOUNTERS
    period: Annotated[float, msgspec.Meta(gt=0, le=20)] | msgspec.UnsetType = msgspec.UNSET  # [s]
    radius: Annotated[float, msgspec.Meta(ge=RADII[0], le=RADII[1])] | msgspec.UnsetType = msgspec.UNSET  # [m]
    preferred_speed: Literal["human"] | _Speed | msgspec.UnsetType = msgspec.UNSET  # as of macid.traits
    max_speed: _Speed | msgspec.UnsetType = msgspec.UNSET  # [m/s]
    lcf_mean: Annotated[float, msgspec.Meta(ge=-1, le=1)] | msgspec.UnsetType = msgspec.UNSET  # CoPO's own
    lcf_std: Annotated[float, msgspec.Meta(ge=0, le=100)] | msgspec.UnsetType = msgspec.UNSET

    def __post_init__(self):
        if (self.lcf_mean is msgspec.UNSET) != (self.lcf_std is msgspec.UNSET):
            raise ValueError("lcf_mean and lcf_std come together")


def read_network(path: str | os.PathLike[str]) -> tuple[tuple[tuple[np.ndarray, np.ndarray], ...], dict[str, Any]]:
    """What `write_network` wrote to `path` (.npz), without an encoder: (layers, recipe). Raises UsageError (a
    ValueError) for what is none."""
    parts, recipe = read_networks(path)
    if parts[ENCODER]:
        raise UsageError(f"'{path}' is a pedestrians' policy, with an encoder of people.")
    return parts[""], recipe


def read_networks(
    path: str | os.PathLike[str], prefixes: Sequence[str] = ("", ENCODER)
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What `write_networks` wrote to `path` (.npz): ({prefix: layers}, recipe), of each of `prefixes`; () where the
    file has none of a part. Raises UsageError (a ValueError) for what is none."""
    path = pathlib.Path(path)
    return _parsed(path, *_contents(path), prefixes)


def _contents(path):
    """The bytes of a policy's two files. Raises UsageError."""
    weights = read_bytes(path, "policy", MOST_POLICY_BYTES)
    return weights, read_bytes(path.with_suffix(".json"), "policy's recipe", MOST_RECIPE_BYTES)


def _parsed(path, weights, recipe, prefixes=("", ENCODER)):
    """({prefix: layers}, recipe) of the contents (bytes) of a policy's two files. Raises UsageError."""
    try:
        found, documents = arrays.unpack(io.BytesIO(weights), MOST_POLICY_BYTES)
        counts = {prefix: sum(name.startswith(prefix) for name in found) // 2 for prefix in prefixes if prefix}
        counts[""] = max(1, len(found) // 2 - sum(counts.values()))
        wanted = {
            prefix: [(f"{prefix}weight{number}", f"{prefix}bias{number}") for number in range(count)]
            for prefix, count in counts.items()
        }
        names = {name for rows in wanted.values() for row in rows for name in row}
        if documents or found.keys() != names:
            odd = sorted({*found, *documents} - names) or sorted(names - found.keys())
            told = f"{odd[0][:60]!r} is odd or missing"
            raise ValueError(f"it must hold weight0, bias0, weight1 and so on, and nothing else: {told}")
        parts = {prefix: tuple((found[w], found[b]) for w, b in rows) for prefix, rows in wanted.items()}
        for prefix, layers in parts.items():
            if prefix in ("", ENCODER) and (layers or not prefix):
                check_layers(layers)
            for layer in layers:
                check_layers([layer])
    except ValueError as error:
        raise UsageError(f"'{path}' is not a policy (npz with its json beside it): {error}.") from None
    document = parse(path.with_suffix(".json"), "the policy's recipe", recipe)
    return parts, convert(document, dict, f"the policy's recipe '{path.with_suffix('.json')}'")
