"""PPO for robots in worlds on a device: collecting and updating are one compiled program, beside which the host draws
episodes and plays validation episodes.

The policy is an MLP on `bson.features`, or with a memory of its own a GRU on them (bson.recurrent without an eye). It
is written in the same format as those of bson.learning.train, so that `bson evaluate` and NumPy can run it. What guided
robots see can't be computed in a compiled program. Acting and updating are those of bson.learning.pieces. Torch is not
needed.
"""

import contextlib
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

from bson import recurrent
from bson.features import FEATURES, SCANS, SECTORS, remember, vector
from bson.interfaces.device import DeviceWorlds
from bson.interfaces.functional import BsonFuncEnv
from bson.learning import pieces
from bson.learning.draw import EachEpisode, load_draw
from bson.learning.hyperparameters import check, differing, training_command
from bson.learning.keeper import BestKeeper, Keeper, collect_keeper, restore_keeper, started, wanted_keeper
from bson.learning.pieces import Gru, Learner, Mlp
from bson.simulation.engines.warp import WarpConfig, check_warp
from bson.task import TaskConfig
from macid import start
from macid.files import UsageError, lock_folder
from macid.learning import ppo
from macid.learning.curves import (
    CHECKPOINT,
    FILES,
    Board,
    check_arrays,
    check_tensorboard,
    damaged,
    read_checkpoint,
    training_folder,
    write_checkpoint,
    write_curve,
)

INPUTS = ("scans", "gru-scans")  # what can be seen on a device
_SITTING = 16  # updates within which the host does not wait for the device
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
    piece: int = 32  # with a memory: control steps through which gradients go back
    warmup: int = 0  # updates in which the value alone learns, to begin with

    def __post_init__(self):
        check(self)
        if self.rollout % self.piece and self.piece % self.rollout:
            raise ValueError(f"rollout must be a multiple of piece ({self.piece}), not {self.rollout}.")


STARTED = DevicePpoConfig(learning_rate=2e-4, final_learning_rate=1e-5, log_std=-1.5, warmup=8)  # from a policy


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
    validate_every: int = 2_000_000  # steps; the policy that scores best is kept
    validate_episodes: int = 64
    inputs: str = "scans"  # what the robot sees, of INPUTS
    draw: str | None = None  # settings to be drawn for the episodes (bson.learning.draw): a shipped draw, or a file
    start: str | None = None  # with a memory: the policy from which training goes on

    def __post_init__(self):
        if self.algo != "ppo":
            raise ValueError(f"--engine warp trains ppo, not {self.algo!r}.")
        for name in ("steps", "num_envs", "validate_every", "validate_episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}.")
        TaskConfig().replace(**self.task)  # raises where a field is not valid
        if self.inputs not in INPUTS:
            raise UsageError(f"--engine warp learns with --inputs of {', '.join(INPUTS)}, not {self.inputs}.")
        if self.start is not None and self.inputs == "scans":
            raise UsageError("--start is for robots with a memory: --inputs gru-scans, not scans.")
        if self.episodes is not None:
            assert self.episodes.largest  # raises where the draw can't be had

    @property
    def setting(self) -> TaskConfig:
        """The TaskConfig that a draw changes."""
        return TaskConfig().replace(**self.task)

    @property
    def episodes(self) -> EachEpisode | None:
        """The settings of the episodes; None where all have `setting`."""
        return EachEpisode(load_draw(self.draw), self.setting) if self.draw else None

    @property
    def name(self) -> str:
        """The algorithm, the engine, the pedestrians' model where it is not the default one, and as for others what the
        robot sees, the draw, and the policy that training began from."""
        model = self.task.get("pedestrian_model")
        parts = ["ppo-warp", *([self.inputs] if self.inputs != "scans" else [])]
        parts += [pathlib.Path(self.draw).stem] if self.draw else []
        parts += [f"from-{pathlib.Path(self.start).stem}"] if self.start else []
        return "-".join([*parts, *([pathlib.Path(model).stem] if isinstance(model, str) else [])])

    @property
    def command(self) -> str:
        """The `bson train` that trains so."""
        changes = differing(self.hyperparameters, STARTED if self.start else DevicePpoConfig())
        return training_command(self, {"engine": self.engine}, changes)

    @property
    def updates(self) -> int:
        """The number of updates, one after each rollout."""
        return max(1, -(-self.steps // (self.num_envs * self.hyperparameters.rollout)))


class Stream(NamedTuple):
    """The state of a training's worlds; leading axes (num_envs,)."""

    carry: Any
    scans: Any  #: (num_envs, SCANS[-1] + 1, SECTORS)
    seen: dict  #: goal and velocity in the last observation
    earned: Any  #: sum of rewards in the episode so far
    began: Any  #: bool: whether an episode began with the last observation
    memories: dict  #: policy's and value's (num_envs, units)


class DevicePpo:
    """The training of `config`, as functions for jax.jit."""

    def __init__(self, config: DeviceTrainConfig, workers: int | None = None, engine: Any = None):
        self.config, self.hyper = config, config.hyperparameters
        episodes = config.episodes
        task = episodes.largest if episodes else config.setting
        env = BsonFuncEnv("local", "lidar2d", config.num_envs, engine=engine, task=task)
        self._ahead = 2 * self.hyper.rollout  # steps of a running iteration and of the next, already asked for
        self._top = (env.config.robot.max_speed, env.config.robot.max_yaw_rate)
        self.first_seed = 2**32 * (config.seed + 1)  # of its episodes
        shortest = episodes.shortest if episodes else None
        self.worlds = DeviceWorlds(
            env, self.first_seed, workers=workers, ahead=self._ahead, settings=episodes, shortest=shortest
        )
        remembers = config.inputs != "scans"
        self._network: Any = Gru("none") if remembers else Mlp(FEATURES, self.hyper.hidden)
        self._piece = min(self.hyper.piece, self.hyper.rollout) if remembers else 1
        hyper, number = self.hyper, config.num_envs * self.hyper.rollout // self._piece
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
        key, *first = jax.random.split(jax.random.key(self.config.seed), 3)
        start = started(self.config)
        parameters = pieces.init(first, self._network, self.hyper.log_std, start)
        return Learner(parameters, self.optimizer.init(parameters), jax.random.key_data(key), jnp.int32(0))

    def stream(self) -> Any:
        """The Stream of worlds in which episodes have just begun."""
        carry, seen = self.worlds.begin()
        number = self.config.num_envs
        scans = jnp.zeros((number, SCANS[-1] + 1, SECTORS), jnp.float32)
        scans = remember(scans, seen["lidar"], jnp.ones(number, bool))
        seen = {name: seen[name] for name in ("goal", "velocity")}
        memories = pieces.memories(self._network, number)
        return Stream(carry, scans, seen, jnp.zeros(number, jnp.float32), jnp.ones(number, bool), memories)

    def _step(self, parameters, episodes, stream, key):
        """One control step of all worlds: the Stream after it, the samples to learn from, the number of episodes that
        ended, and the sums of their figures."""
        x = vector(stream.scans, stream.seen, self._top)
        noted, memories = pieces.act(self._network, parameters, x, stream.began, stream.memories, key)
        carry, outcome = self.worlds.step(stream.carry, noted["action"], episodes)
        ended = outcome.terminated | outcome.truncated
        earned = jnp.where(outcome.began, 0.0, stream.earned) + outcome.reward
        counts = carry.states.counts[:, 0]
        figures = jnp.stack([earned, outcome.terminated, counts > 0, carry.states.steps], axis=-1)
        # No action caused the step with which an episode begins: with the value as its reward it teaches nothing. An
        # episode cut off at the horizon is credited with the value of the state in which it ended.
        reward = jnp.where(outcome.began, noted["value"], outcome.reward * self.hyper.value_scale)
        after = Stream(
            carry,
            remember(stream.scans, outcome.observation["lidar"], outcome.began),
            {name: outcome.observation[name] for name in ("goal", "velocity")},
            earned,
            outcome.began,
            memories,
        )
        noted |= {"reward": reward, "ends": outcome.terminated | outcome.began}
        return after, (noted, ended.sum(), (figures * ended[:, None]).sum(axis=0))

    def _iterate(self, learner, stream, episodes):
        """A rollout and the update by it: (Learner, Stream, figures {name: ()}, tally)."""
        parameters, key = learner.parameters, jax.random.wrap_key_data(learner.key)
        key, acting, shuffling = jax.random.split(key, 3)
        keys = jax.random.split(acting, self.hyper.rollout)
        step = functools.partial(self._step, parameters, episodes)
        stream, (data, ended, figures) = jax.lax.scan(step, stream, keys)
        x = vector(stream.scans, stream.seen, self._top)
        last = pieces.judged(self._network, parameters, x, stream.began, stream.memories)
        learner, explained = pieces.update(
            learner, data, last, shuffling, self._network, self.optimizer, self._ppo, self._piece, self.hyper.warmup
        )
        ended, figures = ended.sum(), figures.sum(axis=0) / jnp.maximum(ended.sum(), 1)
        told = {"episodes": ended, **{name: figures[place] for place, name in enumerate(_FIGURES)}}
        told["explained"] = explained
        learner = learner._replace(key=jax.random.key_data(key))
        return learner, stream, told, self.worlds.tally(stream.carry)

    def run(
        self, learner: Any, stream: Any, number: int = 1, stop: Callable[[], bool] = lambda: False
    ) -> Iterator[tuple[Any, Any, dict[str, Any]]]:
        """`number` iterations, or fewer, once stop() is true; yields (Learner, Stream, figures {name: number}) after
        each. It reads figures one iteration late, so that the device need not wait: the last Learner and Stream that it
        yields are those after all iterations whose figures it yielded."""
        waiting = []  # figures and tallies not read yet
        while number or waiting:
            number = 0 if stop() else number
            if number:
                episodes = self.worlds.ready(self._ahead)
                learner, stream, *news = self.iterate(learner, stream, episodes)
                waiting.append(news)
                number -= 1
            if len(waiting) > 1 or (waiting and not number):
                told, tally = waiting.pop(0)
                self.worlds.count(tally)
                yield learner, stream, {name: float(value) for name, value in jax.device_get(told).items()}

    def layers(self, learner: Any) -> list[tuple[np.ndarray, np.ndarray]]:
        """The policy's layers, as its agent takes them."""
        layers = learner.parameters["policy"]["layers"]
        if isinstance(layers, dict):
            layers = [layer for name in recurrent.shapes("none") for layer in layers[name]]
        return [(np.asarray(weight), np.asarray(bias)) for weight, bias in layers]

    def close(self) -> None:
        """Stops drawing episodes."""
        self.worlds.close()


class Noted(msgspec.Struct, forbid_unknown_fields=True):
    """A checkpoint's values beside its arrays."""

    keeper: Keeper
    used: int  # number of episodes begun


def train(
    config: DeviceTrainConfig,
    out: str | pathlib.Path,
    resume: bool = False,
    show: Callable[..., object] = lambda steps, figures, validation=False: None,
    seconds_between_checkpoints: float = 120.0,
    workers: int | None = None,
    tensorboard: bool = False,
    limits: WarpConfig | None = None,
) -> pathlib.Path:
    """Trains `config` and returns the folder `out`/NAME-SEED with policy.npz, policy.json, config.json, curve.csv and a
    checkpoint. The policy is the one that scored best on validation episodes, played in native worlds.

    show: called after each update with the steps done and figures {name: value} of the episodes that ended in it, and
    after each validation with its scores. tensorboard: whether the curve and the validations are logged for TensorBoard
    too. limits: the engine's; a training can go on with others. resume: goes on from the checkpoint, if there is one;
    the worlds are restored too, so that on a CPU, where physics is deterministic, training goes on as if never
    interrupted. Ctrl-C leaves a checkpoint, once there is something to keep. Raises UsageError if the folder has a
    training of another configuration, if it has one of this configuration and `resume` is not set, or if another
    process trains there.
    """
    path = pathlib.Path(out) / f"{config.name}-{config.seed}"
    if tensorboard:
        check_tensorboard()
    check_warp()
    started(config)  # refuses a wrong policy before anything is written
    with lock_folder(path, FILES, alone=("config.json",)), contextlib.ExitStack() as held:
        keeper = BestKeeper(config, training_folder(path, config, resume))
        trainer = DevicePpo(config, workers, limits)
        held.callback(trainer.close)
        return _train(trainer, keeper, show, seconds_between_checkpoints, held if tensorboard else None)


def _streamed(stream):
    """A Stream as arrays, {name: array}, but for the pool's slot, which is the pool's own matter."""
    stream = stream._replace(carry=stream.carry._replace(slot=np.int32(0)))
    return {f"stream/{place}": np.asarray(leaf) for place, leaf in enumerate(jax.tree.leaves(stream))}


def _restored(trainer, keeper):
    """(Learner, Stream, number of episodes begun before) of the checkpoint; of a new training without one."""
    learner, stream = trainer.learner(), trainer.stream()
    saved = read_checkpoint(keeper.folder, Noted)
    if not saved:
        return learner, stream, 0
    found, noted = saved
    layers, worlds = trainer.layers(learner), trainer.worlds
    try:
        check_arrays(found, pieces.leaves(learner) | _streamed(stream) | wanted_keeper(noted["keeper"], layers))
        keeper.restore(restore_keeper(found, noted["keeper"], len(layers)))
    except ValueError as error:
        raise damaged(keeper.folder / CHECKPOINT, error) from None
    leaves, tree = jax.tree.flatten(stream)
    stream = jax.tree.unflatten(tree, [jnp.asarray(found[f"stream/{place}"]) for place in range(len(leaves))])
    carry = worlds.resume(stream.carry, trainer.first_seed + noted["used"])
    return pieces.of_leaves(learner, found), stream._replace(carry=carry), noted["used"]


def _train(trainer, keeper, show, every, held):
    config, folder = trainer.config, keeper.folder
    learner, stream, used = _restored(trainer, keeper)
    per, last, begun = config.num_envs * config.hyperparameters.rollout, time.monotonic(), len(keeper.curve)
    if held is not None:
        keeper.board = held.enter_context(Board(folder, keeper.curve, int(learner.done) * per))

    def save():
        arrays, noted = collect_keeper(keeper.state)
        arrays |= pieces.leaves(learner) | _streamed(stream)
        write_checkpoint(folder, arrays, {"keeper": noted, "used": used + trainer.worlds.pool.begun})
        write_curve(folder / "curve.csv", keeper.curve)

    with start.deferred(lambda: len(keeper.curve) > begun) as interrupted:
        while True:
            done = int(learner.done)
            steps, over = done * per, done >= config.updates
            if steps // config.validate_every > len(keeper.validations) or (
                over and not (keeper.validations and keeper.validations[-1]["steps"] == steps)
            ):
                try:
                    scores = keeper.validate(trainer.layers(learner), "clip", steps, interrupted)
                except KeyboardInterrupt:
                    if len(keeper.curve) > begun:
                        save()
                    raise
                show(steps, scores, validation=True)
                save()
                keeper.write(steps)
            if over:
                return folder
            for now in trainer.run(learner, stream, min(config.updates - done, _SITTING), interrupted):
                learner, stream, figures = now
                steps = (len(keeper.curve) + 1) * per
                row = {"steps": steps, "seconds": round(keeper.seconds, 1), **figures}
                keeper.curve.append(row)
                if keeper.board:
                    keeper.board.write(row)
                show(steps, figures)
            if interrupted():
                save()
                raise KeyboardInterrupt
            if time.monotonic() - last > every:
                last = time.monotonic()
                save()
