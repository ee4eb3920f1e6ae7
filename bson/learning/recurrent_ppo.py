"""Recurrent robots learn by PPO in native worlds, from nothing or from a policy that imitation made.

PPO by Schulman et al., "Proximal policy optimization algorithms", 2017, with the hidden states stored that began a
piece (bson.learning.pieces); the worlds are those of guided robots. stable-baselines3's friends have an LSTM alone.

Worlds can't be stored: every `leg` updates all begin new episodes, whose seeds follow from the steps done. A training
that goes on from there is the one that was not interrupted, bit for bit.
"""

import dataclasses
import functools
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from bson import recurrent
from bson.learning import pieces
from bson.learning.hyperparameters import check
from bson.learning.keeper import Keeper, collect_keeper, restore_keeper, wanted_keeper
from bson.learning.legs import Legs
from bson.learning.pieces import Gru, Learner
from macid.learning import ppo
from macid.learning.curves import check_arrays


@dataclasses.dataclass(frozen=True)
class RecurrentPpoConfig:
    """Hyperparameters."""

    learning_rate: float = 5e-4
    final_learning_rate: float = 5e-5  # reached linearly over training
    gamma: float = 0.99  # per control step
    lam: float = 0.95  # lambda of GAE
    clip: float = 0.2
    rollout: int = 128  # control steps of each world between two updates
    piece: int = 32  # control steps through which gradients go back
    batch: int = 16  # pieces
    epochs: int = 4
    log_std: float = -0.7  # initial
    value_scale: float = 0.1  # factor on rewards, inside GAE and the value's loss
    warmup: int = 0  # updates in which the value alone learns, to begin with
    leg: int = 8  # updates after which the worlds begin anew, and a checkpoint is written

    def __post_init__(self):
        check(self)
        if self.rollout % self.piece:
            raise ValueError(f"rollout must be a multiple of piece ({self.piece}), not {self.rollout}.")


class Noted(msgspec.Struct):
    """A checkpoint's values beside its arrays."""

    keeper: Keeper
    updates: Annotated[int, msgspec.Meta(ge=0, le=10**9)]


class RecurrentPpo(Legs):
    """The training of a network with an `eye` (bson.recurrent.EYES) in `env`, a GuidedVecEnv that shows what it sees.

    steps: control steps of all worlds together; seed: of networks and actions; first_seed: the env's, to which the
    steps done are added; start: the parts of a policy to begin from, as bson.recurrent takes them.
    """

    def __init__(
        self,
        env: Any,
        eye: str,
        steps: int,
        config: RecurrentPpoConfig,
        seed: int,
        first_seed: int,
        start: Any = None,
    ):
        super().__init__(env, steps, config)
        self._network, self._first_seed = Gru(eye), first_seed
        count = env.num_envs * config.rollout // config.piece  # of pieces in an update
        self._ppo = ppo.PpoConfig(
            learning_rate=config.learning_rate,
            final_learning_rate=config.final_learning_rate,
            clip=config.clip,
            gamma=config.gamma,
            lam=config.lam,
            batch=config.batch,
            epochs=config.epochs,
        )
        minibatches = self.number * config.epochs * max(1, count // config.batch)
        self._optimizer = ppo.make_optimizer(self._ppo, minibatches, ("policy", "value"))
        key, *first = jax.random.split(jax.random.key(seed), 3)
        parameters = pieces.init(first, self._network, config.log_std, start)
        self.learner = Learner(
            parameters, self._optimizer.init(parameters), jax.random.key_data(key), jnp.int32(0)
        )  #: its state
        self.output = "clip"  #: of the policy's file
        self._act = jax.jit(functools.partial(pieces.act, self._network))
        self._judged = jax.jit(functools.partial(pieces.judged, self._network))
        self._learn = jax.jit(
            functools.partial(
                pieces.update,
                network=self._network,
                optimizer=self._optimizer,
                config=self._ppo,
                piece=config.piece,
                warmup=config.warmup,
            ),
            donate_argnums=0,
        )
        self._x = self._began = self._memories = None

    @property
    def layers(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """The present policy's, as its agent takes them."""
        parts = self.learner.parameters["policy"]["layers"]
        ordered = [layer for name in recurrent.shapes(self._network.eye) for layer in parts[name]]
        return [(np.array(weight), np.array(bias)) for weight, bias in ordered]

    def update(self) -> tuple[list[dict[str, float]], dict[str, float]]:
        """A rollout and the update by it: what the infos tell as `episode` of the episodes that ended, and figures of
        the update."""
        if self.rests:
            self._env.seed(self._first_seed + self.steps)
            self._x = self._env.reset()
            self._began = np.ones(self._env.num_envs, bool)
            self._memories = pieces.memories(self._network, self._env.num_envs)
        key, acting, shuffling = jax.random.split(jax.random.wrap_key_data(self.learner.key), 3)
        parameters, rows, ended = self.learner.parameters, [], []
        for each in jax.random.split(acting, self._config.rollout):
            noted, self._memories = self._act(parameters, self._x, self._began, self._memories, each)
            noted = jax.tree.map(np.asarray, noted)
            self._x, reward, done, infos = self._env.step(noted["action"])
            reward = reward * self._config.value_scale
            # An episode that was cut off is credited with the value of the state in which it was.
            off = np.array([info.get("TimeLimit.truncated", False) for info in infos])
            if off.any():
                last = np.array([info.get("terminal_observation", x) for info, x in zip(infos, self._x, strict=True)])
                value = self._judged(parameters, last, np.zeros_like(off), self._memories)
                reward = reward + self._config.gamma * np.where(off, value, 0.0)
            rows.append(noted | {"reward": np.asarray(reward, np.float32), "ends": done})
            ended += [info["episode"] for info in infos if "episode" in info]
            self._began = done
        last = self._judged(parameters, self._x, self._began, self._memories)
        data = jax.tree.map(lambda *each: np.stack(each), *rows)
        self.learner, explained = self._learn(self.learner, data, last, shuffling)
        self.learner = self.learner._replace(key=jax.random.key_data(key))
        self.updates += 1
        spread = jnp.exp(self.learner.parameters["policy"]["log_std"]).mean()
        return ended, {"explained": float(explained), "spread": float(spread)}

    def collect(self, keeper: dict[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """({name: array}, the values of a Noted) of a training that rests, with a keeper's state."""
        found, noted = collect_keeper(keeper)
        return found | pieces.leaves(self.learner), {"keeper": noted, "updates": self.updates}

    def restore(self, found: dict[str, np.ndarray], noted: dict[str, Any]) -> dict[str, Any]:
        """Goes on from a checkpoint; returns the keeper's state. Raises ValueError for one of another training."""
        check_arrays(found, pieces.leaves(self.learner) | wanted_keeper(noted["keeper"], self.layers))
        keeper = restore_keeper(found, noted["keeper"], len(self.layers))
        self.learner = pieces.of_leaves(self.learner, found)
        self._go_on_after(noted["updates"])
        return keeper
