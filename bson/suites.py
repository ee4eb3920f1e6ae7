"""Frozen sets of episodes: assets/suites/NAME.toml.

A suite is a configuration, the seeds of its episodes, and axes: each names its grades, and each grade what it changes of
the configuration. Every combination of grades is a cell, and every cell plays the same seeds.
"""

import dataclasses
import hashlib
import itertools
import json
import tomllib

import numpy as np

from bson.robot import load_robot
from bson.task import TaskConfig
from macid import assets
from macid.maps import load_map

_SEED_STRIDE = 1_000_000  # between the episodes of --seed S and of --seed S + 1


@dataclasses.dataclass(frozen=True)
class Cell:
    """One setting of a suite. grades: ((axis, grade), ...), none where the suite has one cell only."""

    grades: tuple[tuple[str, str], ...]
    config: TaskConfig

    @property
    def name(self):
        """The grades' names, or "all"."""
        return ", ".join(grade for _, grade in self.grades) or "all"

    @property
    def slug(self):
        """The name, for files."""
        return self.name.replace(", ", "-")

    @property
    def content(self):
        """All that an episode follows from beside its seed: grades, configuration, and the files that it names."""
        drawn = None
        if self.config.map:
            layout = load_map(self.config.map)
            drawn = [layout.size, layout.obstacles, layout.routed, layout.regions, layout.routes]
        setting = dataclasses.asdict(self.config)
        name = setting["robot"].pop("name")
        if name != "jackal":  # the suites were frozen when there was no other
            setting["robot"]["files"] = load_robot(name).digest
        return [self.grades, setting, drawn]


@dataclasses.dataclass(frozen=True)
class Suite:
    """Episodes to be judged by: cells, each with the same seeds."""

    name: str
    description: str
    cells: tuple[Cell, ...]
    seeds: tuple[int, ...]

    @property
    def axes(self):
        """{axis: its grades, in order}."""
        found = {}
        for cell in self.cells:
            for axis, grade in cell.grades:
                found.setdefault(axis, {})[grade] = None
        return {axis: list(grades) for axis, grades in found.items()}

    @property
    def digest(self):
        """A hash of all that the episodes follow from: cells, seeds, and the maps that they name. 12 hexadecimal digits."""
        content = [self.seeds, *(cell.content for cell in self.cells)]
        text = json.dumps(content, sort_keys=True, default=np.ndarray.tolist)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def drawn(self, episodes=None, seed=0):
        """The seeds of the first `episodes` (default: all) of each cell. seed: 0 for the frozen set, else another set of
        the kind.

        Raises ValueError when the suite has fewer episodes.
        """
        if episodes is not None and not 1 <= episodes <= len(self.seeds):
            raise ValueError(f"Suite '{self.name}' has 1 to {len(self.seeds)} episodes a cell, not {episodes}.")
        if seed < 0:
            raise ValueError(f"A seed must be at least 0, not {seed}.")
        return [s + _SEED_STRIDE * seed for s in self.seeds[:episodes]]


def suite_names():
    """Names of the suites, sorted."""
    return assets.names("suites", ".toml")


def load_suite(name):
    """The suite `name`. Raises ValueError for an unknown name."""
    if name not in suite_names():
        raise ValueError(f"Unknown suite '{name}'. Choose one of {', '.join(suite_names())}.")
    fields = tomllib.loads(assets.path("suites", f"{name}.toml").read_text())
    base = TaskConfig().replace(**fields["config"])
    axes = [
        [(axis, grade, changes) for grade, changes in grades.items()] for axis, grades in fields.get("axes", {}).items()
    ]
    cells = []
    for combination in itertools.product(*axes):
        changes = {key: value for _, _, each in combination for key, value in each.items()}
        cells.append(Cell(tuple((axis, grade) for axis, grade, _ in combination), base.replace(**changes)))
    return Suite(fields["name"], fields["description"], tuple(cells), tuple(fields["seeds"]))
