"""A robot's and a suite's files, changed at random, are read or refused in one line, and never anything else."""

import pathlib
import tempfile

import hostile
import pytest
from hypothesis import HealthCheck, given, settings

from bson.evaluation.suites import load_suite, read_suite
from bson.robot import load_robot
from macid import assets

ROBOT = assets.path("robots", "diffbot.toml").read_text()
SUITE = """name = "mine"
description = "two axes"
seeds = [1, 2, 3]

[config]
lcf = [-2.0, 2.0]
goal_distance = [13.0, 40.0]
horizon = 600
robot = "diffbot"
reward = { goal = 2.0 }

[axes.people]
few = { num_pedestrians = 3 }
many = { pedestrian_density = 0.5 }

[axes.where]
hall = { map = "hall" }
maze = { obstacle_density = 0.5, pedestrian_model = { orca = 1.0, social-force = 2.0 } }
"""
MODEL = assets.path("robots", "diffbot.urdf").read_bytes()
few = settings(max_examples=500, deadline=None, suppress_health_check=list(HealthCheck), database=None)
many = settings(few, max_examples=20_000)


def refused(content, model=MODEL):
    with tempfile.TemporaryDirectory() as folder:
        (pathlib.Path(folder) / "diffbot.toml").write_bytes(content)
        (pathlib.Path(folder) / "diffbot.urdf").write_bytes(model)
        return hostile.refused_in_one_line(load_robot, f"{folder}/diffbot.toml")


def refused_suite(content):
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder) / "mine.toml"
        file.write_bytes(content)
        return hostile.refused_in_one_line(read_suite, file)


def check_robot(content):
    refused(content)


def check_model(model):
    refused(ROBOT.encode(), model)


def check_suite(content):
    refused_suite(content)


ALL = {
    "robot": (hostile.mutated(ROBOT, " = "), check_robot),
    "model": (hostile.mutated(MODEL.decode(), '="', [f'{value}"' for value in hostile.SCALARS]), check_model),
    "suite": (hostile.mutated(SUITE, " = "), check_suite),
}


def test_the_files_are_valid_as_long_as_nothing_is_changed():
    assert not refused(ROBOT.encode())
    assert not refused_suite(SUITE.encode())


@pytest.mark.parametrize("kind", ALL)
def test_a_changed_file_is_read_or_refused_in_one_line(kind):
    strategy, run = ALL[kind]
    few(given(strategy)(run))()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ALL)
def test_twenty_thousand_changed_files(kind):
    strategy, run = ALL[kind]
    many(given(strategy)(run))()


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        (("seeds = [1, 2, 3]", "seeds = []"), "'seeds': it must be a list"),
        (("seeds = [1, 2, 3]", "seeds = [1, 1]"), "'seeds': no seed may stand twice"),
        (("seeds = [1, 2, 3]", "seeds = [-1]"), r"'seeds\[0\]': it must be a whole number of at least 0"),
        (('name = "mine"', "name = 3"), "'name': it must be a name of letters"),
        (
            ("horizon = 600", "horizon = 1e9"),
            "'config.horizon': it must be a whole number of at least 1 and of at most 1e.06, not 1000000000.0",
        ),
        (("horizon = 600", "horizont = 600"), "'config': unknown key 'horizont'. Choose among .*horizon"),
        (("num_pedestrians = 3", "num_pedestrians = [3]"), "'axes.people.few.num_pedestrians': it must be"),
        (('map = "hall"', 'map = "hal"'), "'axes.people.few, axes.where.hall': Unknown map 'hal'"),
        (('"diffbot"', '"dif"'), "'config': Unknown robot 'dif'"),
        (("[axes.where]", "[axes.people]"), "is not TOML"),
    ],
)
def test_what_is_wrong_in_a_suite_is_told(tmp_path, changed, told):
    assert changed[0] in SUITE
    (tmp_path / "mine.toml").write_text(SUITE.replace(*changed))
    with pytest.raises(ValueError, match=f"suite '.*mine.toml'.*{told}"):
        read_suite(tmp_path / "mine.toml")


def test_a_suites_file_is_read_as_the_shipped_ones_are(tmp_path):
    (tmp_path / "mine.toml").write_text(SUITE)
    assert [cell.name for cell in read_suite(tmp_path / "mine.toml").cells] == [
        *("few, hall", "few, maze"),
        *("many, hall", "many, maze"),
    ]
    for name in ("paper", "scenarios"):
        assert read_suite(assets.path("suites", f"{name}.toml")).digest == load_suite(name).digest
