"""How well a crowd walks (paper, sec. IV-A): success rate, collision penalty, path efficiency. Pure functions on arrays."""

import numpy as np


def success_rate(arrived, collisions, tolerated=10):
    """SR_n [%]: the share of people who arrived and collided in fewer than `tolerated` (n) steps of 0.02 s.

    arrived: bool, collisions: int, both any shape.
    """
    return 100.0 * float(np.mean(np.asarray(arrived) & (np.asarray(collisions) < tolerated)))


def collision_penalty(collisions):
    """CP: steps of 0.02 s in which a person touches somebody or something, per person and episode."""
    return float(np.mean(collisions))


def path_efficiency(arrived, distance, travelled):
    """PE [%]: start-to-goal distance over the distance walked, at most 1, over those who arrived; NaN if nobody did.

    (Who has not arrived has no finished path. The last 0.5 m are not walked, hence the bound.)
    """
    arrived = np.asarray(arrived)
    if not arrived.any():
        return float("nan")
    ratio = np.asarray(distance)[arrived] / np.maximum(np.asarray(travelled)[arrived], 1e-9)
    return 100.0 * float(np.mean(np.minimum(ratio, 1.0)))
