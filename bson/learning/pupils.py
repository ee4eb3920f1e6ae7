"""Trainings of recurrent robots: by imitation, and by PPO, SAC and TAC.

config: a bson.learning.train.TrainConfig with the inputs of a recurrent robot.
"""

import contextlib
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np

from bson.agents import learned, load_agent
from bson.agents.contract import Setting, Unsuited, check_settings
from bson.agents.learned import KINDS
from bson.learning.dagger import DaggerConfig, Imitation, Noted, common_track, guard_of
from bson.learning.draw import load_draw
from bson.learning.guided_env import GuidedVecEnv
from bson.learning.keeper import RECENT, BestKeeper, means_of, started
from bson.learning.recurrent_ppo import Noted as NotedPpo
from bson.learning.recurrent_ppo import RecurrentPpo
from bson.learning.recurrent_sac import Noted as NotedSac
from bson.learning.recurrent_sac import RecurrentSac, RecurrentSacConfig
from macid.files import UsageError
from macid.learning.curves import CHECKPOINT, Board, damaged, read_checkpoint, write_checkpoint


def check_pupil(config: Any) -> None:
    """Raises UsageError where there is no such teacher, or where the teacher, the pupil or its shield refuses a setting
    of the training."""
    kind, chosen, its = KINDS[config.inputs], config.hyperparameters, config.setting
    if config.draw is not None:
        its = load_draw(config.draw).setting(np.random.default_rng(config.seed), its)
    told = ""
    try:
        if isinstance(chosen, DaggerConfig):
            teacher = load_agent(chosen.expert)
            check_settings(teacher, [its], common_track(teacher, kind))
        told = f"A robot with --inputs {config.inputs} "
        setting = Setting.of(its, common_track(kind, kind))
        sight = kind.sight(setting)
        if isinstance(chosen, DaggerConfig) and chosen.shield:
            told = "The shield "
            guard_of(sight, setting)
    except Unsuited as error:
        raise UsageError(f"{told}{str(error).partition(';')[0].rstrip('.')}.") from None


def imitate(config: Any, keeper: BestKeeper, show: Callable) -> pathlib.Path:
    """Rounds of imitation, with a checkpoint after each; returns the keeper's folder. show: as of
    bson.learning.train.train."""
    draw, kind = load_draw(config.draw) if config.draw else None, KINDS[config.inputs]
    settings = config.setting, draw, config.steps, config.hyperparameters, config.seed
    training = Imitation(load_agent(config.hyperparameters.expert), kind, *settings, begun=started(config))
    if saved := read_checkpoint(keeper.folder, Noted):
        try:
            keeper.restore(training.restore(*saved))
        except ValueError as error:
            raise damaged(keeper.folder / CHECKPOINT, error) from None
    done = training.steps

    def progress(more):
        nonlocal done
        done += more
        if done // 1000 > (done - more) // 1000:
            show(min(done, config.steps), {})

    def told(update, loss):
        keeper.log({"steps": min(done, config.steps), "seconds": round(keeper.seconds, 1), "loss": loss})
        show(min(done, config.steps), {"update": update, "loss": loss})

    while training.rounds < config.hyperparameters.rounds:
        training.round(progress, told)
        show(training.steps, keeper.validate(training.layers, "clip", training.steps), validation=True)
        write_checkpoint(keeper.folder, *training.collect(keeper.state))
        keeper.write(training.steps)
    keeper.write(config.steps)
    return keeper.folder


def reinforce(config: Any, keeper: BestKeeper, show: Callable, held: contextlib.ExitStack | None) -> pathlib.Path:
    """PPO, SAC and TAC with a memory, in legs, with a checkpoint after each; returns the keeper's folder. show: as of
    bson.learning.train.train; held: closes the curve's Board, None without one."""
    kind, chosen, seed = KINDS[config.inputs], config.hyperparameters, 10_000_000 * (config.seed + 1)
    begun, more = started(config), {}
    learner: Any = RecurrentPpo
    noted = NotedPpo
    if isinstance(chosen, RecurrentSacConfig):
        learner, noted = RecurrentSac, NotedSac
        more = {"output": learned.load(config.start).output} if config.start else {}
    draw = load_draw(config.draw) if config.draw else None
    env = GuidedVecEnv(config.num_envs, seed, draw, config.setting, pupil=kind)
    with contextlib.closing(env):
        training: Any = learner(env, kind.eye, config.steps, chosen, config.seed, seed, begun, **more)
        if saved := read_checkpoint(keeper.folder, noted):
            try:
                keeper.restore(training.restore(*saved))
            except ValueError as error:
                raise damaged(keeper.folder / CHECKPOINT, error) from None
            show(training.steps, {})
        if held is not None:
            keeper.board = held.enter_context(Board(keeper.folder, keeper.curve, training.steps))
        recent = []
        while True:
            steps = training.steps
            if training.rests and steps:
                write_checkpoint(keeper.folder, *training.collect(keeper.state))
                validated = keeper.validations[-1]["steps"] if keeper.validations else 0
                if steps > validated and (training.done or steps // config.validate_every > len(keeper.validations)):
                    show(steps, keeper.validate(training.layers, training.output, steps), validation=True)
                    write_checkpoint(keeper.folder, *training.collect(keeper.state))
                    keeper.write(steps)
            if training.done:
                return keeper.folder
            ended, figures = training.update()
            recent = (recent + ended)[-RECENT:]
            if recent:
                means = means_of(recent)
                keeper.log({"steps": training.steps, "seconds": round(keeper.seconds, 1), **means}, figures)
                show(training.steps, means | figures)
