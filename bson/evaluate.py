"""An agent on many episodes at once: their records, and the results file."""

import dataclasses
import math
import platform
import sys
from importlib import metadata

import numpy as np

from bson.agents import act
from bson.metrics import METRICS, measure, summarise
from bson.session import Recorder, Session

BATCH = 16  # worlds at once


def run_episodes(make_agent, config, track, seeds, agent_name="agent", progress=None, batch=BATCH, nthread=0):
    """Plays the episodes `seeds`; returns their Episodes in that order.

    make_agent: gives a callable for one world (see bson.agents). progress: called after each control step of the batch
    with (control steps done, Episode or None) for each episode that ended, and (steps, None) otherwise. An episode
    does not depend on which others run beside it.
    """
    nworld = min(batch, len(seeds))
    session = Session(config, track, nworld, nthread=nthread)
    agents = [make_agent() for _ in range(nworld)]
    waiting, playing, recorders, done = list(enumerate(seeds)), {}, {}, {}
    observations = {}

    def begin(index):
        if not waiting:
            playing.pop(index, None)
            return
        playing[index], seed = waiting.pop(0)
        observation = session.reset([index], [seed])
        if hasattr(agents[index], "reset"):
            agents[index].reset(seed)
        recorders[index] = Recorder(session, index)
        observations[index] = {name: value[0] for name, value in observation.items()}

    for index in range(nworld):
        begin(index)
    while playing:
        ids = sorted(playing)
        actions = np.stack([act(agents[index], observations[index], agent_name) for index in ids])
        observation, _, terminated, truncated = session.step(ids, actions)
        for row, index in enumerate(ids):
            recorders[index].snap()
            observations[index] = {name: value[row] for name, value in observation.items()}
            ended = terminated[row] or truncated[row]
            if ended:
                done[playing[index]] = recorders[index].episode()
            if progress:
                progress(1, done[playing[index]] if ended else None)
            if ended:
                begin(index)
    return [done[number] for number in range(len(seeds))]


def results(agent, suite, config, episodes, **more):
    """The content of results.json. Numbers that are not finite (no people: nearest_person) become null.

    summary: means over the episodes in which a metric is finite; counts: how many these are; metrics: what each is.
    """
    measured = [measure(episode) for episode in episodes]
    summary = summarise(measured)
    return {
        "agent": agent,
        "suite": suite,
        "config": dataclasses.asdict(config),
        "versions": versions(),
        "summary": {name: row["mean"] for name, row in summary.items()},
        "intervals": {name: [row["low"], row["high"]] for name, row in summary.items()},
        "counts": {name: row["count"] for name, row in summary.items()},
        "metrics": {
            metric.name: {"unit": metric.unit, "better": metric.better or "neither", "what": metric.what}
            for metric in METRICS
        },
        "episodes": [
            {"seed": episode.seed, **{name: value if math.isfinite(value) else None for name, value in row.items()}}
            for episode, row in zip(episodes, measured, strict=True)
        ],
        **more,
    }


def summarise_cells(cells, played):
    """For each of a suite's `cells`, whose episodes `played` has: its name, grades, configuration and summary."""
    rows = []
    for cell, episodes in zip(cells, played, strict=True):
        summary = summarise([measure(episode) for episode in episodes])
        rows.append(
            {
                "name": cell.name,
                "grades": dict(cell.grades),
                "config": dataclasses.asdict(cell.config),
                "episodes": len(episodes),
                "summary": {name: row["mean"] for name, row in summary.items()},
                "intervals": {name: [row["low"], row["high"]] for name, row in summary.items()},
            }
        )
    return rows


def versions():
    """What the results were made with."""
    packages = ("bson-macid", "mujoco", "jax", "numpy", "gymnasium")
    return {
        **{name: metadata.version(name) for name in packages},
        "python": platform.python_version(),
        "os": sys.platform,
    }


def format_summary(content):
    """The score, then the other metrics by group, as plain text."""
    count = len(content["episodes"])
    lines = [
        f"{content['agent']} on {content['suite']}: {count} episode{'s' if count != 1 else ''} (mean, 95% interval)"
    ]
    group = None
    for metric in METRICS:
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
    return "\n".join(lines)
