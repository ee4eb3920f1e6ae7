"""Pedestrians moved by a learned policy.

A policy walks at the speed that its training made best, mostly the greatest, 1.5 m/s: its free speed. A person with a
preferred speed has another pace, preferred speed / free speed. It sees all speeds as shares of that pace, and what the
network commands is multiplied by the pace, so that alone it walks at its preferred speed.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from macid import encounters, geometry
from macid.encounter_policy import EncounterPolicy
from macid.geometry import Array
from macid.observation import COLUMNS, RAY_RANGE, RAYS, SIZE, observe
from macid.pedestrians.facing import face_velocity
from macid.policy import Policy, to_velocity
from macid.state import MAX_LCF, MAX_SPEED, CrowdState

FREE_GOAL = 10.0  # distance of the goal of a person who walks freely [m]
FREE_LCFS = np.linspace(-MAX_LCF, MAX_LCF, 17, dtype=np.float32)
_ITERATIONS = 200
_SPEEDS = np.array([0.0] * COLUMNS["goal"] + [1.0, 0.0, 0.0] + [0.0, 1.0, 1.0] * RAYS, bool)  # columns that are speeds


def to_command(velocity: Array, yaw: Array) -> Array:
    """Command (..., 3), world velocity [m/s] and yaw rate [rad/s], of (v, w) (..., 2) by people facing `yaw` (...)."""
    ahead = velocity[..., :1] * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
    return jnp.concatenate([ahead, velocity[..., 1:]], axis=-1)


@functools.lru_cache(64)
def free_speeds(policy: Policy) -> np.ndarray:
    """The speed [m/s] at which a person with each of FREE_LCFS walks where nothing is in sight, towards a goal
    FREE_GOAL ahead: a fixed point of the policy's command as a function of the speed that it sees."""
    observed = np.zeros((len(FREE_LCFS), SIZE), np.float32)
    observed[:, 0] = FREE_GOAL
    observed[:, -3 * RAYS :: 3] = RAY_RANGE
    speed = np.ones(len(FREE_LCFS), np.float32)
    for _ in range(_ITERATIONS):
        observed[:, COLUMNS["goal"]] = speed
        speed = (speed + to_velocity(policy.action(observed, FREE_LCFS))[:, 0]) / 2  # by halves: it can't swing
    return np.maximum(speed, np.float32(0.1))  # of a policy that stands, there is no pace


@dataclass(frozen=True)
class Learned:
    """A policy's mean action, from the observation that it was trained with. `lcf` sets each person's temper."""

    policy: Policy
    period: float = 0.02  #: between two decisions [s]

    def __call__(self, state: CrowdState, boxes: Array, goals: Array, lcf: Array) -> Array:
        """World-frame velocity [m/s] and yaw rate [rad/s]: (..., K, 3); see macid.pedestrians."""
        state = jax.tree.map(jnp.asarray, state)
        observed = jnp.asarray(observe(state, jnp.asarray(boxes), jnp.asarray(goals)), jnp.float32)
        lcf, wanted, most = jnp.asarray(lcf, jnp.float32), state.traits.preferred_speed, state.traits.max_speed
        if wanted is None:
            velocity = to_velocity(self.policy.act(observed, lcf))
        else:
            pace = (wanted / jnp.interp(lcf, FREE_LCFS, free_speeds(self.policy)))[..., None]
            action = self.policy.act(jnp.where(_SPEEDS, observed / pace, observed), lcf)
            velocity = to_velocity(action) * jnp.concatenate([pace, jnp.ones_like(pace)], axis=-1)
        if most is None and wanted is not None:
            most = jnp.full_like(wanted, MAX_SPEED)
        if most is not None:
            capped = jnp.minimum(velocity[..., 0], most)
            velocity = jnp.stack([capped, velocity[..., 1]], axis=-1)
        return to_command(velocity, state.yaw)


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
    most = MAX_SPEED if state.traits.max_speed is None else state.traits.max_speed
    velocity = velocity * jnp.minimum(1.0, most / jnp.maximum(geometry.norm(velocity), 1e-6))[..., None]
    return face_velocity(velocity, state.yaw, period)
