"""An agent on many episodes at once: their records, and the results file."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from bson.agents.contract import Setting, act, made_for, reset_agent
from bson.episodes.record import Episode, Recorder
from bson.episodes.session import Session
from bson.episodes.tracks import LocalTrack
from bson.evaluation.metrics import METRICS, Metric, measure, metrics_of
from bson.evaluation.statistics import summarise_runs
from bson.simulation.world import World
from bson.task import TaskConfig
from macid import files

BATCH = 16  # worlds at once


class Watch(Protocol):
    """Watches one episode that is played, from its reset on."""

    def snap(self, action: np.ndarray, reward: float, terminated: bool, truncated: bool, /) -> object:
        """Called after each control step, with the agent's action (2,), as it gave it, and what the step brought."""
        ...

    def end(self, episode: Episode, /) -> object:
        """Called at the end."""
        ...


def run_episodes(
    make_agent: Callable[..., Any],
    config: TaskConfig,
    track: LocalTrack,
    seeds: Sequence[int],
    agent_name: str = "agent",
    progress: Callable[..., object] | None = None,
    batch: int = BATCH,
    nthread: int = 0,
    watch: Callable[[Session, int], Watch] | None = None,
) -> list[Episode]:
    """Plays the episodes `seeds`; returns their Episodes in that order.

    make_agent: gives an agent, a callable, for one world; it is called with the Setting if it takes one (see
    bson.agents). progress(steps, episode): called after each control step of each world, with 1 and the Episode that
    ended in this step, or None. watch(session, index): called as an episode begins in the world `index`; gives its
    Watch. An agent that has to be told of its world's state in this way has such a function as `told_by`, and drives
    one world at a time. An episode does not depend on which others run beside it.
    """
    told_by = getattr(make_agent, "told_by", None)
    nworld, watch = min(1 if told_by else batch, len(seeds)), _both(told_by, watch)
    setting = Setting.of(config, track)
    agents = [made_for(make_agent, setting) for _ in range(nworld)]  # an agent that refuses does so at once
    session = Session(config, track, nworld, nthread=nthread)
    waiting, playing, recorders, done = list(enumerate(seeds)), {}, {}, {}
    observations, watching = {}, {}

    def begin(index):
        if not waiting:
            playing.pop(index, None)
            return
        playing[index], seed = waiting.pop(0)
        observation = session.reset([index], [seed])
        reset_agent(agents[index], seed, agent_name)
        recorders[index] = Recorder(session, index)
        if watch:
            watching[index] = watch(session, index)
        observations[index] = {name: value[0] for name, value in observation.items()}

    for index in range(nworld):
        begin(index)
    while playing:
        ids = sorted(playing)
        actions = np.stack([act(agents[index], observations[index], agent_name) for index in ids])
        observation, reward, terminated, truncated = session.step(ids, actions)
        for row, index in enumerate(ids):
            recorders[index].snap(actions[row])
            if watch:
                watching[index].snap(actions[row], reward[row], terminated[row], truncated[row])
            observations[index] = {name: value[row] for name, value in observation.items()}
            ended = terminated[row] or truncated[row]
            if ended:
                done[playing[index]] = recorders[index].episode()
                if watch:
                    watching[index].end(done[playing[index]])
            if progress:
                progress(1, done[playing[index]] if ended else None)
            if ended:
                begin(index)
    return [done[number] for number in range(len(seeds))]


def _both(first, second):
    """One `watch` for two, of which each may be None."""
    if first is None or second is None:
        return first or second

    class Both:
        def __init__(self, session, index):
            self._watches = [each(session, index) for each in (first, second)]

        def snap(self, *told):
            for each in self._watches:
                each.snap(*told)

        def end(self, episode):
            for each in self._watches:
                each.end(episode)

    return Both


def pair(
    config: TaskConfig,
    episodes: Sequence[Episode],
    progress: Callable[..., object] | None = None,
    batch: int = BATCH,
    nthread: int = 0,
) -> list[Episode]:
    """`episodes` of one configuration, each with its pair: the same people for as long a time, without the robot.

    People begin as in the episode and go to the same goals; later goals are drawn from the same stream, in the order in
    which people ask for them. An episode that failed, or that has its pair already, stays as it is. progress is called
    as by `run_episodes`.
    """
    paired = list(episodes)
    todo = [number for number, episode in enumerate(episodes) if not episode.fault and episode.people_alone is None]
    todo.sort(key=lambda number: -len(episodes[number].pose))
    if not todo:
        return paired
    world = World(config, min(batch, len(todo)), nthread=nthread, with_robot=False)
    for first in range(0, len(todo), batch):
        numbers = todo[first : first + batch]
        ids, rows = np.arange(len(numbers)), np.array([len(episodes[number].pose) for number in numbers])
        world.reset(ids, [episodes[number].seed for number in numbers])
        people = [world.people[ids]]
        while len(going := ids[rows > len(people)]):
            world.step(going, np.zeros((len(going), 2)))
            people.append(world.people[ids])
            for index in going:
                ended = rows[index] == len(people)
                if ended:
                    fault = world.fault[index] and f"without the robot: {world.fault[index]}"
                    alone = np.array([row[index] for row in people])
                    number = numbers[int(index)]
                    paired[number] = dataclasses.replace(episodes[number], people_alone=alone, fault=fault)
                if progress:
                    progress(1, paired[numbers[index]] if ended else None)
    return paired


def results(
    agent: str,
    suite: str,
    cells: Sequence[Any],
    played: Sequence[Sequence[Episode]],
    own: Sequence[Metric] = (),
    **more: Any,
) -> dict[str, Any]:
    """The content of results.json. Numbers that are not finite (no people: nearest_person) become null.

    played: the Episodes of each of `cells`. own: the user's own Metrics. summary: means over the episodes in which a
    metric is finite; counts: how many these are; metrics: each metric's unit and meaning; cells: a summary of each;
    config, people: the first cell's; faults: the episodes in which physics failed, with the last time [s] at which it
    had not failed: these are counted nowhere else. Raises ValueError where every episode is one of these.
    """
    faults = [
        fault_row(cell, episode)
        for cell, episodes in zip(cells, played, strict=True)
        for episode in episodes
        if episode.fault
    ]
    scored = [sound(episodes) for episodes in played]
    if not any(scored):
        raise ValueError(f"There is nothing to score: physics failed in all episodes. {_in_words(faults[0])}")
    metrics = (*METRICS, *own)
    measured = [[measure(episode, metrics) for episode in episodes] for episodes in scored]
    seeds = [[episode.seed for episode in episodes] for episodes in scored]
    summaries = [_summary(*each) for each in zip(measured, seeds, strict=True)]
    together = itertools.chain(*measured), itertools.chain(*seeds)
    return {
        "agent": agent,
        "suite": suite,
        "config": dataclasses.asdict(cells[0].config),
        "people": cells[0].config.people,
        "versions": versions(),
        **(summaries[0] if len(cells) == 1 else _summary(*map(list, together))),
        "metrics": {
            metric.name: {"unit": metric.unit, "better": metric.better or "neither", "what": metric.what}
            for metric in metrics
        },
        "cells": [
            {
                "name": cell.name,
                "grades": dict(cell.grades),
                "config": dataclasses.asdict(cell.config),
                "episodes": len(episodes),
                **summary,
            }
            for cell, episodes, summary in zip(cells, scored, summaries, strict=True)
        ],
        "episodes": [
            episode_row(cell, episode, row)
            for cell, episodes, rows in zip(cells, scored, measured, strict=True)
            for episode, row in zip(episodes, rows, strict=True)
        ],
        "faults": faults,
        **more,
    }


def episode_row(cell: Any, episode: Episode, measured: dict[str, float]) -> dict[str, Any]:
    """An item of `episodes` in results.json. cell: the episode's Cell; measured: its metrics, as `measure` gives
    them."""
    return {
        "seed": episode.seed,
        "cell": cell.name,
        **{name: value if math.isfinite(value) else None for name, value in measured.items()},
        **_each_person(episode),
    }


def fault_row(cell: Any, episode: Episode) -> dict[str, Any]:
    """An item of `faults` in results.json: an episode of `cell` in which physics failed."""
    return {"seed": episode.seed, "cell": cell.name, "time": episode.duration, "what": episode.fault}


def _each_person(episode):
    """The robot's effects on each pedestrian, {"people": {name: [value, or None for a pedestrian whom the robot didn't
    meet]}}; {} without a pair."""
    people = {
        name: [round(float(value), 4) if math.isfinite(value) else None for value in values]
        for name, values in episode.effects.items()
    }
    return {"people": people} if people else {}


def sound(episodes: Sequence[Episode]) -> list[Episode]:
    """The `episodes` in which physics did not fail."""
    return [episode for episode in episodes if not episode.fault]


def _in_words(fault):
    return f"Seed {fault['seed']} of cell '{fault['cell']}', after {fault['time']:.1f} s: {fault['what']}."


def _summary(measured, seeds):
    """summary, intervals and counts of results.json, over `measured`, dicts of `measure` of episodes with these
    `seeds`; episodes of one seed come together (bson.evaluation.statistics)."""
    rows = summarise_runs([measured], np.array(seeds)) if measured else {}
    return {
        "summary": {name: row["mean"] for name, row in rows.items()},
        "intervals": {name: [row["low"], row["high"]] for name, row in rows.items()},
        "counts": {name: row["count"] for name, row in rows.items()},
    }


def versions() -> dict[str, str]:
    """The versions of the software that made the results."""
    return files.versions("bson-macid", "mujoco", "jax", "numpy", "gymnasium")


def format_summary(content: dict[str, Any]) -> str:
    """The score, then the other metrics by group, as plain text."""
    count = len(content["episodes"])
    lines = [
        f"{content['agent']} on {content['suite']}: {count} episode{'s' if count != 1 else ''} (mean, 95% interval)"
    ]
    group = None
    for metric in metrics_of(content):
        if metric.minor or metric.name not in content["summary"]:
            continue
        if metric.group != group:
            group = metric.group
            lines.append(f" {group}")
        low, high = content["intervals"][metric.name]
        entered = content["counts"][metric.name]
        few = f", {entered} episode{'s' if entered != 1 else ''}" if entered < count else ""
        interval = f"[{low:.3f}, {high:.3f}]"
        lines.append(
            f"  {metric.name:<21}{content['summary'][metric.name]:>9.3f}   {interval:<20}"
            f" {metric.unit:<5} {metric.better or '-'}{few}".rstrip()
        )
    if faults := content["faults"]:
        lines.append(f" not scored, as physics failed: {len(faults)} episode{'s' if len(faults) != 1 else ''}")
        lines += [f"  {_in_words(fault)}" for fault in faults]
    return "\n".join(lines)


def replayed(
    episode: Episode, config: TaskConfig, track: LocalTrack, watch: Callable[[Session, int], Watch]
) -> Episode:
    """Plays `episode` of `config` again by its actions, for `watch` (see run_episodes). The worlds of one seed and the
    same actions are equal, so what comes out is the same Episode."""
    actions = iter(() if episode.actions is None else episode.actions)
    (again,) = run_episodes(lambda: lambda observation: next(actions), config, track, [episode.seed], watch=watch)
    return again
