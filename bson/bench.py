"""How fast the benchmark steps and robots learn in it, how much of the time MuJoCo itself takes, and what bags cost."""

import dataclasses
import itertools
import os
import pathlib
import platform
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np

from bson.episodes import tracks
from bson.episodes.record import Recorder
from bson.episodes.session import Session
from bson.evaluation.play import versions
from bson.evaluation.suites import Cell
from bson.simulation.engines.base import Engine
from bson.task import TaskConfig

PEOPLE = (24, 50, 100, 200)
BATCHES = (1, 16)
LEARNERS = ("ppo", "sac", "tac")
SENSORS = {"none": (), **tracks.SENSORS}
_ACTION = (0.5, 0.1)  # a wide arc at 1 m/s


class _Stopwatch:
    """An Engine whose calls are timed."""

    def __init__(self, engine):
        self._engine, self.seconds = engine, 0.0

    def __getattr__(self, name):
        attribute = getattr(self._engine, name)
        if not callable(attribute):
            return attribute

        def timed(*args, **kwargs):
            begin = time.perf_counter()
            result = attribute(*args, **kwargs)
            self.seconds += time.perf_counter() - begin
            return result

        return timed


def measure_speed(config: TaskConfig, sensors: Sequence[Any], nworld: int, seconds: float = 2.0) -> tuple[float, float]:
    """Control steps/s of all worlds together, and MuJoCo's share of the wall time, stepping for about `seconds` [s].

    Counted are physics, pedestrians, sensors, observation and reward, and the resets of worlds that end.
    """
    session = Session(config, tracks.LocalTrack(tuple(sensors)), nworld, seeds=range(nworld))
    ids = np.arange(nworld)
    session.reset(ids, range(nworld))
    action = np.tile(_ACTION, (nworld, 1))
    for _ in range(5):  # compiles and warms up
        session.step(ids, action)
    watch = _Stopwatch(session.world.engine)
    session.world.engine = cast(Engine, watch)
    steps, begin = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - begin) < seconds:
        _, _, terminated, truncated = session.step(ids, action)
        steps += 1
        if (ended := np.flatnonzero(terminated | truncated)).size:
            session.reset(ended, session.next_seeds(ended))
    return steps * nworld / elapsed, watch.seconds / elapsed


def machine() -> str:
    """One line on the machine and the versions."""
    model = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as f:
            model = next(line.split(":")[1].strip() for line in f if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    made_with = versions()
    return f"{model}, {os.cpu_count()} CPUs; mujoco {made_with['mujoco']}, jax {made_with['jax']}"


def run(
    people: Sequence[int] = PEOPLE,
    batches: Sequence[int] = BATCHES,
    sensors: Sequence[str] = ("none", "lidar2d"),
    seconds: float = 2.0,
    model: str = "macid",
    show: Callable[[str], object] = print,
) -> list[dict[str, Any]]:
    """Prints the table, a line a case as it is measured; returns its rows as dicts.

    Raises ValueError for a sensor set that is not among SENSORS.
    """
    _check_sensors(sensors)
    show(machine())
    show(f"pedestrians: {model}; control step 0.1 s = 5 physics steps; {seconds:g} s a case")
    show(f"{'people':>7}{'worlds':>8}{'sensor':>10}{'control steps/s':>17}{'in MuJoCo':>11}")
    rows = []
    for number, nworld, sensor in itertools.product(people, batches, sensors):
        config = TaskConfig(num_pedestrians=number, pedestrian_model=model)
        speed, share = measure_speed(config, SENSORS[sensor], nworld, seconds)
        rows.append({"people": number, "worlds": nworld, "sensor": sensor, "steps_per_s": speed, "in_mujoco": share})
        show(f"{number:>7}{nworld:>8}{sensor:>10}{speed:>17,.0f}{share:>10.0%}")
    return rows


def measure_learning(
    algo: str, config: dict[str, Any], nworld: int, seconds: float = 20.0
) -> tuple[float, float, float]:
    """Control steps/s of all worlds together while `algo` learns in them for about `seconds` [s] (whole rounds of
    collecting and updating), and the shares of the wall time that its updates and MuJoCo take.

    algo: one of LEARNERS; config: fields of TaskConfig, as a dict.
    """
    from stable_baselines3.common.callbacks import BaseCallback

    from bson.learning.presets import ALGORITHMS
    from bson.learning.train import one_thread
    from bson.learning.vec_env import FeatureVecEnv

    class Timer(BaseCallback):
        """Times all rounds but the first ones, in which JAX and torch compile."""

        def __init__(self):
            super().__init__()
            self.begin: float | None = None
            self.elapsed: float | None = None
            self.collecting = self.rounds = 0

        def _on_rollout_start(self):
            now = time.perf_counter()
            self.rounds += 1
            if self.begin is None and self.rounds > 2 and self.num_timesteps > 100 * nworld:
                self.begin, self.first, self.collecting, watch.seconds = now, self.num_timesteps, 0.0, 0.0
            elif self.begin is not None and now - self.begin >= seconds:
                self.elapsed = now - self.begin
            self._since = now

        def _on_rollout_end(self):
            self.collecting += time.perf_counter() - self._since

        def _on_step(self):
            if self.elapsed is None:
                self.steps = self.num_timesteps
            return self.elapsed is None

    hyperparameters = ALGORITHMS[algo]
    if hasattr(hyperparameters, "learning_starts"):
        hyperparameters = dataclasses.replace(hyperparameters, learning_starts=nworld)
    env = FeatureVecEnv(nworld, seed=0, **config)
    watch = _Stopwatch(env.world.engine)
    env.world.engine = cast(Engine, watch)
    timer = Timer()
    with one_thread():
        hyperparameters.build(env, seed=0).learn(10**12, callback=timer, log_interval=None)
    elapsed = timer.elapsed
    assert elapsed is not None  # set before learning ends
    return (timer.steps - timer.first) / elapsed, 1.0 - timer.collecting / elapsed, watch.seconds / elapsed


def run_learning(
    algos: Sequence[str] = LEARNERS,
    people: Sequence[int] = (24,),
    batches: Sequence[int] = (16,),
    seconds: float = 20.0,
    model: str = "macid",
    show: Callable[[str], object] = print,
) -> list[dict[str, Any]]:
    """Prints the table of training speeds, a line a case as it is measured; returns its rows as dicts.

    Raises ValueError for an algorithm that is not among LEARNERS.
    """
    for algo in algos:
        if algo not in LEARNERS:
            raise ValueError(f"Unknown algorithm {algo!r}. Choose among {', '.join(LEARNERS)}.")
    show(machine())
    show(f"training on 2D LIDAR; pedestrians: {model}; {seconds:g} s a case")
    show(f"{'algorithm':>10}{'people':>8}{'worlds':>8}{'control steps/s':>17}{'in updates':>12}{'in MuJoCo':>11}")
    rows = []
    for algo, number, nworld in itertools.product(algos, people, batches):
        config = {"num_pedestrians": number, "pedestrian_model": model}
        speed, updating, share = measure_learning(algo, config, nworld, seconds)
        show(f"{algo:>10}{number:>8}{nworld:>8}{speed:>17,.0f}{updating:>12.0%}{share:>11.0%}")
        case = {"algo": algo, "people": number, "worlds": nworld}
        rows.append({**case, "steps_per_s": speed, "in_updates": updating, "in_mujoco": share})
    return rows


def measure_recording(config: TaskConfig, sensors: Sequence[Any], seconds: float = 60.0) -> tuple[float, int]:
    """The processor's time [s] that writing a bag of `seconds` [s] of an episode takes, without the simulation, and the
    bag's size [bytes]. The robot drives wide arcs."""
    from bson.interfaces import bag

    steps = round(seconds / config.control_period)
    session = Session(config.replace(horizon=steps + 1), tracks.LocalTrack(tuple(sensors)), 1, seeds=[0])
    session.reset([0], [0])
    recorder, action = Recorder(session, 0), np.array(_ACTION)
    told = bag.about("arcs", "none", Cell((), config), ["local", ""], [])
    with tempfile.TemporaryDirectory() as folder, bag.recordings(folder, lambda seed: "bag", told) as begin:
        before = time.process_time()
        recording = begin(session, 0)
        spent = time.process_time() - before
        for _ in range(steps):
            session.step([0], action[None])
            before = time.process_time()
            recording.snap(action)
            spent += time.process_time() - before
        episode = recorder.episode()
        before = time.process_time()
        recording.end(episode)
        spent += time.process_time() - before
        return spent, sum(file.stat().st_size for file in pathlib.Path(folder, "bag").iterdir())


def run_recording(
    people: Sequence[int] = (24,),
    sensors: Sequence[str] = ("lidar2d",),
    model: str = "macid",
    seconds: float = 60.0,
    show: Callable[[str], object] = print,
) -> list[dict[str, Any]]:
    """Prints what writing bags takes, a line a case as it is measured; returns its rows as dicts. Raises ValueError for
    a sensor set that is not among SENSORS."""
    _check_sensors(sensors)
    show(machine())
    show(f"writing a bag of {seconds:g} s of an episode, without simulating it (CPU time); pedestrians: {model}")
    show(f"{'people':>7}{'sensor':>10}{'seconds':>10}{'MB':>8}")
    rows = []
    for number, sensor in itertools.product(people, sensors):
        config = TaskConfig(num_pedestrians=number, pedestrian_model=model)
        spent, size = measure_recording(config, SENSORS[sensor], seconds)
        rows.append({"people": number, "sensor": sensor, "of": seconds, "seconds": spent, "bytes": size})
        show(f"{number:>7}{sensor:>10}{spent:>10.2f}{size / 1e6:>8.2f}")
    return rows


def _check_sensors(sensors):
    """Raises ValueError for a sensor set that is not among SENSORS."""
    for sensor in sensors:
        if sensor not in SENSORS:
            raise ValueError(f"Unknown sensor {sensor!r}. Choose among {', '.join(SENSORS)}.")
