import dataclasses
import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from bson import cli
from bson.agents import load_agent
from bson.episodes.tracks import make_track
from bson.evaluation.play import pair, run_episodes
from bson.evaluation.store import Unfinished, basis
from bson.evaluation.suites import Cell
from bson.task import TaskConfig
from macid.files import UsageError

CONFIG = TaskConfig(num_pedestrians=2, map_size=20.0, goal_distance=(6.0, 15.0), horizon=4, pedestrian_model="orca")
CELL = Cell((("people", "two"),), CONFIG)


@pytest.fixture(scope="module")
def played():
    return run_episodes(load_agent("goal"), CONFIG, make_track("local", "lidar2d"), [5, 6])


def same(one, other):
    """Whether two Episodes are alike, down to the types and the last bit."""
    for field in dataclasses.fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if type(a) is not type(b) or not (np.array_equal(a, b) and getattr(a, "dtype", 0) == getattr(b, "dtype", 0)):
            return False
    return True


def test_an_episode_comes_back_as_it_was(played, tmp_path):
    unfinished = Unfinished(tmp_path, {}, resume=False)
    failed = dataclasses.replace(played[1], fault="qpos", nearest_person=played[1].nearest_person * np.inf)
    unfinished.save(CELL, played[0])
    unfinished.save(CELL, failed)
    again = Unfinished(tmp_path, {}, resume=True)
    assert same(again.load(CELL, 5), played[0]) and played[0].people_alone is None
    assert same(again.load(CELL, 6), failed) and not same(failed, played[1])
    assert again.load(CELL, 7) is None and again.load(Cell((), CONFIG), 5) is None
    (alone,) = pair(CONFIG, [played[0]])
    again.save(CELL, alone)
    assert same(again.load(CELL, 5), alone) and alone.people_alone is not None


def test_without_resume_what_is_there_goes_and_nothing_else(played, tmp_path):
    Unfinished(tmp_path, {"agent": "a"}, resume=False).save(CELL, played[0])
    (tmp_path / "unfinished" / "mine.txt").write_text("mine")
    unfinished = Unfinished(tmp_path, {"agent": "b"}, resume=False)
    assert unfinished.load(CELL, 5) is None
    unfinished.discard()
    assert [path.name for path in tmp_path.rglob("*")] == ["unfinished", "mine.txt"]
    (tmp_path / "unfinished" / "mine.txt").unlink()
    Unfinished(tmp_path, {"agent": "b"}, resume=True).discard()
    assert not list(tmp_path.iterdir())


def test_what_episodes_follow_from_is_told_apart(played, tmp_path):
    (tmp_path / "agent.py").write_text("agent = None")
    agent = str(tmp_path / "agent.py")
    track = ("local", "lidar2d")
    before = basis(agent, track, [CELL], False)
    assert basis(agent, track, [CELL], False) == before
    other = dataclasses.replace(CELL, config=CONFIG.replace(horizon=5))
    learned = dataclasses.replace(CELL, config=CONFIG.replace(pedestrian_model="macid"))
    changes = {
        "agent": basis("goal", track, [CELL], False),
        "track": basis(agent, ("global", "lidar2d"), [CELL], False),
        "cells": basis(agent, track, [other], False),
        "paired": basis(agent, track, [CELL], True),
        "cells and pedestrians": basis(agent, track, [learned], False),
    }
    (tmp_path / "agent.py").write_text("agent = 1")
    for name, after in {**changes, "agent ": basis(agent, track, [CELL], False)}.items():
        assert " and ".join(key for key in before if before[key] != after[key]) == name.strip()
    Unfinished(tmp_path, before, resume=False).save(CELL, played[0])
    with pytest.raises(UsageError, match="track changed.*--resume"):
        Unfinished(tmp_path, changes["track"], resume=True)


def test_nothing_is_made_or_lost_before_the_first_episode_is_saved(played, tmp_path):
    Unfinished(tmp_path, {"agent": "a"}, resume=False)
    assert not list(tmp_path.iterdir())
    Unfinished(tmp_path, {"agent": "a"}, resume=False).save(CELL, played[0])
    assert Unfinished(tmp_path, {"agent": "b"}, resume=False).load(CELL, 5) is None
    assert same(Unfinished(tmp_path, {"agent": "a"}, resume=True).load(CELL, 5), played[0])


def test_a_damaged_or_foreign_episode_is_as_if_it_were_not_there(played, tmp_path):
    other = Unfinished(tmp_path / "other", {"agent": "b"}, resume=False)
    other.save(CELL, played[0])
    Unfinished(tmp_path, {"agent": "a"}, resume=False).save(CELL, played[0])
    path = tmp_path / "unfinished" / f"{CELL.slug}-5.npz"
    whole = path.read_bytes()
    flipped = whole[:200] + bytes([whole[200] ^ 1]) + whole[201:]
    foreign = (tmp_path / "other" / "unfinished" / path.name).read_bytes()
    for content in (b"", whole[:1], whole[:-1], whole[: len(whole) // 2], whole[:-32], whole + b"x", flipped, foreign):
        path.write_bytes(content)
        again = Unfinished(tmp_path, {"agent": "a"}, resume=True)
        assert again.load(CELL, 5) is None
    again.save(CELL, played[0])
    assert same(again.load(CELL, 5), played[0]) and path.read_bytes() == whole


@pytest.mark.parametrize("content", [b"", b"[]", b"null", b"{", b"\xff", b"{}", b'{"agent": [}', b"[" * 5000])
def test_a_wrong_basis_is_named_with_what_to_do(played, tmp_path, content):
    Unfinished(tmp_path, {"agent": "a"}, resume=False).save(CELL, played[0])
    (tmp_path / "unfinished" / "basis.json").write_bytes(content)
    with pytest.raises(UsageError, match="--resume") as caught:
        Unfinished(tmp_path, {"agent": "a"}, resume=True)
    assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)
    Unfinished(tmp_path, {"agent": "a"}, resume=False).save(CELL, played[1])


KILLER = """import os, pathlib, signal
calls = 0
def agent(observation):
    global calls
    calls += 1
    if pathlib.Path("armed").exists() and calls > 16 * 4 + 2:  # in the second batch of episodes
        os.kill(os.getpid(), signal.SIGKILL)
    return [1.0, 0.3]
"""


def test_an_evaluation_that_was_killed_goes_on_and_gives_what_it_would_have_given(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "agent.py").write_text(KILLER)
    (tmp_path / "armed").touch()
    command = ["evaluate", "--agent", "agent.py", "--suite", "paper", "--episodes", "18", "--videos", "0"]
    for change in ("num_pedestrians=2", "map_size=20.0", "goal_distance=(6,15)", "horizon=4", "pedestrian_model=orca"):
        command += ["--set", change]
    killed = subprocess.run([sys.executable, "-m", "bson.cli", *command, "--out", "killed"], capture_output=True)
    assert killed.returncode == -signal.SIGKILL
    assert len(list((tmp_path / "killed" / "unfinished").glob("*.npz"))) == 16
    assert not (tmp_path / "killed" / "results.json").exists()

    os.unlink(tmp_path / "armed")
    one, two = sorted((tmp_path / "killed" / "unfinished").glob("*.npz"))[3:5]
    one.write_bytes(b"")  # as a crash of the machine leaves it
    two.write_bytes(two.read_bytes()[:-100])
    leftover = tmp_path / "killed" / "unfinished" / f".{one.name}.ab12cd_3"
    leftover.write_bytes(b"half")
    assert cli.main([*command, "--set", "lcf=1", "--out", "killed", "--resume"]) == 2
    assert "cells changed since it began" in capsys.readouterr().err
    contents, progress = [], []
    for out in (["killed", "--resume"], ["whole"]):
        assert cli.main([*command, "--out", *out]) == 0
        progress.append(capsys.readouterr().err)
        assert {path.name for path in (tmp_path / out[0]).iterdir()} == {"results.json", "report.html"}
        contents.append(json.loads((tmp_path / out[0] / "results.json").read_text()))
        contents[-1].pop("command")
    assert "14/18" in progress[0] and "13/18" not in progress[0] and " 0/18" in progress[1]
    assert contents[0] == contents[1] and len(contents[0]["episodes"]) == 18


DELETER = """import shutil
calls = 0
def agent(observation):
    global calls
    calls += 1
    if calls > 16 * 4 + 2:  # in the second batch of episodes
        shutil.rmtree("out", ignore_errors=True)
    return [1.0, 0.3]
"""


def test_a_folder_deleted_while_running_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "deleter.py").write_text(DELETER)
    command = [
        "evaluate",
        "--agent",
        "deleter.py",
        "--suite",
        "paper",
        "--episodes",
        "17",
        "--videos",
        "0",
        "--out",
        "out",
    ]
    for change in ("num_pedestrians=2", "map_size=20.0", "goal_distance=(6,15)", "horizon=4", "pedestrian_model=orca"):
        command += ["--set", change]
    assert cli.main(command) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert (
        error.startswith("bson: error: Can't write 'out/unfinished/") and "there is no folder 'out/unfinished'" in error
    )
    assert os.listdir(tmp_path) == ["deleter.py"]
