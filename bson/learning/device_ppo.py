"""Proximal policy optimisation in worlds on a device (MJX-Warp): rollouts and updates in one compiled program.

Features, networks and policies are the same as for PPO by stable-baselines3 (bson.learning.train), so that `bson
evaluate` and NumPy can run the result. Advantages and updates are the pedestrians' (macid.learning.ppo). Torch is not
needed.
"""

import dataclasses
import functools
import pathlib
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from bson.agents import learned
from bson.agents.contract import Setting
from bson.features import FEATURES, SCANS, SECTORS, remember, vector
from bson.interfaces.device import DeviceWorlds
from bson.interfaces.functional import BsonFuncEnv
from bson.task import TaskConfig
from macid.files import lock_folder
from macid.learning import ppo
from macid.learning.curves import (
    FILES,
    damaged,
    plain,
    read_checkpoint,
    thin,
    training_folder,
    write_checkpoint,
    write_curve,
)
from macid.policy import write_network

ACTIONS = 2
_FIGURES = ("return", "success", "collided", "length")  # means over the episodes that ended


@dataclasses.dataclass(frozen=True)
class DevicePpoConfig:
    """Hyperparameters, for many worlds; bson.learning.algorithms.PpoConfig has them for a few."""

    hidden: tuple[int, ...] = (64, 64, 64)
    learning_rate: float = 1e-3
    final_learning_rate: float = 5e-5  # reached linearly over training
    gamma: float = 0.99  # per control step
    lam: float = 0.95  # lambda of GAE
    clip: float = 0.2
    rollout: int = 32  # control steps of each world between two updates
    batches: int = 8  # minibatches in an epoch
    epochs: int = 4
    log_std: float = -0.7  # initial
    value_scale: float = 0.1  # factor on rewards, inside GAE and the value's loss


@dataclasses.dataclass(frozen=True)
class DeviceTrainConfig:
    """How a robot is trained on a device, on BSON/LocalLidar2D-v0."""

    seed: int = 0
    steps: int = 10_000_000  # control steps, of all worlds together
    task: dict = dataclasses.field(default_factory=dict)  # fields of TaskConfig that differ from the paper's setting
    num_envs: int = 1024
    algo: str = "ppo"
    engine: str = "warp"
    hyperparameters: DevicePpoConfig = DevicePpoConfig()

    def __post_init__(self):
        if self.algo != "ppo":
            raise ValueError(f"--engine warp trains ppo, not {self.algo!r}.")
        for name in ("steps", "num_envs"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}.")
        TaskConfig().replace(**self.task)  # raises where a field is not valid

    @property
    def name(self) -> str:
        """The algorithm, the engine, and the pedestrians' model where it is not the default one."""
        model = self.task.get("pedestrian_model")
        return "-".join(["ppo-warp", *([pathlib.Path(model).stem] if isinstance(model, str) else [])])

    @property
    def updates(self) -> int:
        """The number of updates, one after each rollout."""
        return max(1, -(-self.steps // (self.num_envs * self.hyperparameters.rollout)))


class Learner(NamedTuple):
    """The state of a training, beside its worlds."""

    parameters: Any
    optimizer: Any
    key: Any
    done: Any  #: () int32: updates so far


class Stream(NamedTuple):
    """The state of a training's worlds; leading axes (num_envs,)."""

    carry: Any
    scans: Any  #: (num_envs, SCANS[-1] + 1, SECTORS)
    seen: dict  #: goal and velocity in the last observation
    earned: Any  #: sum of rewards in the episode so far


def network(layers: Any, x: jax.Array) -> jax.Array:
    """The network of `bson.agents.learned`: layers with ReLU between, applied to x (..., in)."""
    for weight, bias in layers[:-1]:
        x = jnp.maximum(x @ weight + bias, 0.0)
    weight, bias = layers[-1]
    return x @ weight + bias


class DevicePpo:
    """The training of `config`, as functions for jax.jit."""

    def __init__(self, config: DeviceTrainConfig, workers: int | None = None, engine: Any = None):
        self.config, self.hyper = config, config.hyperparameters
        env = BsonFuncEnv("local", "lidar2d", config.num_envs, engine=engine, **config.task)
        self._ahead = 2 * self.hyper.rollout  # steps of a running iteration and of the next, already asked for
        self._top = (env.config.robot.max_speed, env.config.robot.max_yaw_rate)
        self.setting = Setting.of(env.config, env.track)  #: the setting in which it learns
        self.first_seed = 2**32 * (config.seed + 1)  # of its episodes
        self.worlds = DeviceWorlds(env, self.first_seed, workers=workers, ahead=self._ahead)
        hyper, number = self.hyper, config.num_envs * self.hyper.rollout
        self._ppo = ppo.PpoConfig(
            learning_rate=hyper.learning_rate,
            final_learning_rate=hyper.final_learning_rate,
            clip=hyper.clip,
            gamma=hyper.gamma,
            lam=hyper.lam,
            batch=max(1, number // hyper.batches),
            epochs=hyper.epochs,
            log_std=hyper.log_std,
        )
        steps = config.updates * hyper.epochs * max(1, number // self._ppo.batch)
        self.optimizer = ppo.make_optimizer(self._ppo, steps, ("policy", "value"))
        self.iterate = jax.jit(self._iterate, donate_argnums=(0, 1))

    def learner(self) -> Any:
        """The Learner with which a training begins."""
        key = jax.random.key(self.config.seed)
        key, policy, value = jax.random.split(key, 3)
        hidden = self.hyper.hidden
        parameters = {
            "policy": {
                "layers": ppo.init_mlp(policy, (FEATURES, *hidden, ACTIONS), 0.01),
                "log_std": jnp.full(ACTIONS, self.hyper.log_std, jnp.float32),
            },
            "value": ppo.init_mlp(value, (FEATURES, *hidden, 1), 1.0),
        }
        return Learner(parameters, self.optimizer.init(parameters), jax.random.key_data(key), jnp.int32(0))

    def stream(self) -> Any:
        """The Stream of worlds in which episodes have just begun."""
        carry, seen = self.worlds.begin()
        number = self.config.num_envs
        scans = jnp.zeros((number, SCANS[-1] + 1, SECTORS), jnp.float32)
        scans = remember(scans, seen["lidar"], jnp.ones(number, bool))
        seen = {name: seen[name] for name in ("goal", "velocity")}
        return Stream(carry, scans, seen, jnp.zeros(number, jnp.float32))

    def _act(self, parameters, stream, key):
        x = vector(stream.scans, stream.seen, self._top)
        mean, log_std = network(parameters["policy"]["layers"], x), parameters["policy"]["log_std"]
        z = jax.random.normal(key, mean.shape)
        return x, mean + jnp.exp(log_std) * z, ppo.gaussian_log_density(z, log_std)

    def _step(self, parameters, episodes, stream, key):
        """One control step of all worlds: the Stream after it, the samples to learn from, the number of episodes that
        ended, and the sums of their figures."""
        x, action, log_probability = self._act(parameters, stream, key)
        value = network(parameters["value"], x)[..., 0]
        carry, outcome = self.worlds.step(stream.carry, action, episodes)
        ended = outcome.terminated | outcome.truncated
        earned = jnp.where(outcome.began, 0.0, stream.earned) + outcome.reward
        counts = carry.states.counts[:, 0]
        figures = jnp.stack([earned, outcome.terminated, counts > 0, carry.states.steps], axis=-1)
        # No action caused the step with which an episode begins: with the value as its reward it teaches nothing. An
        # episode cut off at the horizon is credited with the value of the state in which it ended.
        reward = jnp.where(outcome.began, value, outcome.reward * self.hyper.value_scale)
        after = Stream(
            carry,
            remember(stream.scans, outcome.observation["lidar"], outcome.began),
            {name: outcome.observation[name] for name in ("goal", "velocity")},
            earned,
        )
        noted = {
            "x": x,
            "action": action,
            "log_probability": log_probability,
            "value": value,
            "reward": reward,
            "ends": outcome.terminated | outcome.began,
        }
        return after, (noted, ended.sum(), (figures * ended[:, None]).sum(axis=0))

    def _iterate(self, learner, stream, episodes):
        """A rollout and the update by it: (Learner, Stream, figures {name: ()}, tally)."""
        parameters, key = learner.parameters, jax.random.wrap_key_data(learner.key)
        key, acting, shuffling = jax.random.split(key, 3)
        keys = jax.random.split(acting, self.hyper.rollout)
        step = functools.partial(self._step, parameters, episodes)
        stream, (data, ended, figures) = jax.lax.scan(step, stream, keys)
        last = network(parameters["value"], vector(stream.scans, stream.seen, self._top))[..., 0]
        advantage, target = ppo.gae(
            data["reward"], data["value"], last, self.hyper.gamma, self.hyper.lam, data["ends"], "end"
        )
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        batch = {name: data[name] for name in ("x", "action", "log_probability")}
        batch |= {"critic": data["x"], "advantage": advantage, "return_value": target}
        batch = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)
        parameters, optimizer = ppo.update(
            parameters, self.optimizer, learner.optimizer, batch, shuffling, self._ppo, network
        )
        ended, figures = ended.sum(), figures.sum(axis=0) / jnp.maximum(ended.sum(), 1)
        told = {"episodes": ended, **{name: figures[place] for place, name in enumerate(_FIGURES)}}
        learner = Learner(parameters, optimizer, jax.random.key_data(key), learner.done + 1)
        return learner, stream, told, self.worlds.tally(stream.carry)

    def run(self, learner: Any, stream: Any, number: int = 1) -> Iterator[tuple[Any, Any, dict[str, Any]]]:
        """`number` iterations; yields (Learner, Stream, figures {name: number}) after each. It reads figures one
        iteration late, so that the device need not wait."""
        waiting = []  # figures and tallies not read yet
        for index in range(number + 1):
            if index < number:
                episodes = self.worlds.ready(self._ahead)
                learner, stream, *news = self.iterate(learner, stream, episodes)
                waiting.append(news)
            if index:
                told, tally = waiting.pop(0)
                self.worlds.count(tally)
                yield learner, stream, {name: float(value) for name, value in jax.device_get(told).items()}

    def layers(self, learner: Any) -> list[tuple[np.ndarray, np.ndarray]]:
        """The policy's layers, as bson.agents.learned takes them."""
        layers = learner.parameters["policy"]["layers"]
        return [(np.asarray(weight), np.asarray(bias)) for weight, bias in layers]

    def close(self) -> None:
        """Stops drawing episodes."""
        self.worlds.close()


class Noted(msgspec.Struct, forbid_unknown_fields=True):
    """A checkpoint's values beside its arrays."""

    curve: list[dict[str, float]]
    spent: float
    used: int  # number of episodes begun


def train(
    config: DeviceTrainConfig,
    out: str | pathlib.Path,
    resume: bool = False,
    show: Callable[..., object] = lambda steps, figures: None,
    seconds_between_checkpoints: float = 120.0,
    workers: int | None = None,
) -> pathlib.Path:
    """Trains `config` and returns the folder `out`/NAME-SEED with policy.npz, policy.json, config.json, curve.csv and a
    checkpoint.

    show: called after each update with the steps done and figures {name: value} of the episodes that ended in it.
    resume: goes on from the checkpoint, if there is one; the worlds then begin the episodes that follow. Raises
    UsageError if the folder has a training of another configuration, if it has one of this configuration and `resume`
    is not set, or if another process trains there.
    """
    path = pathlib.Path(out) / f"{config.name}-{config.seed}"
    with lock_folder(path, FILES, alone=("config.json",)):
        folder = training_folder(path, config, resume)
        trainer = DevicePpo(config, workers)
        try:
            return _train(trainer, folder, show, seconds_between_checkpoints)
        finally:
            trainer.close()


def _train(trainer, folder, show, every):
    config, learner, curve, spent = trainer.config, trainer.learner(), [], 0.0
    used = 0
    leaves, tree = jax.tree.flatten(learner)
    saved = read_checkpoint(folder, Noted)
    if saved:
        found, noted = saved
        try:
            found = [found[str(place)] for place in range(len(leaves))]
            if any(
                one.shape != other.shape or one.dtype != other.dtype for one, other in zip(found, leaves, strict=True)
            ):
                raise ValueError("its networks have another shape")
        except (KeyError, ValueError) as error:
            raise damaged(folder / "checkpoint.npz", error) from None
        learner = jax.tree.unflatten(tree, map(jnp.asarray, found))
        curve, spent, used = noted["curve"], noted["spent"], noted["used"]
        trainer.worlds.restart(trainer.first_seed + noted["used"])
    begin, last, per = time.monotonic(), time.monotonic(), config.num_envs * config.hyperparameters.rollout

    def save(learner):
        found = {str(place): np.asarray(leaf) for place, leaf in enumerate(jax.tree.leaves(learner))}
        noted = {"curve": curve, "spent": spent + time.monotonic() - begin, "used": used + trainer.worlds.pool.begun}
        write_checkpoint(folder, found, noted)

    left = config.updates - int(learner.done)
    stream = trainer.stream() if left > 0 else None
    while left > 0:
        some, left = min(left, 16), left - min(left, 16)  # the host does not wait for the device within these
        for now in trainer.run(learner, stream, some):
            learner, stream, figures = now
            steps = (len(curve) + 1) * per
            curve.append({"steps": steps, "seconds": round(spent + time.monotonic() - begin, 1), **figures})
            show(steps, figures)
        if time.monotonic() - last > every:
            last = time.monotonic()
            save(learner)
            write_curve(folder / "curve.csv", curve)
    save(learner)
    write_curve(folder / "curve.csv", curve)
    recipe = {
        "name": config.name,
        **plain(config),
        "steps_done": int(learner.done) * per,
        "seconds": round(spent + time.monotonic() - begin, 1),
        "output": "clip",
        "setting": learned.setting_document(trainer.setting),
        "curve": [{name: round(value, 4) for name, value in row.items()} for row in thin(curve, 60)],
    }
    write_network(folder / "policy", trainer.layers(learner), recipe)
    return folder
