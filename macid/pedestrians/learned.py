"""Pedestrians moved by a learned policy."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from macid import encounters, geometry
from macid.encounter_policy import EncounterPolicy
from macid.geometry import Array
from macid.observation import observe
from macid.pedestrians.facing import face_velocity
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
        state = type(state)(*map(jnp.asarray, state))
        observed = observe(state, jnp.asarray(boxes), jnp.asarray(goals))
        action = self.policy.act(jnp.asarray(observed, jnp.float32), jnp.asarray(lcf, jnp.float32))
        return to_command(to_velocity(action), state.yaw)


@dataclass(frozen=True)
class LearnedEncounters:
    """An EncounterPolicy's mean action, from `macid.encounters`. `lcf` sets each person's temper."""

    policy: EncounterPolicy
    period: float = 0.1  #: between two decisions [s]

    def __call__(self, state: CrowdState, boxes: Array, goals: Array, lcf: Array) -> Array:
        """World-frame velocity [m/s] and yaw rate [rad/s]: (..., K, 3); see macid.pedestrians."""
        state, goals = jax.tree.map(jnp.asarray, state), jnp.asarray(goals)
        observed = jnp.asarray(encounters.observe(state, jnp.asarray(boxes), goals), jnp.float32)
        velocity = self.policy.velocity(observed, jnp.asarray(lcf, jnp.float32), self.period)
        return goal_command(velocity, state, goals, self.period)


def goal_command(velocity: Array, state: CrowdState, goals: Array, period: float) -> Array:
    """The command (..., K, 3) of people who want `velocity` (..., K, 2) [m/s], in the goal's frame, for `period` [s];
    no faster than their traits allow."""
    velocity = geometry.from_frame(velocity, encounters.towards(state, goals))
    if (fastest := state.traits.max_speed) is not None:
        speed = geometry.norm(velocity)
        velocity = velocity * (jnp.minimum(speed, fastest) / jnp.maximum(speed, 1e-6))[..., None]
    return face_velocity(velocity, state.yaw, period)
