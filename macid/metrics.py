"""How well a crowd walks (paper, sec. IV-A): success rate, collision penalty, path efficiency. Pure functions on
arrays."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import rankdata

from macid.geometry import Array


def success_rate(arrived: ArrayLike, collisions: ArrayLike, tolerated: int = 10) -> float:
    """SR_n [%]: the share of people who arrived and collided in fewer than `tolerated` (n) steps of 0.02 s.

    arrived: bool, collisions: int, both any shape.
    """
    return 100.0 * float(np.mean(np.asarray(arrived) & (np.asarray(collisions) < tolerated)))


def collision_penalty(collisions: Array) -> float:
    """CP: steps of 0.02 s in which a person touches somebody or something, per person and episode."""
    return float(np.mean(collisions))


def path_efficiency(arrived: ArrayLike, distance: ArrayLike, travelled: ArrayLike) -> float:
    """PE [%]: start-to-goal distance over the distance walked, at most 1, the mean over people who arrived; NaN if
    nobody arrived.

    (A person who has not arrived has no finished path. The last 0.5 m are not walked, hence the bound.)
    """
    arrived = np.asarray(arrived)
    if not arrived.any():
        return float("nan")
    ratio = np.asarray(distance)[arrived] / np.maximum(np.asarray(travelled)[arrived], 1e-9)
    return 100.0 * float(np.mean(np.minimum(ratio, 1.0)))


def rank_correlation(values: ArrayLike) -> float:
    """Spearman's rank correlation of `values` (N,) with their order, in [-1, 1]; equal values share their mean rank.

    NaN where it has no meaning: for fewer than two values, equal values only, or one that is not finite.
    """
    values = np.asarray(values, float)
    if len(values) < 2 or not np.isfinite(values).all() or (values == values[0]).all():
        return float("nan")
    return float(np.corrcoef(np.arange(len(values)), rankdata(values))[0, 1])


def mean_by_section(sorted_by: ArrayLike, values: ArrayLike, edges: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """The mean of `values` in each section of `sorted_by`, both any shape, and the number in each: (N,) and (N,).

    Section i is from edges[i] up to edges[i + 1]; the last one has its upper edge too. The mean of an empty section is
    NaN.
    """
    edges = np.asarray(edges)
    place = np.digitize(np.ravel(sorted_by), edges[1:-1])
    within = (np.ravel(sorted_by) >= edges[0]) & (np.ravel(sorted_by) <= edges[-1])
    sums, counts = (np.bincount(place[within], weights, len(edges) - 1) for weights in (np.ravel(values)[within], None))
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan), counts
