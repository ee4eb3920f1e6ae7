"""A learning algorithm of one's own: A2C from stable-baselines3.

bson train --algo own_algorithm.py:A2c --steps 1e6 --out runs
"""

import dataclasses

from stable_baselines3 import A2C


@dataclasses.dataclass(frozen=True)
class A2c:
    """Advantage actor-critic (Mnih et al. 2016). The fields stand in the policy's recipe."""

    hidden: tuple[int, ...] = (64, 64)
    learning_rate: float = 7e-4
    rollout: int = 16  # control steps of each world between updates

    def build(self, env, seed):
        """The model that learns in `env`, a stable-baselines3 VecEnv of bson.features' vectors."""
        return A2C(
            "MlpPolicy",
            env,
            learning_rate=self.learning_rate,
            n_steps=self.rollout,
            policy_kwargs={"net_arch": list(self.hidden), "activation_fn": _relu()},
            seed=seed,
            device="cpu",
        )


def _relu():
    """What policies that NumPy runs have between their layers."""
    import torch

    return torch.nn.ReLU
