"""How fast the robot's worlds step on a device: MJX-Warp's engine, whole control steps, and episodes that follow each
other."""

import dataclasses
import gc
import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from macid.files import UsageError

SENSORS = ("none", "lidar2d", "lidar3d", "camera")
PEOPLE, WORLDS = (24,), (1024, 4096)
_ACTION = (0.5, 0.1)  # a wide arc at 1 m/s
_CHUNK = 10  # control steps that the host asks for at once
_DRAWN = 256  # episodes that a profile's worlds begin with
_LONGEST = 600.0  # time that a case in its own process may take [s]


def measure(
    sensor: str = "lidar2d",
    people: int = 24,
    worlds: int = 4096,
    model: str = "macid",
    seconds: float = 5.0,
    engine: Any = None,
    workers: int | None = None,
    **config: Any,
) -> dict[str, Any]:
    """A row of the table, as a dict: control steps/s of all worlds together, in this process.

    Counted are physics, pedestrians, sensors, observation and reward, and the episodes that begin.
    engine: WarpConfig, or a dict of its fields.
    """
    import jax
    import jax.numpy as jnp

    from bson.episodes.tracks import SENSORS as SETS
    from bson.interfaces.device import DeviceWorlds
    from bson.interfaces.functional import BsonFuncEnv
    from bson.simulation.engines.warp import WarpConfig

    engine = WarpConfig(**(engine or {})) if isinstance(engine, dict | None) else engine
    begin = time.perf_counter()
    sensors = SETS.get(sensor, ())
    env = BsonFuncEnv(
        "local", sensors, worlds, seed=0, engine=engine, num_pedestrians=people, pedestrian_model=model, **config
    )
    fleet = DeviceWorlds(env, workers=workers, ahead=_CHUNK)
    actions = jnp.tile(jnp.asarray(_ACTION, jnp.float32), (worlds, 1))

    def chunk(carry, episodes):
        def one(carry, _):
            carry, outcome = fleet.step(carry, actions, episodes)
            seen = sum(jnp.sum(jnp.asarray(value, jnp.float32)) for value in outcome.observation.values())
            return carry, (seen, outcome.reward.sum())  # returned so that the compiler leaves nothing of a step out

        return jax.lax.scan(one, carry, None, length=_CHUNK)

    run = jax.jit(chunk, donate_argnums=0)
    carry, _ = fleet.begin()
    drawn = time.perf_counter()
    for _ in range(2):
        carry, _ = jax.block_until_ready(run(carry, fleet.ready(_CHUNK)))
        fleet.done(carry)
    compiled = time.perf_counter()
    steps, fleet.pool.waited = 0, 0.0
    start = time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds:
        carry, _ = jax.block_until_ready(run(carry, fleet.ready(_CHUNK)))
        fleet.done(carry)
        steps += _CHUNK
    memory = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0)
    fleet.close()
    return {
        "device": device(),
        "engine": "warp",
        "people": people,
        "worlds": worlds,
        "sensor": sensor,
        "model": model,
        "limits": dataclasses.asdict(engine),
        "steps_per_s": steps * worlds / elapsed,
        "steps": steps,
        "made_s": drawn - begin,
        "compiled_s": compiled - drawn,
        "waited_s": fleet.pool.waited,
        "episodes": int(fleet.pool.begun),
        "faults": int(np.asarray(carry.states.fault).sum()),
        "jax_peak_gb": memory / 1e9,
    }


def measure_training(
    people: int = 24,
    worlds: int = 4096,
    model: str = "macid",
    seconds: float = 5.0,
    engine: dict[str, Any] | None = None,
    workers: int | None = None,
    **hyperparameters: Any,
) -> dict[str, Any]:
    """As `measure`, but control steps/s while PPO learns, with the LIDAR's 720 beams."""
    import jax

    from bson.learning.device_ppo import DevicePpo, DevicePpoConfig, DeviceTrainConfig
    from bson.simulation.engines.warp import WarpConfig

    begin = time.perf_counter()
    task = {"num_pedestrians": people, "pedestrian_model": model}
    config = DeviceTrainConfig(0, 10**9, task, worlds, hyperparameters=DevicePpoConfig(**hyperparameters))
    trainer = DevicePpo(config, workers, WarpConfig(**(engine or {})))
    learner, stream = trainer.learner(), trainer.stream()
    drawn = time.perf_counter()
    *_, (learner, stream, _) = trainer.run(learner, stream, 2)
    compiled = time.perf_counter()
    updates, figures, trainer.worlds.pool.waited = 0, {}, 0.0
    while (elapsed := time.perf_counter() - compiled) < seconds:
        *_, (learner, stream, figures) = trainer.run(learner, stream, 4)
        jax.block_until_ready(learner)
        updates += 4
    steps = updates * config.hyperparameters.rollout
    trainer.close()
    return {
        "device": device(),
        "engine": "warp",
        "people": people,
        "worlds": worlds,
        "sensor": "ppo",
        "model": model,
        "steps_per_s": steps * worlds / elapsed,
        "steps": steps,
        "made_s": drawn - begin,
        "compiled_s": compiled - drawn,
        "waited_s": trainer.worlds.pool.waited,
        "episodes": trainer.worlds.pool.begun,
        "figures": figures,
    }


def measure_score(score: str, episodes: int = 100, engine: dict[str, Any] | None = None) -> dict[str, Any]:
    """How fast the agent `score` is scored on the suite `paper`, and its SNS in each episode."""
    from bson.agents import load_agent
    from bson.episodes.tracks import make_track
    from bson.evaluation.device_agents import device_agent
    from bson.evaluation.metrics import measure as metrics_of
    from bson.evaluation.on_device import play
    from bson.evaluation.suites import load_suite
    from bson.simulation.engines.warp import WarpConfig

    suite, factory = load_suite("paper"), load_agent(score)
    config, track = suite.cells[0].config, (factory.track, factory.sensor)
    begin = time.perf_counter()
    agent = device_agent(score, factory, config, make_track(*track), score)
    played = play(agent, config, track, suite.drawn(episodes, 0), WarpConfig(**(engine or {})))
    seconds = time.perf_counter() - begin
    measured = [metrics_of(episode) for episode in played]
    return {
        "device": device(),
        "engine": "warp",
        "scored": score,
        "seconds": seconds,
        **{name: float(np.mean([row[name] for row in measured])) for name in ("SNS", "RC", "Coll", "SP", "PE")},
        "each": {episode.seed: round(float(row["SNS"]), 3) for episode, row in zip(played, measured, strict=True)},
    }


def profile_parts(
    sensor: str = "lidar2d",
    people: int = 24,
    worlds: int = 4096,
    model: str = "macid",
    seconds: float = 1.0,
    engine: dict[str, Any] | None = None,
    **config: Any,
) -> dict[str, Any]:
    """What bounds the speed: "parts" are {part: microseconds} that parts of a control step, each compiled by itself,
    take for all worlds together."""
    import jax
    import jax.numpy as jnp

    from bson.episodes.tracks import SENSORS as SETS
    from bson.interfaces.functional import BsonFuncEnv
    from bson.simulation.engines.warp import WarpConfig

    config |= {"num_pedestrians": people, "pedestrian_model": model}
    limits = WarpConfig(**(engine or {}))
    env = BsonFuncEnv("local", SETS.get(sensor, ()), worlds, min(worlds, _DRAWN), engine=limits, **config)
    world, task, action = env.world, env.config, jnp.asarray(_ACTION, jnp.float32)

    def moved(state, by):
        """`state` moved a little, so that the compiler can't reuse one step's work for the next."""
        qpos = state.motion.qpos.at[3 * people].add(1e-9 * by)
        return state._replace(motion=state.motion._replace(qpos=qpos))

    def physics(state):
        motion = state.motion
        for _ in range(task.decisions):
            motion, _, _ = world.engine.step(motion, state.drawn.boxes, task.substeps)
        return state._replace(motion=motion)

    def decisions(state):
        for _ in range(task.decisions if people else 0):
            state = moved(state, world._commands(state).sum())
        return state

    def sensing(state):
        state = world.sense(state)
        return moved(state, sum(jnp.sum(reading.astype(jnp.float32)) for reading in state.readings.values()))

    parts = {
        "control step": lambda state: env.transition(state, action),
        "physics": physics,
        "people's decisions": decisions,
        "sensing": sensing,
    }
    states = jax.jit(jax.vmap(env.initial, in_axes=(0, None)))(jnp.arange(worlds), env.default_params)
    found = {}
    for part, of_one in parts.items():
        several = jax.jit(
            lambda states, of_one=of_one: jax.lax.scan(
                lambda states, _: (jax.vmap(of_one)(states), None), states, None, length=_CHUNK
            )[0]
        )
        jax.block_until_ready(several(states))
        count, begin = 0, time.perf_counter()
        while not count or time.perf_counter() - begin < seconds:
            jax.block_until_ready(several(states))
            count += _CHUNK
        found[part] = round(1e6 * (time.perf_counter() - begin) / count, 1)
    return {"device": device(), "people": people, "worlds": worlds, "sensor": sensor, "parts": found}


def device() -> str:
    """The device that the worlds are on, in words."""
    import jax

    first = jax.devices()[0]
    return f"{len(jax.devices())} x {first.device_kind} ({first.platform})"


def run(
    people: Sequence[int] = PEOPLE,
    worlds: Sequence[int] = WORLDS,
    sensors: Sequence[str] = ("none", "lidar2d"),
    seconds: float = 5.0,
    model: str = "macid",
    train: bool = False,
    engine: dict[str, Any] | None = None,
    show: Callable[..., object] = print,
) -> list[dict[str, Any]]:
    """Prints the table, a line a case as it is measured; returns its rows as dicts.

    train: measure PPO while it learns. engine: fields of WarpConfig. Each case has a process of its own, so that no
    case finds programs that another compiled. Raises ValueError for a sensor set that is not among SENSORS, UsageError
    for a case that fails.
    """
    for sensor in sensors:
        if sensor not in SENSORS:
            raise ValueError(f"Unknown sensor {sensor!r}. Choose among {', '.join(SENSORS)}.")
    common = {"seconds": seconds, "model": model, "engine": engine or {}}
    cases = [
        {"people": number, "worlds": many, **common, **({} if train else {"sensor": sensor})}
        for number in people
        for many in worlds
        for sensor in sensors
    ]
    rows = []
    for case in cases:
        row = (measure_training if train else measure)(**case) if len(cases) == 1 else _apart(case, train)
        if not rows:
            show(f"{row['device']}; pedestrians: {model}; control step 0.1 s = 5 physics steps; {seconds:g} s a case")
            show(f"{'people':>7}{'worlds':>8}{'sensor':>10}{'control steps/s':>17}")
        show(f"{row['people']:>7}{row['worlds']:>8}{row['sensor']:>10}{row['steps_per_s']:>17,.0f}")
        rows.append(row)
    return rows


def _apart(case, train=False):
    """`measure`, or `measure_training`, in a process of its own."""
    command = [sys.executable, "-m", "bson.bench_warp", "{}", json.dumps({**case, "train": train})]
    limit = _LONGEST + case["seconds"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit, check=False)
    except subprocess.TimeoutExpired:
        raise UsageError(f"The bench of {case} did not end within {limit:g} s.") from None
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise UsageError(f"The bench of {case} ended with code {done.returncode}: {last}")
    return json.loads(done.stdout.splitlines()[-1])


def _main(engine, *cases):
    """Measures `cases`, each in JSON like `engine`, the fields of WarpConfig; prints each row as one line of JSON."""
    for case in map(json.loads, cases):
        case["engine"] = {**json.loads(engine), **case.get("engine", {})}
        kinds = {"train": measure_training, "profile": profile_parts}
        asked = [kind for kind in kinds if case.pop(kind, False)]
        measured = kinds[asked[0]] if asked else measure_score if "score" in case else measure
        print(json.dumps(measured(**case)), flush=True)
        gc.collect()


if __name__ == "__main__":
    _main(*sys.argv[1:])
