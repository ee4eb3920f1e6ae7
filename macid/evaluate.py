"""Tables I and II: pedestrian models, and the LCFs of one model, compared on the paper's four levels."""

import dataclasses
import itertools
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

from macid import metrics
from macid.crowd import CONFIG, Crowd, CrowdConfig
from macid.engines.base import DIVERGED
from macid.layout import LEVELS, OTHER_LEVELS, VALIDATION_LEVELS, load_level
from macid.learning.methods import get_method
from macid.pedestrians import make_controller
from macid.state import PHYSICS_STEP

LCF_BINS = 6  # Table I's sections
TOLERATED = 20  # Fig. 2: SR_n for n = 1 to this
_COOPERATIVE = (0.67, 1.33)  # the LCFs of Table II


def _recipe(pedestrian):
    """How a learned model was made and how it scores, a dict; empty for a rule."""
    return getattr(getattr(make_controller(pedestrian, 0.02), "policy", None), "recipe", {})


def usual_period(pedestrian: str) -> float:
    """The time between decisions [s] that a learned model was trained with; a physics step for a rule."""
    return _recipe(pedestrian).get("period", PHYSICS_STEP)


def table_lcf(pedestrian: str) -> tuple[float, float]:
    """The range of LCFs (least, most) with which a model enters Table II; rules ignore it."""
    recipe = _recipe(pedestrian)
    if "lcf_mean" in recipe:  # CoPO's own distribution, as a uniform one of its mean and standard deviation
        mean, half = recipe["lcf_mean"], 3**0.5 * recipe["lcf_std"]
        return max(-1.0, mean - half), min(1.0, mean + half)
    return get_method(recipe["method"]).test_lcf if "method" in recipe else _COOPERATIVE


def lcf_bins(pedestrian: str) -> list[tuple[float, float]]:
    """Table I's sections of the range in which a learned model's LCFs were drawn: [(least, most), ...].

    Raises ValueError for a model without LCFs.
    """
    recipe = _recipe(pedestrian)
    low, high = get_method(recipe["method"]).lcf if "method" in recipe else (0.0, 0.0)
    if low == high:
        raise ValueError(f"'{pedestrian}' was not trained with LCFs: there is nothing to divide.")
    edges = np.linspace(low, high, LCF_BINS + 1).tolist()
    return list(itertools.pairwise(edges))


def evaluate_level(
    pedestrian: str,
    level: int | str,
    episodes: int = 5,
    seed: int = 0,
    config: CrowdConfig = CONFIG,
    engine: str = "native",
) -> dict[str, Any]:
    """One model on one level: a dict of Table II's columns, of `arrived` [%], and of how people walk: `dv` [m/s a
    second] and `dw` [rad/s a second], the mean change of speed and of yaw rate between decisions, and `stalled` [%],
    the share of the time below 0.1 m/s; and their standard deviation over episodes.

    config's `number` is overridden by the level's. The episodes run at once, as worlds of one batch. `faults`: the
    episodes in which physics failed, and how; these are scored nowhere. Raises ValueError where no sound episode is
    left.
    """
    layout, config, (end,), faults = _play(pedestrian, level, [(config.lcf, episodes)], seed, config, engine)
    return {
        "pedestrian": pedestrian,
        "level": level,
        "people": layout.pedestrians,
        "episodes": episodes,
        "seed": seed,
        "engine": engine,
        "config": dataclasses.asdict(config),
        **_measured(end),
        "faults": faults,
    }


def _play(pedestrian, level, groups, seed, config, engine):
    """Plays a level. Returns its layout, the config with its number of people, and, for each of `groups`, the ended
    Episode, which has only the worlds in which physics did not fail; and the faults in all other worlds, [{"episode",
    "what"}, ...], where episodes are counted through all groups.

    groups: pairs of a range of LCFs and a number of episodes. Each group begins from the same seed, so groups of as
    many episodes have the same starts and goals. All are worlds of one batch. Raises ValueError where a group has no
    sound world.
    """
    layout = load_level(level)
    config = dataclasses.replace(config, number=layout.people)
    crowd = Crowd(layout, config, nworld=sum(episodes for _, episodes in groups), engine=engine)
    drawn = [crowd.draw(np.random.default_rng((seed, *level_seed(level))), n, lcf) for lcf, n in groups]
    start = crowd.begin(*jax.tree.map(lambda *arrays: np.concatenate(arrays), *drawn))
    end, _ = crowd.rollout(start, make_controller(pedestrian, config.period))
    whats = _faults(crowd, end)
    end = end._replace(physics=None)
    last = np.cumsum([episodes for _, episodes in groups])
    ends = []
    for worlds in np.split(np.arange(crowd.nworld), last[:-1]):
        sound = [world for world in worlds if not whats[world]]
        if not sound:
            raise ValueError(
                f"There is nothing to score: physics failed in all episodes of '{pedestrian}' on {level_name(level)}. "
                f"Episode {worlds[0]}: {whats[worlds[0]]}."
            )
        ends.append(jax.tree.map(lambda leaf, sound=sound: np.asarray(leaf)[sound], end))
    return layout, config, ends, [{"episode": world, "what": what} for world, what in enumerate(whats) if what]


def _faults(crowd, end):
    """For each world of a crowd whose Episode ended, what failed in its physics: "" where nothing did."""
    mean_speed = np.asarray(end.travelled).max(axis=-1) / crowd.config.duration
    return [
        what or ("" if speed <= DIVERGED else f"somebody moved at {speed:.0f} m/s on average")
        for what, speed in zip(crowd.engine.faults(end.physics), mean_speed, strict=True)
    ]


def _measured(end):
    """The columns of `evaluate_level` of an ended Episode."""
    arrived, collisions = ~end.walking, end.collisions
    each = {
        "SR10": [metrics.success_rate(a, c) for a, c in zip(arrived, collisions, strict=True)],
        "CP": [metrics.collision_penalty(c) for c in collisions],
        "PE": [metrics.path_efficiency(*row) for row in zip(arrived, end.distance, end.travelled, strict=True)],
        "arrived": [100.0 * float(a.mean()) for a in arrived],
        "dv": _per_second(end.sped, end.time),
        "dw": _per_second(end.turned, end.time),
        "stalled": 100.0 * _per_second(end.stalled, end.time),
    }
    return {
        "SR": [metrics.success_rate(arrived, collisions, n) for n in range(1, TOLERATED + 1)],
        **{name: _over_episodes(np.mean, values) for name, values in each.items()},
        **{f"{name}_std": _over_episodes(np.std, values) for name, values in each.items()},
    }


def measure_knob(
    pedestrian: str,
    level: int | str,
    episodes: int = 5,
    mixed: int = 10,
    seed: int = 0,
    config: CrowdConfig = CONFIG,
    engine: str = "native",
) -> dict[str, Any]:
    """How a learned model's LCF works on one level: a dict of

    - `sections`, Table I's sections of its LCFs, (least, most) each; `SR10` [%] and `CP` of `episodes` episodes in
      which everybody's LCF is of one section; `SR10_rank` and `CP_rank`, their rank correlations with the sections;
    - `own_CP`, of `mixed` episodes in which everybody's LCF is drawn from the whole range: for each section, the mean
      collision steps of people whose own LCF is of it; `own_people`, how many people these are; `own_CP_rank`.

    `faults` are as in `evaluate_level`. A rank correlation is None where it has no meaning (all equal). config's
    `number` and `lcf` are overridden. Starts and goals are the same in every section. Raises ValueError for a model
    without LCFs.
    """
    sections = lcf_bins(pedestrian)
    edges = [sections[0][0], *(high for _, high in sections)]
    groups = [(section, episodes) for section in sections] + [((edges[0], edges[-1]), mixed)]
    layout, config, ends, faults = _play(pedestrian, level, groups, seed, config, engine)
    figures = [_measured(end) for end in ends[:-1]]
    own, people = metrics.mean_by_section(ends[-1].lcf, ends[-1].collisions, edges)
    found = {name: [row[name] for row in figures] for name in ("SR10", "CP")}
    found["own_CP"] = [None if np.isnan(mean) else float(mean) for mean in own]
    ranks = {f"{name}_rank": _rank_correlation(values) for name, values in found.items()}
    return {
        "pedestrian": pedestrian,
        "level": level,
        "people": layout.pedestrians,
        "episodes": episodes,
        "mixed": mixed,
        "seed": seed,
        "engine": engine,
        "period": config.period,
        "sections": sections,
        **found,
        "own_people": people.tolist(),
        **ranks,
        "faults": faults,
    }


def _rank_correlation(values):
    """`metrics.rank_correlation`, with None instead of NaN; values of which one is None have no rank correlation."""
    correlation = metrics.rank_correlation([np.nan if value is None else value for value in values])
    return correlation if np.isfinite(correlation) else None


def level_name(level: int | str) -> str:
    """How a table calls a level."""
    return f"Lv.{level}" if level in LEVELS else str(level)


def level_seed(level: int | str) -> tuple[int, ...]:
    """The whole numbers that stand behind the seed in the random generator of a level's episodes. No two levels have
    the same, so that no two levels share their draws."""
    if level in LEVELS:
        return (level,)
    return (OTHER_LEVELS.index(level), 0x7A2) if level in OTHER_LEVELS else (VALIDATION_LEVELS.index(level), 0x7A1)


def _range(pair):
    return "({:.2f}, {:.2f})".format(*pair)


def _per_second(amount, time):
    """Everybody's `amount` (episodes, K) together, per second of everybody's `time` (episodes, K): (episodes,)."""
    return (np.asarray(amount).sum(axis=1) / np.asarray(time).sum(axis=1)).astype(float)


def _over_episodes(statistic, values):
    """`statistic` of the episodes that have a value; None if none has (PE where nobody arrived)."""
    numbers = [value for value in values if np.isfinite(value)]
    return float(statistic(numbers)) if numbers else None


def format_table(rows: Iterable[dict[str, Any]]) -> str:
    """Rows of `evaluate_level` as Table II's columns, plain text; below them the episodes that are not scored."""

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
            f"{row['pedestrian']:<21}{level_name(row['level']):<7}{row['people']:>6}"
            f"{_range(row['config']['lcf']):>15}  "
            f"{cell(row, 'SR10'):>14}{cell(row, 'CP'):>16}{cell(row, 'PE'):>14}{cell(row, 'arrived'):>14}"
            f"{cell(row, 'dv'):>14}{cell(row, 'dw'):>15}{cell(row, 'stalled'):>14}"
        )
    for row in rows:
        for fault in row.get("faults", ()):
            where = f"{row['pedestrian']} on {level_name(row['level'])}"
            lines.append(f"not scored, as physics failed: episode {fault['episode']} of {where}: {fault['what']}")
    return "\n".join(lines)
