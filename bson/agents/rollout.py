"""Where the robot will be under a sequence of commands, and how near people will be then: what agents that try their
commands before they drive have in common. For JAX, many sequences at once."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bson.agents.contract import Setting


@dataclass(frozen=True)
class RolloutConfig:
    """What the robot's own dynamics are taken to be. Metres, seconds, radians."""

    acceleration: float = 3.25  # that the tyres give, in top speeds a second, for all shipped robots [1/s]
    turn_lag: float = 0.1  # time constant of the yaw rate
    max_lateral_acceleration: float = 2.5  # beyond it the Jackal turns more sharply than commanded [m/s2]


def robot_row(config: RolloutConfig, setting: Setting) -> np.ndarray:
    """(6,): the robot's top speed [m/s], top yaw rate [rad/s], acceleration [m/s2], and its footprint's half length,
    half width and radius [m]."""
    robot = setting.robot
    accel = config.acceleration * setting.built_for[0]
    return np.array([*setting.top, accel, robot.half_length, robot.half_width, robot.radius], np.float32)


def rollout(
    config: RolloutConfig,
    robot: Any,
    state: Any,
    step: Any,
    commands: Any,
    steer: Callable | None = None,
    given: Any = (),
) -> tuple[Any, Any, Any, Any, Any]:
    """Places x, y, yaws and speeds (T, N) after each `step` [s] of `commands` (T, N, 2) (v, w), from the `state` (5,)
    x, y, yaw, v, w of the `robot` (6,); and the commands (T, N, 2) within what the tyres hold.

    steer(command, x, y, yaw, *now): changes a step's command (N, 2); now: that step's rows of the arrays `given`."""
    acceleration = robot[2]
    follow = jnp.minimum(1.0, step / config.turn_lag)

    def advance(carried, now):
        x, y, yaw, v, w = carried
        command = now[0] if steer is None else steer(now[0], x, y, yaw, *now[1:])
        new_v = v + jnp.clip(command[:, 0] - v, -acceleration * step, acceleration * step)
        most = config.max_lateral_acceleration / jnp.maximum(jnp.abs(new_v), 1e-3)
        command = jnp.stack([command[:, 0], jnp.clip(command[:, 1], -most, most)], axis=-1)
        new_w = w + follow * (command[:, 1] - w)
        middle = yaw + 0.5 * step * new_w
        way = 0.5 * step * (v + new_v)
        moved = (x + way * jnp.cos(middle), y + way * jnp.sin(middle), yaw + step * new_w, new_v, new_w)
        return moved, (*moved[:4], command)

    n = commands.shape[1]
    start = tuple(jnp.broadcast_to(value, (n,)) for value in state)
    return jax.lax.scan(advance, start, (commands, *given))[1]


def gaps(robot: Any, x: Any, y: Any, yaw: Any, discs: Any, radius: Any) -> Any:
    """The gaps (T, N, K) [m] between the `robot`'s footprint at x, y, yaw (T, N) and `discs` of `radius` [m] at (T, K,
    2); where a disc's middle is within the footprint, -radius."""
    dx, dy = discs[:, None, :, 0] - x[..., None], discs[:, None, :, 1] - y[..., None]
    cos, sin = jnp.cos(yaw)[..., None], jnp.sin(yaw)[..., None]
    ahead, aside = jnp.abs(cos * dx + sin * dy) - robot[3], jnp.abs(cos * dy - sin * dx) - robot[4]
    return jnp.sqrt(jnp.maximum(ahead, 0.0) ** 2 + jnp.maximum(aside, 0.0) ** 2) - radius


def gap(robot: Any, x: Any, y: Any, yaw: Any, discs: Any, radius: Any) -> Any:
    """The least of `gaps` (T, N) [m]."""
    return jnp.min(gaps(robot, x, y, yaw, discs, radius), axis=-1)


def going_on(places: np.ndarray, velocities: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Where people at `places` (n, 2) [m] will be (n, T, 2) at `times` (T,) [s] if they keep their `velocities`."""
    return places[:, None] + times[:, None] * velocities[:, None]
