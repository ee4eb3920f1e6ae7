"""The individual reward (eq. 5), for pedestrians and for the robot."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class RewardWeights:
    """Weights of eq. 5; the collision weight is a penalty."""

    distance: float = 10.0  # per metre that the goal came closer
    goal: float = 1.0
    collision: float = 0.6


def individual_reward(distance_reduced, arrived, collided, weights=RewardWeights()):
    """Eq. 5: w_d r_d + w_g I_g - w_c I_c, any shape. distance_reduced in metres; arrived, collided are indicators."""
    return weights.distance * distance_reduced + weights.goal * arrived - weights.collision * collided
