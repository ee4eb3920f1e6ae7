"""How fast the benchmark steps, and how much of the time MuJoCo itself takes."""

import os
import platform
import time

import numpy as np

from bson import tracks
from bson.evaluate import versions
from bson.session import Session
from bson.task import TaskConfig

PEOPLE = (24, 50, 100, 200)
BATCHES = (1, 16)
SENSORS = {"none": (), **tracks.SENSORS}
_ACTION = (0.5, 0.1)  # a wide arc at 1 m/s


class _Stopwatch:
    """A MuJoCo batch whose calls are timed."""

    def __init__(self, batch):
        self._batch, self.seconds = batch, 0.0

    def __getattr__(self, name):
        attribute = getattr(self._batch, name)
        if not callable(attribute):
            return attribute

        def timed(*args, **kwargs):
            begin = time.perf_counter()
            result = attribute(*args, **kwargs)
            self.seconds += time.perf_counter() - begin
            return result

        return timed


def measure_speed(config, sensors, nworld, seconds=2.0):
    """Control steps/s of all worlds together, and MuJoCo's share of the wall time, stepping for about `seconds` [s].

    Counted are physics, pedestrians, sensors, observation and reward, and the resets of worlds that end.
    """
    session = Session(config, tracks.LocalTrack(sensors), nworld, seeds=range(nworld))
    ids = np.arange(nworld)
    session.reset(ids, ids)
    action = np.tile(_ACTION, (nworld, 1))
    for _ in range(5):  # compile and warm up
        session.step(ids, action)
    watch = session.world.batch = _Stopwatch(session.world.batch)
    steps, begin = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - begin) < seconds:
        _, _, terminated, truncated = session.step(ids, action)
        steps += 1
        if (ended := np.flatnonzero(terminated | truncated)).size:
            session.reset(ended, session.next_seeds(ended))
    return steps * nworld / elapsed, watch.seconds / elapsed


def machine():
    """One line on the machine and the versions."""
    model = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as f:
            model = next(line.split(":")[1].strip() for line in f if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    made_with = versions()
    return f"{model}, {os.cpu_count()} CPUs; mujoco {made_with['mujoco']}, jax {made_with['jax']}"


def run(people=PEOPLE, batches=BATCHES, sensors=tuple(SENSORS), seconds=2.0, model="macid", show=print):
    """Prints the table, a line a case as it is measured; returns its rows as dicts.

    Raises ValueError for a sensor set that is not among SENSORS.
    """
    for sensor in sensors:
        if sensor not in SENSORS:
            raise ValueError(f"Unknown sensor {sensor!r}. Choose among {', '.join(SENSORS)}.")
    show(machine())
    show(f"pedestrians: {model}; control step 0.1 s = 5 physics steps; {seconds:g} s a case")
    show(f"{'people':>7}{'worlds':>8}{'sensor':>10}{'control steps/s':>17}{'in MuJoCo':>11}")
    rows = []
    for number in people:
        for nworld in batches:
            for sensor in sensors:
                config = TaskConfig(num_pedestrians=number, pedestrian_model=model)
                speed, share = measure_speed(config, SENSORS[sensor], nworld, seconds)
                rows.append(
                    {"people": number, "worlds": nworld, "sensor": sensor, "steps_per_s": speed, "in_mujoco": share}
                )
                show(f"{number:>7}{nworld:>8}{sensor:>10}{speed:>17,.0f}{share:>10.0%}")
    return rows
