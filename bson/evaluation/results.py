"""results.json in Python (Results), and its reading: bounded in size, checked against one schema, and checked for
contradictions. It loads neither JAX nor MuJoCo."""

import collections
import dataclasses
import functools
import math
import pathlib
import unicodedata
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from bson.evaluation.metrics import METRICS, TAKEN, metrics_of
from macid.documents import convert, is_number, parse, read_bytes, shown
from macid.files import UsageError, write_json

MOST_BYTES = 1 << 28  # an episode has some 1.5 kB, with --paired 3 kB
MOST_EPISODES, MOST_CELLS = 100_000, 10_000
_MOST_DEEP = 20  # levels of lists and objects inside each other; a configuration has some 5
_MOST_KEY = 500  # characters
_Count = Annotated[int, msgspec.Meta(ge=0)]
_Name = Annotated[str, msgspec.Meta(min_length=1, max_length=500)]
_Word = Annotated[str, msgspec.Meta(max_length=500)]


class _Cell(msgspec.Struct):
    name: _Name
    grades: dict[_Name, _Word]
    config: dict[str, Any]
    summary: dict[_Name, float] = {}
    intervals: dict[_Name, tuple[float, float]] = {}


class _Fault(msgspec.Struct):
    seed: _Count
    cell: _Name
    time: float
    what: str


_SCORED = msgspec.defstruct(
    "_Scored",
    [
        ("cell", _Name),
        ("seed", _Count),
        *((metric.name, float | msgspec.UnsetType | None, msgspec.UNSET) for metric in METRICS),
        ("people", dict[str, list[float | None]] | msgspec.UnsetType, msgspec.UNSET),
    ],
)


class _Episode(_SCORED):
    """An episode's cell and seed, and its metrics, None where a metric is infinite."""


_WHAT = "Name folders of bson evaluate (--out), or their results.json."


class _Metric(msgspec.Struct):
    unit: _Word
    better: Literal["up", "down", "neither"]
    what: _Word


class Content(msgspec.Struct):
    """The fields of results.json that are read; its other fields are notes for people."""

    agent: _Name
    suite: _Name
    versions: dict[_Name, _Word]
    summary: dict[_Name, float]
    intervals: dict[_Name, tuple[float, float]]
    cells: Annotated[list[_Cell], msgspec.Meta(min_length=1, max_length=MOST_CELLS)]
    episodes: Annotated[list[_Episode], msgspec.Meta(min_length=1, max_length=MOST_EPISODES)]
    metrics: dict[_Name, _Metric] = {}
    faults: list[_Fault] = []
    overrides: dict[_Name, _Word] = {}
    suite_digest: _Name | None = None
    task_digest: _Name | None = None
    track: list[_Name] | None = None
    command: str | None = None
    frozen_seeds: bool = True


@dataclasses.dataclass(frozen=True)
class Results:
    """The results of an evaluation: E scored episodes, in the order of cells and seeds.

    content: the content of results.json. source: the folder or file, as the user named it; the agent's name where the
    results were not saved. written: the files that the evaluation has written, the films last.
    """

    content: dict[str, Any] = dataclasses.field(repr=False)
    source: str = ""
    written: tuple[pathlib.Path, ...] = ()

    @classmethod
    def load(cls, source: str | pathlib.Path) -> "Results":
        """The Results in `source`, a folder that `bson evaluate` wrote, or its results.json. Raises UsageError."""
        path = pathlib.Path(source)
        return cls(read_results(path / "results.json" if path.is_dir() else path), str(source))

    def save(self, path: str | pathlib.Path) -> None:
        """Writes the file `path`, or results.json in the folder `path`, all or nothing. Raises UsageError."""
        path = pathlib.Path(path)
        write_json(path / "results.json" if path.is_dir() else path, self.content)

    @property
    def agent(self) -> str:
        """The agent's name."""
        return self.content["agent"]

    @property
    def suite(self) -> str:
        """The suite's name."""
        return self.content["suite"]

    @property
    def summary(self) -> dict[str, float]:
        """{metric: mean over the episodes in which it is finite}."""
        return self.content["summary"]

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """{metric: (low, high), the mean's bootstrap 95% interval}."""
        return {name: (low, high) for name, (low, high) in self.content["intervals"].items()}

    @property
    def cells(self) -> list[str]:
        """The cells' names, in order."""
        return [cell["name"] for cell in self.content["cells"]]

    @property
    def configs(self) -> dict[str, dict[str, Any]]:
        """{cell: its configuration}."""
        return {cell["name"]: cell["config"] for cell in self.content["cells"]}

    @property
    def rows(self) -> dict[tuple[str, int], dict[str, Any]]:
        """{(cell, seed): the episode's metrics, None for a value that is not finite}."""
        return {(row["cell"], row["seed"]): row for row in self.content["episodes"]}

    @functools.cached_property
    def cell(self) -> np.ndarray:
        """(E,) the cell's name of each episode."""
        return np.array([row["cell"] for row in self.content["episodes"]], dtype=str)

    @functools.cached_property
    def seed(self) -> np.ndarray:
        """(E,) int64, the seed of each episode."""
        return np.array([row["seed"] for row in self.content["episodes"]], dtype=np.int64)

    @functools.cached_property
    def metrics(self) -> dict[str, np.ndarray]:
        """{metric: (E,) float64, its value in each episode}, in the units of bson.evaluation.metrics.METRICS; infinity
        where an episode has no value, such as a distance to people where there are none. Metrics that an older file
        lacks are left out."""
        rows = self.content["episodes"]
        names = [metric.name for metric in metrics_of(self.content) if all(metric.name in row for row in rows)]
        return {name: np.array([_value(row[name]) for row in rows], dtype=float) for name in names}

    def by_cell(self, metric: str) -> dict[str, np.ndarray]:
        """{cell: (its episodes,) float64, the values of `metric` there}. Raises KeyError for a metric that the results
        don't have."""
        return {name: self.metrics[metric][self.cell == name] for name in self.cells}

    def cell_means(self, metric: str) -> np.ndarray:
        """(cells,) float64, the mean of `metric` in each cell over the episodes in which it is finite; NaN where no
        episode has a finite value."""
        return np.array([cell.get("summary", {}).get(metric, math.nan) for cell in self.content["cells"]], dtype=float)


def _value(number):
    return math.inf if number is None else number


def read_results(path: str | pathlib.Path) -> dict[str, Any]:
    """The content of the results.json at `path`, a dict. Raises UsageError, one line that names the file, the key and
    the value."""
    try:
        content = parse(path, "results", read_bytes(path, "results", MOST_BYTES), ".json")
    except UsageError as error:
        raise UsageError(f"No results in '{path}': {str(error).rstrip('.')}. {_WHAT}") from None
    missing = [key for key in _NEEDED if not isinstance(content, dict) or key not in content]
    rows = [] if missing or not isinstance(content["episodes"], list) else content["episodes"]
    if missing := missing or ["cell" for row in rows if isinstance(row, dict) and "cell" not in row]:
        raise UsageError(f"'{path}' has no '{missing[0]}': it isn't of this version's bson evaluate. {_WHAT}")
    _check_form(content, f"results '{path}'")
    found = convert(content, Content, f"results '{path}'")
    _check_sense(found, f"results '{path}'")
    for index, row in enumerate(rows):
        for name in found.metrics.keys() - TAKEN & row.keys():
            if not (row[name] is None or is_number(row[name])):
                wanted = f"a number or null is wanted, not {shown(row[name])}"
                raise UsageError(f"results '{path}', key 'episodes[{index}].{name}': {wanted}.")
    return content


_NEEDED = [field.name for field in msgspec.structs.fields(Content) if field.required]


def _check_form(content, name):
    """Raises UsageError for content that no page or table can show: deep nesting, and text of more than one line."""
    waiting = [("", content, 0)]
    while waiting:
        key, value, depth = waiting.pop()
        if depth > _MOST_DEEP:
            raise UsageError(f"{name}, key {shown(key)} is nested too deeply.")
        if isinstance(value, str):
            if not value.isprintable() and any(unicodedata.category(c) in ("Cc", "Zl", "Zp") for c in value):
                raise UsageError(f"{name}, key {shown(key)}: text of one line is wanted, not {shown(value)}.")
        elif isinstance(value, dict):
            if long := [part for part in value if len(part) > _MOST_KEY]:
                raise UsageError(f"{name}: the key {shown(long[0])} has more than {_MOST_KEY} characters.")
            waiting += [(key, each, depth + 1) for each in value]
            waiting += [(f"{key}.{part}" if key else part, each, depth + 1) for part, each in value.items()]
        elif isinstance(value, list):
            waiting += [(f"{key}[{index}]", each, depth + 1) for index, each in enumerate(value)]


def _check_sense(found, name):
    """Raises UsageError where two parts of `found` (Content) contradict each other."""
    cells, axes = [cell.name for cell in found.cells], list(found.cells[0].grades)
    if twice := _twice(cells):
        raise UsageError(f"{name}, key 'cells': {shown(twice[0])} stands twice.")
    for index, cell in enumerate(found.cells):
        if list(cell.grades) != axes or (len(cells) > 1 and not axes):
            wanted = shown(axes or "of several cells")
            raise UsageError(f"{name}, key 'cells[{index}].grades': the axes {wanted} are wanted.")
    known, played = set(cells), set()
    for key, rows in (("episodes", found.episodes), ("faults", found.faults)):
        for index, row in enumerate(rows):
            if row.cell not in known:
                raise UsageError(f"{name}, key '{key}[{index}].cell': {shown(row.cell)} is none of the cells.")
            if (row.cell, row.seed) in played:
                which = f"the episode {row.seed} of {shown(row.cell)}"
                raise UsageError(f"{name}, key '{key}[{index}]': {which} stands twice.")
            played.add((row.cell, row.seed))
    for metric in found.summary:
        if metric not in found.intervals:
            raise UsageError(f"{name}, key 'intervals': {shown(metric)} is missing.")


def _twice(names):
    """The `names` that are listed more than once, in order."""
    return [name for name, count in collections.Counter(names).items() if count > 1]
