"""How many agent-steps a second a crowd rolls out and learns from."""

import dataclasses
import os
import time

import jax

from macid.layout import LEVELS, load_level
from macid.learning import train as presets
from macid.learning.train import Trainer

WORLDS = (1, 4, 16, 64)


def measure(config, seconds=3.0):
    """Agent-steps/s of rollouts alone (observation, policy, physics, reward) and of whole training iterations.

    Each is repeated for about `seconds` [s], after a first call that compiles.
    """
    trainer = Trainer(config)
    state = trainer.init()
    roll = jax.jit(trainer._rollout)

    def speed(call):
        jax.block_until_ready(call())
        count, begin = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - begin) < seconds:
            jax.block_until_ready(call())
            count += 1
        return count * trainer.samples / elapsed

    return speed(lambda: roll(state.parameters, state.walk, state.key)), speed(lambda: trainer.iterate(state))


def run(engine="native", levels=LEVELS, worlds=WORLDS, seconds=3.0, preset="fast", show=print):
    """Prints the table, a line a case; returns its rows as dicts."""
    show(
        f"{jax.default_backend()}, {os.cpu_count()} CPUs, jax {jax.__version__}; "
        f"engine {engine}, preset {preset}, 0.02 s a decision"
    )
    show(f"{'people':>7}{'worlds':>8}{'rollout agent-steps/s':>23}{'training agent-steps/s':>24}")
    rows = []
    for level in levels:
        for nworld in worlds:
            config = dataclasses.replace(
                presets.preset(preset, level=level, nworld=nworld, engine=engine), rollout=50
            )
            people, rollout, training = load_level(level).pedestrians, *measure(config, seconds)
            rows.append({"people": people, "worlds": nworld, "rollout": rollout, "training": training})
            show(f"{people:>7}{nworld:>8}{rollout:>23,.0f}{training:>24,.0f}")
    return rows
