"""What every physics engine gives, and all that the code behind `physics.py` sees."""

from typing import Any, NamedTuple

import numpy as np

RADIUS = 0.35  # of a pedestrian [m]
HEIGHT = 1.7  # of a pedestrian [m]
RESPONSE = 0.01  # time constant with which a pedestrian's body follows a commanded velocity [s]
MAX_SPEED = 1.5  # [m/s]
MAX_YAW_RATE = 1.0  # [rad/s]
CONTACT_GAP = 0.01  # a surface gap up to this counts as a collision [m] (Unity's contact offset)
GOAL_RADIUS = 0.5  # [m]
PHYSICS_STEP = 0.02  # [s]

# Whoever has left the map, and every unused slot of a batch, stands out here, out of everybody's range [m].
FAR_AWAY = 1000.0


class CrowdState(NamedTuple):
    """A crowd at one instant, in the world frame. NumPy or JAX arrays, with any leading axes."""

    position: Any  #: (..., K, 2) [m]
    yaw: Any  #: (..., K) [rad]
    velocity: Any  #: (..., K, 2) [m/s]
    yaw_rate: Any  #: (..., K) [rad/s]
    contact: Any  #: (..., K) bool: closer than CONTACT_GAP to a person, an obstacle or a wall


def parking_place(index):
    """Where slot `index` (any shape) of a crowd stands when it is not on the map: (..., 2) [m]."""
    index = np.asarray(index, dtype=float)
    return np.stack([FAR_AWAY + 2.0 * index, np.full_like(index, FAR_AWAY)], axis=-1)
