"""Episodes in Minari datasets, for offline learning (extra `data`)."""

import dataclasses
import pathlib
from typing import Any

from bson.benchmark.episodes import check_spawn, episodes_bar
from macid.files import (
    UsageError,
)


def dataset(
    agent: Any = None,
    out: str | pathlib.Path | None = None,
    *,
    name: str | None = None,
    suite: str = "paper",
    cell: str | None = None,
    episodes: int | None = None,
    seed: int = 0,
    track: str | None = None,
    sensor: Any = None,
    overrides: dict[str, Any] | None = None,
    untrained: bool = False,
    command: str | None = None,
    quiet: bool = False,
) -> list[pathlib.Path]:
    """Plays an agent and writes its episodes to a Minari dataset, as `bson dataset` does (extra `data`); returns the
    datasets' folders.

    agent: as for `evaluate`; None: three datasets, expert, medium and random, of the agents
    bson.learning.dataset.LEVELS. name: the dataset's id, by default bson/SUITE/AGENT-v0. out: folder of datasets, by
    default Minari's own. cell: one cell of the suite, by its name. The other arguments are as for `evaluate`. Where the
    request can't be met, raises UsageError before anything is played. A dataset is whole or not there.
    """
    from bson.agents import agent_label, check_settings, load_agent
    from bson.episodes.tracks import make_track, sensor_label
    from bson.evaluation.play import versions
    from bson.evaluation.store import basis, files_digest
    from bson.evaluation.suites import load_suite
    from bson.learning import dataset as datasets

    datasets.check()
    if agent is None and name is not None:
        raise UsageError("--id names one dataset, and without --agent there are three: give --agent, too.")
    chosen, changes = load_suite(suite), overrides or {}
    seeds = chosen.drawn(episodes, seed)
    cells = [one for one in chosen.cells if cell in (None, one.name)]
    if not cells:
        known = ", ".join(repr(one.name) for one in chosen.cells)
        raise UsageError(f"Suite '{suite}' has no cell {cell!r}. Choose one of {known}.")
    cells = [dataclasses.replace(one, config=one.config.replace(**changes)) for one in cells]
    for one in cells:
        check_spawn(one.config, seeds)
    planned = []
    for level, each in {"": agent}.items() if agent is not None else datasets.LEVELS.items():
        called, made = agent_label(each), load_agent(each, untrained)
        wanted = track or made.track, sensor or made.sensor
        check_settings(made, [one.config for one in cells], make_track(*wanted))
        usual = f"bson/{_word(chosen.name)}/{level or _word(pathlib.Path(called).stem)}-v0"
        planned.append((called, made, wanted, name or usual, datasets.folder_of(name or usual, out)))
    for called, made, wanted, its_name, folder in planned:
        about = {
            "algorithm_name": called,
            "description": f"{len(seeds)} episodes of each of {len(cells)} cells of the suite {chosen.name}",
            "suite": chosen.name,
            "suite_digest": None if changes or cell is not None else chosen.digest,
            "task_digest": files_digest(basis(called, wanted, cells, False)),
            "seeds": list(map(int, seeds)),
            "track": [wanted[0], sensor_label(wanted[1])],
            "overrides": {key: str(value) for key, value in changes.items()},
            "versions": versions(),
            "command": command,
        }
        with episodes_bar(called, len(seeds) * len(cells), quiet) as progress:
            datasets.write(folder, its_name, made, called, cells, wanted, seeds, about, progress)
    return [folder for *_, folder in planned]


def _word(name):
    """`name` as a word of a dataset's id."""
    return "".join(c if c.isalnum() or c in "-_" else "-" for c in name)
