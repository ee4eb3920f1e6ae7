"""What users bring: tests/examples run as their first lines say, and what is wrong with one's own is told in one
line."""

import json
import pathlib
import shutil

import numpy as np
import pytest

import bson.cli
import macid.cli
from bson.registry import KINDS, kind
from macid.registry import Kind

EXAMPLES = pathlib.Path(__file__).parent / "examples"
FEW = ["--episodes", "2", "--videos", "0", "--set", "horizon=80"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The examples in a folder of their own, which is the current one."""
    for file in EXAMPLES.glob("own_*"):
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def scored(folder, *words):
    assert bson.cli.main(["evaluate", *words, *FEW, "--out", str(folder / "out")]) == 0
    return json.loads((folder / "out" / "results.json").read_text())


def test_examples_are_short():
    for file in EXAMPLES.glob("own_*"):
        assert len(file.read_text().splitlines()) < 60, file.name


def test_an_agent_drives_to_the_goal_with_any_robot(here):
    for robot in ("jackal", "courier"):
        content = scored(here, "--agent", "own_agent.py", "--suite", "smoke", "--set", f"robot={robot}")
        assert content["summary"]["RC"] > 0.05  # 8 s of some 25 m


def test_a_sensor_reads_where_the_nearest_person_is(here):
    from bson.interfaces.gym import BsonEnv

    content = scored(here, "--agent", "own_sensor.py", "--sensor", "own_sensor.py:SENSORS", "--suite", "smoke")
    assert [sensor["kind"] for sensor in content["sensors"]][-1] == "NearestPerson"
    env = BsonEnv(sensor="own_sensor.py:SENSORS", num_pedestrians=1, goal_distance=(15.0, 16.0))
    for seed in range(30):
        observation, info = env.reset(seed=seed)
        away = np.hypot(*observation["nearest"]) - 0.35 - info["nearest_person"]
        if info["nearest_person"] < 7.0:  # surface to surface: the Jackal's is up to 0.3 m from its centre
            assert -0.3 < away < 0.6
            return
    pytest.fail("nobody came near")


def test_pedestrians_walk_in_both_commands(here):
    setting = "pedestrian_model=own_pedestrian.py:KeepRight"
    content = scored(here, "--agent", "goal", "--suite", "smoke", "--set", setting)
    assert content["config"]["pedestrian_model"] == "own_pedestrian.py:KeepRight"
    words = ["--pedestrian", "own_pedestrian.py:KeepRight", "--levels", "1", "--episodes", "1"]
    assert macid.cli.main(["evaluate", *words, "--out", "walk.json"]) == 0
    assert "own_pedestrian" in pathlib.Path("walk.json").read_text()


def test_keep_right_keeps_right():
    import jax.numpy as jnp

    from macid.pedestrians import make_controller
    from macid.state import CrowdState

    controller = make_controller(f"{EXAMPLES / 'own_pedestrian.py'}:KeepRight", 0.1)
    place = jnp.array([[0.0, 0.0], [1.2, 0.0], [9.0, 9.0]])
    state = CrowdState(place, jnp.zeros(3), jnp.zeros((3, 2)), jnp.zeros(3), jnp.zeros(3, bool))
    goals = jnp.array([[8.0, 0.0], [-8.0, 0.0], [9.0, 0.0]])
    command = np.asarray(controller(state, jnp.zeros((0, 5)), goals, jnp.zeros(3)))
    assert command[0, 1] < -0.5 and command[1, 1] > 0.5  # to the right of each, who meet
    assert command[2] == pytest.approx([0.0, -1.3, 0.0], abs=1e-6)


def test_a_map_and_a_suite(here):
    content = scored(here, "--agent", "vfh", "--suite", "own_suite.toml", "--set", "map=own_map.toml")
    assert content["suite"] == "tempers" and len(content["cells"]) == 4 and len(content["episodes"]) == 8


def test_a_metric_stands_in_results_report_and_comparison(here, capsys):
    content = scored(here, "--agent", "goal", "--suite", "smoke", "--metric", "own_metric.py:waiting")
    assert content["metrics"]["waiting"]["unit"] == "s" and all("waiting" in row for row in content["episodes"])
    assert content["summary"]["waiting"] == pytest.approx(np.mean([row["waiting"] for row in content["episodes"]]))
    assert "waiting" in capsys.readouterr().out and "time below 0.1 m/s" in (here / "out" / "report.html").read_text()
    assert bson.cli.main(["compare", "out", "out", "--out", "both"]) == 0
    assert "waiting" in (here / "both" / "compare.html").read_text()
    from bson.evaluation.results import Results

    assert Results.load("out").metrics["waiting"].shape == (2,)


def test_an_algorithm_trains_a_policy_that_is_an_agent(here):
    pytest.importorskip("stable_baselines3")
    words = ["--algo", "own_algorithm.py:A2c", "--steps", "640", "--worlds", "4", "--set", "horizon=40"]
    assert bson.cli.main(["train", *words, "--out", "runs"]) == 0
    (policy,) = pathlib.Path("runs").glob("*/policy.npz")
    assert policy.parent.name == "own_algorithm-0"
    assert scored(here, "--agent", str(policy), "--suite", "smoke")["agent"] == str(policy)


def test_a_planner_plans():
    from bson.planners import Grid, plan

    cells = np.zeros((40, 40), np.uint8)
    cells[18:22, 5:25] = 1
    grid = Grid(cells, 0.25, (-5.0, -5.0))
    path = plan(f"{EXAMPLES / 'own_planner.py'}:aside", grid, (-1.0, -4.0), (-1.0, 4.0))
    assert len(path) == 3 and path[0] == pytest.approx([-1, -4]) and path[-1] == pytest.approx([-1, 4])


@pytest.mark.parametrize("what", KINDS)
def test_every_kind_of_name_is_told_in_one_way(what):
    if what == "algorithms":
        pytest.importorskip("stable_baselines3")
    found = kind(what)
    assert isinstance(found, Kind) and found.names()
    with pytest.raises(ValueError, match=f"Unknown {found.what} 'nothing-of-this-name'. Choose one of ") as caught:
        found.load("nothing-of-this-name")
    assert "\n" not in str(caught.value) and all(name in str(caught.value) for name in found.names())


@pytest.mark.parametrize("what", [what for what in KINDS if what not in ("maps", "robots", "suites")])
def test_ones_own_that_is_nothing_of_the_kind_is_told(what, tmp_path):
    if what == "algorithms":
        pytest.importorskip("stable_baselines3")
    (tmp_path / "odd_names.py").write_text("number = 3")
    with pytest.raises(ValueError, match="odd_names") as caught:
        kind(what).load(f"{tmp_path / 'odd_names.py'}:number")
    assert "\n" not in str(caught.value)
