"""tools/ship_agent.py: a policy, its scores and those of its training's other seeds."""

import json
import re
import shutil
import sys

import pytest
import ship_agent
from made_results import scored

from macid import assets


def policy(folder, seed, **changes):
    """A copy of a shipped policy in `folder`, as that of another `seed`."""
    folder.mkdir(exist_ok=True)
    path, shipped = folder / f"{seed}.npz", assets.root() / "agents" / "tac"
    shutil.copy(shipped.with_suffix(".npz"), path)
    recipe = json.loads(shipped.with_suffix(".json").read_text())
    kept = {key: value for key, value in recipe.items() if key not in ("scores", "seeds", "other scores")}
    kept |= {"seed": seed, "command": re.sub(r"--seed \d+", f"--seed {seed}", recipe["command"])} | changes
    path.with_suffix(".json").write_text(json.dumps({key: value for key, value in kept.items() if value is not None}))
    return path


@pytest.fixture
def ship(tmp_path, monkeypatch):
    """Calls the tool, which ships to the folder `agents`; returns its exit code."""
    monkeypatch.setattr(ship_agent, "AGENTS", tmp_path / "agents")
    (tmp_path / "agents").mkdir()

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["ship_agent", *map(str, words)])
        return ship_agent.main()

    return call


@pytest.fixture
def results(tmp_path):
    """(results of an agent with a score on `paper`, made for each call)."""
    return lambda score, suite="paper": scored(tmp_path / f"{suite}-{score}", "made", score, suite)


def test_scores_and_seeds_are_noted(ship, results, tmp_path):
    words = [policy(tmp_path / "runs", 1), results(90.0), results(40.0, "dense")]
    assert ship("mine", *words, "--seed", policy(tmp_path / "runs", 0), results(80.0)) == 0
    recipe = json.loads((tmp_path / "agents" / "mine.json").read_text())
    assert [(seed["seed"], seed["SNS"]) for seed in recipe["seeds"]] == [(0, 80.0), (1, 90.0)]
    assert recipe["scores"]["suite"] == "paper" and recipe["scores"]["SNS"]["mean"] == 90.0 and recipe["seed"] == 1
    assert [other["suite"] for other in recipe["other scores"]] == ["dense"]
    assert (tmp_path / "agents" / "mine.npz").read_bytes() == words[0].read_bytes()


@pytest.mark.parametrize(
    ("seed", "changes", "suite", "told"),
    [
        (1, {}, "paper", "The seeds must differ, not be 1, 1"),
        (0, {"command": "bson train --algo tac --seed 0 --steps 5"}, "paper", "is no other seed of the training `bson"),
        (0, {"command": None}, "paper", "has no command: it was trained by an earlier version"),
        (0, {}, "dense", "are of the suite 'paper', not 'dense'"),
    ],
)
def test_what_is_no_other_seed_is_refused(seed, changes, suite, told, ship, results, tmp_path, capsys):
    other = policy(tmp_path / "other", seed, **changes)
    words = [policy(tmp_path / "runs", 1), results(90.0), "--seed", other, results(80.0, suite)]
    assert ship("mine", *words) == 2 and told in capsys.readouterr().err
    assert not list((tmp_path / "agents").iterdir())
