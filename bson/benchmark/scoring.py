"""An agent's score on a suite."""

import contextlib
import dataclasses
import functools
import json
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

from bson.benchmark.bags import check_record, record_ends
from bson.benchmark.episodes import cells_bar, check_spawn
from bson.benchmark.films import film_episodes
from bson.benchmark.wire import ROS, OtherSide, on_the_wire
from bson.evaluation.results import Results
from macid.executors import Executor, make_executor
from macid.files import (
    UsageError,
    check_file,
    check_folder,
    lock_folder,
    remove_leftovers,
    write_bytes,
)


def evaluate(
    agent: Any,
    suite: str = "paper",
    *,
    passphrase: str | None = None,
    out: str | pathlib.Path | None = None,
    episodes: int | None = None,
    seed: int = 0,
    track: str | None = None,
    sensor: Any = None,
    overrides: dict[str, Any] | None = None,
    untrained: bool = False,
    paired: bool = False,
    metrics: Sequence[str] = (),
    videos: int = 2,
    record: bool = False,
    resume: bool = False,
    executor: str | Executor = "local",
    ray_address: str | None = None,
    workers: int | None = None,
    engine: str = "native",
    stamped: bool = True,
    real_time: bool = False,
    timeout: float = 10.0,
    command: str | None = None,
    told: Callable[[Results], None] | None = None,
    quiet: bool = False,
) -> Results:
    """Scores an agent on a suite, as `bson evaluate` does; returns the Results.

    agent: a name, "module:attribute", "file.py[:attribute]" or "policy.npz", or the agent itself, a function or a class
    (see bson.agents). suite: its name. passphrase: of the suite "held-out", which needs one. out: folder for
    results.json, report.html and videos/; None: nothing is written. episodes: only the first so many of each cell.
    seed: 0 for the suite's own seeds; another number for another set of seeds of the same kind. track, sensor: as for
    bson.episodes.tracks.make_track (default: what the agent wants). overrides: fields of TaskConfig that are changed.
    paired: also plays each episode without the robot. metrics: the user's own metrics, each `module:function` or
    `file.py:function` (see bson.evaluation.metrics). videos: the number of films. record: also writes the worst and the
    best episode to `out`/bags (see `record`). resume: goes on with the evaluation that was cut short in `out`.
    executor, ray_address, workers: see macid.executors.make_executor. engine: "native", or "warp", with or without
    options (warp:contacts=32, see bson.simulation.engines.warp.WarpConfig), which plays all episodes of a cell at once
    on a device, for agents that are JAX functions (bson.evaluation.device_agents). stamped, real_time, timeout: of the
    agent "ros", which is whatever drives on the other side of ROS 2: whether it sends TwistStamped, not Twist; whether
    the world takes a control step each period and does not wait for a command; how long a command may take in lockstep
    [s]. command: the command that `results.json` names as its origin. told: called with the Results once they are
    written, before anything is filmed. quiet: no progress on stderr.

    Results are the same bit for bit with any executor and any number of workers; results of the engine "warp" agree
    with them to a tolerance. Where the request can't be met, raises UsageError or another ValueError, of one line,
    before anything is written.
    """
    from bson.agents import agent_label, check_settings, load_agent
    from bson.episodes.tracks import make_track, sensor_label, sensor_settings
    from bson.evaluation.executors import check_engine, play_cells
    from bson.evaluation.metrics import own_metrics
    from bson.evaluation.play import results, sound
    from bson.evaluation.store import Unfinished, basis, files_digest
    from bson.evaluation.suites import load_suite
    from bson.interfaces.bag import remove_bags
    from bson.reporting.report import make_report

    name, changes = agent_label(agent), overrides or {}
    own = own_metrics(metrics)
    if resume and out is None:
        raise UsageError("resume goes on with what is in the folder `out`: give it.")
    chosen = load_suite(suite, passphrase)
    seeds = chosen.of_cells(episodes, seed)
    cells = [dataclasses.replace(cell, config=cell.config.replace(**changes)) for cell in chosen.cells]
    if agent == ROS and (executor != "local" or engine != "native"):
        raise UsageError("The agent 'ros' drives one world in this process: leave --executor and --engine out.")
    make_agent = OtherSide(track, sensor) if agent == ROS else load_agent(agent, untrained)
    wanted = track or make_agent.track, sensor or make_agent.sensor
    seen = make_track(*wanted)
    check_settings(make_agent, [cell.config for cell in cells], seen)
    for cell, each in zip(cells, seeds, strict=True):
        check_spawn(cell.config, each)
    follows_from = basis(name, wanted, cells, paired)
    if engine != "native":
        check_engine(engine, agent, make_agent, [cell.config for cell in cells], wanted, name, executor, paired)
        follows_from["engine"] = engine
    if agent == ROS and real_time:
        follows_from["real_time"] = True
    if record:
        check_record(out, engine)
    folder = None if out is None else _evaluation_folder(out)
    runner = make_executor(executor, ray_address, workers)
    with contextlib.ExitStack() as held:
        unfinished = None
        if folder is not None:
            held.enter_context(lock_folder(folder))
            unfinished = Unfinished(folder, follows_from, resume)
        found = [
            {one: episode for one in each if unfinished and (episode := unfinished.load(cell, one))}
            for cell, each in zip(cells, seeds, strict=True)
        ]
        if agent == ROS:
            make_agent = held.enter_context(on_the_wire(stamped, real_time, timeout))
        with runner:
            played = play_cells(
                runner,
                agent,
                make_agent,
                untrained,
                name,
                cells,
                wanted,
                seeds,
                found,
                paired,
                functools.partial(cells_bar, name, len(cells) > 1, quiet),
                unfinished.save if unfinished else lambda cell, episode: None,
                engine,
            )
        content = results(
            name,
            chosen.name,
            cells,
            played,
            own,
            suite_digest=chosen.digest if not changes else None,
            task_digest=files_digest(follows_from),
            track=[wanted[0], sensor_label(wanted[1])],
            sensors=sensor_settings(seen.sensors),
            paired=paired,
            overrides={key: str(value) for key, value in changes.items()},
            frozen_seeds=seed == 0,
            command=command,
            **({} if engine == "native" else {"engine": engine}),
            **({"real_time": True} if agent == ROS and real_time else {}),
        )
        found = Results(json.loads(json.dumps(content)), name if out is None else str(out))
        if folder is None:
            if told:
                told(found)
            return found
        # Films and bags that an earlier run left here do not belong to these results.
        remove_leftovers(folder / "videos")
        remove_bags(folder / "bags")
        for stale in (folder / "report.html", *(folder / "videos").glob("seed-*.webm")):
            if not stale.is_symlink():
                stale.unlink(missing_ok=True)
        found.save(folder / "results.json")
        if told:
            told(found)
        played = [sound(each) for each in played]
        bags = record_ends(played, cells, seen, folder / "bags", content) if record else []
        films, why_not = film_episodes(played, cells, seen, folder / "videos", videos, name, quiet)
        report = make_report(content, [e for each in played for e in each], films, why_not)
        write_bytes(folder / "report.html", report.encode())
        assert unfinished is not None  # as `out` is a folder
        unfinished.discard()
    return dataclasses.replace(
        found, written=(folder / "results.json", folder / "report.html", *bags, *(path for path, _ in films))
    )


def _evaluation_folder(out):
    """`out` as a Path, if an evaluation can write all its files there. Raises UsageError."""
    folder = check_folder(out)
    for file in (folder / "results.json", folder / "report.html", *(folder / "videos").glob("seed-*.webm")):
        check_file(file)
    check_folder(folder / "videos")
    return folder
