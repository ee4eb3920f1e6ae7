"""What `bson doctor` says of the sensors. (The whole command: test_cli.)"""

import os
import pathlib
import shutil
import subprocess
import sys

import numpy as np
import pytest

import macid
from bson import doctor
from bson.episodes.tracks import SENSORS
from bson.sensors import Camera, Lidar2D, RgbCamera
from macid.drawing import gl

KEYS = {sensor.key: isinstance(sensor, Camera) for sensors in SENSORS.values() for sensor in sensors}
draws = pytest.mark.skipif(gl.gl_problem() is not None, reason="needs OpenGL")


@pytest.fixture
def diagnose(monkeypatch):
    """Runs the checks of that name alone: whether all is well, and the lines."""
    checks = doctor.CHECKS

    def run(name):
        monkeypatch.setattr(doctor, "CHECKS", [check for check in checks if check[0] == name])
        lines = []
        return doctor.run(lines.append), lines

    return run


@pytest.mark.parametrize(("name", "cameras"), [("sensors", False), pytest.param("cameras", True, marks=draws)])
def test_each_sensor_is_read(diagnose, name, cameras):
    well, (line,) = diagnose(name)
    assert well and line.split()[:2] == ["ok", name]
    named = {word.strip(",") for word in line.split()}
    assert {key for key in KEYS if key in named} == {key for key, camera in KEYS.items() if camera == cameras}


def stuck(value):
    """What binds a sensor that reads `value` everywhere."""
    return lambda sensor, world, robot="robot": (
        lambda world, ids: np.full((len(ids), *sensor.space.shape), value, sensor.space.dtype)
    )


@pytest.mark.parametrize(("value", "told"), [(30.0, "'lidar' reads 30 everywhere"), (0.0, "not in its space")])
def test_a_blind_sensor_is_told_with_what_to_do(diagnose, monkeypatch, value, told):
    monkeypatch.setattr(Lidar2D, "bind", stuck(value))
    well, (line,) = diagnose("sensors")
    assert not well and line.split()[:2] == ["MISSING", "sensors"]
    assert told in line and "mend: reinstall mujoco" in line


@draws
def test_a_black_picture_is_told_but_all_else_works(diagnose, monkeypatch):
    monkeypatch.setattr(RgbCamera, "bind", stuck(0))
    well, (line,) = diagnose("cameras")
    assert well and line.split()[:2] == ["without", "cameras"] and "'rgb' reads 0 everywhere" in line


def test_without_pictures_cameras_are_not_tried(diagnose, monkeypatch):
    monkeypatch.setattr(gl, "gl_problem", lambda: "no EGL here")
    monkeypatch.setattr(doctor, "_read", None)
    well, (line,) = diagnose("cameras")
    assert well and line.split()[:2] == ["without", "cameras"] and "no pictures here" in line


CARDS = ("NVIDIA H100 80GB HBM3, 570.86, 81559 MiB", "NVIDIA H100 80GB HBM3, 570.86, 81559 MiB")


@pytest.fixture
def nvidia(tmp_path, monkeypatch):
    """Puts an nvidia-smi in front of the machine's own: it prints `lines` and ends with `code`."""

    def install(lines, code=0):
        tool = tmp_path / "nvidia-smi"
        tool.write_text("#!/bin/sh\n" + "".join(f"echo '{line}'\n" for line in lines) + f"exit {code}\n")
        tool.chmod(0o755)
        monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)

    return install


def test_without_a_gpu_it_is_said_what_runs_instead(diagnose, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(doctor, "_DRIVER", tmp_path / "none")
    well, (line,) = diagnose("gpu")
    assert well and line.split()[:2] == ["ok", "gpu"] and "no NVIDIA GPU here; JAX is on the cpu" in line
    well, (line,) = diagnose("engines")
    assert well and "crowds run on native (JAX has no GPU here); robots on native" in line
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    well, (line,) = diagnose("warp")
    assert well and "not installed, and without a GPU not needed" in line


def test_a_gpu_that_is_not_used_is_told_with_its_driver_and_what_to_do(diagnose, nvidia, monkeypatch):
    nvidia(CARDS)
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    well, (line,) = diagnose("gpu")
    assert well and line.split()[:2] == ["without", "gpu"]
    assert line.count("NVIDIA H100 80GB HBM3, driver 570.86, 81559 MiB") == 2
    assert "but JAX is on the cpu (JAX_PLATFORMS=cpu)" in line and "mend: install JAX for it" in line
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    well, (line,) = diagnose("warp")
    assert well and line.split()[:2] == ["without", "warp"] and "mend: pip install 'bson-macid[warp]'" in line
    well, (line,) = diagnose("engines")
    assert "--engine warp needs the extra warp" in line


@pytest.mark.parametrize(
    ("lines", "code", "told"),
    [
        (("Failed to initialize NVML: Driver/library version mismatch",), 18, "code 18: Failed to initialize NVML"),
        ((), 9, "code 9: no message"),
    ],
)
def test_a_driver_that_does_not_work_is_told(diagnose, nvidia, lines, code, told):
    nvidia(lines, code)
    well, (line,) = diagnose("gpu")
    assert well and line.split()[:2] == ["without", "gpu"] and told in line


def test_another_version_of_warp_is_told(diagnose, monkeypatch):
    warp = pytest.importorskip("warp")
    well, (line,) = diagnose("warp")
    assert well and line.split()[:2] == ["ok", "warp"] and warp.__version__ in line
    monkeypatch.setattr(warp, "__version__", "0.9.0")
    well, (line,) = diagnose("warp")
    assert well and "warp-lang is 0.9.0, not 1." in line and line.split()[0] == "without"


ROOT = pathlib.Path(macid.__file__).parents[1]
PYMONGO = '"""BSON (Binary JSON) encoding and decoding."""\n\nclass BSON(bytes):\n    pass\n'


def site(folder, state):
    """A folder with our two packages as an installation has them, and what pymongo does to them."""
    for name in ("bson", "macid"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "macid" / "_assets").symlink_to(ROOT / "assets")
    front = folder / "front"
    if state == "shadowed":
        (front / "bson").mkdir(parents=True)
        (front / "bson" / "__init__.py").write_text(PYMONGO)
    elif state == "overwritten":
        (folder / "bson" / "__init__.py").write_text(PYMONGO)
    elif state == "removed":
        (folder / "bson" / "__init__.py").unlink()
    if state != "removed":
        noted = (front if state == "shadowed" else folder) / "pymongo-4.15.dist-info"
        noted.mkdir()
        (noted / "METADATA").write_text("Metadata-Version: 2.1\nName: pymongo\nVersion: 4.15\n")
        (noted / "RECORD").write_text("bson/__init__.py,,\nbson/code.py,,\n")
    return os.pathsep.join(map(str, (front, folder)))


def call(path, *words, **environment):
    """What the console script prints with `path` as PYTHONPATH: its exit code, stdout and stderr."""
    code = (
        "import os, sys; mine = os.environ['PYTHONPATH'].split(os.pathsep);"
        "sys.path[:] = [p for p in sys.path if p in mine or not os.path.isdir(os.path.join(p, 'bson'))];"  # no checkout
        f"from macid.start import bson; sys.argv[1:] = {list(words)}; sys.exit(bson())"
    )
    environment = {**os.environ, "PYTHONPATH": path, "JAX_PLATFORMS": "cpu", **environment}
    ran = subprocess.run([sys.executable, "-P", "-c", code], env=environment, capture_output=True, text=True)
    return ran.returncode, ran.stdout, ran.stderr


@pytest.mark.parametrize(
    ("state", "told"),
    [
        ("shadowed", "of pymongo, which stands before bson-macid's in"),
        ("overwritten", "is not bson-macid's any more: pymongo also has a package bson, and overwrote it"),
        ("removed", "bson/__init__.py' is missing: another package of the name bson, as pymongo,"),
    ],
)
def test_another_package_of_the_name_bson_is_told_with_the_cure(tmp_path, state, told):
    path = site(tmp_path, state)
    code, out, err = call(path, "list")
    assert code == 2 and out == "" and err.count("\n") == 1
    assert err.startswith("bson: error: ") and told in err and "environment of its own" in err
    if state == "overwritten":  # as with the console scripts of earlier installations
        words = [sys.executable, "-P", "-m", "bson.cli", "evaluate"]
        ran = subprocess.run(words, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True)
        assert ran.returncode == 2 and told in ran.stderr and ran.stderr.count("\n") == 1
        return
    code, out, err = call(path, "doctor")
    assert code == 1 and err == ""
    (line,) = [line for line in out.splitlines() if line.split()[:2] == ["MISSING", "name"]]
    assert told in line and "gymnasium.make" in line
    assert "environment of its own" in out and "not tried: it needs bson" in out
    assert [line.split()[0] for line in out.splitlines() if line.split()[1] in ("packages", "jax")] == ["ok", "ok"]


def test_a_namesake_beside_ours_is_told(tmp_path, diagnose, monkeypatch):
    path = site(tmp_path, "intact")
    monkeypatch.syspath_prepend(path.split(os.pathsep)[1])
    well, (line,) = diagnose("namesakes")
    assert well and line.split()[:2] == ["without", "namesakes"] and "pymongo also installs a package bson" in line


def test_without_egl_list_and_doctor_run_and_say_what_to_do(tmp_path):
    (tmp_path / "libEGL.so.1").touch()  # what can't be loaded stands before the system's
    (tmp_path / "libEGL.so").touch()
    missing = {"MUJOCO_GL": "egl", "LD_LIBRARY_PATH": str(tmp_path)}
    code, out, err = call(str(ROOT), "list", **missing)
    assert code == 0 and "vfh" in out and err == ""
    code, out, err = call(str(ROOT), "doctor", **missing)
    lines = {line.split()[1]: line.split()[0] for line in out.splitlines() if line.startswith("  ")}
    assert code == 0 and lines["packages"] == lines["physics"] == "ok" and lines["pictures"] == "without"
    assert "libegl1" in out and "Traceback" not in err
    code, out, err = call(str(ROOT), "evaluate", **missing)
    assert code == 2 and err.count("\n") == 1 and "Install EGL" in err and "unset MUJOCO_GL" in err


def test_where_a_backend_aborts_the_doctor_does_not():
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment |= {"PYTHONPATH": str(ROOT), "MUJOCO_GL": "glfw"}
    ran = subprocess.run(
        [sys.executable, "-P", "-m", "bson.cli", "doctor"], env=environment, capture_output=True, text=True
    )
    assert ran.returncode == 0
    lines = {line.split()[1]: line.split()[0] for line in ran.stdout.splitlines()}
    assert lines["pictures"] == lines["cameras"] == "without"
