"""The benchmark for Python: the commands `bson evaluate`, `compare`, `leaderboard`, `verify`, `render`, `record`,
`replay`, `ros`, `deploy`, `dataset` and `train` as calls.

    from bson import benchmark

    results = benchmark.evaluate(agent, "smoke", out="results/mine")
    results.metrics["SNS"]  # (episodes,), see bson.evaluation.results.Results

Errors that a user can mend are ValueErrors of one line, most of them macid.files.UsageError. Heavy modules are loaded
when they are needed: comparing results loads neither JAX nor MuJoCo.
"""

import contextlib
import dataclasses
import functools
import json
import pathlib
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from bson.episodes.record import Episode
from bson.evaluation.results import Results
from bson.evaluation.verify import verify as verify
from macid.executors import Executor, make_executor
from macid.files import (
    UsageError,
    check_file,
    check_folder,
    lock_folder,
    new_folder,
    output_folder,
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
    executor, ray_address, workers: see macid.executors.make_executor. engine: "native", or "warp", which plays all
    episodes of a cell at once on a device, for agents that are learned policies. stamped, real_time, timeout: of the
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
    make_agent = _Other(track, sensor) if agent == ROS else load_agent(agent, untrained)
    wanted = track or make_agent.track, sensor or make_agent.sensor
    seen = make_track(*wanted)
    check_settings(make_agent, [cell.config for cell in cells], seen)
    for cell, each in zip(cells, seeds, strict=True):
        _check_spawn(cell.config, each)
    follows_from = basis(name, wanted, cells, paired)
    if engine != "native":
        check_engine(engine, agent, wanted, executor, paired)
        follows_from["engine"] = engine
    if agent == ROS and real_time:
        follows_from["real_time"] = True
    if record:
        _check_record(out, engine)
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
            make_agent = held.enter_context(_on_the_wire(stamped, real_time, timeout))
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
                functools.partial(_bar, name, len(cells) > 1, quiet),
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
        bags = _record_ends(played, cells, seen, folder / "bags", content) if record else []
        films, why_not = _films(played, cells, seen, folder / "videos", videos, name, quiet)
        report = make_report(content, [e for each in played for e in each], films, why_not)
        write_bytes(folder / "report.html", report.encode())
        assert unfinished is not None  # as `out` is a folder
        unfinished.discard()
    return dataclasses.replace(
        found, written=(folder / "results.json", folder / "report.html", *bags, *(path for path, _ in films))
    )


ROS = "ros"  # the agent that drives on the other side of ROS 2


class _Other:
    """What the agent on the other side of ROS 2 wants to be given."""

    takes_setting = False

    def __init__(self, track, sensor):
        from bson.interfaces import ros

        ros.check()
        self.track, self.sensor = track or "local", sensor or "lidar2d"

    def __call__(self, setting=None):
        raise TypeError("It drives once it is on the wire.")


def _on_the_wire(stamped, real_time, timeout):
    """A context manager of the agent on the other side of ROS 2, as run_episodes takes it."""
    from bson.interfaces import ros_world

    return ros_world.agent(stamped, not real_time, timeout)


def _check_record(out, engine):
    """Raises UsageError where an evaluation can't record its episodes."""
    from bson.interfaces import bag

    bag.check()
    if out is None:
        raise UsageError("record writes bags beside the results: give the folder `out`, too.")
    if engine != "native":
        raise UsageError(f"The engine '{engine}' keeps no actions, which bags are made from: leave --record out.")
    check_folder(pathlib.Path(out) / "bags")


def _record_ends(played, cells, track, folder, content):
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


def _bag_name(cell, several, seed):
    return f"seed-{seed}{'-' + cell.slug if several else ''}"


_ABOUT = ("suite_digest", "task_digest", "overrides", "frozen_seeds", "versions", "command")  # keys of results.json


def _about(cell, content):
    """What the bags of a `cell` tell beside their episodes. content: that of results.json."""
    from bson.interfaces import bag

    more = {key: content[key] for key in _ABOUT}
    return bag.about(content["agent"], content["suite"], cell, content["track"], content["sensors"], **more)


def _evaluation_folder(out):
    """`out` as a Path, if an evaluation can write all its files there. Raises UsageError."""
    folder = check_folder(out)
    for file in (folder / "results.json", folder / "report.html", *(folder / "videos").glob("seed-*.webm")):
        check_file(file)
    check_folder(folder / "videos")
    return folder


def _check_spawn(config, seeds):
    """Draws the episodes `seeds`, so that a map without room is refused before anything runs."""
    import numpy as np

    from bson.task import spawn

    for seed in seeds:
        spawn(config, np.random.default_rng(seed))


@contextlib.contextmanager
def _bar(name, several, quiet, cell, without_robot, total, done):
    """A progress bar on stderr, for the argument `watch` of play_cells."""
    from tqdm import tqdm

    told = f"{name}: {cell}" if several and cell is not None else name
    if without_robot:
        told += ", without the robot"
    with tqdm(total=total, initial=done, unit="episode", desc=told, file=sys.stderr, smoothing=0, disable=quiet) as bar:
        steps, shown = 0, time.monotonic()

        def progress(control_steps, ended):
            nonlocal steps, shown
            steps += control_steps
            bar.update(ended)
            if not quiet and (ended or time.monotonic() - shown > 0.2):
                shown = time.monotonic()
                bar.set_postfix_str(f"{steps / max(bar.format_dict['elapsed'], 1e-9):,.0f} steps/s", refresh=True)

        yield progress


def to_film(played: Sequence[Sequence[Episode]], number: int) -> list[tuple[int, Episode, str]]:
    """The episodes to film, each as (the cell's place, the episode, a description of it).

    played: the episodes of each cell. With one cell: `number` of its episodes, evenly from the worst SNS to the best.
    With several cells: the worst episode of each of the `number` worst cells, and the best episode of the best cell.
    """
    from bson.evaluation.metrics import sns, spread_by_score

    if len(played) == 1:
        chosen = [(0, episode) for episode in spread_by_score(played[0], number)]
        kinds = {len(chosen) - 1: "the best episode", 0: "the worst episode"}
    else:
        ranked = sorted(
            ((place, sorted(episodes, key=sns)) for place, episodes in enumerate(played) if episodes),
            key=lambda cell: sum(map(sns, cell[1])) / len(cell[1]),
        )
        chosen = [(place, episodes[0]) for place, episodes in ranked[:number]]
        kinds = dict.fromkeys(range(len(chosen)), "its worst episode") | {0: "the worst cell's worst episode"}
        best, episodes = ranked[-1]
        if all(episode is not episodes[-1] for _, episode in chosen):
            kinds[len(chosen)] = "the best cell's best episode"
            chosen.append((best, episodes[-1]))
    return [(*each, kinds.get(rank, "")) for rank, each in enumerate(chosen)]


def _films(played, cells, track, folder, number, name, quiet):
    """Films episodes (see to_film); returns (path, caption) pairs, and the reason if there are none.

    played: the episodes of each of `cells`.
    """
    from tqdm import tqdm

    from bson.episodes import film
    from bson.evaluation.metrics import sns
    from bson.simulation.scene import build_model
    from macid import drawing

    if number == 0:
        return [], "No films were asked for (--videos 0)."
    if problem := drawing.gl_problem():
        print(f"No video: {problem}", file=sys.stderr)
        return [], f"No video: {problem}"
    output_folder(folder)
    model = functools.cache(lambda config: build_model(config, track.sensors))
    made = []
    chosen = to_film(played, number)
    for place, episode, kind in tqdm(chosen, unit="film", desc="filming", file=sys.stderr, disable=quiet):
        cell, several = cells[place], len(cells) > 1
        path = folder / f"seed-{episode.seed}{'-' + cell.slug if several else ''}.webm"
        film.film(model(cell.config), episode, path, title=f"{name}: {cell.name}" if several else name)
        where = f" in '{cell.name}'" if several else ""
        made.append((path, f"seed {episode.seed}{where}{kind and f', {kind}'}: SNS {sns(episode):.1f}"))
    return made, ""


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
    make_agent = _Other(track, sensor) if agent == ROS else load_agent(agent, untrained)
    wanted = track or make_agent.track, sensor or make_agent.sensor
    seen = make_track(*wanted)
    check_settings(make_agent, [cell.config for cell in cells], seen)
    for cell in cells:
        _check_spawn(cell.config, seeds)
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
    with _on_the_wire(stamped, real_time, timeout) if agent == ROS else contextlib.nullcontext(make_agent) as driver:
        for cell in cells:
            called = functools.partial(_bag_name, cell, several)
            with (
                _bar(name, several, quiet, cell.name, False, len(seeds), 0) as bar,
                new_folder(folder),
                bag.recordings(folder, called, _about(cell, content), stamped) as watch,
            ):

                def progress(steps, episode, bar=bar):
                    bar(steps, episode is not None)

                run_episodes(driver, cell.config, seen, seeds, name, progress, watch=watch)
            written += [folder / called(one) for one in seeds]
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


def ros(
    *,
    suite: str | None = None,
    seed: int = 0,
    episodes: int | None = None,
    track: str = "local",
    sensor: Any = "lidar2d",
    overrides: dict[str, Any] | None = None,
    lockstep: bool = False,
    stamped: bool = True,
    timeout: float = 10.0,
    told: Callable[[str], object] = print,
) -> None:
    """A world as a ROS 2 node, as `bson ros` does (extra `ros`; see bson.interfaces.ros_world).

    suite: the suite whose episodes are played one after another, `episodes` of each cell; None: the episode `seed` of
    the paper's setting, and then those that the node's service begins. lockstep: whether the world waits for one
    command in each control step, at most `timeout` [s]. stamped: whether commands are TwistStamped, not Twist. told:
    called with a line on each episode that ended. Raises UsageError.
    """
    from bson.episodes.tracks import make_track
    from bson.evaluation.metrics import sns
    from bson.evaluation.suites import load_suite
    from bson.interfaces import ros as connection
    from bson.interfaces import ros_world
    from bson.task import TaskConfig

    connection.check()
    changes, seen = overrides or {}, make_track(track, sensor)
    if suite is None:
        if episodes is not None:
            raise UsageError("--episodes is a number of a suite's episodes: give --suite, too.")
        plan, config = None, TaskConfig().replace(**changes)
        _check_spawn(config, [seed])
    else:
        chosen = load_suite(suite)
        plan = [(cell.config.replace(**changes), one) for cell in chosen.cells for one in chosen.drawn(episodes, seed)]
        for each, one in plan:
            _check_spawn(each, [one])
        config = plan[0][0]

    def ended(episode):
        how = episode.fault or ("arrived" if episode.arrived else "timed out")
        told(
            f"seed {episode.seed}: SNS {sns(episode):.1f}, {how} after {episode.duration:.1f} s, "
            f"{episode.collisions} collisions"
        )

    ros_world.serve(plan, config, seen, seed, stamped, lockstep, timeout, ended)


def deploy(
    agent: Any,
    *,
    robot: str = "jackal",
    period: float = 0.1,
    untrained: bool = False,
    stamped: bool = True,
    timeout: float = 10.0,
    goal_frames: Sequence[str] = (),
) -> None:
    """Drives a robot with an agent until it is interrupted, as `bson deploy` does (extra `ros`; see
    bson.interfaces.ros_agent, also for the arguments). agent: as for `evaluate`. Raises UsageError."""
    from bson.agents import agent_label, load_agent
    from bson.interfaces import ros as connection
    from bson.interfaces import ros_agent
    from bson.robot import robot_config

    connection.check()
    factory = load_agent(agent, untrained)
    ros_agent.drive(factory, agent_label(agent), robot_config(robot), period, stamped, timeout, goal_frames)


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
        _check_spawn(one.config, seeds)
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
        with _bar(called, False, quiet, None, False, len(seeds) * len(cells), 0) as bar:

            def progress(steps, episode, bar=bar):
                bar(steps, episode is not None)

            datasets.write(folder, its_name, made, called, cells, wanted, seeds, about, progress)
    return [folder for *_, folder in planned]


def _word(name):
    """`name` as a word of a dataset's id."""
    return "".join(c if c.isalnum() or c in "-_" else "-" for c in name)


def _loaded(results):
    """The Results given, or those read from the folder or file of that name."""
    return results if isinstance(results, Results) else Results.load(results)


def compare(results: Sequence[Any], out: str | pathlib.Path | None = None) -> dict[str, Any]:
    """Results beside each other, with paired differences from the first, as `bson compare` does: the content of
    compare.json.

    results: Results, or folders that an evaluation wrote, or their results.json, or bson.reporting.compare.Groups of
    Results: the trainings of one agent, with intervals over these, too (see bson.evaluation.statistics). out: folder
    for compare.json and compare.html; None: nothing is written. Raises ValueError where they can't be compared.
    """
    from bson.reporting.compare import Group, compare, make_page
    from bson.reporting.page import publish

    content = compare([each if isinstance(each, Group) else _loaded(each) for each in results])
    if out is not None:
        publish(out, "compare", content, make_page(content))
    return content


def heatmap(results: Results | str | pathlib.Path, metric: str = "SNS", out: str | pathlib.Path | None = None) -> str:
    """A metric over the cells of a suite, drawn as the report draws the SNS: an HTML page.

    results: one item, as for `compare`. metric: a name of bson.evaluation.metrics.METRICS. out: an .html file to write.
    Raises UsageError where the suite has one cell only, or the metric is unknown.
    """
    from bson.evaluation.metrics import METRICS
    from bson.reporting.heatmap import Scale, Tile, cell_maps
    from bson.reporting.page import render

    found, known = _loaded(results), {one.name: one for one in METRICS}
    cells = found.content["cells"]
    if metric not in known:
        raise UsageError(f"Unknown metric '{metric}'. Choose one of {', '.join(known)}.")
    if len(cells) < 2:
        raise UsageError(
            f"The results of '{found.agent}' on '{found.suite}' have one cell only: there is nothing to map."
        )
    tiles = [
        Tile(cell["grades"], cell["summary"].get(metric), *cell["intervals"].get(metric, (None, None)))
        for cell in cells
    ]
    values = [end for tile in tiles if tile.value is not None for end in (tile.low, tile.high) if end is not None]
    share = known[metric].unit == "share" or metric in ("RC", "SP", "PE", "SPL")
    most = 100.0 if metric == "SNS" else 1.0 if share else max([*values, 1e-9])
    scale = Scale(min([0.0, *values]), max([most, *values]), known[metric].better or "up")
    drawn = cell_maps(tiles, scale, metric, f"{known[metric].unit} {known[metric].better}".strip())
    title = f"{metric} of {found.agent} on {found.suite}"
    page = render("cells.html", title=title, what=known[metric].what, axes=len(cells[0]["grades"]), map=drawn)
    if out is not None:
        write_bytes(check_file(out), page.encode())
    return page


def leaderboard(
    results: Sequence[Results | str | pathlib.Path],
    readme: str | pathlib.Path | None = None,
    *,
    out: str | pathlib.Path | None = None,
    everything: bool = False,
    told: Callable[[str], object] = lambda line: None,
) -> str:
    """Results as Markdown tables, sorted by SNS, as `bson leaderboard` does.

    results: Results that were read from files, or these folders or files. readme: a file that gets the tables too,
    between its marks. out: folder for board.json and board.html, of the results that `verify` found equal; everything:
    also of the others, marked. told: called with a line for each that is left out or marked. Raises ValueError where
    results of one suite have different episodes.
    """
    from bson.reporting.board import publish
    from bson.reporting.leaderboard import fill_readme, leaderboard

    found = [_loaded(each) for each in results]
    text = leaderboard(found)
    if out is not None:
        for line in publish(found, out, everything):
            told(line)
    if readme is not None:
        fill_readme(readme, text)
    return text


def film(
    agent: Any,
    out: str | pathlib.Path = "episode.webm",
    *,
    seed: int = 0,
    step: int | None = None,
    track: str | None = None,
    sensor: Any = None,
    overrides: dict[str, Any] | None = None,
    untrained: bool = False,
    quiet: bool = False,
) -> pathlib.Path:
    """Films the episode `seed` of an agent, as `bson render` does; returns the path.

    out: a .webm film, or a .png picture of the control step `step` (default: halfway; -1 is the last). The other
    arguments are as for `evaluate`. Where the request can't be met, raises UsageError before anything is played.
    """
    from bson.agents import agent_label, check_settings, load_agent
    from bson.episodes import film
    from bson.episodes.tracks import make_track
    from bson.evaluation.play import run_episodes
    from bson.simulation.scene import build_model
    from bson.task import TaskConfig
    from macid import drawing

    config, name = TaskConfig().replace(**overrides or {}), agent_label(agent)
    make_agent = load_agent(agent, untrained)
    seen = make_track(track or make_agent.track, sensor or make_agent.sensor)
    check_settings(make_agent, [config], seen)
    path = pathlib.Path(out)
    if path.suffix not in (".webm", ".png"):
        raise UsageError(f"--out must end in .webm (a film) or .png (a picture), not '{path.name}'.")
    check_file(path)
    if problem := drawing.gl_problem():
        raise UsageError(f"No pictures here: {problem}")
    _check_spawn(config, [seed])
    with _bar(name, False, quiet, None, False, 1, 0) as bar:

        def progress(steps, episode):
            bar(steps, episode is not None)

        (episode,) = run_episodes(make_agent, config, seen, [seed], name, progress)
    if episode.fault:
        raise UsageError(f"Physics failed in the episode of seed {seed}: {episode.fault}. Choose another --seed.")
    model = build_model(config, seen.sensors)
    if path.suffix == ".png":
        step = len(episode.pose) // 2 if step is None else step
        if not -len(episode.pose) <= step < len(episode.pose):
            raise UsageError(f"--step must be below {len(episode.pose)}, the episode's length, not {step}.")
        with new_folder(path.parent):
            film.still(model, episode, path, step)
    else:
        with new_folder(path.parent):
            film.film(model, episode, path, title=name)
    return path


def live(
    agent: Any = None,
    out: str | pathlib.Path = "human",
    *,
    suite: str | None = None,
    cell: str | None = None,
    seed: int = 0,
    track: str | None = None,
    sensor: Any = None,
    overrides: dict[str, Any] | None = None,
    untrained: bool = False,
    host: str = "127.0.0.1",
    port: int = 8080,
    token: str | None = None,
    stays: bool = False,
    command: str | None = None,
) -> None:
    """Serves pages to drive in, as `bson live` does; returns once the last page has been closed.

    agent: drives at first, as of `evaluate`; None: the person does. out: folder for the episodes that a person drives
    from beginning to end: results.json of the agent `human`, and episodes/, from which `train` with demonstrations=out
    learns. suite, cell: whose settings and seeds are driven, with `seed` as of `evaluate`; without a suite the default
    task, and the seeds from `seed` on. host, port, token: where to listen, see macid.live.server.Server. stays: also
    without pages. The rest as of `evaluate`. Raises UsageError.
    """
    from macid.live.server import check_address, load_viser, serve

    check_address(host, token)
    load_viser()
    from bson.agents import agent_label, check_settings, load_agent
    from bson.episodes.tracks import make_track
    from bson.evaluation.driven import Driven, score_so_far
    from bson.evaluation.suites import Cell, load_suite
    from bson.interfaces.drive import PERSON, Course
    from bson.interfaces.live import DrivePage, DriveSetting
    from bson.task import TaskConfig
    from macid.documents import shown

    changes = overrides or {}
    if suite is None:
        if cell is not None:
            raise UsageError("--cell is one of a suite: give --suite, too.")
        cells, seeds, digest, called = [Cell((), TaskConfig())], (), None, "live"
    else:
        chosen = load_suite(suite)
        cells, seeds, digest, called = chosen.cells, tuple(chosen.drawn(None, seed)), chosen.digest, chosen.name
    cells = [dataclasses.replace(each, config=each.config.replace(**changes)) for each in cells]
    settings = {each.name: each.config for each in cells}
    if cell is not None and cell not in settings:
        raise UsageError(f"Suite '{suite}' has no cell {shown(cell)}. Choose one of {', '.join(map(repr, settings))}.")
    course = Course(settings, seeds, seed)
    begun_with = (track or "local", sensor or "lidar2d")
    seen = make_track(*begun_with)
    if agent is not None:
        factory = load_agent(agent, untrained)
        check_settings(factory, settings.values(), make_track(track or factory.track, sensor or factory.sensor))
    for config in settings.values():
        _check_spawn(config, [course.after(None)])
        for one in seen.sensors:
            one.every(config.control_period)
    name = PERSON if agent is None else agent_label(agent)
    setting = DriveSetting(course, cell or cells[0].name, agent or PERSON, name, track, sensor, untrained)
    with lock_folder(out, ["results.json"]) as folder:
        driven = Driven(
            folder,
            called,
            cells,
            begun_with,
            suite_digest=digest if not changes else None,
            overrides={key: str(value) for key, value in changes.items()},
            frozen_seeds=suite is not None and seed == 0,
            command=command,
        )
        serve(
            lambda client: DrivePage(client, setting, score_so_far, driven.keep, driven.seeds),
            "bson live",
            host,
            port,
            token,
            stays,
        )
    with contextlib.suppress(OSError):
        folder.rmdir()  # where nobody has driven


@contextlib.contextmanager
def agents_extra() -> Iterator[None]:
    """Where the extra `agents` is missing, raises an error that tells what to install."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise UsageError(f"Training needs {error.name}: pip install 'bson-macid[agents]'.") from None


def train(
    algo: str = "ppo",
    out: str | pathlib.Path = "runs",
    *,
    seed: int = 0,
    seeds: int = 1,
    steps: int = 1_000_000,
    worlds: int = 16,
    preset: str = "fast",
    overrides: dict[str, Any] | None = None,
    demonstrations: str | None = None,
    inputs: str = "scans",
    draw: str | None = None,
    teacher: str | None = None,
    start: str | None = None,
    resume: bool = False,
    tensorboard: bool = False,
    executor: str | Executor = "local",
    ray_address: str | None = None,
    workers: int | None = None,
) -> list[pathlib.Path]:
    """Trains robots, as `bson train` does; returns the folders `out`/NAME-SEED of the seeds `seed` to `seed` + `seeds`
    - 1.

    algo: a name of bson.learning.train.ALGORITHMS, or the user's own `file.py:class`; preset: a name of PRESETS. steps:
    control steps of all worlds together. worlds: how many are stepped at once. overrides: fields of TaskConfig that are
    changed. demonstrations: of bc, what to learn from in place of an expert: a Minari dataset, its id or its folder, or
    the folder `out` of `live`, with what people drove. inputs: what the robot sees, a name of
    bson.agents.learned.KINDS; draw: settings drawn for the episodes, a name of bson.learning.draw.draw_names() or a
    .toml file; teacher: of bc with a recurrent robot, the agent whom it imitates; start: of ppo with one, the policy
    from which it goes on, a shipped one or a .npz file. resume: goes on from checkpoints.
    executor, ray_address, workers: see macid.executors.make_executor; an executor with several workers trains the seeds
    side by side. Raises UsageError, also where the extra `agents` is missing.
    """
    with agents_extra():
        from bson.learning.train import TrainConfig, hyperparameters

    chosen = hyperparameters(algo, preset)
    if demonstrations is not None:
        from bson.learning.dataset import check_demonstrations
        from bson.task import TaskConfig

        if algo != "bc":
            raise UsageError(f"--demonstrations are what bc learns from, not {algo}: leave them out.")
        if executor != "local":
            raise UsageError("--demonstrations are read in this process: leave --executor out.")
        check_demonstrations(demonstrations, TaskConfig().replace(**overrides or {}))
        chosen = dataclasses.replace(chosen, demonstrations=demonstrations)
    if inputs != "scans" and preset == "fast" and demonstrations is None:
        chosen = None  # what learns with these inputs
    if teacher is not None:
        chosen = _pupils_hyperparameters(algo, inputs, teacher)
    more = {"hyperparameters": chosen, "inputs": inputs, "draw": draw, "start": start}
    configs = [TrainConfig(algo, one, int(steps), overrides or {}, worlds, **more) for one in range(seed, seed + seeds)]
    return train_configs(configs, out, resume, tensorboard, executor, ray_address, workers)


def _pupils_hyperparameters(algo, inputs, teacher):
    from bson.agents import load_agent
    from bson.learning.dagger import DaggerConfig

    if algo != "bc" or inputs == "scans":
        raise UsageError(
            f"--teacher is whom bc imitates with --inputs gru, gru-map, camera or gru-scans, not {algo} on {inputs}."
        )
    load_agent(teacher)
    return DaggerConfig(teacher)


def train_configs(
    configs: Sequence[Any],
    out: str | pathlib.Path,
    resume: bool = False,
    tensorboard: bool = False,
    executor: str | Executor = "local",
    ray_address: str | None = None,
    workers: int | None = None,
) -> list[pathlib.Path]:
    """As `train`, for a list of TrainConfigs."""
    with agents_extra():
        from bson.learning import train as training
    from macid import start

    start.cleaning_up()
    with make_executor(executor, ray_address, workers) as runner:
        if runner.workers is None:
            return [training.train_with_bar(config, out, resume, tensorboard) for config in configs]
        if tensorboard:
            raise UsageError("--tensorboard is for trainings in this process: leave it out with --executor ray.")
        return training.train_apart(runner, configs, out, resume)
