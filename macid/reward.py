"""The individual reward (eq. 5), for pedestrians and for the robot."""

import dataclasses

from macid import geometry
from macid.documents import MOST_NUMBER, is_number, shown
from macid.geometry import Array


@dataclasses.dataclass(frozen=True)
class RewardWeights:
    """Weights of eq. 5; the collision weight is a penalty. Raises ValueError for what is no number."""

    distance: float = 10.0  # per metre that the goal came closer
    goal: float = 1.0
    collision: float = 0.6

    def __post_init__(self):
        for field in dataclasses.fields(self):
            if not is_number(value := getattr(self, field.name)):
                raise ValueError(
                    f"RewardWeights: {field.name} must be a number from {-MOST_NUMBER:g} to {MOST_NUMBER:g}, "
                    f"not {shown(value)}."
                )


WEIGHTS = RewardWeights()  #: those where nothing else is said


def individual_reward(
    distance_reduced: Array, arrived: Array, collided: Array, weights: RewardWeights = WEIGHTS
) -> Array:
    """Eq. 5: w_d r_d + w_g I_g - w_c I_c, any shape. distance_reduced in metres; arrived, collided are indicators."""
    return weights.distance * distance_reduced + weights.goal * arrived - weights.collision * collided


NEIGHBOR_DISTANCE = 5.0  # d_n of eq. 1 [m]


def neighbors(position: Array) -> Array:
    """Who neighbours whom, eq. 1: (..., K, K) bool for people at `position` (..., K, 2) [m]. Nobody neighbours
    himself."""
    return geometry.pairs_within(position, NEIGHBOR_DISTANCE)


def neighborhood_mean(values: Array, near: Array) -> Array:
    """Mean of `values` (..., K, F) over each person's neighbours `near` (..., K, K): (..., K, F); 0 without neighbours.

    Eq. 1 is this mean of the neighbours' individual rewards.
    """
    xp = values.__array_namespace__()
    weight = xp.astype(near, values.dtype)
    count = xp.sum(weight, axis=-1, keepdims=True)
    return weight @ values / xp.maximum(count, xp.ones_like(count))
