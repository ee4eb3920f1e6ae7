"""Episodes as jobs of an executor (macid.executors), and the user's files that these jobs need elsewhere."""

import dataclasses
import functools
import math
import pathlib
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from bson.agents import BUILT_IN, learned, load_agent
from bson.episodes.record import Episode
from bson.episodes.tracks import make_track
from bson.evaluation.play import BATCH, pair, run_episodes
from bson.evaluation.suites import Cell
from bson.robot import load_robot
from bson.simulation.engines import engine_limits, engine_name
from bson.task import TaskConfig
from macid.executors import Carried, Executor, carry_files, carry_module
from macid.files import UsageError
from macid.maps import map_files
from macid.registry import own_module, parts

_TELL = 0.2  # between messages on control steps [s]
_MODEL = frozenset(
    [".xml", ".urdf", ".toml", ".stl", ".obj", ".msh", ".mtl", ".dae", ".skn", ".png", ".jpg", ".bin", ".hf"]
)  # endings of a robot's files


@dataclasses.dataclass(frozen=True)
class Play:
    """Episodes of one cell that are to be played. agent: what `load_agent` takes."""

    agent: Any
    config: TaskConfig
    track: tuple[Any, Any]  # as for make_track; None for the sensors that the agent brings
    seeds: tuple[int, ...]
    called: str = "agent"
    untrained: bool = False  # whether the agent may drive in a setting other than that of its training
    engine: str = "native"  # the engine of the worlds, with or without options


@dataclasses.dataclass(frozen=True)
class Pair:
    """Episodes of one cell, whose people are to be played again without the robot."""

    config: TaskConfig
    episodes: tuple[Episode, ...]


def play(job: Play, send: Callable[[Any], None], make_agent: Any = None) -> None:
    """The work of a Play: sends (control steps, Episode or None), the progress of `run_episodes`. make_agent: the
    agent's factory, where it is loaded already."""
    make_agent = make_agent or load_agent(job.agent, job.untrained)
    track, sensor = job.track
    sensor = make_agent.sensor if sensor is None else sensor
    seen = make_track(track, sensor)
    if engine_name(job.engine) == "warp":
        from bson.evaluation.device_agents import device_agent
        from bson.evaluation.on_device import play as play_on_device

        agent = device_agent(job.agent, make_agent, job.config, seen, job.called)
        where = job.config, (track, sensor), job.seeds, engine_limits(job.engine)
        for episode in play_on_device(agent, *where, progress=lambda steps: send((steps, None)), name=job.called):
            send((0, episode))
        return
    run_episodes(make_agent, job.config, seen, job.seeds, job.called, _told_by(send))


def pair_up(job: Pair, send: Callable[[Any], None]) -> None:
    """The work of a Pair: sends (control steps, Episode or None), the progress of `pair`."""
    pair(job.config, job.episodes, _told_by(send))


def _told_by(send):
    """A `progress` for run_episodes: sends each Episode as it ends, and the count of steps now and then."""
    steps, last = 0, time.monotonic()

    def progress(more, episode):
        nonlocal steps, last
        steps += more
        if episode is not None or time.monotonic() - last > _TELL:
            send((steps, episode))
            steps, last = 0, time.monotonic()

    return progress


def check_engine(
    engine: str,
    agent: Any,
    make_agent: Any,
    configs: Sequence[TaskConfig],
    track: tuple[Any, Any],
    called: str,
    executor: Any,
    paired: bool,
) -> None:
    """Raises UsageError where `engine` is no engine, or can't play what is asked: `agent`, of the factory `make_agent`,
    on `track`, as for make_track."""
    engine_limits(engine)
    if engine_name(engine) == "native":
        return
    from bson.evaluation.device_agents import device_agent
    from bson.simulation.batched import check_sensors
    from bson.simulation.engines.warp import check_warp

    if executor != "local" or paired:
        raise UsageError("The engine 'warp' plays in this process, and no pairs: leave --executor and --paired out.")
    if isinstance(make_agent, learned.Factory) and track != (make_agent.track, make_agent.sensor):
        wanted = f"the {make_agent.track} track with {make_agent.sensor}"
        raise UsageError(f"The engine 'warp' plays '{called}' on {wanted}: leave --track and --sensor out.")
    seen = make_track(*track)
    check_sensors(seen.sensors)
    for config in dict.fromkeys(configs):
        device_agent(agent, make_agent, config, seen, called)
    check_warp()


def shares(seeds: Sequence[int], total: int, executor: Executor) -> list[Sequence[int]]:
    """`seeds` of one cell in parts, one for each job: in this process one part; elsewhere parts of at most a batch, so
    that the `total` of episodes makes about two jobs a worker. Results don't depend on the parts."""
    if executor.workers is None:
        return [seeds] if seeds else []
    most = max(1, min(BATCH, math.ceil(total / (2 * executor.workers))))
    return [seeds[first : first + most] for first in range(0, len(seeds), most)]


def carried_agent(agent: Any) -> Carried:
    """The agent's files that travel: its own or its module's file, the modules beside it that it imported, and the
    files that its attribute `files` names, relative to its folder; for a policy its .npz and .json. Installed files
    don't travel."""
    if not isinstance(agent, str):
        return carry_module(getattr(agent, "__module__", None) or "", getattr(agent, "files", ()))
    if agent in BUILT_IN or agent in learned.names():
        return Carried()
    if agent.endswith(".npz"):
        return carry_files(_network(agent))
    return carried_code(agent, "agent")


def carried_code(name: str, attribute: str = "") -> Carried:
    """The files of the user's own code `name` that travel, as in carried_agent; none for another name. attribute: the
    attribute for a file that is given without one."""
    module, (file, given) = own_module(name), parts(name)
    found = getattr(sys.modules.get(module), given or attribute, None)
    top = pathlib.Path(file).parent if file.endswith(".py") else None
    return carry_module(module, getattr(found, "files", ()), top)


def carried_task(config: TaskConfig) -> Carried:
    """The files that a task names, all of which travel: the map's, the robot's folder, pedestrians' policies."""
    files = [] if config.map is None else map_files(config.map)
    if config.robot.name.endswith(".toml"):
        robot = load_robot(config.robot.name)
        for folder in dict.fromkeys([pathlib.Path(config.robot.name).parent, pathlib.Path(robot.model).parent]):
            files += [file for file in folder.rglob("*") if file.suffix.lower() in _MODEL]
    for model in config.model_shares:
        files += _network(model) if model.endswith(".npz") else []
    return sum(map(carried_code, config.model_shares), carry_files(files))


def carried_track(track: tuple[Any, Any]) -> Carried:
    """The files that travel for a track and a sensor, as make_track takes them, where they name the user's own code."""
    return sum((carried_code(each) for each in track if isinstance(each, str)), Carried())


def _network(path):
    return [pathlib.Path(path), pathlib.Path(path).with_suffix(".json")]


def play_each(
    executor: Executor,
    plays: Sequence[Play],
    whole: Callable[[Play, list[Episode]], None],
) -> None:
    """Plays episodes of different agents and settings, all side by side.

    whole: called with each of `plays` once all its Episodes are there, and with these, in the order of its seeds.
    """
    carried = Carried()
    for each in plays:
        carried += carried_agent(each.agent) + carried_task(each.config) + carried_track(each.track)
    found = [{} for _ in plays]
    total = sum(len(each.seeds) for each in plays)
    parts = [(place, share) for place, each in enumerate(plays) for share in shares(each.seeds, total, executor)]

    def receive(index, piece):
        place, episode = parts[index][0], piece[1]
        if episode is not None:
            found[place][episode.seed] = episode
            if len(found[place]) == len(plays[place].seeds):
                whole(plays[place], [found[place].pop(seed) for seed in plays[place].seeds])

    jobs = [_left_to_play(plays[place], share, found[place]) for place, share in parts]
    executor.run(play, jobs, receive, carried)


def play_cells(
    executor: Executor,
    agent: Any,
    make_agent: Any,
    untrained: bool,
    called: str,
    cells: Sequence[Cell],
    track: tuple[Any, Any],
    seeds: Sequence[Sequence[int]],
    found: list[dict[int, Episode]],
    paired: bool,
    watch: Callable[[str | None, bool, int, int], Any],
    keep: Callable[[Cell, Episode], None],
    engine: str = "native",
) -> list[list[Episode]]:
    """The Episodes of each of `cells`, those of its `seeds`.

    make_agent: the factory of `agent`. found: for each cell {seed: Episode} of the episodes that are there; the others
    are added. keep: called with each Episode that ends. watch: called with the cell's name (None: all cells), whether
    the robot is left out, the number of episodes and the number already done; gives a context manager of a function
    progress(control steps, whether an episode ended). paired: also plays without the robot. engine: the engine of the
    worlds, see bson.benchmark.evaluate.
    """
    whole = executor.workers is not None  # workers elsewhere play all cells at once

    brought = not isinstance(track[1], str) and track[1] is getattr(make_agent, "sensor", None)
    seen = (track[0], None) if brought else track  # a worker takes the agent's sensors from the agent

    def play_of(place):
        return Play(agent, cells[place].config, seen, tuple(seeds[place]), called, untrained, engine)

    playing = play if whole else functools.partial(play, make_agent=make_agent)
    carried = Carried()
    if whole:
        carried += carried_agent(agent) + carried_track(track)
        for config in {cell.config: None for cell in cells}:
            carried += carried_task(config)
    for places in [range(len(cells))] if whole else [[place] for place in range(len(cells))]:
        name, all_of_them = None if whole else cells[places[0]].name, sum(len(seeds[place]) for place in places)

        def missing(place):
            return [seed for seed in seeds[place] if seed not in found[place]]

        def unpaired(place):
            each = (found[place][seed] for seed in seeds[place])
            return [one for one in each if not one.fault and one.people_alone is None]

        def run(work, parts, without, done, all_of_them=all_of_them, name=name):
            with watch(name, without, all_of_them, done) as progress:

                def receive(index, piece):
                    steps, episode = piece
                    if episode is not None:
                        place = parts[index][0]
                        keep(cells[place], episode)
                        found[place][episode.seed] = episode
                    progress(steps, episode is not None)

                executor.run(work, [part[1] for part in parts], receive, carried)

        total = sum(len(missing(place)) for place in places)
        parts = [
            (place, _left_to_play(play_of(place), share, found[place]))
            for place in places
            for share in shares(missing(place), total, executor)
        ]
        run(playing, parts, False, all_of_them - total)
        if paired:
            total = sum(len(unpaired(place)) for place in places)
            parts = [
                (place, _left_to_pair(cells[place], share, found[place]))
                for place in places
                for share in shares([one.seed for one in unpaired(place)], total, executor)
            ]
            run(pair_up, parts, True, all_of_them - total)
    return [[each[seed] for seed in own] for each, own in zip(found, seeds, strict=True)]


def _left_to_play(whole, share, found):
    """The job (macid.executors.Job) of the episodes `share` of the Play `whole`, without the episodes `found`, {seed:
    Episode}."""

    def left():
        seeds = tuple(seed for seed in share if seed not in found)
        return dataclasses.replace(whole, seeds=seeds) if seeds else None

    return left


def _left_to_pair(cell, share, found):
    """The job of the episodes `share` of a cell without the robot."""

    def left():
        episodes = tuple(found[seed] for seed in share)
        episodes = tuple(one for one in episodes if not one.fault and one.people_alone is None)
        return Pair(cell.config, episodes) if episodes else None

    return left
