"""What results say of agents beyond these episodes and these trainings: intervals over training seeds and episodes,
interquartile means, and the probability that one agent does better than another.

Several runs are evaluations of policies that differ by their training seed alone, on the same episodes. All intervals
are 95% percentile bootstrap intervals by scipy.stats.bootstrap from a fixed seed. What is drawn anew, with replacement:

- the training seeds of each agent, where it has several, independently of another agent's;
- the episodes, once for all runs, since every run meets the same people on the same map in an episode. So what is hard
  about an episode is no news from each run, and what is good about a run is no news from each episode: both levels
  enter the interval, as in a two-way layout (Owen 2007, "The pigeonhole bootstrap").

Episodes are drawn by their seed: where cells of a suite play the same seeds, as those of `standard` do, episodes of one
seed have draws in common, such as the maze and where the robot begins, and they come together. `seeds` says which they
are; without, each episode is its own.

With one run of each agent, and no seed twice among its episodes, the interval is that of
bson.evaluation.metrics.summarise. Few training seeds make an interval too narrow, as a bootstrap knows no more of their
spread than they show: among three seeds it is sqrt(2/3) of the true one. LEAST_SEEDS is where a reader is told.
"""

import itertools
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from bson.evaluation.metrics import summarise

RESAMPLES = 9999
LEAST_SEEDS = 5  # with fewer training seeds an interval over them is told to be too narrow
TRIMMED = 0.25  # of the values, at either end, that an interquartile mean leaves out
_AT_ONCE = 1 << 21  # numbers drawn at once, 16 MB


class Estimate(NamedTuple):
    """A figure with its interval."""

    value: float
    low: float
    high: float


def estimate(statistic: Callable[..., Any], levels: Sequence[int], size: int = 0) -> Estimate:
    """A statistic of levels that are drawn anew, each by itself, with its interval.

    levels: the number of things of each level, such as (runs, episodes). statistic(*drawn): called with the indices
    (..., n) of what is drawn of each level; gives (...). A level with one thing is always that thing. size: how many
    numbers it takes for one draw, where that is more than the indices. Draws without a value (NaN) do not enter.
    """
    from scipy import stats

    several = [count for count in levels if count > 1]

    def of(*drawn, axis=-1):
        given = iter(drawn)
        one = np.zeros((*drawn[0].shape[:-1], 1), int)
        return statistic(*(next(given) if count > 1 else one for count in levels))

    if not several:
        value = float(statistic(*(np.zeros(1, int) for _ in levels)))
        return Estimate(value, value, value)
    everything = [np.arange(count) for count in several]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)  # of draws without a value
        found = stats.bootstrap(
            everything,
            of,
            n_resamples=RESAMPLES,
            batch=max(1, _AT_ONCE // max(size, sum(several))),
            vectorized=True,
            method="percentile",
            rng=np.random.default_rng(0),
        )
    low, high = np.nanpercentile(found.bootstrap_distribution, [2.5, 97.5])
    return Estimate(float(of(*everything)), float(low), float(high))


def _counts(drawn, count):
    """How often each of `count` things is among the indices `drawn` (..., n): (..., count)."""
    rows = drawn.reshape(-1, drawn.shape[-1])
    places = (rows + count * np.arange(len(rows))[:, None]).ravel()
    return np.bincount(places, minlength=count * len(rows)).reshape(*drawn.shape[:-1], count)


def _sums(values, weights):
    """The sums (...) of `values` (n1, ..., nk) times the weights (..., n1), ..., (..., nk) of each level."""
    lead = weights[0].shape[:-1]
    flat = [weight.reshape(-1, weight.shape[-1]).astype(float) for weight in weights]
    found = np.tensordot(flat[-1], values, axes=(1, values.ndim - 1))  # (draws, n1, ...)
    for weight in flat[:-1]:
        found = np.einsum("dn...,dn->d...", found, weight)
    return found.reshape(lead)


def _places(seeds, count):
    """(how many seeds there are, which of them each of `count` episodes has); None: each its own."""
    if seeds is None:
        return count, np.arange(count)
    known, places = np.unique(seeds, return_inverse=True)
    return len(known), places


def _mean(values, seeds=None):
    """The levels and the statistic of `estimate` that is the mean of `values` (n1, ..., episodes) of what is drawn, the
    last level by the episodes' `seeds`; NaN does not enter."""
    known = np.isfinite(values)
    filled, known = np.where(known, values, 0.0), known.astype(float)
    count, places = _places(seeds, values.shape[-1])
    levels = (*values.shape[:-1], count)

    def statistic(*drawn):
        *weights, last = (_counts(each, count) for each, count in zip(drawn, levels, strict=True))
        weights.append(last[..., places])
        with np.errstate(invalid="ignore"):
            return _sums(filled, weights) / _sums(known, weights)

    return statistic, levels


def mean(values: np.ndarray, seeds: np.ndarray | None = None) -> Estimate:
    """The mean over runs and episodes, of `values` (runs, episodes), where NaN does not enter."""
    entering = np.isfinite(values).any(axis=tuple(range(values.ndim - 1)))
    values, seeds = values[..., entering], None if seeds is None else seeds[entering]
    return estimate(*_mean(values, seeds), values.size)


def interquartile_mean(values: np.ndarray, seeds: np.ndarray | None = None) -> Estimate:
    """The interquartile mean (IQM) of `values` (runs, episodes): the mean of the middle half of all runs' episodes
    together, without the least and the greatest quarter (Agarwal et al. 2021, "Deep reinforcement learning at the edge
    of the statistical precipice"; scipy.stats.trim_mean). One failed episode in four does not move it, nor does one
    lucky one."""
    order = np.argsort(values, axis=None, kind="stable")
    ranked, (count, places) = values.ravel()[order], _places(seeds, values.shape[1])

    def statistic(runs, drawn):
        of_runs, of_episodes = _counts(runs, len(values)), _counts(drawn, count)[..., places]
        weights = (of_runs[..., :, None] * of_episodes[..., None, :]).reshape(*of_runs.shape[:-1], -1)[..., order]
        upto = weights.cumsum(axis=-1)
        total = upto[..., -1:]
        cut = (TRIMMED * total).astype(int)
        kept = np.diff(np.clip(upto - cut, 0, total - 2 * cut), axis=-1, prepend=0)
        return (kept * ranked).sum(axis=-1) / (total - 2 * cut)[..., 0]

    return estimate(statistic, (len(values), count), values.size)


class Improvement(NamedTuple):
    """How likely one agent does better than another: `paired` on the same episode, `unpaired` on any two episodes of
    the same cell; ties: the share of the pairs that neither wins, of each."""

    paired: Estimate
    paired_ties: float
    unpaired: Estimate
    unpaired_ties: float


def improvement(
    ours: np.ndarray, theirs: np.ndarray, cells: np.ndarray, better: str = "up", seeds: np.ndarray | None = None
) -> Improvement:
    """The probability of improvement P(X > Y) + P(X = Y) / 2 (Agarwal et al. 2021; the Mann-Whitney statistic).

    ours, theirs: (runs, episodes) of X and of Y, the same episodes; cells: (episodes,) each one's cell. X and Y are a
    run of each, drawn at random. better: "up", or "down" where less is better: X > Y is then X < Y. Paired, both play
    the same episode. Unpaired, each plays an episode of its own of the same cell: what lies between two people who sit
    different exams of the same kind. An interval beyond 0.5 bears out that X does better. Where either has no value
    (NaN), the pair does not enter.
    """
    sign = -1.0 if better == "down" else 1.0
    x, y = sign * ours, sign * theirs
    return Improvement(*_paired(x, y, seeds), *_unpaired(x, y, cells, seeds))


def _wins(x, y):
    """1 where x > y, 1/2 where they are equal, 0 where x < y, and NaN where either is; and whether they are equal."""
    known = np.isfinite(x) & np.isfinite(y)
    equal = np.where(known, x == y, np.nan)
    return np.where(known, (x > y) + 0.5 * (x == y), np.nan), equal


def _paired(x, y, seeds):
    won, equal = _wins(x[:, None], y[None])  # (runs, runs, episodes)
    return mean(won, seeds), float(np.nanmean(equal))


def _unpaired(x, y, cells, seeds):
    """Of each cell, every value of x is placed among those of y, which takes no longer than sorting them."""
    count, places = _places(seeds, len(cells))
    blocks = []  # (the cell's episodes, which of x and of y are known, x's places among y's sorted values, their order)
    for cell in dict.fromkeys(cells):
        here = np.flatnonzero(cells == cell)
        ours, theirs = x[:, here].ravel(), y[:, here].ravel()
        known, known_theirs = np.isfinite(ours), np.isfinite(theirs)
        order = np.flatnonzero(known_theirs)[np.argsort(theirs[known_theirs], kind="stable")]
        below, upto = (np.searchsorted(theirs[order], ours[known], side) for side in ("left", "right"))
        blocks.append((here, known, order, below, upto))

    levels = (len(x), len(y), count, count)

    def shares(*drawn):
        """The shares of the pairs that x wins, a tie counted half, and of the ties."""
        of_x, of_y, episodes_x, episodes_y = (_counts(each, size) for each, size in zip(drawn, levels, strict=True))
        episodes_x, episodes_y = episodes_x[..., places], episodes_y[..., places]
        won, equal, total = 0.0, 0.0, 0.0
        for here, known, order, below, upto in blocks:
            ours = (of_x[..., :, None] * episodes_x[..., None, here]).reshape(*of_x.shape[:-1], -1)[..., known]
            theirs = (of_y[..., :, None] * episodes_y[..., None, here]).reshape(*of_y.shape[:-1], -1)[..., order]
            before = np.concatenate([np.zeros((*theirs.shape[:-1], 1), int), np.cumsum(theirs, axis=-1)], axis=-1)
            less, at_most = before[..., below], before[..., upto]
            won = won + (ours * (less + at_most)).sum(axis=-1) / 2
            equal = equal + (ours * (at_most - less)).sum(axis=-1)
            total = total + ours.sum(axis=-1) * before[..., -1]
        with np.errstate(invalid="ignore"):
            return won / total, equal / total

    everything = [np.arange(size) for size in levels]
    return estimate(lambda *drawn: shares(*drawn)[0], levels, x.size + y.size), float(shares(*everything)[1])


def table(runs: Sequence[Sequence[dict[str, float]]], name: str) -> np.ndarray:
    """The metric `name` of several runs of the same episodes, each a list of dicts of
    bson.evaluation.metrics.measure: (runs, episodes), NaN where it is infinite."""
    values = np.array([[row[name] for row in rows] for rows in runs], dtype=float)
    return np.where(np.isfinite(values), values, np.nan)


def summarise_runs(
    runs: Sequence[Sequence[dict[str, float]]], seeds: np.ndarray | None = None
) -> dict[str, dict[str, Any]]:
    """As bson.evaluation.metrics.summarise, of several runs of the same episodes: means over runs and episodes, with
    intervals over both. seeds: those of the episodes. One run, no seed twice: the same as summarise."""
    if len(runs) == 1 and _each_its_own(seeds):
        return summarise(list(runs[0]))
    return _summary({name: table(runs, name) for name in runs[0][0]}, seeds)


def _each_its_own(seeds):
    """Whether no two episodes share a seed; None: each has its own."""
    return seeds is None or len(np.unique(seeds)) == len(seeds)


def _summary(tables, seeds):
    """{metric: {"mean", "low", "high", "count"}} of {metric: values, the episodes last}."""
    found = {}
    for name, values in tables.items():
        if count := int(np.isfinite(values).sum()):
            row, value = mean(values, seeds), float(values[np.isfinite(values)].mean())
            found[name] = {"mean": value, "low": row.low, "high": row.high, "count": count}
    return found


def difference_of_runs(
    ours: Sequence[Sequence[dict[str, float]]],
    theirs: Sequence[Sequence[dict[str, float]]],
    seeds: np.ndarray | None = None,
) -> dict[str, dict[str, Any]]:
    """Mean differences ours - theirs of the same episodes, between every run of ours and every one of theirs, with
    intervals over both agents' training seeds and over episodes; as summarise_runs. One run each: paired differences.
    count is the number of pairs of episodes in which both are finite."""
    if len(ours) == len(theirs) == 1 and _each_its_own(seeds):
        pairs = zip(ours[0], theirs[0], strict=True)
        return summarise([{name: one[name] - other[name] for name in one} for one, other in pairs])
    names = ours[0][0]
    return _summary({name: table(ours, name)[:, None] - table(theirs, name)[None] for name in names}, seeds)


def pairs_of(count: int) -> list[tuple[int, int]]:
    """Every pair of `count` things, the later one first: (1, 0), (2, 0), (2, 1), ..."""
    return [
        (later, earlier) for earlier, later in sorted(itertools.combinations(range(count), 2), key=lambda p: p[::-1])
    ]
