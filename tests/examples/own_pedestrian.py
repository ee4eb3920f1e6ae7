"""A pedestrian model of one's own: people walk straight to their goals and keep to the right of whoever is near.

bson evaluate --agent vfh --suite smoke --set pedestrian_model=own_pedestrian.py:KeepRight
macid evaluate --pedestrian own_pedestrian.py:KeepRight --levels 1
"""

import jax.numpy as jnp

SPEED = 1.3  # [m/s]
NEAR = 1.5  # between centres [m]


class KeepRight:
    """A controller: see macid.pedestrians. It is traced by jax.jit, so it is written with jax.numpy."""

    def __init__(self, period):
        self.period = period  # between decisions [s]

    def __call__(self, state, boxes, goals, lcf):
        ahead = goals - state.position
        ahead = ahead / jnp.maximum(jnp.linalg.norm(ahead, axis=-1, keepdims=True), 1e-6)
        away = state.position[..., None, :, :] - state.position[..., :, None, :]  # from each to each (..., K, K, 2)
        distance = jnp.linalg.norm(away, axis=-1) + 1e3 * jnp.eye(away.shape[-2])
        met = (distance < NEAR) & (jnp.sum(away * ahead[..., None, :], axis=-1) > 0)
        right = jnp.stack([ahead[..., 1], -ahead[..., 0]], axis=-1)
        way = jnp.where(jnp.any(met, axis=-1)[..., None], ahead + right, ahead)
        velocity = SPEED * way / jnp.linalg.norm(way, axis=-1, keepdims=True)
        return jnp.concatenate([velocity, jnp.zeros_like(velocity[..., :1])], axis=-1)
