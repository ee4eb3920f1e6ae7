"""Training a robot: PPO, SAC and TAC in worlds of the benchmark, or BC from an expert's episodes."""

import contextlib
import dataclasses
import pathlib
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from tqdm import tqdm

from bson.agents import learned
from bson.agents.contract import Setting, Unsuited
from bson.episodes.tracks import make_track
from bson.evaluation.executors import carried_agent, carried_code, carried_task
from bson.learning import checkpoint
from bson.learning.algorithms import export
from bson.learning.dagger import DaggerConfig
from bson.learning.dataset import demonstrations
from bson.learning.draw import load_draw
from bson.learning.guided_env import GuidedVecEnv
from bson.learning.hyperparameters import differing, training_command
from bson.learning.imitation import BcConfig, clone, demonstrate, select
from bson.learning.keeper import RECENT, BestKeeper, means_of, noted_config, started
from bson.learning.presets import INPUTS, PRESETS, PUPILS, STARTED, hyperparameters
from bson.learning.pupils import check_pupil, imitate, reinforce
from bson.learning.recurrent_ppo import RecurrentPpoConfig
from bson.learning.recurrent_sac import RecurrentSacConfig
from bson.learning.vec_env import FeatureVecEnv
from bson.task import TaskConfig
from macid import start
from macid.documents import read_document, shown
from macid.executors import Carried
from macid.files import UsageError, lock_folder
from macid.learning.curves import (
    CHECKPOINT,
    FILES,
    Board,
    check_tensorboard,
    damaged,
    read_checkpoint,
    training_folder,
    write_checkpoint,
)
from macid.learning.jobs import Group, folder_of, train_groups
from macid.policy import MOST_RECIPE_BYTES

_TRACK = make_track(learned.Learned.track, learned.Learned.sensor)  # of recipes' settings, and of BC
_REMEMBERING = DaggerConfig | RecurrentPpoConfig | RecurrentSacConfig


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """How a robot is trained: on BSON/LocalLidar2D-v0 by its scans, with other inputs, or from another policy."""

    algo: str = "ppo"
    seed: int = 0
    steps: int = 1_000_000  # control steps, of all worlds together
    task: dict = dataclasses.field(default_factory=dict)  # fields of TaskConfig that differ from the paper's setting
    num_envs: int = 16
    validate_every: int = 100_000  # steps; the policy that scores best is kept
    validate_episodes: int = 64
    hyperparameters: Any = None  # a PpoConfig, SacConfig, BcConfig or the user's own; default: the algorithm's
    inputs: str = "scans"  # what the robot sees, of bson.agents.learned.KINDS
    draw: str | None = None  # settings to be drawn for the episodes (bson.learning.draw): a shipped draw, or a file
    start: str | None = None  # of a recurrent robot: the policy from which it goes on

    def __post_init__(self):
        usual = hyperparameters(self.algo, inputs=self.inputs, start=self.start)
        for name in ("steps", "num_envs", "validate_every", "validate_episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}.")
        if self.seed < 0:
            raise ValueError(f"A seed must be at least 0, not {self.seed}.")
        TaskConfig().replace(**self.task)  # raises where a field is not valid
        if self.inputs not in INPUTS:
            raise ValueError(f"inputs must be one of {', '.join(INPUTS)}, not {shown(self.inputs)}.")
        if self.draw is not None:
            load_draw(self.draw)
            if self.inputs == "scans":
                others = ", ".join(name for name in INPUTS if name != "scans")
                raise UsageError(f"A draw is for robots with --inputs of {others}, not {self.inputs}.")
        others = [name for name in INPUTS if name not in PUPILS]
        fits = {algo: list(INPUTS) for algo in STARTED} | {"bc": ["scans", *PUPILS]}
        fits = fits.get(self.algo, others)
        if self.inputs not in fits:
            raise UsageError(f"{self.algo} learns with --inputs of {', '.join(fits)}, not {self.inputs}.")
        remembers = self.inputs in PUPILS
        if self.start is not None and not (remembers and self.algo in STARTED):
            told = f"{', '.join(STARTED)} with --inputs of {', '.join(PUPILS)}"
            raise UsageError(f"--start is for {told}, not {self.algo} on {self.inputs}.")
        if self.hyperparameters is None:
            object.__setattr__(self, "hyperparameters", usual)
        fit = type(usual) if remembers else object
        if not isinstance(self.hyperparameters, fit) or isinstance(self.hyperparameters, _REMEMBERING) != remembers:
            raise UsageError(f"--inputs {self.inputs} learns with no {type(self.hyperparameters).__name__}.")

    @property
    def setting(self) -> TaskConfig:
        """The TaskConfig of the worlds."""
        return TaskConfig().replace(**self.task)

    @property
    def name(self) -> str:
        """The algorithm, its preset where it is not the default one, and the pedestrians' model where it is not the
        default one: "ppo", "ppo-paper", "ppo-orca"."""
        paper, model = PRESETS["paper"].get(self.algo), self.task.get("pedestrian_model")
        if isinstance(paper, BcConfig) and isinstance(self.hyperparameters, BcConfig):
            taught = {name: getattr(self.hyperparameters, name) for name in ("expert", "demonstrations")}
            paper = dataclasses.replace(paper, **taught)
        own = self.algo.rpartition(":")[0]  # file.py or package.module
        called = pathlib.Path(own).stem if own.endswith(".py") else own.rpartition(".")[2]
        parts = [called or self.algo, *(["paper"] if self.hyperparameters == paper else [])]
        parts += [self.inputs] if self.inputs != "scans" else []
        parts += [pathlib.Path(self.draw).stem] if self.draw else []
        parts += [f"from-{pathlib.Path(self.start).stem}"] if self.start else []
        return "-".join([*parts, *([pathlib.Path(model).stem] if isinstance(model, str) else [])])

    @property
    def command(self) -> str:
        """The `bson train` that trains so."""
        chosen = self.hyperparameters
        each = {name: hyperparameters(self.algo, name, self.inputs, self.start) for name in PRESETS}
        alike = [name for name, one in each.items() if vars(one).keys() == vars(chosen).keys()] or ["fast"]
        changes = {name: differing(chosen, each[name]) for name in alike}
        preset = min(changes, key=lambda name: len(changes[name]))
        more = {"preset": None if preset == "fast" else preset}
        more["teacher"] = chosen.expert if isinstance(chosen, DaggerConfig) else None
        more |= {name: getattr(chosen, name, None) for name in ("shield", "demonstrations")}
        return training_command(self, more, changes[preset])


class _Progress(BaseCallback):
    """Logs, validates and writes checkpoints between an algorithm's updates."""

    def __init__(self, keeper, show, seconds_between_checkpoints, interrupted):
        super().__init__()
        self._keeper, self._show, self._interrupted = keeper, show, interrupted
        self._every, self._last_save, self._last_row = seconds_between_checkpoints, time.monotonic(), -np.inf
        self.recent = []

    def _on_step(self):
        ended = [info["episode"] for info in self.locals["infos"] if "episode" in info]
        self.recent = (self.recent + ended)[-RECENT:]
        return True

    def _on_rollout_start(self):
        now, steps, keeper = time.monotonic(), self.num_timesteps, self._keeper
        if self._interrupted() or now - self._last_save > self._every:
            self._last_save = now
            _save_checkpoint(self.model, keeper)
        if self._interrupted():
            raise KeyboardInterrupt
        if self.recent and now - self._last_row > 5.0:
            self._last_row = now
            means = means_of(self.recent)
            losses = {k: v for k, v in self.logger.name_to_value.items() if isinstance(v, int | float | np.number)}
            keeper.log({"steps": steps, "seconds": round(keeper.seconds, 1), **means}, losses)
            self._show(steps, means)
        if steps // keeper.config.validate_every > len(keeper.validations):
            scores = _validate(self.model, keeper, self._interrupted)
            keeper.write(steps)
            self._show(steps, scores, validation=True)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Lets torch compute in one thread: for networks this small, threads wait for each other longer than they work,
    and MuJoCo has threads of its own."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _save_checkpoint(model, keeper):
    """Writes all of a training but the worlds: networks, optimisers, replay buffer, counters, random numbers."""
    write_checkpoint(keeper.folder, *checkpoint.collect(model, keeper.state))


def _validate(model, keeper, interrupted):
    """Scores of the model's present policy, see `BestKeeper.validate`. Ctrl-C leaves a checkpoint; a resumed training
    begins with this validation."""
    try:
        return keeper.validate(*_export(keeper.config, model), model.num_timesteps, interrupted)
    except KeyboardInterrupt:
        _save_checkpoint(model, keeper)
        raise


def _export(config, model):
    return getattr(config.hyperparameters, "export", export)(model)


def _env(config, steps=0):
    """The worlds; their episodes follow from the seed and from `steps`, the number of steps done before."""
    seed = 10_000_000 * (config.seed + 1) + steps
    if config.inputs != "scans":
        return GuidedVecEnv(config.num_envs, seed, load_draw(config.draw) if config.draw else None, config.setting)
    return FeatureVecEnv(config.num_envs, seed, **config.task)


def _restored(keeper):
    """The model of the checkpoint in the keeper's folder; the keeper's state is restored. None without a checkpoint."""
    config, saved = keeper.config, read_checkpoint(keeper.folder, checkpoint.Noted)
    if not saved:
        return None
    found, noted = saved
    model = config.hyperparameters.build(_env(config, noted["steps"]), config.seed)
    try:
        keeper.restore(checkpoint.restore(model, found, noted, _export(config, model)[0]))
    except ValueError as error:
        raise damaged(keeper.folder / CHECKPOINT, error) from None
    return model


def is_done(config: TrainConfig, folder: pathlib.Path) -> bool:
    """Whether the training `config` has its policy, to the last step, in `folder`. Raises UsageError, which says what
    to do, where the policy's recipe is damaged."""
    path = folder / "policy.json"
    if not (folder / "policy.npz").exists() or not path.exists():
        return False
    try:
        recipe, wanted = read_document(path, dict, "recipe", MOST_RECIPE_BYTES), noted_config(config)
        done = recipe.get("steps_done")
        if isinstance(done, bool) or not isinstance(done, int | float):
            raise UsageError(f"The recipe '{path}' has no number \"steps_done\".")
    except UsageError as error:
        raise UsageError(f"{str(error).rstrip('.')}. Delete '{path}': --resume writes it anew.") from None
    return done >= config.steps and all(recipe.get(name) == wanted[name] for name in wanted)


@one_thread()
def train(
    config: TrainConfig,
    out: str | pathlib.Path,
    resume: bool = False,
    show: Callable[..., object] = lambda steps, figures, validation=False: None,
    seconds_between_checkpoints: float = 120,
    tensorboard: bool = False,
) -> pathlib.Path:
    """Trains `config` and returns the folder `out`/NAME-SEED with policy.npz, policy.json, config.json and, once
    episodes have ended, curve.csv.

    tensorboard: whether the curve, the validations and stable-baselines3's losses are logged for TensorBoard too (see
    macid.learning.curves.Board). show: called now and then with the steps done and figures {name: value}, of recent
    episodes or of a validation. resume: goes on from the checkpoint, if there is one. Everything is restored but the
    worlds, which begin new episodes, and the running means of the curve. Ctrl-C leaves a checkpoint, once there is
    something to keep. BC has no checkpoints: it begins anew, unless it was done. Recurrent robots have a checkpoint
    after each round of imitation, or each leg of others, and go on from there as if never interrupted. Raises
    UsageError if the folder has a training of another configuration, if it has one of this configuration and `resume`
    is not set, or if another process trains there.
    """
    path = pathlib.Path(out) / f"{config.name}-{config.seed}"
    if tensorboard:
        check_tensorboard()
    if not is_done(config, path):  # what does not fit is refused before anything is written
        if config.inputs in PUPILS:
            check_pupil(config)
        elif config.algo == "bc":
            _expert(config)
        if config.start is not None:
            started(config)
    with lock_folder(path, FILES, alone=("config.json",)), contextlib.ExitStack() as held:
        return _train(config, path, resume, show, seconds_between_checkpoints, held if tensorboard else None)


def _train(config, path, resume, show, seconds_between_checkpoints, held):
    """`train` in the folder `path`, which is locked. held: an ExitStack that closes a Board, or None."""
    folder = training_folder(path, config, resume)
    if is_done(config, folder):
        return folder
    keeper = BestKeeper(config, folder)
    if isinstance(config.hyperparameters, RecurrentPpoConfig | RecurrentSacConfig):
        return reinforce(config, keeper, show, held)
    imitates = isinstance(config.hyperparameters, BcConfig | DaggerConfig)
    model = None if imitates else _restored(keeper)
    if held is not None:
        keeper.board = held.enter_context(Board(folder, keeper.curve, model.num_timesteps if model else 0))
    if imitates:
        return (_train_bc if config.inputs == "scans" else imitate)(config, keeper, show)
    resumed = model is not None
    if model is not None:
        show(model.num_timesteps, {})
    else:
        model = config.hyperparameters.build(_env(config), config.seed)
    left = config.steps - model.num_timesteps
    begun = model.num_timesteps
    with start.deferred(lambda: model.num_timesteps > begun) as interrupted:
        progress = _Progress(keeper, show, seconds_between_checkpoints, interrupted)
        if left > 0:
            model.learn(left, callback=progress, log_interval=None, reset_num_timesteps=not resumed)
        if not keeper.validations or keeper.validations[-1]["steps"] != model.num_timesteps:
            scores = _validate(model, keeper, interrupted)
            show(model.num_timesteps, scores, validation=True)
            _save_checkpoint(model, keeper)
    keeper.write(model.num_timesteps)
    return folder


def train_with_bar(
    config: TrainConfig, out: str | pathlib.Path, resume: bool = False, tensorboard: bool = False
) -> pathlib.Path:
    """`train` with a progress bar on stderr, and a line for each validation."""
    with tqdm(total=config.steps, unit="step", unit_scale=True, desc=config.name, file=sys.stderr, delay=0.5) as bar:

        def show(steps, figures, validation=False):
            if not figures and not bar.n:  # figures of a checkpoint, which took no time now
                bar.initial = steps
            bar.n = min(steps, config.steps)
            text = "  ".join(f"{name} {value:.3g}" for name, value in figures.items())
            if validation:
                bar.write(f"{steps:,} steps, validation: {text}", file=sys.stderr)
            bar.set_postfix_str(text, refresh=True)

        try:
            return train(config, out, resume, show, tensorboard=tensorboard)
        finally:
            if bar.n:  # tqdm does not end the line of a bar that was only refreshed
                print(file=sys.stderr)


def train_apart(
    executor: Any, configs: Sequence[TrainConfig], out: str | pathlib.Path, resume: bool = False
) -> list[pathlib.Path]:
    """Trains `configs` side by side on an executor of several workers, with one progress bar; returns their folders. As
    `train`, but Ctrl-C leaves the last checkpoints that arrived, at most some minutes old."""
    carried, done = Carried(), {}
    for config in configs:
        if config.draw is not None and config.draw.endswith(".toml"):
            raise UsageError(f"A draw's file is read in this process: leave --executor out, or --draw {config.draw}.")
        carried += carried_task(config.setting) + carried_code(config.algo)
        for policy in (getattr(config.hyperparameters, "expert", ""), config.start or ""):
            carried += carried_agent(policy) if policy.endswith(".npz") else Carried()
    with tqdm(
        total=sum(config.steps for config in configs),
        unit="step",
        unit_scale=True,
        desc=configs[0].name,
        file=sys.stderr,
    ) as bar:

        def show(config, steps, figures, validation=False):
            done[folder_of(config)] = min(steps, config.steps)
            bar.n = sum(done.values())
            text = "  ".join(f"{name} {value:.3g}" for name, value in figures.items())
            if validation:
                bar.write(f"{folder_of(config)}: {steps:,} steps, validation: {text}", file=sys.stderr)
            bar.set_postfix_str(text, refresh=True)

        groups = [Group(_train_here, (config,)) for config in configs]
        return train_groups(executor, groups, out, resume, show, is_done, carried)


def _train_here(configs, out, show):
    """The function `train` of a Group (macid.learning.jobs)."""

    def tell(steps, figures, validation=False):
        show(steps, figures, validation)

    for config in configs:
        train(config, out, resume=True, show=tell)


def _expert(config):
    """The factory of BC's expert. Raises UsageError where the expert was trained in a setting other than `config`'s."""
    expert = learned.load(config.hyperparameters.expert)
    try:
        expert(Setting.of(config.setting, _TRACK))
    except Unsuited as error:
        told = str(error).partition(";")[0]
        raise UsageError(f"{told}: BC needs an expert of its setting (in Python: BcConfig(expert=FILE)).") from None
    return expert


def _train_bc(config, keeper, show):
    hyperparameters, steps = config.hyperparameters, 0

    def progress(more):
        nonlocal steps
        steps += more
        if steps % (100 * more) == 0:
            show(min(steps, config.steps), {})

    if hyperparameters.demonstrations is None:
        expert = _expert(config)
        seed = 1_000_000 * (config.seed + 1)
        episodes = demonstrate(expert, config.setting, _TRACK, config.steps, seed, config.num_envs, progress)
    else:
        episodes = demonstrations(hyperparameters.demonstrations, config.setting, config.steps)
    x, action = select(episodes, hyperparameters.keep)

    def each(epoch, loss, held_out):
        keeper.log({"epoch": epoch, "loss": loss, "held_out": held_out})
        show(config.steps, keeper.curve[-1])

    layers = clone(x, action, hyperparameters, config.seed, each)
    show(config.steps, keeper.validate(layers, "clip", config.steps), validation=True)
    keeper.write(config.steps)
    return keeper.folder
