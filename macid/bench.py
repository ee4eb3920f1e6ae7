"""The speed of rollouts and of training, in agent-steps a second, and the time that each part takes."""

import dataclasses
import functools
import os
import time
from collections.abc import Callable, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp

from macid.engines.base import Engine
from macid.layout import LEVELS, load_level
from macid.learning import config as presets
from macid.learning import ppo
from macid.learning.trainer import Trainer
from macid.observation import observe

WORLDS = (1, 4, 16, 64)
KINDS = ("rollout", "training")


def measure(config: presets.TrainConfig, seconds: float = 3.0, only: str | None = None) -> tuple[float | None, ...]:
    """Agent-steps/s of rollouts alone (observation, policy, physics, reward), and of whole training iterations.

    Each is repeated for about `seconds` [s], after a first call that compiles. only: "rollout" or "training"; the other
    is not measured, and its figure is None.
    """
    trainer = Trainer(config)
    state = trainer.init()
    roll = jax.jit(trainer._rollout)
    calls = {
        "rollout": lambda: roll(state.parameters, state.walk, state.key),
        "training": lambda: trainer.iterate(state),
    }
    found = [trainer.samples / _duration(calls[kind], seconds) if only in (None, kind) else None for kind in KINDS]
    trainer.engine.check()
    return tuple(found)


def profile_parts(config: presets.TrainConfig, seconds: float = 1.0) -> dict[str, float]:
    """{part: microseconds} that parts of a training iteration, each compiled by itself, take per decision of all
    worlds: the rollout, the same without physics, physics alone, observation alone, and the gradient steps of the
    update.
    """
    trainer = Trainer(config)
    state, steps = trainer.init(), config.rollout
    engine, boxes = trainer.engine, trainer.engine.boxes
    roll = jax.jit(trainer._rollout)
    command = jnp.zeros((config.nworld, trainer.number, 3)).at[..., 0].set(1.0)

    def physics(physics):
        return jax.lax.scan(lambda state, _: (engine.step(state, command), None), physics, None, length=steps)[0]

    def observation(walk):
        def one(carried, _):
            crowd, _ = carried
            seen = observe(crowd, boxes, walk.goals)
            # The observation moves people a little, so that the compiler can't reuse one for the next.
            return (crowd._replace(position=crowd.position + 1e-6 * seen[..., :2]), seen), None

        crowd = engine.read(walk.physics)
        return jax.lax.scan(one, (crowd, observe(crowd, boxes, walk.goals)), None, length=steps)[0]

    def learn(state, data):
        return ppo.update(state.parameters, trainer.optimizer, state.optimizer, data, state.key, config.ppo)

    _, rolled, last = roll(state.parameters, state.walk, state.key)
    data = jax.jit(lambda: trainer._experience(state, state.walk, rolled, last))()
    parts = {
        "rollout": (roll, (state.parameters, state.walk, state.key)),
        "physics": (jax.jit(physics), (state.walk.physics,)),
        "observation": (jax.jit(observation), (state.walk,)),
        "update": (jax.jit(learn), (state, data)),
    }
    found = {part: _duration(functools.partial(call, *given), seconds) for part, (call, given) in parts.items()}
    trainer.engine = cast(Engine, _Standing(engine))
    still = jax.jit(lambda *given: trainer._rollout(*given))  # not `roll`'s function, so compiled anew
    found["rollout without physics"] = _duration(lambda: still(state.parameters, state.walk, state.key), seconds)
    return {part: round(1e6 * duration / steps, 1) for part, duration in found.items()}


class _Standing:
    """An engine without its physics: nobody moves."""

    def __init__(self, engine):
        self._engine = engine

    def __getattr__(self, name):
        return getattr(self._engine, name)

    def step(self, state, command, nstep=1):
        """`state`, with a change so small that it only keeps the compiler from leaving the step out."""
        return jax.tree.map(lambda x: x + 1e-30 * command[0, 0, 0] if x.dtype == jnp.float32 else x, state)


def _duration(call, seconds):
    """The time of a `call()` [s], repeated for about `seconds` [s] after a first call."""
    jax.block_until_ready(call())
    count, begin = 0, time.perf_counter()
    while not count or time.perf_counter() - begin < seconds:
        jax.block_until_ready(call())
        count += 1
    return (time.perf_counter() - begin) / count


def device() -> str:
    """JAX's devices, for tables: their kind and number, beside the CPUs."""
    devices = jax.devices()
    cpus = f"{os.cpu_count()} CPUs"
    return cpus if devices[0].platform == "cpu" else f"{len(devices)} x {devices[0].device_kind}, {cpus}"


def run(
    engine: str = "native",
    levels: Sequence[int | str] = LEVELS,
    worlds: Sequence[int] = WORLDS,
    seconds: float = 3.0,
    preset: str = "fast",
    show: Callable[[str], None] = print,
    rollout: int = 50,
    only: str | None = None,
    profile: bool = False,
) -> list[dict[str, Any]]:
    """Prints the table, a line a case; returns its rows as dicts.

    rollout: decisions between updates. only: see `measure`. profile: each row also has the times of parts, see
    `profile_parts`.
    """
    show(
        f"{jax.default_backend()}: {device()}, jax {jax.__version__}; "
        f"engine {engine}, preset {preset}, rollouts of {rollout}, 0.02 s a decision"
    )
    show(f"{'people':>7}{'worlds':>8}{'rollout agent-steps/s':>23}{'training agent-steps/s':>24}")
    rows = []
    for level in levels:
        for nworld in worlds:
            config = dataclasses.replace(
                presets.preset(preset, level=level, nworld=nworld, engine=engine), rollout=rollout
            )
            options = {} if only is None else {"only": only}
            people = load_level(level).people
            measured = dict(zip(KINDS, measure(config, seconds, **options), strict=True))
            row = {"device": device(), "engine": engine, "people": people, "worlds": nworld, **measured}
            told = "".join(
                f"{'-' if measured[kind] is None else format(measured[kind], ',.0f'):>{width}}"
                for kind, width in zip(KINDS, (23, 24), strict=True)
            )
            show(f"{people:>7}{nworld:>8}{told}")
            if profile:
                row["profile"] = parts = profile_parts(config, seconds)
                show("  microseconds a decision: " + ", ".join(f"{part} {time:,.0f}" for part, time in parts.items()))
            rows.append(row)
    return rows
