"""The score: SNS and its parts (paper, sec. VI-C, eq. 6), and what users expect beside it. Pure functions of an Episode.

| metric | what | unit | better |
|---|---|---|---|
| SNS | RC * 0.95^Coll * (50 PE + 50 SP) | 0 to 100 | up |
| RC | route completion, 1 - d_f / d_i; below 0 for who ends farther from the goal than it began | - | up |
| Coll | steps of 0.02 s in which the robot is within 0.01 m of anything | steps | down |
| SP | speed score, (v - 0.5 m/s) / 1.0 m/s in [0, 1], v the mean speed | - | up |
| PE | path efficiency, (d_i - d_f) / way driven, in [0, 1]; 0 for who did not move | - | up |
| success | goal reached (within 0.5 m) before the horizon | share | up |
| Coll_person, Coll_obstacle, Coll_wall | Coll by what was touched | steps | down |
| time | duration of the episode | s | down |
| nearest_person | least surface-to-surface distance to a person, at control steps | m | up |
| personal_space | share of time with a person nearer than 1.2 m, surface to surface (Francis et al. 2023) | share | down |
"""

import dataclasses

import numpy as np

GAMMA = 0.95  # of eq. 6
SPEED_RANGE = (0.5, 1.5)  # mean speeds that score 0 and 1 [m/s]
PERSONAL_SPACE = 1.2  # [m]
PARTS = ("SNS", "RC", "Coll", "SP", "PE")


@dataclasses.dataclass(frozen=True)
class Episode:
    """One episode of one robot. World frame; metres, seconds, radians. T control steps, K people, B boxes."""

    seed: int
    start_distance: float  # d_i: from the start to the goal
    final_distance: float  # d_f
    travelled: float  # way driven
    duration: float
    arrived: bool
    collisions: int  # physics steps (0.02 s) in contact with anything
    collisions_person: int
    collisions_obstacle: int
    collisions_wall: int
    collisions_so_far: np.ndarray  # (T + 1,) the count of `collisions` up to each control step
    nearest_person: np.ndarray  # (T + 1,) surface-to-surface; infinity where there is nobody
    goal: np.ndarray  # (2,)
    boxes: np.ndarray  # (B, 5), the first four the outer walls
    lcf: np.ndarray  # (K,)
    pose: np.ndarray  # (T + 1, 3) of the robot: x, y, yaw
    velocity: np.ndarray  # (T + 1, 2) v, w
    people: np.ndarray  # (T + 1, K, 3) x, y, yaw
    qpos: np.ndarray  # (T + 1, nq) MuJoCo's configuration, for films
    period: float  # of control


def route_completion(episode):
    """RC = 1 - d_f / d_i."""
    return 1.0 - episode.final_distance / episode.start_distance


def path_efficiency(episode):
    """PE = (d_i - d_f) / way driven, clipped to [0, 1]."""
    if episode.travelled <= 0:
        return 0.0
    return float(np.clip((episode.start_distance - episode.final_distance) / episode.travelled, 0.0, 1.0))


def speed_score(episode):
    """SP: the mean speed, from 0.5 m/s (0) to 1.5 m/s (1)."""
    low, high = SPEED_RANGE
    if episode.duration <= 0:
        return 0.0
    return float(np.clip((episode.travelled / episode.duration - low) / (high - low), 0.0, 1.0))


def sns(episode):
    """Eq. 6 for one episode: RC gamma^c (50 PE + 50 SP)."""
    quality = 50.0 * path_efficiency(episode) + 50.0 * speed_score(episode)
    return route_completion(episode) * GAMMA**episode.collisions * quality


def measure(episode):
    """All metrics of one episode, as a dict of floats in the order of the module's table."""
    nearest = episode.nearest_person
    return {
        "SNS": sns(episode),
        "RC": route_completion(episode),
        "Coll": float(episode.collisions),
        "SP": speed_score(episode),
        "PE": path_efficiency(episode),
        "success": float(episode.arrived),
        "Coll_person": float(episode.collisions_person),
        "Coll_obstacle": float(episode.collisions_obstacle),
        "Coll_wall": float(episode.collisions_wall),
        "time": episode.duration,
        "nearest_person": float(nearest.min()),
        "personal_space": float((nearest < PERSONAL_SPACE).mean()),
    }


def spread_by_score(episodes, most):
    """At most `most` of `episodes`, evenly from the worst SNS to the best: the first and the last are these two."""
    ranked = sorted(episodes, key=sns)
    places = np.linspace(0, len(ranked) - 1, min(most, len(ranked))).round().astype(int)
    return [ranked[place] for place in np.unique(places)]


def summarise(measured, resamples=9999):
    """Means over episodes, each with a bootstrap 95% interval: {metric: {"mean", "low", "high"}}.

    measured: dicts of `measure`. The interval is the percentile bootstrap's, from a fixed seed, so that the same
    episodes give the same interval. Metrics that are infinite (no people) are left out.
    """
    summary = {}
    for name in measured[0]:
        values = np.array([row[name] for row in measured])
        if not np.isfinite(values).all():
            continue
        means = np.random.default_rng(0).choice(values, (resamples, len(values))).mean(axis=1)
        low, high = np.percentile(means, [2.5, 97.5])
        summary[name] = {"mean": float(values.mean()), "low": float(low), "high": float(high)}
    return summary
