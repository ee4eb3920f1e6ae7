"""What every physics engine gives, and all that the code behind `macid.engines` sees."""

from typing import Any, NamedTuple

import numpy as np

from macid.geometry import Array

RADIUS = 0.35  # of a pedestrian [m]
RADII = (0.1, 0.5)  # least and greatest radius that people may be given [m]
HEIGHT = 1.7  # of a pedestrian [m]
RESPONSE = 0.01  # time constant with which a pedestrian's body follows a commanded velocity [s]
MAX_SPEED = 1.5  # [m/s]
TOP_SPEED = 2.0  # a maximum speed that people may be given, at most [m/s]
MAX_YAW_RATE = 1.0  # [rad/s]
MAX_LCF = 2.0  # local coordination factors lie within it, on both sides of 0
CONTACT_GAP = 0.01  # a surface gap up to this counts as a collision [m] (Unity's contact offset)
GOAL_RADIUS = 0.5  # [m]
PHYSICS_STEP = 0.02  # [s]
STALLED = 0.1  # below this speed a person, or a robot, stands [m/s]


def physics_steps(period: float) -> int:
    """How many physics steps a `period` [s] between decisions is. Raises ValueError unless it is a multiple of one."""
    steps = round(period / PHYSICS_STEP) if np.isfinite(period / PHYSICS_STEP) else 0
    if steps < 1 or abs(steps * PHYSICS_STEP - period) > 1e-9:
        raise ValueError(f"period must be a multiple of the physics step {PHYSICS_STEP} s, not {period}.")
    return steps


# Whoever has left the map, and every unused slot of a batch, stands out here, out of everybody's range [m].
FAR_AWAY = 1000.0


class Traits(NamedTuple):
    """What sets people's bodies and wishes apart: arrays (..., K), or None where everybody is as the paper has it."""

    radius: Any = None  #: [m]; None: RADIUS
    preferred_speed: Any = None  #: at which a person walks where nobody is in its way [m/s]; None: its model's own
    max_speed: Any = None  #: [m/s]; None: MAX_SPEED
    group: Any = None  #: int: people of one number mean to stay together; None: everybody walks alone


PAPER_TRAITS = Traits()  #: what everybody is like in the paper


class CrowdState(NamedTuple):
    """A crowd at one instant, in the world frame. NumPy or JAX arrays, with any leading axes."""

    position: Any  #: (..., K, 2) [m]
    yaw: Any  #: (..., K) [rad]
    velocity: Any  #: (..., K, 2) [m/s]
    yaw_rate: Any  #: (..., K) [rad/s]
    contact: Any  #: (..., K) bool: closer than CONTACT_GAP to a person, an obstacle or a wall
    traits: Traits = PAPER_TRAITS  #: of each person; no leaves, and so nothing to trace, where all are the paper's

    @property
    def radius(self) -> Any:
        """Of each person (..., K), or one number for all [m]."""
        return RADIUS if self.traits.radius is None else self.traits.radius

    def speeds(self, preferred: Any, most: Any) -> tuple[Any, Any]:
        """(preferred speed, top speed) [m/s] of people whose model's own are `preferred` and `most`: numbers where the
        traits leave them to the model, else arrays (..., K)."""
        most = most if self.traits.max_speed is None else self.traits.max_speed
        if self.traits.preferred_speed is not None:
            preferred = self.traits.preferred_speed
        elif self.traits.max_speed is None:
            return preferred, most
        xp = (preferred if self.traits.max_speed is None else most).__array_namespace__()
        return xp.minimum(xp.asarray(preferred), xp.asarray(most)), most


def parking_place(index: Array) -> np.ndarray:
    """Where slot `index` (any shape) of a crowd stands when it is not on the map: (..., 2) [m]."""
    index = np.asarray(index, dtype=float)
    return np.stack([FAR_AWAY + 2.0 * index, np.full_like(index, FAR_AWAY)], axis=-1)
