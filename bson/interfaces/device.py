"""Many worlds of `bson.interfaces.functional` at once, which begin the next episode by themselves. The vector
environment, training and the bench build on them. No step waits for the host."""

import os
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bson.simulation.engines.warp import OutOfRoom
from bson.simulation.pool import Pool
from macid.state import GOAL_RADIUS

_FASTER = 2.0  # a pushed robot is at most this many times as fast as its motors make it


class Carry(NamedTuple):
    """The state of all worlds; leading axes (num_envs,)."""

    states: Any  #: State
    over: Any  #: bool: the episode has ended, and the next step begins another one
    slot: Any  #: () int32: the pool's slot of the next episode
    begun: Any  #: () int32: number of episodes that have begun
    lost: Any  #: () int32: every `overflow` of the engine so far, or-ed


class Outcome(NamedTuple):
    """The results of a step; leading axes (num_envs,). Where an episode began in the step, reward and ends are 0."""

    observation: dict
    reward: Any
    terminated: Any
    truncated: Any
    began: Any  #: bool: an episode began, so the action had no effect


class DeviceWorlds:
    """`env.num_envs` worlds of the BsonFuncEnv `env`, with a pool of episodes from `seed` on.

    `step` is pure, for jax.jit and jax.lax.scan: step(carry, actions, episodes) -> (Carry, Outcome). Before up to
    `steps` steps, call `ready(steps)`, which gives the `episodes`; after them call `done(carry)`. ahead: the most steps
    that are asked for at once. pool: how many episodes are kept ready; None: enough for `ahead` steps. workers:
    processes that draw episodes; None: as many as there are cores to spare, for many worlds. settings: of episodes,
    see bson.simulation.pool; shortest: the least distance of a start from its goal in them [m], None: the task's.
    """

    def __init__(
        self,
        env: Any,
        seed: int = 0,
        pool: int | None = None,
        workers: int | None = None,
        ahead: int = 2,
        settings: Any = None,
        shortest: float | None = None,
    ):
        self.env, self.num_envs = env, env.num_envs
        if workers is None:
            workers = 0 if env.num_envs < 256 else max(1, min(16, (os.cpu_count() or 2) - 1))
        self._counted, config = 0, env.config
        reach = _FASTER * config.robot.max_speed * config.control_period
        nearest = config.goal_distance[0] if shortest is None else shortest
        self._least = max(1, min(config.horizon, int((nearest - GOAL_RADIUS) / reach)))
        size = max(128, env.num_envs + self.most_begun(ahead) + 128) if pool is None else pool
        self.pool = Pool(config, -(-size // 64) * 64 if size > 64 else size, seed, env.has_map, workers, settings)
        self._begin = jax.jit(self._first)

    def restart(self, seed: int) -> None:
        """Starts the pool's episodes anew at `seed`; call `begin` after it."""
        pool = self.pool
        pool.close()
        self.pool = Pool(pool.config, pool.size, seed, self.env.has_map, pool.workers, pool.settings)

    def resume(self, carry: Any, seed: int) -> Any:
        """`carry`, of worlds that were put away, as one whose next episode is the pool's first, `seed`."""
        self.restart(seed)
        self._counted = int(carry.begun)
        return carry._replace(slot=jnp.zeros((), jnp.int32))

    def most_begun(self, steps: int) -> int:
        """How many episodes may begin in `steps` steps at most."""
        return self.num_envs * (1 + steps // (self._least + 1))

    def _first(self, slot, episodes):
        slots = (slot + jnp.arange(self.num_envs)) % self.pool.size
        states = jax.vmap(self.env.initial, in_axes=(0, None))(slots, episodes)
        none = jnp.zeros((), jnp.int32)
        slot = (slot + self.num_envs) % self.pool.size
        carry = Carry(states, jnp.zeros(self.num_envs, bool), jnp.asarray(slot, jnp.int32), none, none)
        return carry, jax.vmap(self.env.observation)(states)

    def begin(self) -> Any:
        """A Carry with the next episodes of the pool in all worlds, and its observations."""
        self.pool.ensure(self.num_envs)
        slot = self.pool.begun % self.pool.size
        carry, observation = self._begin(jnp.int32(slot), self.pool.episodes)
        self.pool.used(self.num_envs)
        self._counted = 0
        return carry, observation

    def ready(self, steps: int = 1) -> Any:
        """The pool's episodes, once there are enough for `steps` steps. Raises NoFreeSpace."""
        self.pool.ensure(self.most_begun(steps))
        return self.pool.episodes

    def done(self, carry: Any) -> None:
        """Counts the episodes that have begun up to `carry`. Raises OutOfRoom where physics did."""
        self.count(self.tally(carry))

    @staticmethod
    def tally(carry: Any) -> jax.Array:
        """The argument of `count`: a new array, which stays valid when the buffers of `carry` are donated to the next
        step."""
        return jnp.stack([carry.begun, carry.lost])

    def count(self, tally: jax.Array) -> None:
        """As `done`, from an array of `tally`."""
        begun, lost = map(int, jax.device_get(tally))
        self.pool.used((begun - self._counted) % 2**32)
        self._counted = begun
        if lost:
            raise OutOfRoom(self.env.world.engine.explain(lost))

    def step(self, carry: Any, actions: jax.Array, episodes: Any) -> tuple[Any, Any]:
        """One control step of all worlds, see the class. actions: (num_envs, 2)."""
        env, states, over = self.env, carry.states, carry.over
        number = over.sum(dtype=jnp.int32)
        slots = (carry.slot + jnp.cumsum(over, dtype=jnp.int32) - 1) % self.pool.size
        after = jax.vmap(env.follow, in_axes=(0, 0, 0, 0, None))(states, actions, over, slots, episodes)
        reward = jnp.where(over, 0.0, jax.vmap(env.reward)(states, actions, after))
        terminated = jax.vmap(env.terminal)(after) & ~over
        truncated = jax.vmap(env.truncation)(after) & ~over
        lost = jax.lax.reduce(after.overflow, jnp.int32(0), jax.lax.bitwise_or, (0,))
        carry = Carry(
            after,
            terminated | truncated,
            (carry.slot + number) % self.pool.size,
            carry.begun + number,
            carry.lost | lost,
        )
        return carry, Outcome(jax.vmap(env.observation)(after), reward, terminated, truncated, over)

    def close(self) -> None:
        """Stops drawing episodes."""
        self.pool.close()
