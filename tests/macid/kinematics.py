"""A crowd without physics, for tests of pedestrian models: position += velocity * period."""

import jax
import jax.numpy as jnp
import numpy as np

from macid.state import CrowdState

OPEN = np.zeros((0, 5))  # no boxes
DOORWAY = np.array([[0.0, 5.6, 0.1, 5.0, 0.0], [0.0, -5.6, 0.1, 5.0, 0.0]])  # a wall along y with a gap of 1.2 m


def crowd(position, velocity=None):
    """People at `position` (..., K, 2) with yaw 0, standing unless `velocity` (..., K, 2) is given."""
    position = jnp.asarray(position, jnp.float32)
    velocity = jnp.zeros_like(position) if velocity is None else jnp.asarray(velocity, jnp.float32)
    zero = jnp.zeros(position.shape[:-1])
    return CrowdState(position, zero, velocity, zero, zero.astype(bool))


def walk(controller, position, boxes, goals, seconds):
    """The states of people who start standing: a CrowdState of NumPy arrays with a leading axis of time."""
    boxes, goals = jnp.asarray(boxes, jnp.float32), jnp.asarray(goals, jnp.float32)
    period = controller.period

    def step(state, _):
        command = controller(state, boxes, goals, None)
        velocity, yaw_rate = command[..., :2], command[..., 2]
        position, yaw = state.position + velocity * period, state.yaw + yaw_rate * period
        state = CrowdState(position, yaw, velocity, yaw_rate, state.contact)
        return state, state

    run = jax.jit(lambda state: jax.lax.scan(step, state, length=round(seconds / period))[1])
    return jax.tree.map(np.asarray, run(crowd(position)))


def least_distance(position):
    """Least distance between two people's centres in `position` (T, K, 2) [m]."""
    distance = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1)
    first, second = np.triu_indices(position.shape[1], 1)
    return distance[:, first, second].min()


def arrival_time(position, goals, period, within=0.3):
    """When each person of `position` (T, K, 2) first comes close to its goal (K, 2): (K,) [s], infinite if never."""
    close = np.linalg.norm(position - goals, axis=-1) < within
    return np.where(close.any(axis=0), (close.argmax(axis=0) + 1) * period, np.inf)


def ring(people, radius, heading=0.0):
    """`people` places (K, 2) evenly on a circle around the origin [m], the first in the direction `heading` [rad]."""
    angle = heading + np.linspace(0, 2 * np.pi, people, endpoint=False)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
