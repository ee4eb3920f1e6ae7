"""PPO, SAC and TAC from stable-baselines3, and their hyperparameters. The preset `paper` of bson.learning.train has the
paper's values (sec. VI-D); the defaults differ where that learns better, or in less time.

Two (1024, 1024) critics and an actor cost some 10 GFLOP an update of 256, a million updates weeks of two cores: SAC's
and TAC's networks are (256, 256) by default, with one update every `steps_per_update` steps.
"""

import contextlib
import contextvars
import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO, SAC

from bson import guided
from bson.learning.attention import PeopleAttention
from bson.learning.hyperparameters import check
from bson.learning.tsallis import TsallisPolicy
from macid.files import UsageError

DEVICE: contextvars.ContextVar[str] = contextvars.ContextVar("device", default="cpu")  #: of the networks, see on_device


@contextlib.contextmanager
def on_device(name: str) -> Iterator[None]:
    """Within the `with`, networks that are built learn on torch's device `name`. For networks of (1024, 1024) that is
    worth it; small ones learn faster on the CPU. Raises UsageError where torch has no such device."""
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        told = str(error).splitlines()[0][:200]
        raise UsageError(
            f"--device {name}: torch can't use it ({told}). Choose cpu, or cuda with an NVIDIA GPU."
        ) from None
    token = DEVICE.set(name)
    try:
        yield
    finally:
        DEVICE.reset(token)


@dataclasses.dataclass(frozen=True)
class PpoConfig:
    """Proximal policy optimisation."""

    hidden: tuple[int, ...] = (64, 64, 64)
    learning_rate: float = 1e-3
    final_learning_rate: float = 5e-5  # reached linearly over training
    gamma: float = 0.99  # per control step
    lam: float = 0.95  # lambda of GAE
    clip: float = 0.2
    rollout: int = 128  # control steps of each world between two updates
    batch: int = 512
    epochs: int = 6
    log_std: float = -0.7  # initial

    def __post_init__(self):
        check(self, batch=2)  # advantages are normalised in a minibatch

    def build(self, env: Any, seed: int) -> Any:
        """The stable-baselines3 model that learns in `env`."""
        first, last = self.learning_rate, self.final_learning_rate
        return PPO(
            "MlpPolicy",
            env,
            learning_rate=lambda remaining: last + (first - last) * remaining,
            n_steps=self.rollout,
            batch_size=self.batch,
            n_epochs=self.epochs,
            gamma=self.gamma,
            gae_lambda=self.lam,
            clip_range=self.clip,
            policy_kwargs={
                "net_arch": list(self.hidden),
                "activation_fn": torch.nn.ReLU,
                "log_std_init": self.log_std,
                **_eyes(env),
            },
            seed=seed,
            device=DEVICE.get(),
        )


@dataclasses.dataclass(frozen=True)
class SacConfig:
    """Soft actor-critic; with q above 1, Tsallis actor-critic."""

    hidden: tuple[int, ...] = (256, 256)
    learning_rate: float = 1e-3
    gamma: float = 0.99  # per control step
    alpha: float = 0.02  # weight of the entropy: a tenth of the usual 0.2, as rewards are a tenth of the usual size
    batch: int = 256
    buffer: int = 300_000  # size of the replay buffer in steps
    learning_starts: int = 10_000  # random steps before learning
    steps_per_update: int = 16  # 16: one update per control step of 16 worlds
    q: float = 1.0  # entropic index
    joint: bool = False  # True: ln_q of the action's density; False: the sum of ln_q of each dimension's density

    def __post_init__(self):
        check(self)

    def build(self, env: Any, seed: int) -> Any:
        """The stable-baselines3 model that learns in `env`."""
        every = self.steps_per_update // math.gcd(self.steps_per_update, env.num_envs)  # of all worlds
        return SAC(
            TsallisPolicy,
            env,
            learning_rate=self.learning_rate,
            gamma=self.gamma,
            ent_coef=self.alpha,
            batch_size=self.batch,
            buffer_size=self.buffer,
            learning_starts=self.learning_starts,
            train_freq=every,
            gradient_steps=every * env.num_envs // self.steps_per_update,
            policy_kwargs={"net_arch": list(self.hidden), "q": self.q, "joint": self.joint, **_eyes(env)},
            seed=seed,
            device=DEVICE.get(),
        )


def _eyes(env):
    """How the policy reads what `env` gives: people by attention, where it tells of people."""
    sees_people = env.observation_space.shape == (guided.SIZE,)
    return {"features_extractor_class": PeopleAttention} if sees_people else {}


def linear_layers(module: torch.nn.Module) -> list[tuple[np.ndarray, np.ndarray]]:
    """[(weight (in, out), bias (out,)), ...] of a torch module's linear layers, in order, as NumPy float32."""
    linear = [layer for layer in module.modules() if isinstance(layer, torch.nn.Linear)]
    pairs = [(layer.weight.detach().cpu().numpy(), layer.bias.detach().cpu().numpy()) for layer in linear]
    return [(weight.T.copy(), bias.copy()) for weight, bias in pairs]


def export(model: Any) -> tuple[list[tuple[np.ndarray, np.ndarray]], str]:
    """The layers of the mean action of a stable-baselines3 model, and how their output becomes an action: "tanh" for a
    model with an actor, such as SAC's, "clip" for others. The first bson.guided.ENCODER_LAYERS of a policy that sees
    people are their encoder's."""
    if hasattr(model, "actor"):
        eyes = linear_layers(model.actor.features_extractor)
        return eyes + linear_layers(model.actor.latent_pi) + linear_layers(model.actor.mu), "tanh"
    policy = model.policy
    eyes = linear_layers(policy.pi_features_extractor)
    return eyes + linear_layers(policy.mlp_extractor.policy_net) + linear_layers(policy.action_net), "clip"
