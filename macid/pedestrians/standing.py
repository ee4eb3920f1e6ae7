"""People who stand still."""

from dataclasses import dataclass

import jax.numpy as jnp

from macid.geometry import Array
from macid.state import CrowdState


@dataclass(frozen=True)
class Standing:
    """Everybody stays. Goals and `lcf` do not matter."""

    period: float = 0.02  #: between two decisions [s]

    def __call__(self, state: CrowdState, boxes: Array, goals: Array, lcf: Array) -> Array:
        """No velocity [m/s], no yaw rate [rad/s]: (..., K, 3); see macid.pedestrians."""
        return jnp.zeros((*state.position.shape[:-1], 3), jnp.float32)
