"""Drawn tasks: for each round of episodes a setting is drawn from ranges, so that a robot learns a whole benchmark and
not one setting of it. assets/draws/NAME.toml, or a file of the user's own.

A draw has kinds, each with its share and a table of TaskConfig's fields. A field has a value, or `{ from = ..., to =
... }`, a range, or `{ among = [...] }`, a choice.
"""

import dataclasses
import pathlib
from collections.abc import Iterator
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from bson.task import TaskConfig
from macid import assets
from macid.documents import convert, is_number, parse, read_bytes, shown, shown_path
from macid.files import UsageError
from macid.registry import Kind

# Seeds of drawn episodes: training's from 2^32 on, validation's from 2^33 on. Every suite's are below 2^31.
_TRAINING, _VALIDATION = 2**32, 2**33
_TRIED = 50  # settings that are drawn of each kind as a draw is read, to find one that is not valid

_Text = Annotated[str, Meta(min_length=1, max_length=1000)]


class _Kind(msgspec.Struct, forbid_unknown_fields=True):
    share: Annotated[float, Meta(gt=0, le=1e6)]
    config: dict[str, Any] = {}


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """The keys of a draw's file."""

    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,59}\Z")]
    description: _Text
    kinds: Annotated[list[_Kind], Meta(min_length=1, max_length=100)]
    validation: Annotated[list[dict[str, Any]], Meta(min_length=1, max_length=100)]
    sizes: Annotated[list[Annotated[int, Meta(ge=0, le=2000)]], Meta(min_length=1, max_length=100)] | None = None


@dataclasses.dataclass(frozen=True)
class Draw:
    """Settings to be drawn. kinds: ((share, {field: value, or how it is drawn}), ...); validation: the settings by
    whose episodes a policy is chosen. sizes: the numbers of people that a world may have, None: any; each new one costs
    the time to make its physics, and to compile a pedestrian model. A drawn crowd has the nearest of them."""

    name: str
    kinds: tuple[tuple[float, dict[str, Any]], ...]
    validation: tuple[TaskConfig, ...]
    sizes: tuple[int, ...] | None

    def setting(self, rng: np.random.Generator, base: TaskConfig) -> TaskConfig:
        """A setting drawn from `rng`: `base` with the fields that a kind draws."""
        shares = np.array([share for share, _ in self.kinds])
        kind = int(rng.choice(len(shares), p=shares / shares.sum()))
        return self._of_kind(kind, rng, base)

    def _of_kind(self, kind, rng, base):
        fields = {name: _drawn(rng, value) for name, value in self.kinds[kind][1].items()}
        return self.fitted(base.replace(**fields))

    def fitted(self, config: TaskConfig) -> TaskConfig:
        """`config` with as many people as a world may have."""
        if self.sizes is None:
            return config
        return config.replace(num_pedestrians=min(self.sizes, key=lambda size: abs(size - config.people)))


# Fields that may differ between episodes of worlds on a device, and how worlds are made that serve all.
ON_A_DEVICE = ("lcf", "goal_distance", "obstacle_density", "num_pedestrians", "pedestrian_density")
_ALIKE = ("person_radius", "preferred_speed", "person_max_speed", "companions", "lcf_each")


@dataclasses.dataclass(frozen=True)
class EachEpisode:
    """The `settings` of a pool of episodes (bson.simulation.pool): each episode has a setting of its own, drawn from
    its seed. base: the setting that the draw changes."""

    draw: Draw
    base: TaskConfig

    def __call__(self, seed: int) -> Iterator[TaskConfig]:
        """The episode's setting, and others in case that there is no room for it."""
        rng = np.random.default_rng((0xD4A35E77, seed))
        while True:
            yield self.draw.setting(rng, self.base)

    @property
    def shortest(self) -> float:
        """The least distance of a start from its goal [m]."""
        kinds = [config.get("goal_distance", self.base.goal_distance) for _, config in self.draw.kinds]
        every = [
            one for kind in kinds for one in (kind.get("among") or [kind["from"]] if isinstance(kind, dict) else [kind])
        ]
        return float(min(np.min(one) for one in every))

    @property
    def largest(self) -> TaskConfig:
        """The setting of worlds that have room for all. Raises UsageError where there is none."""
        called = f"--draw {self.draw.name}: with --engine warp"
        for number, (_, config) in enumerate(self.draw.kinds):
            if odd := sorted(set(config) - {*ON_A_DEVICE}):
                told = ", ".join(ON_A_DEVICE)
                raise UsageError(f"{called} episodes may differ in {told}, not in {odd[0]} (kinds[{number}]).")
        if odd := [name for name in _ALIKE if getattr(self.base, name) != getattr(TaskConfig, name)]:
            raise UsageError(f"{called} all people are the paper's: leave {odd[0]} out.")
        kinds = []
        for _, config in self.draw.kinds:
            fields = {name: _most(value) for name, value in config.items() if name not in ("lcf", "goal_distance")}
            kinds.append(self.draw.fitted(self.base.replace(**fields)))
        walls = max(kind.obstacle_density for kind in kinds)
        return self.base.replace(num_pedestrians=max(kind.people for kind in kinds), obstacle_density=walls)


def _most(value):
    """The greatest value of a field that is drawn so."""
    if isinstance(value, dict):
        return value["to"] if "to" in value else max(value["among"])
    return value


def training_seed(rng: np.random.Generator) -> int:
    """The seed of an episode of training, from `rng`."""
    return _TRAINING + int(rng.integers(2**31))


def validation_seeds(number: int) -> list[int]:
    """The seeds of the first `number` episodes of a validation setting."""
    return [_VALIDATION + index for index in range(number)]


def _drawn(rng, value):
    if isinstance(value, dict) and set(value) == {"from", "to"}:
        return float(rng.uniform(value["from"], value["to"]))
    if isinstance(value, dict) and set(value) == {"among"}:
        return value["among"][int(rng.integers(len(value["among"])))]
    return value


def _check(called, key, value):
    """Raises UsageError for a field that can't be drawn."""
    if not isinstance(value, dict):
        return
    if set(value) == {"from", "to"}:
        least, most = value["from"], value["to"]
        if not (is_number(least) and is_number(most) and least <= most):
            raise UsageError(f"{called}, key '{key}': from and to must be numbers, from <= to, not {shown(value)}.")
    elif "among" in value and not (len(value) == 1 and isinstance(value["among"], list) and value["among"]):
        raise UsageError(f"{called}, key '{key}': among must be a list of values, not {shown(value)}.")


def read_draw(file: str | pathlib.Path) -> Draw:
    """The draw in the TOML `file`. Raises UsageError, naming the faulty part."""
    called = f"draw {shown_path(file)}"
    checked = convert(parse(file, "draw", read_bytes(file, "draw")), _File, called)
    kinds = tuple((kind.share, kind.config) for kind in checked.kinds)
    for number, (_, config) in enumerate(kinds):
        for name, value in config.items():
            _check(called, f"kinds[{number}].config.{name}", value)
    key = "validation"
    try:
        validation = tuple(TaskConfig().replace(**fields) for fields in checked.validation)
        draw = Draw(checked.name, kinds, validation, tuple(checked.sizes) if checked.sizes else None)
        rng = np.random.default_rng(0)
        for number in range(len(kinds)):
            key = f"kinds[{number}].config"
            for _ in range(_TRIED):
                draw._of_kind(number, rng, TaskConfig())
    except (ValueError, TypeError) as error:
        raise UsageError(f"{called}, key '{key}': {error}") from None
    return draw


def draw_names() -> list[str]:
    """Names of the shipped draws, sorted."""
    return assets.names("draws", ".toml")


def load_draw(name: str) -> Draw:
    """The draw `name`: one of `draw_names()`, or a .toml file. Raises UsageError, naming the valid choices."""
    return DRAWS.load(name)


def _read(name):
    return read_draw(name if name.endswith(".toml") else assets.path("draws", f"{name}.toml"))


DRAWS: Kind[Draw] = Kind("draw", shipped=draw_names, read=_read, files=(".toml",))
