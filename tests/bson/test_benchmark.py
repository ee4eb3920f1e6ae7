"""The commands as calls, and Results."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest

from bson import benchmark, cli
from bson.evaluation.metrics import METRICS
from bson.evaluation.results import Results
from macid.files import UsageError

QUICK = {"map_size": 20.0, "goal_distance": (6, 12), "num_pedestrians": 3, "horizon": 20, "pedestrian_model": "orca"}
WORDS = [word for key, value in QUICK.items() for word in ("--set", f"{key}={value}")]


def ahead(observation):
    return [0.5, 0.0]


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    """Results of the call, and the folder in which they are."""
    out = tmp_path_factory.mktemp("call")
    found = benchmark.evaluate("goal", "smoke", out=out, episodes=3, overrides=QUICK, paired=True, videos=0, quiet=True)
    return found, out


def test_the_call_gives_what_the_command_writes(evaluated, tmp_path, capsys):
    found, out = evaluated
    command = [
        "evaluate",
        "--agent",
        "goal",
        "--suite",
        "smoke",
        "--episodes",
        "3",
        "--paired",
        "--videos",
        "0",
        *WORDS,
    ]
    assert cli.main([*command, "--out", str(tmp_path)]) == 0
    theirs = json.loads((tmp_path / "results.json").read_text())
    assert theirs.pop("command").startswith("bson evaluate --agent goal --suite smoke")
    ours = json.loads((out / "results.json").read_text())
    assert ours.pop("command") is None
    assert list(ours) == list(theirs)
    assert ours == theirs
    assert [path.name for path in found.written] == ["results.json", "report.html"]
    assert {path.name for path in out.iterdir()} == {path.name for path in tmp_path.iterdir()}


def test_results_have_the_metrics_as_arrays_and_come_back_as_they_were(evaluated, tmp_path):
    found, out = evaluated
    rows = json.loads((out / "results.json").read_text())["episodes"]
    assert list(found.metrics) == [metric.name for metric in METRICS]
    for name, values in found.metrics.items():
        assert values.dtype == np.float64
        assert values.shape == found.seed.shape == found.cell.shape == (3,)
        assert [None if np.isinf(value) else value for value in values] == [row[name] for row in rows]
    assert found.seed.tolist() == [row["seed"] for row in rows]
    assert set(found.cell) == {"all"} == set(found.cells)
    assert found.summary["SNS"] == pytest.approx(found.metrics["SNS"].mean())
    low, high = found.intervals["SNS"]
    assert low <= found.summary["SNS"] <= high
    assert np.array_equal(found.by_cell("SNS")["all"], found.metrics["SNS"])
    found.save(tmp_path)
    assert (tmp_path / "results.json").read_bytes() == (out / "results.json").read_bytes()
    again = Results.load(tmp_path)
    assert again.content == found.content
    assert again.source == str(tmp_path)
    assert all(np.array_equal(again.metrics[name], values) for name, values in found.metrics.items())


def test_an_agent_may_be_given_itself_and_nothing_need_be_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    found = benchmark.evaluate(ahead, "smoke", episodes=2, overrides=QUICK)
    assert found.agent.endswith(":ahead")
    assert found.metrics["speed_max"].min() > 0.5
    assert not found.written
    assert not list(tmp_path.iterdir())
    assert "2/2" in capsys.readouterr().err
    with pytest.raises(UsageError, match="`out`"):
        benchmark.evaluate(ahead, "smoke", episodes=2, resume=True)
    with pytest.raises(ValueError, match="Unknown option 'people'"):
        benchmark.evaluate(ahead, "smoke", overrides={"people": 3})


def test_results_are_compared_and_ranked_by_calls(evaluated, tmp_path):
    found, out = evaluated
    other = benchmark.evaluate("stop", "smoke", episodes=3, overrides=QUICK, paired=True, quiet=True)
    content = benchmark.compare([found, other], tmp_path / "both")
    assert json.loads((tmp_path / "both" / "compare.json").read_text()) == content
    assert benchmark.compare([out, other])["runs"][1] == content["runs"][1]
    assert benchmark.leaderboard([other, found]).splitlines()[2].startswith("| 1 | `goal`")


def test_a_suite_of_cells_is_mapped(tmp_path):
    changes = {"horizon": 3, "pedestrian_model": "orca"}
    found = benchmark.evaluate("goal", "scenarios", episodes=1, overrides=changes, quiet=True)
    page = benchmark.heatmap(found, "Coll", tmp_path / "map.html")
    assert (tmp_path / "map.html").read_text() == page
    assert all(cell in page for cell in found.cells)
    means = [found.metrics["SNS"][found.cell == cell].mean() for cell in found.cells]
    assert found.cell_means("SNS").tolist() == pytest.approx(means)
    with pytest.raises(UsageError, match=r"Unknown metric 'sns'\. Choose one of SNS"):
        benchmark.heatmap(found, "sns")
    one = Results(found.content | {"cells": found.content["cells"][:1]})
    with pytest.raises(UsageError, match="one cell only"):
        benchmark.heatmap(one)


LIGHT = """
import sys
from bson import benchmark
heavy = {"jax", "jaxlib", "mujoco", "torch", "cv2", "ray"}
benchmark.leaderboard(sys.argv[1:])
benchmark.Results.load(sys.argv[1]).metrics["SNS"]
print(*sorted((heavy | {"scipy"}) & set(sys.modules)))
benchmark.compare(sys.argv[1:], "compared")  # its intervals are scipy's
print(*sorted(heavy & set(sys.modules)))
"""


def test_comparing_loads_neither_jax_nor_mujoco(evaluated, tmp_path):
    found, out = evaluated
    dataclasses.replace(found, content=found.content | {"agent": "other"}).save(tmp_path / "other.json")
    ran = subprocess.run(
        [sys.executable, "-c", LIGHT, str(out), str(tmp_path / "other.json")],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert (ran.returncode, ran.stdout) == (0, "\n\n"), ran.stderr
