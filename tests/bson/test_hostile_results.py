"""Whatever lies in a results.json, `bson compare` and `bson leaderboard` end in success or in one line; and so does an
agent's policy file."""

import json

import numpy as np
import pytest
from hostile_files import array_files, json_files
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bson import cli
from bson.agents import AgentError, act, load_agent
from bson.evaluation.metrics import METRICS
from bson.evaluation.results import Content, Results, read_results
from bson.features import FEATURES
from bson.reporting.compare import compare, format_comparison, make_page
from bson.reporting.leaderboard import leaderboard
from macid.documents import MOST_NUMBER
from macid.files import UsageError
from macid.policy import write_network

GRADES = [{"people": "few"}, {"people": "many"}]
VALUES = {"SNS": 40.0, "Coll": 3.0, "success": 1.0}
GOOD = {
    "agent": "goal",
    "suite": "made",
    "config": {"horizon": 30, "robot": {"name": "jackal"}},
    "people": 3,
    "versions": {"mujoco": "3.17.0", "python": "3.11"},
    "summary": {name: value for name, value in VALUES.items()},
    "intervals": {name: [value, value + 1.0] for name, value in VALUES.items()},
    "counts": {name: 4 for name in VALUES},
    "metrics": {"SNS": {"unit": "", "better": "up", "what": "score"}},
    "cells": [
        {"name": each["people"], "grades": each, "config": {"horizon": 30, "goal_distance": [6, 12]}, "episodes": 2}
        for each in GRADES
    ],
    "episodes": [
        {
            "seed": seed,
            "cell": each["people"],
            **VALUES,
            "SNS": 10.0 * seed,
            "delay": None,
            "people": {"delay": [0.1, None]},
        }
        for each in GRADES
        for seed in (1, 2)
    ],
    "faults": [{"seed": 3, "cell": "few", "time": 0.5, "what": "qvel"}],
    "suite_digest": "0123456789ab",
    "task_digest": "0123",
    "track": ["local", "lidar2d"],
    "paired": False,
    "overrides": {"horizon": "30"},
    "frozen_seeds": True,
    "command": "bson evaluate --agent goal",
}


def one_line(error, printable=False):
    text = str(error)  # the command shows what is not printable by its escape
    assert len(text.splitlines()) == 1 and (text.isprintable() or not printable) and len(text) < 3000, text


def ends_well(folder, content):
    """Reads a results.json, compares it and ranks it with a good one: what was done. What is refused is told of in a
    line."""
    good, theirs = folder / "good.json", folder / "theirs.json"
    if not good.exists():
        good.write_text(json.dumps(GOOD))
    theirs.write_bytes(content)
    try:
        runs = [Results.load(good), Results.load(theirs)]
    except UsageError as error:
        text = str(error)
        one_line(error, printable=True)
        assert "theirs.json" in text
        return "refused"
    done = "read"
    for order in (runs, runs[::-1]):
        try:
            compared = compare(order)
            json.dumps(compared, allow_nan=False)
            assert len(make_page(compared)) > 1000 and format_comparison(compared)
            done = "compared"
        except ValueError as error:
            one_line(error)
    for ranked in (runs, runs[1:]):
        try:
            table = leaderboard(ranked)
            assert all(line.count(" | ") >= 9 for line in table.splitlines() if line.startswith("| "))
        except ValueError as error:
            one_line(error)
    return done


def test_a_name_that_no_terminal_shows_is_shown_by_its_escape(tmp_path, capsys):
    for name, suite in (("good", "made"), ("theirs", "\u00ad\u202e")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(json.dumps({**GOOD, "suite": suite}))
    assert cli.main(["compare", str(tmp_path / "good"), str(tmp_path / "theirs"), "--out", str(tmp_path / "out")]) == 2
    assert "suite 'made' against '\\xad\\u202e'" in capsys.readouterr().err


@given(content=json_files(GOOD))
@settings(max_examples=500, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
def test_results_are_read_or_refused_in_one_line(tmp_path_factory, content):
    ends_well(tmp_path_factory.getbasetemp(), content)


@pytest.mark.slow
def test_twenty_thousand_results_are_read_or_refused_in_one_line(tmp_path):
    ends = []

    @given(content=json_files(GOOD))
    @settings(max_examples=20_000, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    def each(content):
        ends.append(ends_well(tmp_path, content))

    each()
    counts = {end: ends.count(end) for end in ("refused", "read", "compared")}
    print(f"{len(ends)} results: {counts}")
    assert len(ends) >= 20_000 and min(counts.values()) > 0


def changed(*path, value=None):
    """GOOD with the value at `path` replaced, or removed."""
    content = json.loads(json.dumps(GOOD))
    place = content
    for key in path[:-1]:
        place = place[key]
    if value is None:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    return content


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (changed("episodes", value=[]), "episodes"),
        (changed("episodes", 0, "SNS", value="40"), r"episodes\[0\].SNS"),
        (changed("episodes", 1, "Coll", value=float("nan")), r"episodes\[1\].Coll"),
        (changed("episodes", 1, "Coll", value=10**400), r"episodes\[1\].Coll"),
        (changed("episodes", 1, "seed", value=2**63), r"episodes\[1\].seed"),
        (changed("episodes", 1, "seed", value=1.5), r"episodes\[1\].seed"),
        (changed("episodes", 1, "seed", value=1), "'episodes.1.': the episode 1 of 'few' stands twice"),
        (changed("episodes", 1, "cell", value="none"), "'none' is none of the cells"),
        (changed("faults", 0, "seed", value=2), "stands twice"),
        (changed("cells", value=[]), "cells"),
        (changed("cells", 1, "name", value="few"), "'few' stands twice"),
        (changed("cells", 1, "grades", value={}), "the axes .'people'. are wanted"),
        (changed("cells", 1, "grades", "people", value=3), "grades"),
        (changed("cells", 1, "config", value=[]), "config"),
        *[(changed("cells", 0, "summary", value=value), r"cells\[0\].summary") for value in (5, {"SNS": "x"})],
        *[(changed("cells", 0, "intervals", value=value), r"cells\[0\].intervals") for value in (7, {"SNS": 3})],
        (changed("episodes", 1, "seed", value=-1), r"episodes\[1\].seed"),
        (changed("faults", 0, "seed", value=-1), r"faults\[0\].seed"),
        (changed("intervals", "SNS"), "'SNS' is missing"),
        (changed("intervals", "SNS", value=[1.0]), "intervals"),
        (changed("summary", "SNS", value=1e308), "summary.SNS"),
        (changed("summary"), "no 'summary'"),
        (changed("agent", value="a\nb"), "text of one line"),
        (changed("suite", value=["paper"]), "suite"),
        (changed("track", value="local"), "track"),
        (changed("overrides", "horizon", value=30), "overrides"),
        (changed("cells", 0, "config", value={"x" * 5000: 1}), "has more than 500 characters"),
        (changed("versions", value={"mujoco": 3}), "versions"),
    ],
)
def test_what_is_wrong_is_named_by_both_commands(tmp_path, capsys, content, told):
    for name, each in (("good", GOOD), ("theirs", content)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(json.dumps(each))
    for command in (["compare", "--out", str(tmp_path / "out")], ["leaderboard"]):
        assert cli.main([command[0], str(tmp_path / "good"), str(tmp_path / "theirs"), *command[1:]]) == 2
        with pytest.raises(UsageError, match=told):
            Results.load(tmp_path / "theirs")
        error = capsys.readouterr().err
        assert "theirs" in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_every_metric_is_in_the_schema_and_large_numbers_are_compared(tmp_path):
    content = json.loads(json.dumps(GOOD))
    for row in content["episodes"]:
        row |= {metric.name: MOST_NUMBER * (-1) ** row["seed"] for metric in METRICS}
    assert ends_well(tmp_path, json.dumps(content).encode()) == "compared"
    for metric in METRICS:
        wrong = json.loads(json.dumps(content))
        wrong["episodes"][2][metric.name] = [1.0]
        (tmp_path / "theirs.json").write_text(json.dumps(wrong))
        with pytest.raises(UsageError, match=metric.name):
            read_results(tmp_path / "theirs.json")
    assert {"agent", "episodes"} < set(Content.__struct_fields__)


def test_thousands_of_episodes_are_compared(tmp_path):
    content = json.loads(json.dumps(GOOD))
    content["episodes"] = [{"seed": seed, "cell": "few", "SNS": float(seed % 7)} for seed in range(4_000)]
    content["faults"] = []
    (tmp_path / "many.json").write_text(json.dumps(content))
    run = Results.load(tmp_path / "many.json")
    (row,) = compare([run, run])["runs"][1]["difference"].values()
    assert row["count"] == 4_000 and row["mean"] == 0.0


_RNG = np.random.default_rng(1)
ROBOT = {
    "weight0": _RNG.normal(size=(FEATURES, 3)).astype(np.float32), "bias0": np.zeros(3, np.float32),
    "weight1": _RNG.normal(size=(3, 2)).astype(np.float32), "bias1": np.zeros(2, np.float32),
}  # fmt: skip
RECIPE = {"name": "ppo", "algo": "ppo", "output": "clip", "steps_done": 100, "validation": {"SNS": 3.0}}
SEEN = {"goal": np.array([3.0, 0.5]), "velocity": np.zeros(2), "lidar": np.full(720, 5.0)}
robots = st.tuples(array_files(ROBOT), st.just(RECIPE).map(lambda r: json.dumps(r).encode())) | st.tuples(
    st.none(), json_files(RECIPE)
)


@given(content=robots)
@settings(max_examples=500, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
def test_an_agents_file_is_read_or_refused_in_one_line(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "robot.npz"
    if content[0] is None:
        layers = [(ROBOT[f"weight{index}"], ROBOT[f"bias{index}"]) for index in range(2)]
        write_network(path.with_suffix(""), layers, RECIPE)
    else:
        path.write_bytes(content[0])
    path.with_suffix(".json").write_bytes(content[1])
    try:
        agent = load_agent(str(path))()
        agent.reset(0)
        assert np.abs(act(agent, SEEN, "robot.npz")).max() <= 1.0
    except (UsageError, AgentError) as error:
        text = str(error)
        one_line(error, printable=True)
        assert "robot" in text
