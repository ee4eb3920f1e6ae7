"""Frozen sets of episodes: assets/suites/NAME.toml.

A suite is a configuration, the seeds of its episodes, and axes. Each axis names its grades, and each grade names the
fields of the configuration that it changes. Every combination of grades is a cell, and every cell plays the same seeds.

The suite `held-out` has the cells of `standard`, and seeds that only who knows its passphrase knows (`held_out`).
"""

import dataclasses
import hashlib
import itertools
import json
import math
import pathlib
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from bson.robot import load_robot
from bson.task import MAX_PEDESTRIANS, TaskConfig
from macid import assets
from macid.documents import convert, parse, read_bytes, shown, shown_path
from macid.files import UsageError
from macid.maps import load_map
from macid.registry import Kind
from macid.state import MAX_SPEED, RADIUS

_DEFAULTS = {field.name: field.default for field in dataclasses.fields(TaskConfig)}
# Fields that came after suites were frozen: where they are the defaults, they are no part of a digest.
_LATER = ("person_radius", "preferred_speed", "person_max_speed", "companions")
_SEED_STRIDE = 1_000_000  # between the episodes of --seed S and those of --seed S + 1
_MOST_CELLS = 1000
PASSPHRASE_VARIABLE = "BSON_PASSPHRASE"
HELD_OUT, _ITS_CELLS = "held-out", "standard"
_HELD_OUT_FROM = 500_000  # within a stride: no shipped suite has a seed from here on
_STRIDES = 9 * 10**12  # that --seed can name
_PASSPHRASE = 16, 1000  # least and most characters of a passphrase

_Share = Annotated[float, Meta(ge=0, le=1, description="a number from 0 to 1")]
_Lcf = Annotated[float, Meta(ge=-10, le=10)]
_Length = Annotated[float, Meta(gt=0, le=1e4, description="a number above 0 and of at most 10000 m")]
_Period = Annotated[float, Meta(gt=0, le=10, description="a time above 0 and of at most 10 s")]
_Speed = Annotated[float, Meta(gt=0, le=10, description="a speed above 0 and of at most 10 m/s")]
_Weight = Annotated[float, Meta(ge=-1e6, le=1e6)]
_Text = Annotated[str, Meta(min_length=1, max_length=1000)]
_Name = Annotated[
    str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,59}\Z", description="a name of letters, digits, -, _ and .")
]


class _Config(msgspec.Struct, forbid_unknown_fields=True):
    """The fields of a TaskConfig that a suite or a grade may set; TaskConfig checks them further."""

    num_pedestrians: Annotated[int, Meta(ge=0, le=MAX_PEDESTRIANS)] | None = None
    pedestrian_density: _Share | None = None
    obstacle_density: _Share = 0.0
    pedestrian_model: _Text | Annotated[dict[_Text, Annotated[float, Meta(ge=0, le=1e6)]], Meta(min_length=1)] = "macid"
    lcf: _Lcf | Annotated[list[_Lcf], Meta(min_length=2, max_length=2)] = 0.0
    lcf_each: Annotated[list[_Lcf], Meta(max_length=MAX_PEDESTRIANS)] | None = None
    map_size: _Length = 50.0
    map: _Text | None = None
    control_period: _Period = 0.1
    pedestrian_period: _Period = 0.1
    horizon: Annotated[int, Meta(ge=1, le=1_000_000)] = 1000
    goal_distance: _Length | Annotated[list[_Length], Meta(min_length=2, max_length=2)] = 1.0
    reward: dict[_Text, _Weight] = {}
    robot: _Text | dict[_Text, str | float] = "jackal"
    person_radius: _Length = RADIUS
    preferred_speed: _Speed | Annotated[list[_Speed], Meta(min_length=2, max_length=2)] | _Text | None = None
    person_max_speed: _Speed = MAX_SPEED
    companions: _Share | None = None


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """The keys of a suite's file."""

    name: _Name
    description: _Text
    seeds: Annotated[list[Annotated[int, Meta(ge=0, lt=_SEED_STRIDE)]], Meta(min_length=1, max_length=10_000)]
    config: _Config = msgspec.field(default_factory=_Config)
    axes: Annotated[dict[_Name, Annotated[dict[_Name, _Config], Meta(min_length=1)]], Meta(max_length=10)] = {}


@dataclasses.dataclass(frozen=True)
class Cell:
    """One setting of a suite. grades: ((axis, grade), ...), empty where the suite has one cell only."""

    grades: tuple[tuple[str, str], ...]
    config: TaskConfig

    @property
    def name(self) -> str:
        """The grades' names, or "all"."""
        return ", ".join(grade for _, grade in self.grades) or "all"

    @property
    def slug(self) -> str:
        """The name in a form for file names."""
        return self.name.replace(", ", "-")

    @property
    def content(self) -> list[Any]:
        """Everything from which an episode follows beside its seed: grades, configuration, and the content of the files
        that the configuration names."""
        drawn = None
        if self.config.map:
            layout = load_map(self.config.map)
            drawn = [layout.size, layout.obstacles, layout.routed, layout.regions, layout.routes]
        setting = dataclasses.asdict(self.config)
        name = setting["robot"].pop("name")
        if name != "jackal":  # the suites were frozen when the Jackal was the only robot
            setting["robot"]["files"] = load_robot(name).digest
        for name in _LATER:
            if setting[name] == _DEFAULTS[name]:
                del setting[name]
        return [self.grades, setting, drawn]


@dataclasses.dataclass(frozen=True)
class Suite:
    """The episodes by which agents are judged: cells, each with the same seeds.

    apart: the seeds of each cell, where each has its own, as many in each; `seeds` is then empty.
    """

    name: str
    description: str
    cells: tuple[Cell, ...]
    seeds: tuple[int, ...]
    apart: tuple[tuple[int, ...], ...] = ()

    @property
    def axes(self) -> dict[str, list[str]]:
        """{axis: its grades, in order}."""
        found = {}
        for cell in self.cells:
            for axis, grade in cell.grades:
                found.setdefault(axis, {})[grade] = None
        return {axis: list(grades) for axis, grades in found.items()}

    @property
    def digest(self) -> str:
        """A hash of everything from which the episodes follow: cells, seeds, and the maps that they name. 12
        hexadecimal digits."""
        content = [self.apart or self.seeds, *(cell.content for cell in self.cells)]
        text = json.dumps(content, sort_keys=True, default=np.ndarray.tolist)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def drawn(self, episodes: int | None = None, seed: int = 0) -> list[int]:
        """The seeds of the first `episodes` (default: all) of each cell. seed: 0 for the frozen set; another number for
        another set of the same kind.

        Raises ValueError when the suite has fewer episodes.
        """
        if episodes is not None and not 1 <= episodes <= len(self.seeds):
            raise ValueError(f"Suite '{self.name}' has 1 to {len(self.seeds)} episodes a cell, not {episodes}.")
        if seed < 0:
            raise ValueError(f"A seed must be at least 0, not {seed}.")
        return [s + _SEED_STRIDE * seed for s in self.seeds[:episodes]]

    def of_cells(self, episodes: int | None = None, seed: int = 0) -> list[list[int]]:
        """The seeds that each cell plays, as `drawn` gives them, or the first `episodes` of its own.

        Raises ValueError as `drawn` does, and for another `seed` than 0 where cells have seeds of their own.
        """
        if not self.apart:
            return [self.drawn(episodes, seed)] * len(self.cells)
        if seed:
            raise ValueError(f"The seeds of '{self.name}' follow from its passphrase: leave --seed out, not {seed}.")
        if episodes is not None and not 1 <= episodes <= len(self.apart[0]):
            raise ValueError(f"Suite '{self.name}' has 1 to {len(self.apart[0])} episodes a cell, not {episodes}.")
        return [list(each[:episodes]) for each in self.apart]

    def stride(self, seed: int) -> int:
        """The argument `seed` of `of_cells` that gives the episode `seed`."""
        return 0 if self.apart else seed // _SEED_STRIDE


def suite_names() -> list[str]:
    """Names of the suites, sorted."""
    return assets.names("suites", ".toml")


def load_suite(name: str, passphrase: str | None = None) -> Suite:
    """The suite `name`: one of `suite_names()`, a .toml file, or "held-out" with its `passphrase`. Raises UsageError,
    naming the valid choices."""
    if name == HELD_OUT and passphrase is not None:
        return held_out(passphrase)
    if passphrase is not None:
        raise UsageError(f"A passphrase is of the suite '{HELD_OUT}' alone: leave it out with {shown(name)}.")
    return SUITES.load(name)


def held_out(passphrase: str) -> Suite:
    """The suite `held-out` of a `passphrase`: the cells of `standard`, in each as many episodes.

    The seed of a cell's episode `index` (0, 1, ...) follows from the first 16 bytes of SHA-256 of the UTF-8 text
    "passphrase\\0cell\\0index". It lies in one of the strides that --seed names, beyond the seeds of every shipped
    suite there: no set of a shipped suite has it. The digest is of these seeds, and does not tell the passphrase; a
    short one could be guessed from it. Raises UsageError for fewer characters than 16, and for what is no line of text.
    """
    least, most = _PASSPHRASE
    if not (least <= len(passphrase) <= most and passphrase.isprintable()):
        raise UsageError(f"A passphrase is a line of {least} to {most} characters: this one has {len(passphrase)}.")
    open_one = load_suite(_ITS_CELLS)

    def seed(cell, index):
        digest = hashlib.sha256(f"{passphrase}\0{cell.name}\0{index}".encode()).digest()
        stride, place = divmod(int.from_bytes(digest[:16]), _SEED_STRIDE - _HELD_OUT_FROM)
        return _SEED_STRIDE * (stride % _STRIDES) + _HELD_OUT_FROM + place

    apart = tuple(tuple(seed(cell, index) for index in range(len(open_one.seeds))) for cell in open_one.cells)
    return Suite(HELD_OUT, f"the cells of {_ITS_CELLS}, seeds of a passphrase", open_one.cells, (), apart)


def read_suite(file: str | pathlib.Path) -> Suite:
    """The suite in the TOML `file`: `name`, `description`, `seeds`, `config` (a table of TaskConfig's fields) and
    `axes` (for each axis its grades, each a table of the fields that it changes). Raises UsageError, naming the faulty
    part."""
    called = f"suite {shown_path(file)}"
    document = parse(file, "suite", read_bytes(file, "suite"))
    checked = convert(document, _File, called)
    if not checked.description.isprintable():
        raise UsageError(f"{called}, key 'description': it must be printable text.")
    if len(set(checked.seeds)) < len(checked.seeds):
        raise UsageError(f"{called}, key 'seeds': no seed may stand twice.")
    if (number := math.prod(map(len, checked.axes.values()))) > _MOST_CELLS:
        raise UsageError(f"{called}, key 'axes': their grades make {number} cells; {_MOST_CELLS} are possible.")
    axes = [
        [(axis, grade, changes) for grade, changes in grades.items()]
        for axis, grades in document.get("axes", {}).items()
    ]
    key = "config"
    try:
        base = TaskConfig().replace(**document.get("config", {}))
        cells = []
        for combination in itertools.product(*axes):
            key = ", ".join(f"axes.{axis}.{grade}" for axis, grade, _ in combination) or key
            changes = {name: value for _, _, each in combination for name, value in each.items()}
            cells.append(Cell(tuple((axis, grade) for axis, grade, _ in combination), base.replace(**changes)))
    except ValueError as error:
        raise UsageError(f"{called}, key {shown(key)}: {error}") from None
    return Suite(checked.name, checked.description, tuple(cells), tuple(checked.seeds))


def _read(name):
    """The suite `name`, a shipped one, or the suite in a file."""
    if name == HELD_OUT:
        raise UsageError(
            f"The suite '{HELD_OUT}' has no seeds without its passphrase: give it to bson evaluate or bson verify by "
            f"--passphrase-file FILE, or in the environment variable {PASSPHRASE_VARIABLE}."
        )
    return read_suite(name if name.endswith(".toml") else assets.path("suites", f"{name}.toml"))


def _all_names():
    return sorted([*suite_names(), HELD_OUT])


SUITES: Kind[Suite] = Kind("suite", shipped=_all_names, read=_read, files=(".toml",))
