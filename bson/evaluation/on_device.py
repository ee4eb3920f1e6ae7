"""Whole episodes on a device, for scoring: agents are JAX functions (bson.evaluation.device_agents), all episodes run
at once, and each becomes a `bson.episodes.record.Episode`."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bson.agents.contract import AgentError
from bson.episodes.record import Episode, shortest_way
from bson.interfaces.functional import BsonFuncEnv
from bson.simulation.batched import COLLISIONS
from bson.simulation.engines.warp import OutOfRoom
from bson.simulation.pool import Drawn, draw_all
from bson.task import TaskConfig, spawn

_CHUNK = 50  # control steps between two looks at whether all episodes are over


def play(
    agent: Any,
    config: TaskConfig,
    track: tuple[str, Any],
    seeds: Sequence[int],
    engine: Any = None,
    progress: Callable[..., object] | None = None,
    name: str = "agent",
) -> list[Episode]:
    """The Episodes `seeds` of `config` with `agent`, JAX functions, on `track`, (track, sensor) as for
    bson.episodes.tracks.make_track; in that order. progress: called with the number of control steps done since its
    last call, of all worlds together. engine: WarpConfig. name: the agent's, for messages.

    Raises OutOfRoom where physics runs out of it, AgentError for an action that is not finite.
    """
    seeds = [int(seed) for seed in seeds]
    env = BsonFuncEnv(*track, num_envs=len(seeds), engine=engine, task=config)
    k = config.people
    transition, observation = jax.vmap(env.transition), jax.vmap(env.observation)

    def record(state):
        qpos, qvel = state.motion.qpos, state.motion.qvel
        return {
            "pose": state.pose,
            "velocity": state.velocity,
            "qpos": qpos,
            "people": qpos[:, : 3 * k].reshape(-1, k, 3),
            "people_velocity": qvel[:, : 3 * k].reshape(-1, k, 3)[..., :2],
            "nearest_person": state.nearest_person,
            "counts": state.counts,
            "travelled": state.travelled,
            "distance": state.distance,
            "steps": state.steps,
            "arrived": jax.vmap(env.terminal)(state),
            "over": jax.vmap(env.terminal)(state) | jax.vmap(env.truncation)(state),
            "fault": state.fault,
            "overflow": state.overflow,
        }

    @jax.jit
    def begin(episodes):
        state = jax.vmap(env.initial, in_axes=(0, None))(jnp.arange(len(seeds)), episodes)
        return state, agent.begin(observation(state)), record(state)

    @jax.jit
    def chunk(state, memory):
        def one(carry, _):
            state, memory = carry
            action, memory = agent.act(memory, observation(state))
            state = transition(state, action)
            return (state, memory), {**record(state), "acted": jnp.isfinite(action).all(axis=-1)}

        return jax.lax.scan(one, (state, memory), None, length=_CHUNK)

    episodes = jax.tree.map(jnp.asarray, Drawn(*draw_all(config, seeds, env.has_map)))
    state, memory, first = begin(episodes)
    parts = [{key: np.asarray(value)[None] for key, value in first.items()}]
    over = parts[0]["over"][0]
    parts[0]["acted"] = np.ones((1, len(seeds)), bool)
    while not over.all():
        (state, memory), rows = chunk(state, memory)
        parts.append(jax.device_get(rows))
        before, over = over, over | parts[-1]["over"].any(axis=0)
        ended = np.cumsum(parts[-1]["over"], axis=0) - parts[-1]["over"] > 0  # in an earlier step of these
        going = ~(before | ended)
        if (going & ~parts[-1]["acted"]).any():
            raise AgentError(f"Agent '{name}' returned an action that is not finite.")
        if lost := int(np.bitwise_or.reduce(parts[-1]["overflow"], axis=None)):
            raise OutOfRoom(env.world.engine.explain(lost))
        if progress:
            progress(int(going.sum()))
    rows = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    return [
        _episode(config, seed, {key: value[:, row] for key, value in rows.items()}) for row, seed in enumerate(seeds)
    ]


def _episode(config, seed, rows):
    """The Episode of the `rows` {name: (T, ...)} of one world, up to its end."""
    last = int(np.argmax(rows["over"]))
    end = {name: value[last] for name, value in rows.items()}
    rows = {name: value[: last + 1] for name, value in rows.items()}
    drawn = spawn(config, np.random.default_rng(seed))
    start, goal = drawn.robot[:2], drawn.goal
    recorded = ("pose", "velocity", "people", "people_velocity", "qpos", "nearest_person")
    return Episode(
        seed=seed,
        start_distance=float(np.hypot(*(goal - start))),
        shortest=shortest_way(drawn.layout, start, goal, config.robot.radius),
        final_distance=float(end["distance"]),
        travelled=float(end["travelled"]),
        duration=float(np.round(end["steps"] * config.control_period, 9)),
        arrived=bool(end["arrived"]),
        timed_out=bool(end["steps"] >= config.horizon and not end["arrived"]),
        **{name: int(end["counts"][place]) for place, name in enumerate(COLLISIONS)},
        collisions_so_far=rows["counts"][:, 0].astype(np.int64),
        goal=goal.copy(),
        boxes=drawn.layout.boxes.copy(),
        lcf=drawn.lcf.copy(),
        period=config.control_period,
        robot_radius=config.robot.radius,
        people_goals=drawn.people_goals.copy(),
        person_radius=config.person_radius,
        fault="physics failed" if end["fault"] else "",
        **{name: rows[name].astype(float) for name in recorded},
    )
