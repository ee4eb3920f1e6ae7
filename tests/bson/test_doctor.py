"""What `bson doctor` says of the sensors. (The whole command: test_cli.)"""

import numpy as np
import pytest

from bson import doctor
from bson.sensors import Camera, Lidar2D, RgbCamera
from bson.tracks import SENSORS
from macid import drawing

KEYS = {sensor.key: isinstance(sensor, Camera) for sensors in SENSORS.values() for sensor in sensors}
draws = pytest.mark.skipif(drawing.gl_problem() is not None, reason="needs OpenGL")


@pytest.fixture
def diagnose(monkeypatch):
    """Runs the checks of that name alone: whether all is well, and the lines."""

    def run(name):
        monkeypatch.setattr(doctor, "CHECKS", [check for check in doctor.CHECKS if check[0] == name])
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
    monkeypatch.setattr(drawing, "gl_problem", lambda: "no EGL here")
    monkeypatch.setattr(doctor, "_read", None)
    well, (line,) = diagnose("cameras")
    assert well and line.split()[:2] == ["without", "cameras"] and "no pictures here" in line
