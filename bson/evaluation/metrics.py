"""The score: SNS and its parts (paper, sec. VI-C, eq. 6), and the other metrics that users expect (Francis et al.
2023).

The robot's effects on others are measured on a pair: the episode, and the same people for as long without the robot.

Pure functions of an Episode. METRICS, at the end, is the one table of them: name, group, unit, which way is better, and
its meaning, with its threshold.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from bson.episodes.effects import SOCIAL_SPACE
from bson.episodes.record import Episode
from macid import geometry
from macid.documents import shown
from macid.files import UsageError
from macid.registry import Kind
from macid.state import STALLED

GAMMA = 0.95  # of eq. 6
SPEED_RANGE = (0.5, 1.5)  # mean speeds that score 0 and 1 [m/s]
INTIMATE_SPACE, PERSONAL_SPACE = 0.45, 1.2  # [m], surface to surface
PARTS = ("SNS", "RC", "Coll", "SP", "PE")
GROUPS = ("score", "safety", "comfort", "efficiency", "others", "own")  # the last group holds the user's own metrics


class Driven(NamedTuple):
    """The quantities from which the parts of the score follow."""

    start_distance: float  #: to the goal [m]
    final_distance: float  #: [m]
    travelled: float  #: [m]
    duration: float  #: [s]
    collisions: int  #: steps in which the robot touched anything


def route_completion(episode: Episode | Driven) -> float:
    """RC = 1 - d_f / d_i."""
    return 1.0 - episode.final_distance / episode.start_distance


def path_efficiency(episode: Episode | Driven) -> float:
    """PE = (d_i - d_f) / way driven, clipped to [0, 1]."""
    if episode.travelled <= 0:
        return 0.0
    return float(np.clip((episode.start_distance - episode.final_distance) / episode.travelled, 0.0, 1.0))


def speed_score(episode: Episode | Driven) -> float:
    """SP: the mean speed, from 0.5 m/s (0) to 1.5 m/s (1)."""
    low, high = SPEED_RANGE
    if episode.duration <= 0:
        return 0.0
    return float(np.clip((episode.travelled / episode.duration - low) / (high - low), 0.0, 1.0))


def sns(episode: Episode | Driven) -> float:
    """Eq. 6 for one episode: RC gamma^c (50 PE + 50 SP).

    Where RC is below 0, collisions don't discount the score: nothing that the robot does wrong brings the score nearer
    to 0.
    """
    completed = route_completion(episode)
    quality = 50.0 * path_efficiency(episode) + 50.0 * speed_score(episode)
    return completed * quality * (GAMMA**episode.collisions if completed > 0 else 1.0)


def time_to_collision(episode: Episode) -> np.ndarray:
    """For each control step the least t >= 0 [s] with |dp + dv t| = r1 + r2 for any person, if robot and person keep
    their velocities.

    The robot is the disc around its footprint. (T + 1,): 0 where the discs overlap, infinity where none ever will.
    """
    yaw, ahead = episode.pose[:, 2], episode.velocity[:, :1]
    dp = episode.people[..., :2] - episode.pose[:, None, :2]
    dv = episode.people_velocity - (ahead * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1))[:, None]
    reach = episode.robot_radius + episode.person_radius
    return geometry.time_to_collision(dp, dv, reach, grazing=True).min(axis=-1, initial=np.inf)


def spl(episode: Episode) -> float:
    """SPL: 0 for a robot that did not arrive, else the shortest way over the way driven, at most 1 (Anderson et al.
    2018)."""
    return float(episode.arrived) * episode.shortest / max(episode.travelled, episode.shortest)


def _over(statistic, values):
    """`statistic` of `values`; 0 where an episode is too short to have any."""
    return float(statistic(values)) if len(values) else 0.0


def _speed(episode):
    """The speed (T,) [m/s], without sign, after each control step."""
    return np.abs(episode.velocity[1:, 0])


def _derivative(episode, order):
    """The derivative (T + 1 - order,) of the speed ahead; order 1: acceleration [m/s2], 2: jerk [m/s3]."""
    return np.diff(episode.velocity[:, 0], order) / episode.period**order


def _within(episode, distance):
    return float((episode.nearest_person < distance).mean())


def _effect(name):
    """The mean of the effect `name` over the people who have a value; infinity where nobody has, or without a pair."""

    def mean(episode):
        values = episode.effects.get(name, np.empty(0))
        on = np.isfinite(values)
        return float(values[on].mean()) if on.any() else np.inf

    return mean


@dataclasses.dataclass(frozen=True)
class Metric:
    """A row of METRICS."""

    name: str
    group: str  # one of GROUPS
    unit: str  # "" for a plain number
    better: str  # "up" or "down"; "" where neither is better
    of: Callable | None  # float of an Episode, infinity where it has no value; None for a metric read from a file
    what: str  # its meaning, with its threshold
    minor: bool = False  # of interest only at a second look


# fmt: off
METRICS = (
    Metric("SNS", "score", "", "up", sns,
           "RC * 0.95^Coll * (50 PE + 50 SP), of 100; an RC below 0 is not discounted by Coll"),
    Metric("RC", "score", "", "up", route_completion,
           "route completion, 1 - d_f / d_i; below 0 for who ends farther from the goal than it began"),
    Metric("Coll", "score", "steps", "down", lambda e: float(e.collisions),
           "steps of 0.02 s in which the robot is within 0.01 m of anything"),
    Metric("SP", "score", "", "up", speed_score,
           "speed score, (v - 0.5 m/s) / 1.0 m/s in [0, 1], v the mean speed"),
    Metric("PE", "score", "", "up", path_efficiency,
           "path efficiency, (d_i - d_f) / way driven, in [0, 1]; 0 for who did not move"),

    Metric("Coll_person", "safety", "steps", "down", lambda e: float(e.collisions_person), "Coll with people"),
    Metric("Coll_robot_on_person", "safety", "steps", "down", lambda e: float(e.collisions_robot_on_person),
           "of Coll_person: the robot moves towards whom it touches, at more than 0.05 m/s"),
    Metric("Coll_person_on_robot", "safety", "steps", "down",
           lambda e: float(e.collisions_person - e.collisions_robot_on_person),
           "of Coll_person: the others, in which the robot is run into"),
    Metric("Coll_obstacle", "safety", "steps", "down", lambda e: float(e.collisions_obstacle), "Coll with obstacles"),
    Metric("Coll_wall", "safety", "steps", "down", lambda e: float(e.collisions_wall), "Coll with outer walls"),
    Metric("nearest_person", "safety", "m", "up", lambda e: float(e.nearest_person.min()),
           "least surface-to-surface distance to a person, at control steps"),
    Metric("time_to_collision", "safety", "s", "up", lambda e: float(time_to_collision(e).min()),
           "least time until robot and person, as discs, would touch if both kept their velocity; if they ever would"),

    Metric("nearest_person_mean", "comfort", "m", "up", lambda e: float(e.nearest_person.mean()),
           "surface-to-surface distance to the nearest person, mean over time"),
    Metric("intimate_space", "comfort", "share", "down", lambda e: _within(e, INTIMATE_SPACE),
           "share of time with a person nearer than 0.45 m, surface to surface"),
    Metric("personal_space", "comfort", "share", "down", lambda e: _within(e, PERSONAL_SPACE),
           "share of time with a person nearer than 1.2 m, surface to surface"),
    Metric("social_space", "comfort", "share", "down", lambda e: _within(e, SOCIAL_SPACE),
           "share of time with a person nearer than 3.6 m, surface to surface"),
    Metric("acceleration_mean", "comfort", "m/s2", "down", lambda e: _over(np.mean, np.abs(_derivative(e, 1))),
           "of the speed ahead from control step to control step, without its sign"),
    Metric("acceleration_min", "comfort", "m/s2", "up", lambda e: _over(np.min, _derivative(e, 1)),
           "least acceleration: the hardest braking, below 0", minor=True),
    Metric("acceleration_max", "comfort", "m/s2", "down", lambda e: _over(np.max, _derivative(e, 1)),
           "greatest acceleration", minor=True),
    Metric("jerk_mean", "comfort", "m/s3", "down", lambda e: _over(np.mean, np.abs(_derivative(e, 2))),
           "change of the acceleration from control step to control step, without its sign"),
    Metric("jerk_min", "comfort", "m/s3", "up", lambda e: _over(np.min, _derivative(e, 2)),
           "least jerk, below 0", minor=True),
    Metric("jerk_max", "comfort", "m/s3", "down", lambda e: _over(np.max, _derivative(e, 2)),
           "greatest jerk", minor=True),

    Metric("success", "efficiency", "share", "up", lambda e: float(e.arrived),
           "goal reached (within 0.5 m) before the horizon"),
    Metric("timeout", "efficiency", "share", "down", lambda e: float(e.timed_out), "horizon reached before the goal"),
    Metric("SPL", "efficiency", "", "up", spl,
           "success * shortest way around the walls / way driven, in [0, 1]; 0 for who did not arrive"),
    Metric("time", "efficiency", "s", "down", lambda e: e.duration, "duration of the episode"),
    Metric("time_to_goal", "efficiency", "s", "down", lambda e: e.duration if e.arrived else np.inf,
           "duration of the episodes that reached the goal"),
    Metric("stalled_time", "efficiency", "s", "down", lambda e: float((_speed(e) < STALLED).sum() * e.period),
           "time at less than 0.1 m/s, turning on the spot included"),
    Metric("path_length", "efficiency", "m", "down", lambda e: e.travelled, "way driven"),
    Metric("speed_mean", "efficiency", "m/s", "", lambda e: _over(np.mean, _speed(e)),
           "speed after control steps, ahead or back", minor=True),
    Metric("speed_min", "efficiency", "m/s", "", lambda e: _over(np.min, _speed(e)), "least speed", minor=True),
    Metric("speed_max", "efficiency", "m/s", "", lambda e: _over(np.max, _speed(e)), "greatest speed", minor=True),

    Metric("delay", "others", "s", "down", _effect("delay"),
           "how much later people reach their first goal than without the robot (with --paired): mean over those whom "
           "it came within 3.6 m of on their way there, and who get there"),
    Metric("detour", "others", "m", "down", _effect("detour"),
           "how much farther people walk to their first goal than without the robot, beyond what brings them closer: "
           "mean over those whom it came within 3.6 m of on their way there"),
    Metric("added_contact", "others", "s", "down", _effect("added_contact"),
           "how much longer people are within 0.01 m of other people (at control steps) than without the robot: mean "
           "over those whom it came within 3.6 m of on the way to their first goal"),
)
# fmt: on


def _own(found, name):
    """The user's own metric: a Metric, or a function of an Episode. A function's name is the metric's, its docstring is
    the metric's meaning, and its attributes `unit` and `better` ("up", "down" or "") are the metric's."""
    if not isinstance(found, Metric):
        if not callable(found):
            raise UsageError(
                f"Metric '{name}' must be a function of an Episode, or a bson.evaluation.metrics.Metric, not "
                f"{shown(found)}."
            )
        called = getattr(found, "__name__", type(found).__name__)
        what = " ".join((found.__doc__ or "a metric of one's own").split())
        found = Metric(called, "own", getattr(found, "unit", ""), getattr(found, "better", ""), found, what)
    texts = [found.name, found.unit, found.better, found.what]
    if not all(isinstance(text, str) and text.isprintable() and len(text) <= 400 for text in texts) or not found.name:
        raise UsageError(f"Metric '{name}': name, unit, better and what must be printable text of one line.")
    if found.better not in ("up", "down", ""):
        raise UsageError(f"Metric '{name}': better must be 'up', 'down' or '', not {shown(found.better)}.")
    if found.name in TAKEN:
        raise UsageError(f"Metric '{name}': there is a {shown(found.name)} already; call it otherwise.")

    own = found.of
    if own is None:
        raise UsageError(f"Metric '{name}' has no function: its `of` is None.")

    def of(episode):
        with METRIC_KIND.running(name, f"of seed {episode.seed}"):
            value = own(episode)
            return float(value)

    return dataclasses.replace(found, group="own", of=of)


TAKEN = {metric.name for metric in METRICS} | {"cell", "seed", "people"}  # keys of an episode in results.json
METRIC_KIND: Kind[Metric] = Kind("metric", {metric.name: metric for metric in METRICS}, own="function", check=_own)


def own_metrics(names: Sequence[str]) -> tuple[Metric, ...]:
    """The user's own metrics `names`, each `module:function` or `file.py:function`. Raises UsageError, naming the
    fault."""
    found = [METRIC_KIND.own_object(name) for name in names]
    called = [metric.name for metric in found]
    if twice := {name for name in called if called.count(name) > 1}:
        raise UsageError(f"Two metrics are called {shown(min(twice))}: call one otherwise.")
    return tuple(found)


def metrics_of(content: dict) -> tuple[Metric, ...]:
    """The metrics in the `content` of a results.json, the user's own last."""
    own = [
        Metric(name, "own", told["unit"], "" if told["better"] == "neither" else told["better"], None, told["what"])
        for name, told in content.get("metrics", {}).items()
        if name not in TAKEN
    ]
    return (*METRICS, *own)


def measure(episode: Episode, metrics: Sequence[Metric] = METRICS) -> dict[str, float]:
    """`metrics` of one episode, as a dict of floats in their order."""
    return {metric.name: metric.of(episode) for metric in metrics if metric.of is not None}


def spread_by_score(episodes: Sequence[Episode], most: int) -> list[Episode]:
    """At most `most` of `episodes`, evenly from the worst SNS to the best, these two included."""
    ranked = sorted(episodes, key=sns)
    places = np.linspace(0, len(ranked) - 1, min(most, len(ranked))).round().astype(int)
    return [ranked[int(place)] for place in np.unique(places)]


_DRAWN = 1 << 22  # values drawn at once, 32 MB


def summarise(measured: list[dict[str, float]], resamples: int = 9999) -> dict[str, dict]:
    """Means over episodes, each with a bootstrap 95% interval: {metric: {"mean", "low", "high", "count"}}.

    measured: dicts of `measure`. The interval is the percentile bootstrap's, from a fixed seed, so that the same
    episodes give the same interval. Infinite values (no people, not arrived, on no collision course) don't enter. count
    is the number of episodes with a finite value; a metric without any is left out.
    """
    summary = {}
    for name in measured[0] if measured else ():
        values = np.array([row[name] for row in measured])
        values = values[np.isfinite(values)]
        if not len(values):
            continue
        rng, rows = np.random.default_rng(0), max(1, _DRAWN // len(values))  # drawn in parts, which changes no number
        counts = [min(rows, resamples - first) for first in range(0, resamples, rows)]
        means = np.concatenate([rng.choice(values, (count, len(values))).mean(axis=1) for count in counts])
        low, high = np.percentile(means, [2.5, 97.5])
        summary[name] = {"mean": float(values.mean()), "low": float(low), "high": float(high), "count": len(values)}
    return summary
