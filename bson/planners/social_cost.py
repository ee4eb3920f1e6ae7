"""The cost of being near people, on an occupancy grid."""

import math
from dataclasses import dataclass

import numpy as np

from bson.planners.grid import Grid


@dataclass(frozen=True)
class SocialCostConfig:
    """The cost of being near a person."""

    weight: float = 10.0  # cost at the person's place, per metre of way
    sigma: float = 0.6  # to the sides, behind, and all around a standing person [m]
    stretch: float = 1.0  # growth of sigma ahead, per speed [s]

    def __post_init__(self):
        if not (self.weight >= 0 and self.sigma > 0 and self.stretch >= 0):
            raise ValueError(f"weight and stretch must be at least 0 and sigma above, not {self}.")


def social_cost(
    grid: Grid, people: np.ndarray, velocity: np.ndarray, config: SocialCostConfig = SocialCostConfig()
) -> np.ndarray:
    """The cost (rows, columns) >= 0 of each cell's nearness to people, at its centre.

    people (K, 2) [m] and velocity (K, 2) [m/s], world frame. With (x, y) the centre seen from a person, x along the
    velocity v, the cost is the sum over people of

        weight * exp(-(x / s)^2 / 2 - (y / sigma)^2 / 2),  s = sigma + stretch * |v| where x > 0, sigma elsewhere,

    an asymmetric Gaussian as in Kirby, "Social robot navigation" (2010). Below a thousandth of the weight it is 0.
    """
    people, velocity = np.reshape(people, (-1, 2)).astype(float), np.reshape(velocity, (-1, 2)).astype(float)
    if people.shape != velocity.shape or not (np.isfinite(people).all() and np.isfinite(velocity).all()):
        raise ValueError("People and their velocities need the same number of finite rows (x, y).")
    cost = np.zeros(grid.shape)
    rows, columns = grid.shape
    cut = math.sqrt(2.0 * math.log(1000.0))
    for place, (vx, vy) in zip(grid.scaled(people), velocity, strict=True):
        speed = math.hypot(vx, vy)
        ahead = config.sigma + config.stretch * speed
        reach = cut * ahead / grid.resolution
        (j, i), (to_j, to_i) = np.clip([place - reach, place + reach + 1], 0, (columns, rows)).astype(int)
        dx = (np.arange(j, to_j) + 0.5 - place[0]) * grid.resolution
        dy = (np.arange(i, to_i)[:, None] + 0.5 - place[1]) * grid.resolution
        c, s = (vx / speed, vy / speed) if speed else (1.0, 0.0)
        x, y = c * dx + s * dy, c * dy - s * dx
        squared = (x / np.where(x > 0, ahead, config.sigma)) ** 2 + (y / config.sigma) ** 2
        cost[i:to_i, j:to_j] += np.where(squared <= cut**2, config.weight * np.exp(-0.5 * squared), 0.0)
    return cost
