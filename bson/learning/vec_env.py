"""BSON's vector environment as stable-baselines3 wants it, with features for observations."""

import types

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from bson import metrics
from bson.env import BsonVectorEnv
from bson.features import FEATURES, Features


class FeatureVecEnv(VecEnv):
    """`num_envs` worlds of the task `config` (TaskConfig's fields). An ended episode's info has `episode`: return r,
    length l, and the parts of the score."""

    def __init__(self, num_envs, seed, nthread=0, **config):
        self._env = BsonVectorEnv(num_envs, seed=seed, autoreset_mode=AutoresetMode.DISABLED, nthread=nthread, **config)
        self._features, self._all = Features(num_envs), np.arange(num_envs)
        self._returns, self._actions = np.zeros(num_envs), None
        self.render_mode = None
        space = gymnasium.spaces.Box(-10.0, 10.0, (FEATURES,), np.float32)
        super().__init__(num_envs, space, self._env.single_action_space)

    @property
    def world(self):
        """The World of all, for whoever measures it."""
        return self._env.world

    def reset(self):
        """Begins an episode in every world; features (num_envs, FEATURES)."""
        observation, _ = self._env.reset()
        self._returns[:] = 0.0
        return self._features.begin(self._all, observation)

    def step_async(self, actions):
        """Keeps `actions` (num_envs, 2) for `step_wait`."""
        self._actions = actions

    def step_wait(self):
        """A control step: features, rewards (num_envs,), dones, infos. Worlds whose episodes ended begin their next."""
        observation, reward, terminated, truncated, info = self._env.step(self._actions)
        features = self._features.step(self._all, observation)
        self._returns += reward
        done, infos = terminated | truncated, [{} for _ in self._all]
        if done.any():
            ended = np.flatnonzero(done)
            for index in ended:
                infos[index] = {
                    "terminal_observation": features[index].copy(),
                    "TimeLimit.truncated": bool(truncated[index]),
                    "episode": self._summary(index, info),
                }
            self._returns[ended] = 0.0
            observation, _ = self._env.reset(options={"reset_mask": done})
            begun = {name: value[ended] for name, value in observation.items()}
            features[ended] = self._features.begin(ended, begun)
        return features, reward.astype(np.float32), done, infos

    def _summary(self, index, info):
        driven = types.SimpleNamespace(
            start_distance=info["start_distance"][index],
            final_distance=info["distance"][index],
            travelled=info["travelled"][index],
            duration=info["time"][index],
            collisions=info["collisions"][index],
        )
        return {
            "r": float(self._returns[index]),
            "l": round(float(driven.duration) / self._env.config.control_period),
            "SNS": float(metrics.sns(driven)),
            "RC": float(metrics.route_completion(driven)),
            "Coll": float(driven.collisions),
            "SP": metrics.speed_score(driven),
            "PE": metrics.path_efficiency(driven),
            "success": float(info["arrived"][index]),
        }

    def close(self):
        """Nothing is held open."""

    def get_attr(self, attr_name, indices=None):
        """An attribute of this environment, once for each of `indices`."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name, value, indices=None):
        """Not possible: all worlds share one configuration."""
        raise NotImplementedError("The worlds share one configuration: make another FeatureVecEnv.")

    def env_method(self, method_name, *method_args, indices=None, **method_kwargs):
        """Not possible: the worlds are no objects of their own."""
        raise NotImplementedError("The worlds of a batch have no methods of their own.")

    def env_is_wrapped(self, wrapper_class, indices=None):
        """Whether each of `indices` is wrapped: never."""
        return [False for _ in self._get_indices(indices)]
