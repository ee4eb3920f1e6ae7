"""BSON's vector environment for stable-baselines3: with the whole observation, or with features of it."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from bson.evaluation import metrics
from bson.features import FEATURES, Features
from bson.interfaces.gym import BsonVectorEnv
from bson.simulation.world import World


class Worlds(VecEnv):
    """The base of these environments: worlds of one configuration, which are not objects of their own."""

    _env: BsonVectorEnv | gymnasium.vector.VectorEnv
    _actions = None

    def step_async(self, actions):
        """Keeps `actions` (num_envs, 2) for `step_wait`."""
        self._actions = actions

    def close(self):
        """Frees all resources; closing twice does no harm."""
        self._env.close()

    def get_attr(self, attr_name, indices=None):
        """An attribute of this environment, once for each of `indices`."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name, value, indices=None):
        """Not possible: all worlds share one configuration."""
        raise NotImplementedError(f"The worlds share one configuration: make another {type(self).__name__}.")

    def env_method(self, method_name, *method_args, indices=None, **method_kwargs):
        """Not possible: the worlds are not objects of their own."""
        raise NotImplementedError("The worlds of a batch have no methods of their own.")

    def env_is_wrapped(self, wrapper_class, indices=None):
        """Whether each of `indices` is wrapped: never."""
        return [False for _ in self._get_indices(indices)]


class WorldsVecEnv(Worlds):
    """A vector environment of `gymnasium.make_vec` for stable-baselines3, which takes none of Gymnasium's:

        env = WorldsVecEnv(gymnasium.make_vec("BSON/LocalLidar2D-v0", num_envs=8))
        PPO("MultiInputPolicy", env).learn(100_000)

    Observations are the dicts of all worlds. A world whose episode ended begins its next in the same step, in each of
    Gymnasium's autoreset modes; its info has `terminal_observation`, `TimeLimit.truncated` and `episode` (return r,
    length l). Infos have the keys of BsonEnv's `info`. `seed(s)` sets the seed of the next reset; `set_options` takes
    TaskConfig's fields for the next reset, the same for all worlds. Raises ValueError for an environment that is not
    BSON's.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv):
        worlds = getattr(env, "unwrapped", None)
        if not isinstance(worlds, BsonVectorEnv):
            raise ValueError(f"WorldsVecEnv takes what gymnasium.make_vec('BSON/...') gives, not {env!r}.")
        self._env, self._worlds, self.render_mode = env, worlds, None
        self._returns, self._lengths = np.zeros(env.num_envs), np.zeros(env.num_envs, int)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    @property
    def world(self) -> World:
        """The World of all worlds, for callers that need more than the observation."""
        return self._worlds.world

    def reset(self) -> Any:
        """Begins an episode in every world; returns their observations."""
        options = self._options[0]
        if any(other != options for other in self._options):
            raise ValueError("The worlds share one configuration: give one set of options for all.")
        seeds: Any = None if all(seed is None for seed in self._seeds) else list(self._seeds)
        observation, info = self._env.reset(seed=seeds, options=options or None)
        self.reset_infos = self._infos(info)
        self._reset_seeds()
        self._reset_options()
        self._returns[:], self._lengths[:] = 0.0, 0
        return observation

    def step_wait(self) -> Any:
        """One control step; returns observations, rewards (num_envs,), dones, infos."""
        observation, reward, terminated, truncated, info = self._env.step(self._actions)
        self._returns += reward
        self._lengths += 1
        done = terminated | truncated
        final = info.get("final_info", info)
        infos = self._infos(info)
        if not done.any():
            return observation, reward.astype(np.float32), done, infos
        ended, of_the_end = np.flatnonzero(done), self._infos(final)
        for index in ended:
            if "final_obs" in info:
                last = info["final_obs"][index]
            else:
                last = {name: value[index].copy() for name, value in observation.items()}
            infos[index] = {
                **of_the_end[index],
                "terminal_observation": last,
                "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
                "episode": {"r": float(self._returns[index]), "l": int(self._lengths[index])},
            }
        if "final_obs" not in info:
            observation, info = self._env.reset(options={"reset_mask": done})
        begun = self._infos(info)
        for index in ended:
            self.reset_infos[index] = begun[index]
        self._returns[ended], self._lengths[ended] = 0.0, 0
        return observation, reward.astype(np.float32), done, infos

    def _infos(self, info):
        """A vector environment's `info` as one dict for each world."""
        names = [name for name in info if f"_{name}" in info and not name.startswith("final_")]
        return [{name: info[name][index] for name in names} for index in range(self.num_envs)]


class FeatureVecEnv(Worlds):
    """`num_envs` worlds of the task `config` (TaskConfig's fields). An ended episode's info has `episode`: return r,
    length l, and the parts of the score."""

    def __init__(self, num_envs: int, seed: Any, nthread: int = 0, **config: Any):
        self._env = self._worlds = BsonVectorEnv(
            num_envs, seed=seed, autoreset_mode=AutoresetMode.DISABLED, nthread=nthread, **config
        )
        robot = self._worlds.config.robot
        self._features = Features(num_envs, (robot.max_speed, robot.max_yaw_rate))
        self._all = np.arange(num_envs)
        self._returns, self.render_mode = np.zeros(num_envs), None
        space = gymnasium.spaces.Box(-10.0, 10.0, (FEATURES,), np.float32)
        super().__init__(num_envs, space, self._env.single_action_space)

    @property
    def world(self) -> World:
        """The World of all worlds, for callers that measure it."""
        return self._worlds.world

    def reset(self) -> np.ndarray:
        """Begins an episode in every world; returns features (num_envs, FEATURES)."""
        observation, _ = self._env.reset()
        self._returns[:] = 0.0
        return self._features.begin(self._all, observation)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """One control step; returns features, rewards (num_envs,), dones, infos. Worlds whose episodes ended begin
        their next."""
        observation, reward, terminated, truncated, info = self._env.step(self._actions)
        features = self._features.step(self._all, observation)
        self._returns += reward
        done, infos = terminated | truncated, [{} for _ in self._all]
        if done.any():
            ended = np.flatnonzero(done)
            for index in ended:
                row = {name: value[index] for name, value in info.items()}
                infos[index] = {
                    "terminal_observation": features[index].copy(),
                    "TimeLimit.truncated": bool(truncated[index]),
                    "episode": summary(row, self._returns[index], self._worlds.config.control_period),
                }
            self._returns[ended] = 0.0
            observation, _ = self._env.reset(options={"reset_mask": done})
            begun = {name: value[ended] for name, value in observation.items()}
            features[ended] = self._features.begin(ended, begun)
        return features, reward.astype(np.float32), done, infos


def summary(info: Mapping[str, Any], returned: float, control_period: float) -> dict[str, float]:
    """What an ended episode's info tells as `episode`: the sum of rewards r, the length l in control steps, and the
    parts of the score. info: BsonEnv's, of one world."""
    driven = metrics.Driven(
        start_distance=info["start_distance"],
        final_distance=info["distance"],
        travelled=info["travelled"],
        duration=info["time"],
        collisions=info["collisions"],
    )
    return {
        "r": float(returned),
        "l": round(float(driven.duration) / control_period),
        "SNS": float(metrics.sns(driven)),
        "RC": float(metrics.route_completion(driven)),
        "Coll": float(driven.collisions),
        "SP": metrics.speed_score(driven),
        "PE": metrics.path_efficiency(driven),
        "success": float(info["arrived"]),
    }
