"""Episodes in bags, rosbag2 folders with MCAP storage: written, and scored again (extra `record`)."""

import contextlib
import dataclasses
import functools
import json
import pathlib
import sys
from collections.abc import Sequence
from typing import Any

from bson.benchmark.episodes import check_spawn, episodes_bar
from bson.benchmark.wire import ROS, OtherSide, on_the_wire
from bson.episodes.record import Episode
from bson.evaluation.results import Results
from macid.files import (
    UsageError,
    check_file,
    check_folder,
    new_folder,
)


def record(
    agent: Any,
    out: str | pathlib.Path,
    *,
    suite: str | None = None,
    seed: int = 0,
    episodes: int | None = None,
    track: str | None = None,
    sensor: Any = None,
    overrides: dict[str, Any] | None = None,
    untrained: bool = False,
    stamped: bool = True,
    real_time: bool = False,
    timeout: float = 10.0,
    command: str | None = None,
    quiet: bool = False,
) -> list[pathlib.Path]:
    """Plays an agent and writes each episode to a bag, a rosbag2 folder with MCAP storage, as `bson record` does (extra
    `record`); returns the bags' folders, `out`/seed-N, or `out`/seed-N-CELL where a suite has several cells.

    suite: the name of the suite whose episodes are played, `episodes` of each cell; None: one episode of the paper's
    setting. seed: of that episode, or as for `evaluate` with a suite. stamped: whether commands are TwistStamped
    messages, not Twist. The other arguments are as for `evaluate`. Where the request can't be met, raises UsageError
    before anything is played. Each bag is whole or not there.
    """
    from bson.agents import agent_label, check_settings, load_agent
    from bson.episodes.tracks import make_track, sensor_label, sensor_settings
    from bson.evaluation.play import run_episodes, versions
    from bson.evaluation.store import basis, files_digest
    from bson.evaluation.suites import Cell, load_suite
    from bson.interfaces import bag, messages
    from bson.task import TaskConfig

    bag.check()
    name, changes = agent_label(agent), overrides or {}
    if suite is None:
        if episodes is not None:
            raise UsageError("--episodes is a number of a suite's episodes: give --suite, too.")
        cells, seeds, digest = [Cell((), TaskConfig())], [seed], None
    else:
        chosen = load_suite(suite)
        cells, seeds, digest = chosen.cells, chosen.drawn(episodes, seed), chosen.digest
    cells = [dataclasses.replace(cell, config=cell.config.replace(**changes)) for cell in cells]
    make_agent = OtherSide(track, sensor) if agent == ROS else load_agent(agent, untrained)
    wanted = track or make_agent.track, sensor or make_agent.sensor
    seen = make_track(*wanted)
    check_settings(make_agent, [cell.config for cell in cells], seen)
    for cell in cells:
        check_spawn(cell.config, seeds)
    several = len(cells) > 1
    folder = bag.check_new(out, [_bag_name(cell, several, one) for cell in cells for one in seeds])
    for key in messages.unknown(seen.sensors):
        print(f"not recorded: the sensor '{key}', for which ROS has no message here", file=sys.stderr)
    content = {
        "agent": name,
        "suite": suite or "none",
        "suite_digest": None if changes else digest,
        "task_digest": files_digest(basis(name, wanted, cells, False)),
        "track": [wanted[0], sensor_label(wanted[1])],
        "sensors": sensor_settings(seen.sensors),
        "overrides": {key: str(value) for key, value in changes.items()},
        "frozen_seeds": suite is not None and seed == 0,
        "versions": versions(),
        "command": command,
    }
    written = []
    with on_the_wire(stamped, real_time, timeout) if agent == ROS else contextlib.nullcontext(make_agent) as driver:
        for cell in cells:
            called = functools.partial(_bag_name, cell, several)
            with (
                episodes_bar(name, len(seeds), quiet, cell.name if several else None) as progress,
                new_folder(folder),
                bag.recordings(folder, called, _about(cell, content), stamped) as watch,
            ):
                run_episodes(driver, cell.config, seen, seeds, name, progress, watch=watch)
            written += [folder / called(one) for one in seeds]
    return written


def _bag_name(cell, several, seed):
    return f"seed-{seed}{'-' + cell.slug if several else ''}"


_ABOUT = ("suite_digest", "task_digest", "overrides", "frozen_seeds", "versions", "command")  # keys of results.json


def _about(cell, content):
    """What the bags of a `cell` tell beside their episodes. content: that of results.json."""
    from bson.interfaces import bag

    more = {key: content[key] for key in _ABOUT}
    return bag.about(content["agent"], content["suite"], cell, content["track"], content["sensors"], **more)


def check_record(out: str | pathlib.Path | None, engine: str) -> None:
    """Raises UsageError where an evaluation can't record its episodes."""
    from bson.interfaces import bag

    bag.check()
    if out is None:
        raise UsageError("record writes bags beside the results: give the folder `out`, too.")
    if engine != "native":
        raise UsageError(f"The engine '{engine}' keeps no actions, which bags are made from: leave --record out.")
    check_folder(pathlib.Path(out) / "bags")


def record_ends(
    played: Sequence[Sequence[Episode]], cells: Sequence[Any], track: Any, folder: pathlib.Path, content: dict[str, Any]
) -> list[pathlib.Path]:
    """Writes the worst and the best of the episodes `played`, those of each of `cells`, to bags in `folder`; returns
    their paths. content: that of results.json."""
    from bson.evaluation.metrics import sns
    from bson.evaluation.play import replayed
    from bson.interfaces import bag

    ranked = sorted(
        ((cell, one) for cell, episodes in zip(cells, played, strict=True) for one in episodes),
        key=lambda pair: sns(pair[1]),
    )
    written = []
    for cell, episode in ranked[:1] + ranked[1:][-1:]:
        if episode.actions is None:
            told = f"not recorded: an older version began the evaluation, and kept no actions of seed {episode.seed}"
            print(told, file=sys.stderr)
            continue
        called = _bag_name(cell, len(cells) > 1, episode.seed)
        about = _about(cell, content)
        with bag.recordings(folder, lambda seed, called=called: called, about) as watch:
            again = replayed(episode, cell.config, track, watch)
        assert sns(again) == sns(episode), "an episode and its recording differ"
        written.append(folder / called)
    return written


def replay(bags: Sequence[str | pathlib.Path], out: str | pathlib.Path | None = None) -> Results:
    """Scores recorded episodes again, from the messages in their bags, as `bson replay` does; returns the Results. They
    equal those of the evaluation bit for bit, episode by episode (but for the effects on others of --paired).

    bags: folders that `record` or `evaluate` wrote, or folders of these. out: a folder for results.json. Raises
    UsageError where a bag is damaged, or the bags are of different agents, suites or settings.
    """
    from bson.evaluation.play import results
    from bson.evaluation.suites import Cell
    from bson.interfaces import bag
    from bson.task import TaskConfig

    path = None if out is None else check_file(pathlib.Path(out) / "results.json")
    cells: dict[str, Any] = {}
    there = [(folder, *bag.read(folder)) for folder in bag.bags_in(bags)]
    where, first, _ = there[0]
    for folder, about, episode in there:
        for key in ("agent", "suite", "suite_digest", "task_digest", "track"):
            if (one := getattr(first, key)) != (other := getattr(about, key)):
                told = f"{key} {one!r} in '{where}', and {other!r} in '{folder}'"
                raise UsageError(f"The bags are of different evaluations: {told}. Give those of one.")
        if about.cell not in cells:
            try:
                config = TaskConfig(**about.config)
            except (TypeError, ValueError) as error:
                raise UsageError(f"bag '{folder}', key 'config': {error}") from None
            cells[about.cell] = Cell(tuple(map(tuple, about.grades)), config), {}
        played = cells[about.cell][1]
        if episode.seed in played:
            raise UsageError(f"There are two bags of the seed {episode.seed}, and '{folder}' is the second: give one.")
        played[episode.seed] = episode
    content = results(
        first.agent,
        first.suite,
        [cell for cell, _ in cells.values()],
        [list(played.values()) for _, played in cells.values()],
        suite_digest=first.suite_digest,
        task_digest=first.task_digest,
        track=first.track,
        sensors=first.sensors,
        paired=False,
        overrides=first.overrides,
        frozen_seeds=first.frozen_seeds,
        command=None,
    )
    found = Results(json.loads(json.dumps(content)), str(where) if out is None else str(out))
    if path is not None:
        with new_folder(path.parent):
            found.save(path)
        found = dataclasses.replace(found, written=(path,))
    return found
