"""Pedestrians moved by a learned policy."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from macid.geometry import Array
from macid.observation import observe
from macid.policy import Policy, to_velocity
from macid.state import CrowdState


def to_command(velocity: Array, yaw: Array) -> Array:
    """Command (..., 3), world velocity [m/s] and yaw rate [rad/s], of (v, w) (..., 2) by people facing `yaw` (...)."""
    ahead = velocity[..., :1] * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
    return jnp.concatenate([ahead, velocity[..., 1:]], axis=-1)


@dataclass(frozen=True)
class Learned:
    """A policy's mean action, from the observation that it was trained with. `lcf` sets each person's temper."""

    policy: Policy
    period: float = 0.02  #: between two decisions [s]

    def __call__(self, state: CrowdState, boxes: Array, goals: Array, lcf: Array) -> Array:
        """World-frame velocity [m/s] and yaw rate [rad/s]: (..., K, 3); see macid.pedestrians."""
        state = jax.tree.map(jnp.asarray, state)
        observed = observe(state, jnp.asarray(boxes), jnp.asarray(goals))
        action = self.policy.act(jnp.asarray(observed, jnp.float32), jnp.asarray(lcf, jnp.float32))
        return to_command(to_velocity(action), state.yaw)
