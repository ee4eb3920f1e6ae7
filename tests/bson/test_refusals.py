"""A command that is refused, for whatever reason, makes, changes and removes nothing: neither where its results were to
be nor beside it."""

import contextlib
import hashlib
import itertools
import json
import os
import pathlib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import bson.cli
import macid.cli
from macid.files import lock_folder

QUICK = ["--set", "map_size=20.0", "--set", "goal_distance=(6,12)", "--set", "num_pedestrians=2", "--set", "horizon=3"]
TASK = [  # what is wrong with a task
    ["--set", "people=3"],
    ["--set", "num_pedestrians"],
    ["--set", "num_pedestrians=-1"],
    ["--set", "obstacle_density=7"],
    ["--set", "map=nowhere.toml"],
    ["--set", "map=folder"],
    ["--set", "robot=nowhere.toml"],
    ["--set", "robot=empty"],
    ["--set", "pedestrian_model=nobody"],
    ["--set", "horizon=0"],
    ["--set", "person_radius=9"],
    ["--set", "companions=2"],
]
SETTING = [
    *TASK,
    ["--set", "pedestrian_density=1.0", "--set", "map_size=12.0"],  # no room
    ["--agent", "nobody"],
    ["--agent", "nowhere.py"],
    ["--agent", "folder"],
    ["--agent", "broken.py"],
    ["--agent", "raises.py"],
    ["--agent", "no_module:agent"],
    ["--track", "locl"],
    ["--sensor", "sonar"],
    ["--seed", "-1"],
    ["--seed", "x"],
]
LEVEL = [["--levels", "9"], ["--levels", "nowhere.toml"]]
PEOPLE = [["--radius", "9"], ["--preferred-speed", "brisk"], ["--max-speed", "0"], ["--companions", "2"]]
CROWD = [*PEOPLE, ["--pedestrian", "nobody"], ["--period", "0.03"], ["--seed", "-1"]]

# {name: (words, the flag of the results, what they are called, what can be wrong with the rest)}
COMMANDS = {
    "evaluate": (["bson", "evaluate", "--agent", "stop", "--suite", "smoke", *QUICK], "--out", "results", [
        *SETTING, ["--suite", "papers"], ["--episodes", "0"], ["--episodes", "11"], ["--videos", "-1"], ["--nonsense"],
    ]),
    "demo": (["bson", "demo", "--agent", "stop", *QUICK], "--out", "bson-demo", SETTING),
    "compare": (["bson", "compare"], "--out", "comparison", [
        ["nowhere"], ["empty"], ["folder", "folder"], ["list.json", "list.json"], [],
    ]),
    "leaderboard": (["bson", "leaderboard"], "--readme", "README.md", [
        ["nowhere"], ["empty"], ["folder"], ["list.json"], [],
    ]),
    "render": (["bson", "render", "--agent", "stop", *QUICK], "--out", "film.webm", SETTING),
    "export": (["bson", "export", *QUICK], "--out", "scene", [
        *TASK, ["--track", "locl"], ["--sensor", "sonar"], ["--seed", "-1"], ["--cell", "frontal"], ["--suite",
        "scenarios"],
    ]),
    "bench": (["bson", "bench", "--seconds", "0.01"], "--out", "bench.json", [
        ["--pedestrian-model", "nobody"], ["--worlds", "0"], ["--seconds", "0"], ["--pedestrians", "-1"],
        ["--train", "ppo", "--sensors", "lidar2d"],
    ]),
    "train": (["bson", "train", "--steps", "64"], "--out", "runs", [
        *TASK, ["--algo", "dqn"], ["--algo", "bc", "--set", "robot=diffbot"], ["--steps", "0"], ["--worlds", "0"],
        ["--seed", "-1"],
    ]),
    "macid evaluate": (["macid", "evaluate", "--pedestrian", "orca", "--levels", "1"], "--out", "rows.json", [
        *LEVEL, *CROWD, ["--episodes", "0"], ["--bins", "--lcf", "0", "1"], ["--engine", "warp"],
    ]),
    "macid watch": (["macid", "watch", "--pedestrian", "orca", "--seconds", "1"], "--out", "film.webm", [
        *CROWD, ["--level", "9"], ["--seconds", "0"], ["--follow", "999"], ["--scale", "9"], ["--at", "1"],
    ]),
    "macid export": (["macid", "export"], "--out", "scene", [
        *PEOPLE, ["--level", "9"], ["--map", "nowhere"], ["--level", "1", "--map", "hall"], ["--people", "0"],
        ["--lcf", "1", "0"],
    ]),
    "macid train": (["macid", "train", "--level", "1", "--agent-steps", "1"], "--out", "runs", [
        ["--method", "nothing"], ["--level", "9"], ["--level", "nowhere.toml"], ["--period", "0.03"], ["--seeds", "0"],
    ]),
    "macid bench": (["macid", "bench", "--seconds", "0.01"], "--out", "bench.json", [
        *LEVEL, ["--worlds", "0"], ["--seconds", "-1"],
    ]),
}  # fmt: skip
FOLDERS = {"results", "bson-demo", "comparison", "scene", "runs"}
# What stands in the way of results of any kind: names below the folder that the command runs in.
WRONG_PLACES = [
    "file/below",
    "circle/below",
    "dangling/below",
    "fifo/below",
    "/dev/null/below",
    "x" * 300,
    "new/" + "x" * 300,
]
WRONG_FOLDERS = ["file", "fifo", "to-device", "dangling"]
WRONG_FILES = ["folder", "fifo", "to-device", "dangling"]


def listing(folder):
    """All that is in `folder`: kinds, permissions, times, contents."""
    found = {}
    for path in sorted(folder.rglob("*")):
        status = path.lstat()
        content = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() and not path.is_symlink() else ""
        times = None if path.is_dir() else status.st_mtime_ns
        found[str(path.relative_to(folder))] = status.st_mode, times, content, path.is_symlink() and os.readlink(path)
    return found


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with what the wrong command lines name, and earlier results in `there`."""
    folder = tmp_path_factory.mktemp("place")
    for name in ("folder", "there", "there/unfinished", "there/videos"):
        (folder / name).mkdir()
    for name in ("file", "empty"):
        (folder / name).touch()
    os.mkfifo(folder / "fifo")
    (folder / "circle").symlink_to("circle")
    (folder / "dangling").symlink_to("none/at/all")
    (folder / "to-device").symlink_to("/dev/null")
    (folder / "list.json").write_text("[]")
    (folder / "broken.py").write_text("def agent(:")
    (folder / "raises.py").write_text("raise RuntimeError('no')")
    (folder / "film.webm").write_text("an earlier film")
    (folder / "README.md").write_text("no marks")
    for name in ("results.json", "report.html", "compare.json", "unfinished/basis.json", "unfinished/a-1.npz"):
        (folder / "there" / name).write_text("earlier")
    (folder / "there" / "videos" / "seed-1.webm").write_text("earlier")
    return folder


def refused(place, words):
    """Runs a command in `place`; asserts that it is refused and leaves everything as it was."""
    before, device = listing(place), os.stat("/dev/null").st_mode
    main = {"bson": bson.cli.main, "macid": macid.cli.main}[words[0]]
    with contextlib.chdir(place):
        try:
            code = main(words[1:])
        except SystemExit as end:
            code = end.code
    assert code == 2, words
    assert listing(place) == before and os.stat("/dev/null").st_mode == device, words


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_refusal_of_any_kind_leaves_everything_as_it_was(place, data):
    command = data.draw(st.sampled_from(sorted(COMMANDS)))
    words, flag, name, wrong = COMMANDS[command]
    wrong_places = WRONG_PLACES + (WRONG_FOLDERS if name in FOLDERS else WRONG_FILES)
    good = ["there", f"new/deep/{name}", name]
    where = data.draw(st.sampled_from(wrong_places if data.draw(st.booleans()) else good))
    if name not in FOLDERS and where in WRONG_PLACES:
        where += pathlib.Path(name).suffix
    few = {"min_size": 0 if where not in good else 1, "max_size": 2}
    faults = data.draw(st.lists(st.sampled_from(wrong), **few))
    refused(place, [*words, *itertools.chain.from_iterable(faults), flag, where])


PLACES = [
    (command, where)
    for command in COMMANDS
    for where in (WRONG_FOLDERS if COMMANDS[command][2] in FOLDERS else WRONG_FILES)
]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Results of two agents."""
    folders = [str(tmp_path_factory.mktemp(agent)) for agent in ("stop", "goal")]
    for agent, folder in zip(("stop", "goal"), folders, strict=True):
        words = [*COMMANDS["evaluate"][0][1:], "--agent", agent, "--episodes", "2", "--videos", "0", "--out", folder]
        assert bson.cli.main(words) == 0
    return folders


@pytest.mark.parametrize(("command", "where"), PLACES)
def test_what_is_in_the_place_of_the_results_is_told(place, runs, command, where):
    """All else is right."""
    words, flag, _, _ = COMMANDS[command]
    refused(place, [*words, *(runs if command in ("compare", "leaderboard") else []), flag, where])


@pytest.mark.parametrize("name", ["results.json", "report.html", "videos", "unfinished", "unfinished/basis.json"])
@pytest.mark.parametrize("kind", ["fifo", "other"])
def test_what_is_in_the_place_of_one_of_an_evaluation_s_results_is_told_before_the_work(tmp_path, name, kind):
    path = tmp_path / "out" / name
    path.parent.mkdir(parents=True)
    if kind == "fifo":
        os.mkfifo(path)
    elif name in ("videos", "unfinished"):
        path.touch()
    else:
        path.mkdir()
    refused(tmp_path, [*COMMANDS["evaluate"][0], "--out", "out"])


@pytest.mark.parametrize("out", ["there", "new/deep"])
def test_an_agent_that_fails_at_its_first_step_leaves_everything_as_it_was(place, out):
    (place / "nan.py").write_text("def agent(observation):\n    return [float('nan'), 0.0]\n")
    refused(place, [*COMMANDS["evaluate"][0], "--agent", "nan.py", "--episodes", "1", "--out", out])
    refused(place, [*COMMANDS["render"][0], "--agent", "nan.py", "--out", f"{out}/film.webm"])


def test_a_folder_at_work_and_another_evaluation_s_episodes_are_refused(tmp_path, capsys):
    out = tmp_path / "out"
    (out / "unfinished").mkdir(parents=True)
    (out / "unfinished" / "basis.json").write_text(json.dumps({"agent": "another"}))
    refused(tmp_path, [*COMMANDS["evaluate"][0], "--resume", "--out", "out"])
    assert "changed since it began" in capsys.readouterr().err
    words = [*COMMANDS["macid train"][0], "--method", "ipo", "--seeds", "2", "--out", "runs"]
    with lock_folder(out), lock_folder(tmp_path / "runs" / "ipo-1"):
        refused(tmp_path, [*COMMANDS["evaluate"][0], "--out", "out"])
        refused(tmp_path, words)
    assert capsys.readouterr().err.count("Another run is at work") == 2
