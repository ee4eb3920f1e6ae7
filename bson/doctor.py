"""Checks this installation: versions, GL, threads, sensors. Says how to mend each fault.

This file runs without the package `bson` too, where another package has taken its name (see macid.start).
"""

import contextlib
import functools
import importlib
import os
import pathlib
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable

from macid import start
from macid.running import run_command, start_mujoco

_PATIENCE = 120  # time for the process that tries to draw [s]
_DRIVER = pathlib.Path("/proc/driver/nvidia/version")  # of NVIDIA's driver, on Linux
_FIELDS = "name,driver_version,memory.total"  # that nvidia-smi is asked for


def _versions():
    from bson.evaluation.play import versions

    return ", ".join(f"{name} {version}" for name, version in versions().items())


def _python():
    if tuple(map(int, platform.python_version_tuple()[:2])) < (3, 11):
        raise RuntimeError(f"Python {platform.python_version()} is too old: use 3.11 or newer")
    return platform.python_version()


def _name():
    if problem := start.shadowed():
        raise RuntimeError(f"{problem}; gymnasium.make does not find BSON's environments then")
    return "bson is ours"


def _namesakes():
    if others := start.others():
        raise RuntimeError(
            f"{' and '.join(others)} also installs a package bson. One of the two is broken, and uninstalling it "
            "deletes a file of ours"
        )
    return "no other package of the name bson"


def _packages():
    with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None):  # MJX prints a remark that Warp is missing
        importlib.import_module("mujoco.mjx")
    for name in ("mujoco", "dm_control", "jax", "gymnasium", "cv2", "matplotlib", "jinja2", "scipy", "tqdm"):
        importlib.import_module(name)
    return "all there"


def _assets():
    from bson.evaluation.suites import suite_names
    from macid import assets

    return f"{assets.root()} (suites: {', '.join(suite_names())})"


def _physics():
    from bson.sensors import Imu, Lidar2D
    from bson.simulation.world import World
    from bson.task import TaskConfig

    world = World(TaskConfig(num_pedestrians=2), sensors=(Imu(), Lidar2D()))
    world.reset([0], [0])
    world.step([0], [[1.0, 0.0]])
    return f"a world steps; {world.engine.about} on {os.cpu_count()} CPUs"


def _jax():
    import jax

    return f"{jax.default_backend()}: {', '.join(str(device) for device in jax.devices())}"


def _graphics_cards():
    """NVIDIA's GPUs and their driver, in words; None where there is no driver. Raises RuntimeError where the driver
    does not answer."""
    asked = shutil.which("nvidia-smi")
    if asked is None:
        if not _DRIVER.exists():
            return None
        return f"NVIDIA's driver {' '.join(_DRIVER.read_text().split()[:9])}"
    try:
        told = subprocess.run(
            [asked, f"--query-gpu={_FIELDS}", "--format=csv,noheader"],
            capture_output=True,
            text=True,
            timeout=_PATIENCE,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise RuntimeError(f"nvidia-smi does not answer ({error})") from None
    lines = [line.strip() for line in told.stdout.splitlines() if line.strip()]
    if told.returncode or not lines:
        last = ([*lines, *told.stderr.strip().splitlines()] or ["no message"])[-1]
        raise RuntimeError(f"NVIDIA's driver does not work: nvidia-smi ends with code {told.returncode}: {last}")
    cards = [[part.strip() for part in line.split(",")] for line in lines]
    return "; ".join(f"{name}, driver {', '.join(rest)}" for name, *rest in cards)


def _gpu():
    import jax

    cards, ours = _graphics_cards(), jax.default_backend()
    if cards is None:
        return f"no NVIDIA GPU here; JAX is on the {ours}"
    if ours != "gpu":
        chosen = os.environ.get("JAX_PLATFORMS")
        why = f" (JAX_PLATFORMS={chosen})" if chosen else ""
        raise RuntimeError(f"{cards}; but JAX is on the {ours}{why}")
    return f"{cards}; JAX is on it"


def _warp():
    from macid.engines import WARP_PACKAGE, has_warp

    name, _, wanted = WARP_PACKAGE.partition("==")
    if not has_warp():
        if _graphics_cards() is None:
            return "not installed, and without a GPU not needed"
        raise RuntimeError(f"{name} is not installed, so there is no engine 'warp'")
    import warp

    warp.config.log_level = warp.LOG_ERROR  # else Warp prints lines on itself
    if warp.__version__ != wanted:
        raise RuntimeError(f"{name} is {warp.__version__}, not {wanted}, the version for this mujoco-mjx")
    importlib.import_module("mujoco.mjx.third_party.mujoco_warp")
    if _graphics_cards() is None:  # not asked of Warp, which prints a remark on that
        return f"{warp.__version__}, on the CPU (for tests: it is slow there)"
    if not warp.is_cuda_available():
        raise RuntimeError(f"{name} {warp.__version__} does not find the GPU: its driver may be too old")
    return f"{warp.__version__}, on {', '.join(device.name for device in warp.get_cuda_devices())}"


def _engines():
    from macid.engines import best_engine, has_warp

    name, why = best_engine()
    robots = "warp where --engine warp asks for it" if has_warp() else "--engine warp needs the extra warp"
    return f"crowds run on {name} ({why}); robots on native, {robots}"


def _gl():
    if problem := _trial():
        raise RuntimeError(problem)
    from macid.drawing.gl import gl_problem

    if problem := gl_problem():
        raise RuntimeError(problem)
    return f"offscreen pictures work (MUJOCO_GL={os.environ.get('MUJOCO_GL', 'default')})"


@functools.cache
def _trial():
    """Why drawing fails here, None where it works. A process of its own tries, as some backends abort instead of
    raising errors."""
    root = os.path.dirname(os.path.dirname(os.path.abspath(start.__file__)))
    code = (
        f"import sys; sys.path.insert(0, {root!r}); from macid.drawing.gl import gl_problem; print(gl_problem() or '')"
    )
    chosen = f"with MUJOCO_GL={os.environ.get('MUJOCO_GL', 'default')}"
    try:
        tried = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=_PATIENCE)
    except subprocess.TimeoutExpired:
        return f"a process that tries to draw {chosen} does not end within {_PATIENCE} s"
    if tried.returncode == 0:
        return " ".join(tried.stdout.split()) or None
    last = (tried.stderr.strip().splitlines() or ["no message"])[-1]
    return f"a process that tries to draw {chosen} ends with code {tried.returncode}: {last}"


def _read(cameras):
    """Takes one reading of each camera, or of each other sensor. Raises RuntimeError where a reading can't be right."""
    import numpy as np

    from bson.episodes.tracks import SENSORS
    from bson.sensors import Camera
    from bson.simulation.world import World
    from bson.task import TaskConfig

    known = {sensor.key: sensor for sensors in SENSORS.values() for sensor in sensors}
    chosen = [sensor for sensor in known.values() if isinstance(sensor, Camera) == cameras]
    world = World(TaskConfig(num_pedestrians=0), sensors=chosen)
    world.reset([0], [0])
    for sensor in chosen:
        reading = world.readings[sensor.key][0]
        if not sensor.space.contains(reading):
            raise RuntimeError(f"'{sensor.key}' reads what is not in its space")
        if np.ptp(reading) == 0:  # even in an empty room walls, ground and gravity differ
            raise RuntimeError(f"'{sensor.key}' reads {reading.flat[0]:g} everywhere")
    return "a reading each of " + ", ".join(sensor.key for sensor in chosen)


def _sensors():
    return _read(cameras=False)


def _cameras():
    from macid.drawing.gl import gl_problem

    if _trial() or gl_problem():
        raise RuntimeError("not tried: there are no pictures here")
    return _read(cameras=True)


# (name, check, whether nothing works while it fails, how to mend it)
CHECKS = (
    ("python", _python, True, "install Python 3.11 or newer and run tools/setup.sh again"),
    ("name", _name, True, start.CURE),
    ("namesakes", _namesakes, False, start.CURE),
    ("packages", _packages, True, "run tools/setup.sh, or pip install bson-macid"),
    ("versions", _versions, True, "run tools/setup.sh, or pip install bson-macid"),
    ("assets", _assets, True, "reinstall the package"),
    ("physics", _physics, True, "reinstall mujoco>=3.17,<4"),
    ("jax", _jax, True, "reinstall jax"),
    (
        "gpu",
        _gpu,
        False,
        "install JAX for it: pip install 'jax[cuda12]', the same version; leave JAX_PLATFORMS unset",
    ),
    ("warp", _warp, False, "pip install 'bson-macid[warp]'"),
    ("engines", _engines, True, "as jax"),
    ("sensors", _sensors, True, "reinstall mujoco>=3.17,<4"),
    ("pictures", _gl, False, "apt-get install libegl1 libgl1-mesa-dri, and leave MUJOCO_GL unset or egl"),
    ("cameras", _cameras, False, "as pictures"),
)
_OF_BSON = ("versions", "assets", "physics", "sensors", "cameras")  # checks that import the package `bson`


def run(show: Callable[[str], object] = print) -> bool:
    """Prints a line a check; returns whether everything necessary works (pictures and cameras are not necessary)."""
    well, ours = True, start.shadowed() is None
    for name, check, needed, remedy in CHECKS:
        try:
            if name in _OF_BSON and not ours:
                show(f"  -        {name:<10}not tried: it needs bson, see 'name'")
            else:
                show(f"  ok       {name:<10}{check()}")
        except Exception as error:  # any error is to be reported
            well &= not needed
            show(f"  {'MISSING' if needed else 'without':<9}{name:<10}{error}\n{'':21}mend: {remedy}")
    return well


def command() -> int | str | None:
    """Runs `bson doctor`; returns its exit code."""

    def examine():
        start_mujoco(draws=False)
        return 0 if run() else 1

    return run_command("bson", examine)
