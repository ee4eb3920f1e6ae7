"""Is this installation well? Versions, GL, threads, sensors, and how to mend what is missing."""

import contextlib
import importlib
import os
import platform
import sys


def _versions():
    from bson.evaluate import versions

    return ", ".join(f"{name} {version}" for name, version in versions().items())


def _python():
    if sys.version_info < (3, 11):
        raise RuntimeError(f"Python {platform.python_version()} is too old: use 3.11 or newer")
    return platform.python_version()


def _packages():
    with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None):  # MJX remarks that it has no Warp
        importlib.import_module("mujoco.mjx")
    for name in ("mujoco", "dm_control", "jax", "gymnasium", "cv2", "matplotlib", "scipy", "tqdm"):
        importlib.import_module(name)
    return "all there"


def _assets():
    from bson.suites import suite_names
    from macid import assets

    return f"{assets.root()} (suites: {', '.join(suite_names())})"


def _physics():
    from bson.sensors import Imu, Lidar2D
    from bson.task import TaskConfig
    from bson.world import World

    world = World(TaskConfig(num_pedestrians=2), sensors=(Imu(), Lidar2D()))
    world.reset([0], [0])
    world.step([0], [[1.0, 0.0]])
    return f"a world steps; {world.batch.nthread} MuJoCo threads on {os.cpu_count()} CPUs"


def _jax():
    import jax

    return f"{jax.default_backend()}: {', '.join(str(device) for device in jax.devices())}"


def _gl():
    from macid.drawing import gl_problem

    if problem := gl_problem():
        raise RuntimeError(problem)
    return f"offscreen pictures work (MUJOCO_GL={os.environ.get('MUJOCO_GL', 'default')})"


def _read(cameras):
    """Takes one reading of each sensor: of the cameras, or of the others. Raises RuntimeError where it can't be right."""
    import numpy as np

    from bson.sensors import Camera
    from bson.task import TaskConfig
    from bson.tracks import SENSORS
    from bson.world import World

    known = {sensor.key: sensor for sensors in SENSORS.values() for sensor in sensors}
    chosen = [sensor for sensor in known.values() if isinstance(sensor, Camera) == cameras]
    world = World(TaskConfig(num_pedestrians=0), sensors=chosen)
    world.reset([0], [0])
    for sensor in chosen:
        reading = world.readings[sensor.key][0]
        if not sensor.space.contains(reading):
            raise RuntimeError(f"'{sensor.key}' reads what is not in its space")
        if np.ptp(reading) == 0:  # in an empty room, too, walls, ground and gravity differ
            raise RuntimeError(f"'{sensor.key}' reads {reading.flat[0]:g} everywhere")
    return "a reading each of " + ", ".join(sensor.key for sensor in chosen)


def _sensors():
    return _read(cameras=False)


def _cameras():
    from macid.drawing import gl_problem

    if gl_problem():
        raise RuntimeError("not tried: there are no pictures here")
    return _read(cameras=True)


# (what, check, whether nothing works without, how to mend it)
CHECKS = (
    ("python", _python, True, "install Python 3.11 or newer and run tools/setup.sh again"),
    ("packages", _packages, True, "run tools/setup.sh, or pip install bson-macid"),
    ("versions", _versions, True, "run tools/setup.sh, or pip install bson-macid"),
    ("assets", _assets, True, "reinstall the package"),
    ("physics", _physics, True, "reinstall mujoco>=3.17,<4"),
    ("jax", _jax, True, "reinstall jax"),
    ("sensors", _sensors, True, "reinstall mujoco>=3.17,<4"),
    ("pictures", _gl, False, "apt-get install libegl1 libgl1-mesa-dri, and leave MUJOCO_GL unset or egl"),
    ("cameras", _cameras, False, "as pictures"),
)


def run(show=print):
    """Prints a line a check; returns whether all that is needed is there (pictures and cameras are not)."""
    well = True
    for name, check, needed, remedy in CHECKS:
        try:
            show(f"  ok       {name:<10}{check()}")
        except Exception as error:  # whatever it is, it is to be told
            well &= not needed
            show(f"  {'MISSING' if needed else 'without':<9}{name:<10}{error}\n{'':21}mend: {remedy}")
    return well
