"""Tables I and II: pedestrian models, and the LCFs of one, compared on the paper's four levels."""

import dataclasses

import numpy as np

from macid import metrics
from macid.crowd import Crowd, CrowdConfig
from macid.layout import LEVELS, VALIDATION_LEVELS, load_level
from macid.learning.methods import get_method
from macid.pedestrians import make_controller
from macid.state import PHYSICS_STEP

LCF_BINS = 6  # of Table I
TOLERATED = 20  # Fig. 2: SR_n for n = 1 to this
_COOPERATIVE = (0.67, 1.33)  # the LCFs of Table II


def _recipe(pedestrian):
    """How a learned model was made; empty for a rule."""
    return getattr(getattr(make_controller(pedestrian, 0.02), "policy", None), "recipe", {})


def usual_period(pedestrian):
    """The time between decisions [s] that a learned model was trained with; a physics step for a rule."""
    return _recipe(pedestrian).get("period", PHYSICS_STEP)


def table_lcf(pedestrian):
    """The range of LCFs (least, most) with which a model enters Table II; rules ignore it."""
    recipe = _recipe(pedestrian)
    if "lcf_mean" in recipe:  # CoPO's own distribution, as a uniform one of its mean and standard deviation
        mean, half = recipe["lcf_mean"], 3**0.5 * recipe["lcf_std"]
        return max(-1.0, mean - half), min(1.0, mean + half)
    return get_method(recipe["method"]).test_lcf if "method" in recipe else _COOPERATIVE


def lcf_bins(pedestrian):
    """Table I's sections of the range in which a learned model's LCFs were drawn: [(least, most), ...].

    Raises ValueError for a model without LCFs.
    """
    recipe = _recipe(pedestrian)
    low, high = get_method(recipe["method"]).lcf if "method" in recipe else (0.0, 0.0)
    if low == high:
        raise ValueError(f"'{pedestrian}' was not trained with LCFs: there is nothing to divide.")
    edges = np.linspace(low, high, LCF_BINS + 1).tolist()
    return list(zip(edges[:-1], edges[1:], strict=True))


def evaluate_level(pedestrian, level, episodes=5, seed=0, config=CrowdConfig(), engine="native"):
    """One model on one level: a dict of Table II's columns, of `arrived` [%], and of how people walk: `dv` [m/s a second]
    and `dw` [rad/s a second], the mean change of speed and of yaw rate between decisions, and `stalled` [%], the share of
    the time below 0.1 m/s; and their standard deviation over episodes.

    config's `number` is overridden by the level's. The episodes run at once, as worlds of one batch.
    """
    layout = load_level(level)
    config = dataclasses.replace(config, number=layout.pedestrians)
    crowd = Crowd(layout, config, nworld=episodes, engine=engine)
    start = crowd.reset(np.random.default_rng((seed, *level_seed(level))))
    end, _ = crowd.rollout(start, make_controller(pedestrian, config.period))
    arrived, collisions = ~np.asarray(end.walking), np.asarray(end.collisions)
    distance, travelled = np.asarray(end.distance), np.asarray(end.travelled)
    each = {
        "SR10": [metrics.success_rate(a, c) for a, c in zip(arrived, collisions, strict=True)],
        "CP": [metrics.collision_penalty(c) for c in collisions],
        "PE": [metrics.path_efficiency(*row) for row in zip(arrived, distance, travelled, strict=True)],
        "arrived": [100.0 * float(a.mean()) for a in arrived],
        "dv": _per_second(end.sped, end.time),
        "dw": _per_second(end.turned, end.time),
        "stalled": 100.0 * _per_second(end.stalled, end.time),
    }
    curve = [metrics.success_rate(arrived, collisions, n) for n in range(1, TOLERATED + 1)]
    return {
        "pedestrian": pedestrian,
        "level": level,
        "people": layout.pedestrians,
        "episodes": episodes,
        "seed": seed,
        "engine": engine,
        "config": dataclasses.asdict(config),
        "SR": curve,
        **{name: _over_episodes(np.mean, values) for name, values in each.items()},
        **{f"{name}_std": _over_episodes(np.std, values) for name, values in each.items()},
    }


def level_name(level):
    """How a table calls a level."""
    return f"Lv.{level}" if level in LEVELS else str(level)


def level_seed(level):
    """What follows the seed in that of a level's episodes, so that no two levels share their draws: whole numbers."""
    return (level,) if level in LEVELS else (VALIDATION_LEVELS.index(level), 0x7A1)


def _range(pair):
    return "({:.2f}, {:.2f})".format(*pair)


def _per_second(amount, time):
    """Everybody's `amount` (episodes, K) together, per second of everybody's `time` (episodes, K): (episodes,)."""
    return (np.asarray(amount).sum(axis=1) / np.asarray(time).sum(axis=1)).astype(float)


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

    lines = [
        f"{'model':<21}{'level':<7}{'people':>6}{'LCF':>15}  "
        f"{'SR10 [%] up':>14}{'CP down':>16}{'PE [%] up':>14}{'arrived [%]':>14}"
        f"{'|dv| [m/s2]':>14}{'|dw| [rad/s2]':>15}{'stalled [%]':>14}"
    ]
    for row in rows:
        lines.append(
            f"{row['pedestrian']:<21}{level_name(row['level']):<7}{row['people']:>6}{_range(row['config']['lcf']):>15}  "
            f"{cell(row, 'SR10'):>14}{cell(row, 'CP'):>16}{cell(row, 'PE'):>14}{cell(row, 'arrived'):>14}"
            f"{cell(row, 'dv'):>14}{cell(row, 'dw'):>15}{cell(row, 'stalled'):>14}"
        )
    return "\n".join(lines)
