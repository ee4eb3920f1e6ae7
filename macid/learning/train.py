"""The training loop: iterations to the budget, curves, checkpoints, and the policies in the end."""

import contextlib
import os
import pathlib
import time
from collections.abc import Callable, Iterable

import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from macid import start
from macid.engines import engine_kind
from macid.executors import Executor
from macid.files import UsageError, lock_folder, versions
from macid.learning import copo
from macid.learning.config import TrainConfig, seeds_of
from macid.learning.curves import (
    CHECKPOINT,
    FILES,
    Board,
    check_arrays,
    check_tensorboard,
    damaged,
    plain,
    read_checkpoint,
    thin,
    training_folder,
    write_checkpoint,
    write_curve,
)
from macid.learning.jobs import Group, folder_of, train_groups
from macid.learning.scene_trainer import SceneTrainer
from macid.learning.trainer import Trainer
from macid.policy import Policy, load_policy


def train(
    config: TrainConfig,
    out: str | os.PathLike[str],
    seeds: int = 1,
    resume: bool = False,
    show: Callable[[str], object] = print,
    minutes_between_checkpoints: float = 2.0,
    tensorboard: bool = False,
) -> list[Policy]:
    """Trains `seeds` seeds at once to the budget, the config's seed and the following ones; returns their Policies.

    Writes policy.npz and .json, config.json and curve.csv in `out`/NAME-SEED (TrainConfig.name), and now and then a
    checkpoint of all seeds in the first seed's folder. Several devices share the work, with an engine that can (MJX).

    tensorboard: whether each seed's curve is logged for TensorBoard too (see curves.Board). resume: goes on from the
    checkpoint, if there is one, exactly where it stopped, and one seed after the other where the seeds were begun so
    (`train_apart`). Ctrl-C leaves a checkpoint, once there is something to keep. Raises ValueError if the checkpoint
    has another configuration or another process trains there, FloatingPointError if the training diverges.

    The same config gives the same policy, bit for bit, on as many CPU cores. On another number of cores XLA shares the
    sums over a batch among another number of threads, and so rounds them differently, in the first update already. The
    environment variable NPROC, set before JAX begins, is the number of XLA's threads: with NPROC=2, one core gives the
    policy of two.
    """
    configs = seeds_of(config, seeds)
    paths = [pathlib.Path(out) / folder_of(each) for each in configs]
    if tensorboard:
        check_tensorboard()
    if resume and seeds > 1 and _begun_apart(paths):
        each = [train(one, out, 1, True, show, minutes_between_checkpoints, tensorboard) for one in configs]
        return [policy for (policy,) in each]
    with contextlib.ExitStack() as held:
        for path in paths:
            held.enter_context(lock_folder(path, FILES, alone=("config.json",)))
        return _train(configs, paths, resume, show, minutes_between_checkpoints, held if tensorboard else None)


def _begun_apart(paths):
    """Whether the trainings in the folders `paths` were begun one by one, each with a checkpoint of its own."""
    if any((path / CHECKPOINT).exists() for path in paths[1:]):
        return True
    saved = read_checkpoint(paths[0], _Noted)
    return saved is not None and len(saved[1]["configs"]) == 1


def train_apart(
    executor: Executor,
    configs: Iterable[TrainConfig],
    out: str | os.PathLike[str],
    resume: bool = False,
    show: Callable[[str], object] = print,
) -> list[pathlib.Path]:
    """Trains `configs` side by side on an executor of several workers; returns their folders.

    Each config gives the policy of `train` with its seed alone, bit for bit; seeds that `train` had begun at once go on
    at once, as one job. Ctrl-C leaves the last checkpoints that arrived, at most some minutes old. Raises as `train`
    does.
    """
    groups, left = [], list(configs)
    while left:
        first = left[0]
        saved = read_checkpoint(pathlib.Path(out) / folder_of(first), _Noted) if resume else None
        together = saved[1]["configs"] if saved else [plain(first)]
        group = [each for each in left if plain(each) in together]
        if len(group) < len(together):
            raise UsageError(
                f"What is in '{pathlib.Path(out) / folder_of(first)}' is of {len(together)} seeds, not {len(group)}: "
                "go on with all of them, or use another --out."
            )
        group = group or [first]  # a training of another configuration, which it refuses itself
        groups.append(Group(_train_here, tuple(group)))
        left = [each for each in left if each not in group]

    def told(config, line):
        show(f"{folder_of(config)}: {line}")

    return train_groups(executor, groups, out, resume, told, is_done)


def _train_here(configs, out, show):
    """The function `train` of a Group (macid.learning.jobs)."""
    train(configs[0], out, len(configs), resume=True, show=show)


def is_done(config: TrainConfig, folder: pathlib.Path) -> bool:
    """Whether the training `config` has its policy, to the last step, in `folder`."""
    try:
        recipe = load_policy(str(folder / "policy.npz")).recipe
    except ValueError:
        return False
    wanted = plain(config)
    return recipe.get("agent_steps_done", 0) >= config.agent_steps and all(recipe.get(k) == wanted[k] for k in wanted)


def _train(configs, paths, resume, show, minutes_between_checkpoints, held):
    """`train`, of `configs` in the folders `paths`, locked. held: an ExitStack that closes Boards, or None."""
    config, seeds = configs[0], len(configs)
    kind, _ = engine_kind(config.engine)
    folders = [training_folder(path, each, resume) for path, each in zip(paths, configs, strict=True)]
    saved = read_checkpoint(folders[0], _Noted)
    several = kind.shards and jax.device_count() > 1
    make = Trainer if config.scenes is None else SceneTrainer
    trainer = make(config, jax.devices() if several else None)
    states, curves, spent = trainer.init_seeds([each.seed for each in configs]), [[] for _ in configs], 0.0
    if saved:
        states, curves, spent = _restored(*saved, folders[0] / CHECKPOINT, configs, states)
        show(f"resumed at iteration {len(curves[0])} of {trainer.iterations}")
    boards = []
    if held is not None:
        boards = [held.enter_context(Board(*each)) for each in zip(folders, curves, strict=True)]

    def save():
        noted = {"configs": [plain(each) for each in configs], "curves": curves, "seconds": spent}
        write_checkpoint(folders[0], _named(states), noted)
        for folder, curve in zip(folders, curves, strict=True):
            write_curve(folder / "curve.csv", curve)

    begin = last_save = last_show = time.monotonic()
    before, begun = spent, len(curves[0])
    done = begun
    with start.deferred(lambda: done > begun) as interrupted:
        while done < trainer.iterations:
            try:
                following, logs = trainer.iterate_seeds(states)
                logs = jax.device_get(logs)
                trainer.check()
            except KeyboardInterrupt:
                if done > begun:
                    save()
                raise
            states, done = following, done + 1
            now = time.monotonic()
            spent = before + now - begin
            steps = done * trainer.samples
            for index, curve in enumerate(curves):
                values = {name: float(value[index]) for name, value in logs.items()}
                curve.append({"agent_steps": steps, "seconds": round(spent, 2), **values})
                if wrong := [name for name, value in values.items() if not np.isfinite(value)]:
                    raise FloatingPointError(
                        f"Training of seed {configs[index].seed} diverged at iteration {done}: "
                        f"the {wrong[0]} is {values[wrong[0]]}."
                    )
            for place, board in enumerate(boards):
                board.write(curves[place][-1])
            if now - last_show > 5.0 or done == trainer.iterations:
                last_show = now
                figures = "  ".join(f"{name} {value.mean():.3g}" for name, value in logs.items())
                show(
                    f"{steps / 1e6:7.2f}M of {config.agent_steps / 1e6:.0f}M  "
                    f"{seeds * steps / spent:,.0f} agent-steps/s  {figures}"
                )
            if now - last_save > 60 * minutes_between_checkpoints:
                last_save = now
                save()
            if interrupted():
                save()
                raise KeyboardInterrupt
    save()
    policies = []
    for index, (each, folder, curve) in enumerate(zip(configs, folders, curves, strict=True)):
        state = trainer.seed_state(states, index)
        recipe = {
            "name": each.name,
            **plain(each),
            "agent_steps_done": done * trainer.samples,
            "seconds": round(spent / seeds, 1),
        }
        if state.meta is not None:
            recipe["lcf_mean"], recipe["lcf_std"] = map(float, copo.moments(state.meta.distribution))
        recipe["versions"] = versions("bson-macid", "mujoco", "mujoco-mjx", "jax", "optax", "numpy")
        recipe["curve"] = [{name: round(value, 4) for name, value in row.items()} for row in thin(curve, 60)]
        policies.append(trainer.policy(state, recipe))
        policies[-1].save(folder / "policy")
    return policies


class _Noted(msgspec.Struct):
    """A checkpoint's values beside a training's state."""

    configs: list[dict]
    curves: list[list[dict[str, float]]]
    seconds: float


def _restored(found, noted, path, configs, like):
    """(states, curves, seconds) from the arrays `found` and the values `noted` in the checkpoint `path` of a training
    of `configs`. like: states of that training, for their shapes. Raises UsageError."""
    wanted = _named(like)
    if noted["configs"] != [plain(each) for each in configs]:
        raise UsageError(f"'{path}' is of {len(noted['configs'])} seeds, not {len(configs)}. Use another --out.")
    try:
        check_arrays(found, wanted)
        states = jax.tree.unflatten(
            jax.tree.structure(like),
            [_restore(found[name], leaf) for name, leaf in zip(wanted, jax.tree.leaves(like), strict=True)],
        )
        done = {len(curve) for curve in noted["curves"]} | {int(states.iteration)}
        if len(noted["curves"]) != len(configs) or len(done) != 1:
            raise ValueError("the curves are not as long as the training")
    except ValueError as error:
        raise damaged(path, error) from None
    return states, noted["curves"], noted["seconds"]


def _named(states):
    """All leaves of `states`, in their order, as {name: NumPy array}."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(states)
    return {jax.tree_util.keystr(path): _keep(leaf) for path, leaf in leaves}


def _keep(x):
    return np.asarray(jax.random.key_data(x)) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else np.asarray(x)


def _restore(saved, like):
    if jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.asarray(saved))
    return jnp.asarray(saved)
