"""The worlds of `bson.interfaces.functional` as a Gymnasium vector environment: `gymnasium.make_vec(id, num_envs=4096,
engine="warp")`."""

from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode

from bson.episodes.session import closed
from bson.interfaces.device import DeviceWorlds
from bson.interfaces.functional import BsonFuncEnv
from bson.interfaces.gym import ACTION_SPACE, Specified, check_seed, checked_action, frames_per_second
from bson.simulation.engines.warp import warp_config
from bson.simulation.pool import check_number
from bson.simulation.world import check_worlds
from macid.documents import shown

OUTPUTS = ("numpy", "jax", "torch")
_METADATA = {"render_modes": [], "render_fps": 10, "autoreset_mode": AutoresetMode.NEXT_STEP, "jax": True}
_NO_SEED = 2**31, 2**61  # the first episode's seed is drawn from here where the user gives none


class WarpVectorEnv(Specified, gymnasium.vector.VectorEnv):
    """`num_envs` worlds of `bson.interfaces.gym.BsonEnv` on one device, with the spaces, infos and arguments of
    BsonVectorEnv.

    Episodes have the seeds s, s + 1, ... of `reset(seed=s)`, in the order in which the episodes begin; no seed comes
    twice. A world whose episode ended begins the next one in the step that follows (NextStep, Gymnasium's default
    mode).

    output: the kind of arrays for observations, rewards, ends and infos: "numpy", or "jax" or "torch" on the device,
    without a copy. With "jax" and "torch" `info["seed"]` (num_envs, 2) is in halves of 32 bits, the lower first, and
    `info["fault"]` a bool. Actions may be of any of the three kinds; one on the device that is not finite can't be
    refused without waiting for it, and ends the episode as a fault. pool: how many episodes are kept ready; workers:
    processes that draw them; None: as many as are needed. limits: a dict of fields of
    bson.simulation.engines.warp.WarpConfig.
    """

    metadata = _METADATA

    def __init__(
        self,
        num_envs: int = 1,
        track: str = "local",
        sensor: Any = "lidar2d",
        render_mode: str | None = None,
        seed: Any = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        output: str = "numpy",
        pool: int | None = None,
        workers: int | None = None,
        limits: dict[str, Any] | None = None,
        **config: Any,
    ):
        if render_mode is not None:
            raise ValueError("A vector environment draws no pictures: use render_mode=None, or a single environment.")
        if AutoresetMode(autoreset_mode) is not AutoresetMode.NEXT_STEP:
            raise ValueError(
                f"The engine 'warp' has the autoreset_mode NextStep only, not {AutoresetMode(autoreset_mode).value}."
            )
        if output not in OUTPUTS:
            raise ValueError(f"output must be one of {', '.join(OUTPUTS)}, not {shown(output)}.")
        check_worlds("num_envs", num_envs)
        check_number("pool", pool, 1)
        check_number("workers", workers, 0)
        self._first_seed = _one_seed(seed)
        self._arguments = {"num_envs": num_envs, "track": track, "sensor": sensor, "seed": seed, "output": output}
        self._arguments |= {"pool": pool, "workers": workers, "limits": limits, **config}
        self.num_envs, self.render_mode, self._output = num_envs, None, output
        engine = warp_config(limits)
        self._func = BsonFuncEnv(track, sensor, num_envs, engine=engine, **config)
        self.config = self._func.config
        self.metadata = {**self.metadata, "render_fps": frames_per_second(self.config)}
        self.single_observation_space, self.single_action_space = self._func.observation_space, ACTION_SPACE
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self._pool: dict[str, Any] = {"pool": pool, "workers": workers}
        self._worlds: DeviceWorlds | None = None
        self._step: Callable | None = None
        self._carry = self._tally = None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode in every world."""
        if options:
            raise ValueError(
                f"The engine 'warp' takes no options of reset: give {shown(next(iter(options)))} to make_vec."
            )
        if self.closed:
            raise closed()
        seed, self._first_seed = _one_seed(seed if seed is not None else self._first_seed), None
        if self._worlds is None:
            seed = int(np.random.default_rng().integers(*_NO_SEED)) if seed is None else seed
            self._worlds = DeviceWorlds(self._func, seed, **self._pool)
            self._step = jax.jit(self._stepped, donate_argnums=0)
        elif seed is not None:
            self._worlds.restart(seed)
        elif self._tally is not None:
            self._worlds.count(self._tally)
        self._carry, observation = self._worlds.begin()
        self._tally = None
        # Copies, as the next step may use the memory of the states.
        info = jax.tree.map(jnp.copy, jax.vmap(self._func.state_info)(self._carry.states))
        return self._given((observation, self._infos(info)))

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step of every world; a world whose episode ended begins its next instead."""
        worlds, step = self._worlds, self._step
        if self.closed:
            raise closed()
        if self._carry is None or worlds is None or step is None:
            raise gymnasium.error.ResetNeeded("Call reset before step.")
        episodes = worlds.ready(2)  # 2: the last step may not be counted yet
        self._carry, outcome, info, tally = step(self._carry, self._taken(actions), episodes)
        if self._tally is not None:
            worlds.count(self._tally)  # of the step before, so that the host need not wait for this step
        self._tally = tally
        ends = outcome.reward, outcome.terminated, outcome.truncated
        observation, (reward, terminated, truncated), info = self._given((outcome.observation, ends, self._infos(info)))
        if self._output == "numpy":
            reward = reward.astype(float)
        return observation, reward, terminated, truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """Frees all resources. After it the environment can't be stepped or reset."""
        self._close_worlds()

    def _close_worlds(self):
        if self._worlds is not None:
            self._worlds.close()
        self._worlds = self._carry = self._step = self._tally = None

    def _stepped(self, carry, actions, episodes):
        assert self._worlds is not None  # there is a carry, so there are worlds
        carry, outcome = self._worlds.step(carry, actions, episodes)
        return carry, outcome, jax.vmap(self._func.state_info)(carry.states), self._worlds.tally(carry)

    def _taken(self, actions):
        """`actions` (num_envs, 2) as a JAX array. Raises ValueError for another shape or values that are not finite, as
        far as this can be told without waiting for the device."""
        if not isinstance(actions, jax.Array):
            if not hasattr(actions, "__dlpack__") or isinstance(actions, np.ndarray | np.generic):
                return jnp.asarray(checked_action(actions, (self.num_envs, 2)), jnp.float32)
            actions = jnp.from_dlpack(actions.detach() if hasattr(actions, "detach") else actions)
        if actions.shape != (self.num_envs, 2):
            raise ValueError(f"An action must have shape {(self.num_envs, 2)}, not {actions.shape}.")
        return jnp.asarray(actions, jnp.float32)

    def _infos(self, info):
        if self._output == "numpy":
            info = jax.tree.map(np.array, jax.device_get(info))
            low, high = info["seed"].astype(np.int64).T
            words = np.where(info["fault"], "physics failed", "").astype(object)
            info = {**info, "seed": low | high << 32, "fault": words}
            return {**info, **{f"_{name}": np.ones(self.num_envs, bool) for name in info}}
        return {**info, **{f"_{name}": jnp.ones(self.num_envs, bool) for name in info}}

    def _given(self, tree):
        if self._output == "jax":
            return tree
        if self._output == "numpy":
            return jax.tree.map(lambda x: np.array(x) if isinstance(x, jax.Array) else x, tree)
        import torch

        return jax.tree.map(torch.from_dlpack, tree)


def _one_seed(seed):
    """`seed` as an int, or None. Raises ValueError for anything else."""
    check_seed(seed)
    if seed is not None and np.ndim(seed):
        raise ValueError("The engine 'warp' takes one seed: its episodes have that, and those that follow.")
    return None if seed is None else int(seed)
