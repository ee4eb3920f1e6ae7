"""Turning a model's velocity into a pedestrian's command: it looks where it goes."""

import jax.numpy as jnp

from macid.geometry import Array, norm, wrap_angle
from macid.state import MAX_YAW_RATE

STANDING = 0.05  # a person slower than this keeps its yaw [m/s]


def face_velocity(velocity: Array, yaw: Array, period: float) -> Array:
    """Command (..., 3) for world-frame `velocity` (..., 2) [m/s] of people who look along `yaw` (...) [rad].

    The third column is the yaw rate [rad/s] that would turn them into the velocity's direction within `period` [s], up
    to MAX_YAW_RATE; zero for a person who nearly stands.
    """
    heading = jnp.arctan2(velocity[..., 1], velocity[..., 0])
    rate = jnp.clip(wrap_angle(heading - yaw) / period, -MAX_YAW_RATE, MAX_YAW_RATE)
    rate = jnp.where(norm(velocity) < STANDING, 0.0, rate)
    return jnp.concatenate([velocity, rate[..., None]], axis=-1)
