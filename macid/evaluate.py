"""Table II: pedestrian models compared on the paper's four levels."""

import dataclasses

import numpy as np

from macid import metrics
from macid.crowd import Crowd, CrowdConfig
from macid.layout import load_level
from macid.pedestrians import make_controller


def evaluate_level(pedestrian, level, episodes=5, seed=0, config=CrowdConfig(), engine="native"):
    """One model on one level: a dict of Table II's columns and their standard deviation over episodes.

    config's `number` is overridden by the level's. The episodes run at once, as worlds of one batch.
    """
    layout = load_level(level)
    config = dataclasses.replace(config, number=layout.pedestrians)
    crowd = Crowd(layout, config, nworld=episodes, engine=engine)
    start = crowd.reset(np.random.default_rng((seed, level)))
    end, _ = crowd.rollout(start, make_controller(pedestrian, config.period))
    arrived, collisions = ~np.asarray(end.walking), np.asarray(end.collisions)
    distance, travelled = np.asarray(end.distance), np.asarray(end.travelled)
    each = {
        "SR10": [metrics.success_rate(a, c) for a, c in zip(arrived, collisions, strict=True)],
        "CP": [metrics.collision_penalty(c) for c in collisions],
        "PE": [metrics.path_efficiency(*row) for row in zip(arrived, distance, travelled, strict=True)],
        "arrived": [100.0 * float(a.mean()) for a in arrived],
    }
    return {
        "pedestrian": pedestrian,
        "level": level,
        "people": layout.pedestrians,
        "episodes": episodes,
        "seed": seed,
        "engine": engine,
        "config": dataclasses.asdict(config),
        **{name: _over_episodes(np.mean, values) for name, values in each.items()},
        **{f"{name}_std": _over_episodes(np.std, values) for name, values in each.items()},
    }


def _over_episodes(statistic, values):
    """`statistic` of the episodes that have a value; None if none has (PE where nobody arrived)."""
    numbers = [value for value in values if np.isfinite(value)]
    return float(statistic(numbers)) if numbers else None


def format_table(rows):
    """Rows of `evaluate_level` as Table II's columns, plain text."""

    def cell(row, name):
        if row[name] is None:
            return "-"
        return f"{row[name]:.1f} +- {row[name + '_std']:.1f}"

    lines = [f"{'model':<21}{'level':<7}{'people':>6}  {'SR10 [%] up':>14}{'CP down':>16}{'PE [%] up':>14}{'arrived [%]':>14}"]
    for row in rows:
        lines.append(
            f"{row['pedestrian']:<21}Lv.{row['level']:<4}{row['people']:>6}  {cell(row, 'SR10'):>14}{cell(row, 'CP'):>16}"
            f"{cell(row, 'PE'):>14}{cell(row, 'arrived'):>14}"
        )
    return "\n".join(lines)
