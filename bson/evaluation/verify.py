"""Whether results come out again: a share of the episodes of a results file is played anew, and compared bit for bit.

The record of that (Verification) stands beside the results, names their file by its hash, and is what a leaderboard
goes by (bson.reporting.board).
"""

import collections
import contextlib
import dataclasses
import hashlib
import itertools
import json
import math
import pathlib
import secrets
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from bson.evaluation.results import MOST_BYTES, Results
from macid.documents import read_bytes, read_document, shown
from macid.files import UsageError, write_json

ENDING = ".verification.json"  # of a record's file, in place of the results file's ".json"
SHARE = 0.1  # of the episodes that are played again
_MOST_DRAW = 2**32
_TOLERANCE = 1e-9  # between means here and there, whose last bits depend on a CPU's vector instructions
_METRIC = 200  # characters of what differs, in a message
_Text = Annotated[str, msgspec.Meta(max_length=2000)]


class Replayed(msgspec.Struct):
    """An episode that was played again."""

    cell: _Text
    seed: int
    differs: dict[_Text, tuple[Any, Any]]  # {metric: (was, is)}; empty where all came out bit for bit


class Verification(msgspec.Struct):
    """The record of a verification. `verdict` is "equal" where every episode came out bit for bit and `problems` is
    empty."""

    results: Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}\Z")]  # SHA-256 of the results file
    verdict: Literal["equal", "differs"]
    agent: _Text
    suite: _Text
    replayed_agent: _Text  # the name by which the agent was loaded here
    draw: int  # the seed by which the episodes were drawn
    share: float
    count: int  # of the episodes in the results, the faulty ones included
    episodes: list[Replayed]
    problems: list[_Text]  # what the results say of themselves, and does not hold
    notes: list[_Text]  # what differs between there and here, and may be the reason
    made_with: dict[_Text, _Text]  # {package: version} of the results
    played_with: dict[_Text, _Text]  # of the verification
    suite_digest: tuple[str | None, str | None] = (None, None)  # of the results, and here
    task_digest: tuple[str | None, str | None] = (None, None)

    @property
    def equal(self) -> bool:
        """Whether the results hold."""
        return self.verdict == "equal"


def record_path(results: str | pathlib.Path) -> pathlib.Path:
    """The file of the record beside a results file, or beside the results.json of a folder."""
    path = results_path(results)
    return path.with_name(path.name.removesuffix(".json") + ENDING)


def results_path(results: str | pathlib.Path) -> pathlib.Path:
    """The results file that `results` names: itself, or results.json in a folder."""
    path = pathlib.Path(results)
    return path / "results.json" if path.is_dir() else path


def results_hash(results: str | pathlib.Path) -> str:
    """SHA-256 of a results file, 64 hexadecimal digits. Raises UsageError."""
    return hashlib.sha256(read_bytes(results_path(results), "results", MOST_BYTES)).hexdigest()


def read_record(results: str | pathlib.Path) -> Verification | None:
    """The record beside a results file; None where there is none. Raises UsageError for a file that is no record."""
    path = record_path(results)
    return read_document(path, Verification, "verification", MOST_BYTES) if path.exists() else None


def why_unverified(results: str | pathlib.Path) -> str | None:
    """Why a results file can't be trusted; None where its record says that it came out bit for bit. Raises UsageError
    for a record that is none."""
    record = read_record(results)
    if record is None:
        return "never verified"
    if record.results != results_hash(results):
        return "changed since it was verified"
    return None if record.equal else "did not come out when it was verified"


def write_record(path: str | pathlib.Path, record: Verification) -> None:
    """Writes the file `path`, all or nothing. Raises UsageError."""
    write_json(path, msgspec.to_builtins(record))


def drawn(episodes: Sequence[tuple[str, int]], share: float, draw: int) -> list[tuple[str, int]]:
    """A random `share` of `episodes`, rounded up, at least one, in their order; `draw` is the seed."""
    count = max(1, math.ceil(share * len(episodes) - 1e-9))
    which = np.random.default_rng(draw).choice(len(episodes), count, replace=False)
    return [episodes[place] for place in np.sort(which)]


@contextlib.contextmanager
def _silent(cell: str | None, without_robot: bool, total: int, done: int) -> Iterator[Callable[[int, bool], None]]:
    yield lambda steps, ended: None


def verify(
    results: str | pathlib.Path,
    *,
    agent: Any = None,
    suite: str | None = None,
    passphrase: str | None = None,
    track: str | None = None,
    sensor: Any = None,
    metrics: Sequence[str] = (),
    share: float = SHARE,
    draw: int | None = None,
    watch: Callable[[str | None, bool, int, int], Any] = _silent,
) -> Verification:
    """Plays a random share of the episodes of a results file again, and tells whether they come out, as `bson verify`
    does; writes nothing.

    results: a folder that `bson evaluate` wrote, or its results.json. agent: the agent, as for bson.benchmark.evaluate;
    None: the one that the results name, if it comes with this package. No code that a results file names is run. suite:
    its name, or its .toml file where it is one's own; passphrase: of the suite "held-out". track, sensor: where they
    are one's own, as for bson.benchmark.evaluate. metrics: one's own, as there; those that are not given are not
    compared. share: of the episodes, those in which physics failed included; at least one is played. draw: the seed by
    which they are drawn; None: one that nobody could foresee. watch: as for bson.evaluation.executors.play_cells.

    Checked beside these episodes: that all episodes of the suite are there and no other; that the settings are the
    suite's; that the means follow from the episodes. Raises UsageError where the results can't be verified.
    """
    from bson.agents import agent_label, check_settings, load_agent
    from bson.episodes.tracks import make_track, sensor_settings
    from bson.evaluation.executors import play_cells
    from bson.evaluation.metrics import METRICS, measure, own_metrics
    from bson.evaluation.overrides import read_overrides
    from bson.evaluation.play import episode_row, fault_row, versions
    from bson.evaluation.store import basis, files_digest
    from bson.evaluation.suites import HELD_OUT, load_suite
    from macid.executors import make_executor

    if not 0 < share <= 1:
        raise UsageError(f"The share of the episodes must be above 0 and at most 1, not {share:g}.")
    found, hashed = Results.load(results_path(results)), results_hash(results)
    content = found.content
    _check_repeatable(content, agent, results)
    own = own_metrics(metrics)
    chosen = load_suite(content["suite"] if suite is None else suite, passphrase)
    if chosen.name != content["suite"]:
        raise UsageError(f"'{results}' has results of the suite {shown(content['suite'])}, not of '{chosen.name}'.")
    rows = found.rows
    faults = {(row["cell"], row["seed"]): row for row in content.get("faults", [])}
    if chosen.name == HELD_OUT and {seed for _, seed in [*rows, *faults]}.isdisjoint(itertools.chain(*chosen.apart)):
        raise UsageError(f"'{results}' has no seed of this passphrase: it was made with another one.")
    changes = read_overrides(f"{key}={text}" for key, text in content.get("overrides", {}).items())
    cells = {
        cell.name: dataclasses.replace(cell, config=cell.config.replace(**changes))
        for cell in chosen.cells
        if cell.name in found.configs
    }
    if unknown := [name for name in found.configs if name not in cells]:
        raise UsageError(
            f"The suite '{chosen.name}' has no cell {shown(unknown[0])}, of which '{results}' has results."
        )
    agent = content["agent"] if agent is None else agent
    make_agent = load_agent(agent, untrained=True)  # whether it may try is not the question here
    wanted = _track(content, make_agent, track, sensor, results)
    seen = make_track(*wanted)
    check_settings(make_agent, [cell.config for cell in cells.values()], seen)

    draw = secrets.randbelow(_MOST_DRAW) if draw is None else draw
    again = drawn([*rows, *faults], share, draw)
    seeds = {name: [seed for cell, seed in again if cell == name] for name in cells}
    played = play_cells(
        make_executor("local"),
        agent,
        make_agent,
        True,
        agent_label(agent),
        list(cells.values()),
        wanted,
        list(seeds.values()),
        [{} for _ in cells],
        bool(content.get("paired")),
        watch,
        lambda cell, episode: None,
    )
    measured = (*METRICS, *own)
    now = {
        (cell.name, episode.seed): _json(
            fault_row(cell, episode) if episode.fault else episode_row(cell, episode, measure(episode, measured))
        )
        for cell, episodes in zip(cells.values(), played, strict=True)
        for episode in episodes
    }
    replayed = [Replayed(*key, _difference(rows.get(key) or faults[key], now[key])) for key in again]

    digests = content.get("suite_digest"), None if changes else chosen.digest
    problems = [
        *_missing(chosen, rows.keys() | faults.keys(), list(cells), content.get("frozen_seeds", True)),
        *_other_settings(found.configs, {name: _json(dataclasses.asdict(cell.config)) for name, cell in cells.items()}),
        *_other_means(content),
    ]
    if digests[0] != digests[1]:
        problems.append(f"digest of the suite: was {digests[0]}, is {digests[1]}")
    tasks = content.get("task_digest"), files_digest(basis(agent_label(agent), wanted, list(cells.values()), False))
    here = versions()
    notes = [
        f"{package}: was {content['versions'].get(package)}, is {here.get(package)}"
        for package in {**content["versions"], **here}
        if content["versions"].get(package) != here.get(package)
    ]
    if tasks[0] is not None and tasks[0] != tasks[1]:
        notes.append(f"made with other settings, maps, robots or pedestrians' weights: was {tasks[0]}, is {tasks[1]}")
    if content.get("sensors") not in (None, _json(sensor_settings(seen.sensors))):
        notes.append("the sensors are other ones, or set otherwise")
    if agent_label(agent) != content["agent"]:
        notes.append(f"agent {shown(content['agent'])} was played by {shown(agent_label(agent))} here")
    known = {metric.name for metric in measured}
    if ignored := [name for name in content.get("metrics", {}) if name not in known]:
        notes.append(f"not compared, as --metric was not given: {', '.join(ignored)}")
    equal = not problems and not any(each.differs for each in replayed)
    return Verification(
        hashed,
        "equal" if equal else "differs",
        content["agent"],
        chosen.name,
        agent_label(agent),
        draw,
        share,
        len(rows) + len(faults),
        replayed,
        problems,
        notes,
        content["versions"],
        here,
        digests,
        tasks,
    )


def _json(content):
    """`content` as it is once it was in a JSON file."""
    return json.loads(json.dumps(content))


def _check_repeatable(content, agent, source):
    """Raises UsageError for results that can't be played again, and where the agent is not at hand."""
    from bson.agents import agent_names
    from bson.interfaces.drive import NAME

    name = content["agent"]
    if name == NAME:
        raise UsageError(f"'{source}' has what a person drove, which no program plays again: it can't be verified.")
    if (engine := content.get("engine", "native")) != "native":
        raise UsageError(
            f"'{source}' was played by the engine {shown(engine)}, which agrees to a tolerance, not bit for bit: "
            "evaluate without --engine."
        )
    if content.get("real_time"):
        raise UsageError(f"'{source}' was played in real time, which does not come twice: evaluate in lockstep.")
    if agent is None and name not in agent_names():
        raise UsageError(f"The agent {shown(name)} of '{source}' does not come with this package: give it by --agent.")


def _track(content, make_agent, track, sensor, source):
    """The track and the sensors, as make_track takes them: those given, or those of the results, or the agent's own.
    Raises UsageError for others that the results name: no code that they name is run."""
    from bson.episodes.tracks import SENSOR_KIND, TRACK_KIND, sensor_label

    found, told = [], [*(content.get("track") or []), None, None]
    for what, label, given, kind, own, called in (
        ("track", told[0], track, TRACK_KIND, make_agent.track, make_agent.track),
        ("sensor", told[1], sensor, SENSOR_KIND, make_agent.sensor, sensor_label(make_agent.sensor)),
    ):
        if given is None and label not in (None, called, *kind.names()):
            raise UsageError(f"The {what} {shown(label)} of '{source}' does not come with this package: give --{what}.")
        found.append(given or (label if label in kind.names() else own))
    return tuple(found)


def _difference(was, now):
    """{metric: (was, is)} of what differs between two rows of an episode, in what both have."""
    if ("what" in was) != ("what" in now):
        return {"fault": (was.get("what"), now.get("what"))}
    return {name: (was[name], now[name]) for name in was if name in now and was[name] != now[name]}


def _missing(suite, played, cells, frozen):
    """A line for each cell in which other episodes were `played`, {(cell, seed)}, than its first ones in the suite, and
    where they are not of the `frozen` set, or are, against what the results say."""
    seeds = {name: [seed for cell, seed in played if cell == name] for name in cells}
    most = max(map(len, seeds.values()))
    ((stride, _),) = collections.Counter(suite.stride(seed) for _, seed in played).most_common(1)
    try:
        wanted = dict(zip((c.name for c in suite.cells), suite.of_cells(most, stride), strict=True))
    except ValueError as error:
        return [f"more episodes than the suite has: {error}"]
    lines = [f"cell '{name}' was not played" for name in wanted if name not in cells]
    if frozen != (stride == 0):
        lines.append(f"frozen_seeds is {json.dumps(frozen)}, the seeds are those of --seed {stride}")
    for name in cells:
        for what, found in (
            ("left out", [seed for seed in wanted[name] if seed not in seeds[name]]),
            ("no episodes of the suite", [seed for seed in seeds[name] if seed not in wanted[name]]),
        ):
            if found:
                lines.append(
                    f"cell '{name}': {what}: seeds {', '.join(map(str, found[:10]))}{'...' * (len(found) > 10)}"
                )
    return lines


def _other_settings(theirs, ours):
    """A line for each field of a cell's configuration that is not the suite's. theirs, ours: {cell: {field: value}}."""
    return [
        f"cell '{cell}': {field} was {shown(config[field])}, the suite has {shown(ours[cell][field])}"
        for cell, config in theirs.items()
        for field in config
        if field in ours[cell] and config[field] != ours[cell][field]
    ]


def _other_means(content):
    """A line for each summary, of all episodes or of a cell, that does not follow from the episodes."""
    from bson.evaluation.metrics import metrics_of
    from bson.evaluation.statistics import summarise_runs

    names = [metric.name for metric in metrics_of(content)]
    parts = [("all episodes", content, content["episodes"])]
    parts += [
        (f"cell '{cell['name']}'", cell, [row for row in content["episodes"] if row["cell"] == cell["name"]])
        for cell in content["cells"]
        if "summary" in cell
    ]
    lines = []
    for where, told, rows in parts:
        measured = [
            {name: math.inf if row[name] is None else row[name] for name in names if name in row} for row in rows
        ]
        found = summarise_runs([measured], np.array([row["seed"] for row in rows])) if rows else {}
        for name in sorted({*told["summary"], *found}):
            row, nothing = found.get(name, {}), [None, None]
            was = [told["summary"].get(name), *told.get("intervals", {}).get(name, nothing)]
            now = [row.get(key) for key in ("mean", "low", "high")]
            if None in was + now or not np.allclose(np.array(was), np.array(now), _TOLERANCE, _TOLERANCE):
                told_and_found = [f"{each[0]} in [{each[1]}, {each[2]}]" for each in (was, now)]
                lines.append(
                    f"{name} of {where}: the mean was {told_and_found[0]}, its episodes have {told_and_found[1]}"
                )
    return lines


def format_verification(record: Verification) -> str:
    """A Verification as plain text."""
    differ = [each for each in record.episodes if each.differs]
    verdict = f"{len(differ)} of them differ" if differ else "all equal, bit for bit"
    lines = [
        f"{record.agent} on {record.suite}: {len(record.episodes)} of {record.count} episodes played again "
        f"(draw {record.draw}): {verdict}"
    ]
    for each in differ:
        told = ", ".join(f"{name} was {was}, is {now}" for name, (was, now) in each.differs.items())
        told = told if len(told) <= _METRIC else f"{told[:_METRIC]}... ({len(each.differs)} metrics)"
        lines.append(f"  cell '{each.cell}', seed {each.seed}: {told}")
    lines += [f"does not hold: {problem}" for problem in record.problems]
    lines += [f"note: {note}" for note in record.notes]
    return "\n".join(lines)
