"""Learned pedestrians of the second kind: they see `macid.encounters`, and choose a velocity rather than (v, w).

Their network's two outputs a change the velocity that a person wants from its preferred speed, straight to the goal:
p (1 + a_0, a_1) in the goal's frame, each a within [-1, 1]. The velocity follows what is wanted with the time constant
RELAXATION, as legs do. So a network that says nothing walks straight to its goal at its preferred speed.
"""

import dataclasses
import math
import os
from typing import Any

import numpy as np

from macid import encounters, networks
from macid.geometry import Array
from macid.networks import Layers, check_layers, write_network
from macid.readings import MOST_READING, as_readings, is_traced, within
from macid.state import MAX_LCF

RELAXATION = 0.3  # [s]
MOST_SPEED = 2.0  # [m/s]
PERIOD = 0.1  # between decisions where a recipe doesn't tell [s]

_WALLS = slice(encounters.OWN_SIZE - encounters.WALL_RAYS, encounters.OWN_SIZE)
_TIME = 5  # column of PERSON


def wanted_velocity(action: Array, preferred_speed: Array) -> Array:
    """The velocity (..., 2) [m/s] that network outputs `action` (..., 2) want, in the goal's frame; at most
    MOST_SPEED."""
    xp = action.__array_namespace__()
    action = xp.minimum(xp.maximum(action, -xp.ones_like(action)), xp.ones_like(action))
    wanted = preferred_speed[..., None] * xp.stack([1.0 + action[..., 0], action[..., 1]], axis=-1)
    speed = xp.sqrt(wanted[..., :1] ** 2 + wanted[..., 1:] ** 2)
    return wanted * (MOST_SPEED / xp.maximum(speed, xp.full_like(speed, MOST_SPEED)))


def next_velocity(action: Array, velocity: Array, preferred_speed: Array, period: float) -> Array:
    """The velocity (..., 2) [m/s], in the goal's frame, that a person with `velocity` (..., 2) takes for `period`
    [s]."""
    share = 1.0 - math.exp(-period / RELAXATION)
    return velocity + share * (wanted_velocity(action, preferred_speed) - velocity)


@dataclasses.dataclass(frozen=True, eq=False)
class EncounterPolicy:
    """A trained policy: `policy(observation, lcf) -> velocity`.

    layers, person: the layers of the head and of the encoder of a person (`networks.encounter_network`), float32 NumPy.
    recipe: how it was made and how it scores. Raises ValueError where the layers don't fit together, or hold a weight
    that is not finite or beyond MOST_WEIGHT.
    """

    layers: tuple
    recipe: dict
    person: tuple

    def __post_init__(self):
        check_layers(self.layers)
        check_layers(self.person)
        for what, layers, end, wanted in (
            ("the encoder of people takes", self.person, 0, networks.PERSON),
            ("the network takes", self.layers, 0, networks.OWN + 2 * (self.person[-1][0].shape[1] - 1)),
            ("the network gives", self.layers, -1, 2),
        ):
            found = layers[end][0].shape[0 if end == 0 else 1]
            if found != wanted:
                raise ValueError(f"{what} {found} numbers, not {wanted}")

    @property
    def network(self) -> dict[str, Layers]:
        """The layers as `networks.encounter_network` takes them."""
        return {"person": self.person, "head": self.layers}

    @property
    def period(self) -> float:
        """The time between decisions in the policy's training [s]."""
        return self.recipe.get("period", PERIOD)

    def __call__(self, observed: Array, lcf: Array) -> Array:
        """The velocity (..., 2) [m/s] for the next period, in the goal's frame (x towards the goal), for observations
        (..., encounters.SIZE) and LCFs (...); NumPy or JAX, as the input is.

        Raises ValueError as `understood` does.
        """
        observed, lcf = understood(observed, lcf)
        return self.velocity(observed, lcf, self.period)

    def velocity(self, observed: Array, lcf: Array, period: float) -> Array:
        """The same without checking the input, for `period` [s]."""
        own = observed[..., : encounters.OWN_SIZE]
        return next_velocity(self.act(observed, lcf), own[..., 1:3], own[..., 3], period)

    def action(self, observed: Array, lcf: Array) -> Array:
        """The network's outputs (..., 2), unclipped, as `wanted_velocity` reads them."""
        return self.act(*understood(observed, lcf))

    def act(self, observed: Array, lcf: Array) -> Array:
        """`action` without checking either."""
        lcf = observed.__array_namespace__().broadcast_to(lcf, observed.shape[:-1])
        return networks.encounter_network(self.network, networks.encounter_inputs(observed, lcf))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes `path`.npz (weights) and `path`.json (recipe), each all or nothing."""
        write_network(path, self.layers, self.recipe, self.person)

    def to_torch(self) -> Any:
        """The same policy as a torch.nn.Module: forward(observation (..., encounters.SIZE), lcf (...)) -> (..., 2).
        Needs torch. It refuses no value: NaN reads as 0, and numbers outside their range as its nearer end."""
        import torch

        policy = self

        class TorchPolicy(torch.nn.Module):
            person: Any
            head: Any

            def __init__(self):
                super().__init__()
                for name, layers in policy.network.items():
                    linears = torch.nn.ModuleList()  # self.person and self.head
                    for weight, bias in layers:
                        linear = torch.nn.Linear(*weight.shape)
                        linear.weight.data = torch.as_tensor(np.array(weight).T.copy())
                        linear.bias.data = torch.as_tensor(np.array(bias))
                        linears.append(linear)
                    setattr(self, name, linears)

            def forward(self, observed, lcf):
                like = self.head[0].weight
                least, most = (torch.as_tensor(np.array(limit)).to(like) for limit in _LIMITS)
                observed = torch.as_tensor(observed).to(like)
                lcf = torch.as_tensor(lcf).to(like).nan_to_num().clamp(-MAX_LCF, MAX_LCF)
                observed = observed.nan_to_num(posinf=math.inf, neginf=-math.inf)
                observed = torch.minimum(torch.maximum(observed, least), most)
                own, people = observed[..., : encounters.OWN_SIZE], observed[..., encounters.OWN_SIZE :]
                people = people.unflatten(-1, (encounters.PEOPLE, encounters.PERSON_SIZE))
                place = people[..., 1:3]
                distance = place.norm(dim=-1, keepdim=True)
                lcf = lcf.expand(observed.shape[:-1])[..., None] / MAX_LCF
                own_inputs = torch.cat(
                    [
                        own[..., :1].log1p() / math.log1p(24.0),
                        own[..., 1:3] / networks.MAX_SPEED,
                        own[..., 3:4] - encounters.WALKING_SPEED,
                        (own[..., 4:5] - 0.3) / 0.1,
                        own[..., 5:6],
                        1.0 / (1.0 + own[..., _WALLS]),
                        lcf,
                    ],
                    dim=-1,
                )
                encoded = torch.cat(
                    [
                        people[..., :1],
                        place / (1.0 + distance),
                        1.0 / (1.0 + distance),
                        people[..., 3:5] / networks.MAX_SPEED,
                        torch.exp(-people[..., 5:6] / 2.0),
                        people[..., 6:7],
                    ],
                    dim=-1,
                )
                for linear in self.person[:-1]:
                    encoded = torch.relu(linear(encoded))
                encoded = self.person[-1](encoded)
                present = people[..., :1]
                attention = present * torch.exp(10.0 * torch.tanh(encoded[..., :1] / 10.0))
                encoded = torch.relu(encoded[..., 1:])
                mean = (attention * encoded).sum(-2) / (1.0 + attention.sum(-2))
                x = torch.cat([own_inputs, mean, (present * encoded).sum(-2) / 4.0], dim=-1)
                for linear in self.head[:-1]:
                    x = torch.tanh(linear(x))
                x = self.head[-1](x).clamp(-1.0, 1.0)
                wanted = own[..., 3:4] * torch.stack([1.0 + x[..., 0], x[..., 1]], dim=-1)
                wanted = wanted * (MOST_SPEED / wanted.norm(dim=-1, keepdim=True).clamp(min=MOST_SPEED))
                share = 1.0 - math.exp(-policy.period / RELAXATION)
                return own[..., 1:3] + share * (wanted - own[..., 1:3])

        return TorchPolicy()


def _limits() -> tuple[np.ndarray, np.ndarray]:
    """The least and the greatest number of each column of an observation: two arrays (encounters.SIZE,)."""
    most = MOST_READING
    own_least = [0.0, -most, -most, 0.0, 0.0, 0.0] + [0.0] * encounters.WALL_RAYS
    own_most = [most, most, most, most, most, 1.0] + [encounters.WALL_RANGE] * encounters.WALL_RAYS
    least = [0.0, -most, -most, -most, -most, 0.0, 0.0] * encounters.PEOPLE
    greatest = [1.0, most, most, most, most, encounters.MOST_TIME, 1.0] * encounters.PEOPLE
    return np.array(own_least + least, np.float32), np.array(own_most + greatest, np.float32)


_LIMITS = _limits()
_NAMES = [
    *(f"{name}{number if width > 1 else ''}" for name, width in encounters.OWN.items() for number in range(width)),
    *(
        f"{name}{number if width > 1 else ''} of person {person}"
        for person in range(encounters.PEOPLE)
        for name, width in encounters.PERSON.items()
        for number in range(width)
    ),
]


def understood(observed: Array, lcf: Array) -> tuple[Array, Array]:
    """Observations (..., encounters.SIZE) and LCFs (...) as an EncounterPolicy takes them, float32 arrays, NumPy or
    JAX, as `observed` is.

    A wall farther than WALL_RANGE and a time beyond MOST_TIME, infinity included, read as these. Raises ValueError for
    what can't be understood: NaN, a negative distance, time, speed or radius, any other number that is infinite or
    beyond MOST_READING, an LCF outside [-MAX_LCF, MAX_LCF], what is no number, a wrong shape. Under jax.jit only shapes
    and types can be refused: NaN then reads as 0, and a number outside its range as its nearer end.
    """
    observed, lcf, xp = as_readings(observed, lcf, encounters.SIZE, "macid.encounters")
    least, most = (xp.asarray(limit) for limit in _LIMITS)
    if not is_traced(observed):
        values = np.asarray(observed)
        far = np.isin(_LIMITS[1], (encounters.WALL_RANGE, encounters.MOST_TIME))  # these may be beyond their most
        good = (values >= _LIMITS[0]) & ((values <= _LIMITS[1]) | far)
        if not good.all():
            place = tuple(int(i) for i in np.argwhere(~good)[0])
            column = place[-1]
            where = f"column {column}, {_NAMES[column]}"
            where += f", of observation {list(place[:-1])}" if place[:-1] else ""
            wanted = f"a number from {_LIMITS[0][column]:g} to {_LIMITS[1][column]:g}"
            raise ValueError(f"An observation can't be understood: {where}, is {values[place]:g}; {wanted} is wanted.")
    return within(xp, observed, least, most), xp.asarray(lcf)
