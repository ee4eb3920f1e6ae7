"""Robots that learn (extra `agents`)."""

import contextlib
import dataclasses
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from macid.executors import Executor, make_executor
from macid.files import (
    UsageError,
)


@contextlib.contextmanager
def agents_extra() -> Iterator[None]:
    """Where the extra `agents` is missing, raises an error that tells what to install."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise UsageError(f"Training needs {error.name}: pip install 'bson-macid[agents]'.") from None


def train(
    algo: str = "ppo",
    out: str | pathlib.Path = "runs",
    *,
    seed: int = 0,
    seeds: int = 1,
    steps: int = 1_000_000,
    worlds: int = 16,
    preset: str = "fast",
    hyperparameters: Mapping[str, Any] | None = None,
    validate_every: int = 100_000,
    validate_episodes: int = 64,
    overrides: dict[str, Any] | None = None,
    demonstrations: str | None = None,
    inputs: str = "scans",
    draw: str | None = None,
    teacher: str | None = None,
    shield: bool = False,
    start: str | None = None,
    resume: bool = False,
    tensorboard: bool = False,
    executor: str | Executor = "local",
    ray_address: str | None = None,
    workers: int | None = None,
) -> list[pathlib.Path]:
    """Trains robots, as `bson train` does; returns the folders `out`/NAME-SEED of the seeds `seed` to `seed` + `seeds`
    - 1.

    algo: a name of bson.learning.presets.ALGORITHMS, or the user's own `file.py:class`; preset: a name of PRESETS.
    steps: control steps of all worlds together. worlds: how many are stepped at once. hyperparameters: fields of the
    algorithm's configuration that are changed, as {"learning_rate": 3e-4}; validate_every: steps between two
    validations (imitation has one after each round); validate_episodes: by which the policy that is kept is chosen.
    overrides: fields of TaskConfig that are changed. demonstrations: of bc, what to learn from in place of an expert: a
    Minari dataset, its id or its folder, or the folder `out` of `live`, with what people drove. inputs: what the robot
    sees, a name of bson.agents.learned.KINDS; draw: settings drawn for the episodes, a name of
    bson.learning.draw.draw_names() or a .toml file; teacher: of bc with a recurrent robot, the agent whom it imitates;
    shield: whether that robot drives behind bson.agents.shield.Shield as it learns; start: of a recurrent robot, the
    policy from which it goes on, a shipped one or a .npz file. resume: goes on from checkpoints. executor, ray_address,
    workers: see macid.executors.make_executor; an executor with several workers trains the seeds side by side. Raises
    UsageError, also where the extra `agents` is missing.
    """
    with agents_extra():
        from bson.learning.hyperparameters import changed
        from bson.learning.presets import SHIELDED
        from bson.learning.presets import hyperparameters as usual
        from bson.learning.train import TrainConfig

    chosen = usual(algo, preset, inputs, start)
    if demonstrations is not None:
        from bson.learning.dataset import check_demonstrations
        from bson.task import TaskConfig

        if algo != "bc":
            raise UsageError(f"--demonstrations are what bc learns from, not {algo}: leave them out.")
        if executor != "local":
            raise UsageError("--demonstrations are read in this process: leave --executor out.")
        check_demonstrations(demonstrations, TaskConfig().replace(**overrides or {}))
        chosen = dataclasses.replace(usual(algo, preset), demonstrations=demonstrations)
    if teacher is not None:
        from bson.agents import load_agent

        if algo != "bc" or inputs == "scans":
            told = f"not {algo} on {inputs}"
            raise UsageError(f"--teacher is whom bc imitates with --inputs gru, gru-map, camera or gru-scans, {told}.")
        load_agent(teacher)
        chosen = dataclasses.replace(chosen, expert=teacher)
    if shield:
        if algo != "bc" or inputs not in SHIELDED:
            told = f"not of {algo} on {inputs}"
            raise UsageError(f"--shield is of bc with --inputs {' or '.join(SHIELDED)}, {told}.")
        if hasattr(chosen, "shield"):  # a TrainConfig refuses the others
            chosen = dataclasses.replace(chosen, shield=True)
    chosen = changed(chosen, hyperparameters or {})
    more: dict[str, Any] = {"validate_every": validate_every, "validate_episodes": validate_episodes}
    more |= {"hyperparameters": chosen, "inputs": inputs, "draw": draw, "start": start}
    configs = [TrainConfig(algo, one, int(steps), overrides or {}, worlds, **more) for one in range(seed, seed + seeds)]
    return train_configs(configs, out, resume, tensorboard, executor, ray_address, workers)


def train_configs(
    configs: Sequence[Any],
    out: str | pathlib.Path,
    resume: bool = False,
    tensorboard: bool = False,
    executor: str | Executor = "local",
    ray_address: str | None = None,
    workers: int | None = None,
) -> list[pathlib.Path]:
    """As `train`, for a list of TrainConfigs."""
    with agents_extra():
        from bson.learning import train as training
    from macid import start

    start.cleaning_up()
    with make_executor(executor, ray_address, workers) as runner:
        if runner.workers is None:
            return [training.train_with_bar(config, out, resume, tensorboard) for config in configs]
        if tensorboard:
            raise UsageError("--tensorboard is for trainings in this process: leave it out with --executor ray.")
        return training.train_apart(runner, configs, out, resume)
