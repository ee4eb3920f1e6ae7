"""Evaluations by the workers of a Ray cluster give what they give in this process, whatever becomes of a worker."""

import dataclasses
import importlib.util
import json
import os
import pathlib
import shutil
import socket
import subprocess
import sys
import threading
import time

import pytest

from bson import benchmark, cli
from bson.evaluation.executors import carried_agent, carried_task, shares
from bson.evaluation.suites import load_suite
from bson.task import TaskConfig
from macid.executors import Local, make_executor
from macid.files import UsageError

ROOT = pathlib.Path(__file__).parents[2]
QUICK = {"map_size": 20.0, "goal_distance": (6, 12), "num_pedestrians": 3, "horizon": 15, "pedestrian_model": "orca"}
WORDS = [word for key, value in QUICK.items() for word in ("--set", f"{key}={value}")]
CLUSTER = """
import os, sys
os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
import ray
ray.init(address="local", num_cpus=2, include_dashboard=False, object_store_memory=1 << 27, _temp_dir=sys.argv[1],
         log_to_driver=False, logging_level="ERROR")
print(ray.get_runtime_context().gcs_address, flush=True)
sys.stdin.read()
ray.shutdown()
"""


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """HOST:PORT of a Ray cluster of two workers that somebody else has begun on this machine."""
    folder = pathlib.Path("/tmp") / f"bson-test-{os.getpid()}"  # a short path, as it has sockets
    for name, value in {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "ab" * 32}.items():
        os.environ.setdefault(name, value)  # Ray reads it as it is imported
    pytest.importorskip("ray")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    elsewhere = tmp_path_factory.mktemp("elsewhere")  # not where the agents lie
    process = subprocess.Popen(
        [sys.executable, "-c", CLUSTER, str(folder)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=elsewhere, env=environment,
    )  # fmt: skip
    try:
        yield process.stdout.readline().strip()
    finally:
        process.communicate()
        shutil.rmtree(folder, ignore_errors=True)


AGENT = """
import os, pathlib, signal, sys
import own_helper
from bson.sensors import Imu

class agent:
    files = ("speed.txt",)
    sensor = (Imu(), own_helper.Near(beams=90))

    def __init__(self):
        self.speed = float((pathlib.Path(__file__).parent / "speed.txt").read_text())

    def reset(self, seed):
        self.seed, self.steps = seed, 0
        armed = pathlib.Path({folder!r}) / "armed"
        with open(pathlib.Path({folder!r}) / "log", "a") as log:
            print(os.getpid(), seed, own_helper.__file__, os.environ.get("BSON_THREADS"), file=log)
        self.dies = seed == 103 and armed.exists()
        if self.dies:
            armed.unlink()

    def __call__(self, observation):
        self.steps += 1
        if self.dies and self.steps == 8:
            os.kill(os.getpid(), signal.SIGKILL)
        if self.seed == 104 and (pathlib.Path({folder!r}) / "wrong").exists():
            raise RuntimeError("not today")
        return [self.speed, own_helper.turn(observation)]
"""
HELPER = """
from bson.sensors import Lidar2D

class Near(Lidar2D):
    pass

def turn(observation):
    return 0.3 * float(observation["goal"][1] > 0)
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A folder with an agent of the user's, what it imports and what it reads; it is the current one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "own.py").write_text(AGENT.replace("{folder!r}", repr(str(tmp_path))))
    (tmp_path / "own_helper.py").write_text(HELPER)
    (tmp_path / "speed.txt").write_text("0.7")
    yield tmp_path
    sys.modules.pop("own_helper", None)


def content(folder):
    """results.json, without the name of the folder."""
    found = json.loads((folder / "results.json").read_text())
    found["command"] = found["command"] and found["command"].rpartition(" --out ")[0]
    return found


def command(out, *words):
    flags = ["--agent", "own.py", "--suite", "smoke", "--episodes", "6", "--paired", "--videos", "0"]
    return cli.main(["evaluate", *flags, *WORDS, "--out", str(out), *words])


def log(folder):
    """(process, seed, where its helper lies, threads) of each episode that began."""
    lines = [line.split() for line in (folder / "log").read_text().splitlines()]
    (folder / "log").unlink()
    return [(int(process), int(seed), helper, threads) for process, seed, helper, threads in lines]


def test_workers_give_what_this_process_gives_though_one_is_killed(own, address, capsys):
    assert command(own / "here") == 0
    here = log(own)
    assert {process for process, *_ in here} == {os.getpid()}
    (own / "armed").touch()
    assert command(own / "there", "--executor", "ray", "--ray-address", address) == 0
    told = capsys.readouterr().err
    assert "a worker was lost" in told
    assert "to the workers go: own.py, own_helper.py, speed.txt" in told
    there = log(own)
    assert content(own / "there") == content(own / "here")
    assert not (own / "armed").exists()
    assert not (own / "there" / "unfinished").exists()
    assert len({process for process, *_ in there}) >= 2
    assert os.getpid() not in {process for process, *_ in there}
    assert len(there) < len(here) + 6  # not all was played anew
    assert all(threads == "1" and not pathlib.Path(helper).is_relative_to(own) for _, _, helper, threads in there)
    assert not list(pathlib.Path("/tmp").glob("macid-ray-*"))


@pytest.mark.parametrize("first", ["here", pytest.param("there", marks=pytest.mark.slow)])
def test_what_was_cut_short_goes_on_elsewhere(own, address, first, capsys):
    places = {"here": [], "there": ["--executor", "ray", "--ray-address", address, "--workers", "1"]}
    assert command(own / "whole") == 0
    log(own)
    (own / "wrong").touch()
    before, after = places[first], places["there" if first == "here" else "here"]
    assert command(own / "parts", *before) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("bson: error: Agent 'own.py'")
    assert "not today" in error
    assert "macid-worker" not in error
    assert f"in {own / 'own.py'}, line" in error or "in own.py, line" in error
    assert not (own / "parts" / "results.json").exists()
    (own / "wrong").unlink()
    log(own)
    assert command(own / "parts", *after, "--resume") == 0
    assert content(own / "parts") == content(own / "whole")


GIVEN = "import own_helper\ndef drive(observation):\n    return [0.4, own_helper.turn(observation)]\n"


@pytest.mark.slow
def test_an_agent_that_is_given_itself_travels_by_its_module(address, own):
    sys.path.insert(0, str(own))
    (own / "given.py").write_text(GIVEN)
    import given

    try:
        setting = {"episodes": 3, "overrides": QUICK, "quiet": True}
        here = benchmark.evaluate(given.drive, "smoke", **setting)
        there = benchmark.evaluate(given.drive, "smoke", executor="ray", ray_address=address, **setting)
        named = benchmark.evaluate("given:drive", "smoke", executor="ray", ray_address=address, **setting)
    finally:
        del sys.modules["given"]
    assert here.agent == "given:drive"
    assert there.content == here.content == named.content


@pytest.mark.slow
def test_maps_robots_and_policies_of_the_users_travel(address, own):
    shutil.copytree(ROOT / "assets" / "robots", own / "robots")
    for name in ("office.yaml", "office.png", "office.pgm"):
        if (ROOT / "assets" / "maps" / name).exists():
            shutil.copy(ROOT / "assets" / "maps" / name, own / name)
    for suffix in (".npz", ".json"):
        shutil.copy(ROOT / "assets" / "policies" / f"macid-0{suffix}", own / f"mine{suffix}")
    shutil.copy(ROOT / "assets" / "agents" / "tac.npz", own / "robot.npz")
    shutil.copy(ROOT / "assets" / "agents" / "tac.json", own / "robot.json")
    changes = {
        "map": "office.yaml",
        "robot": str(own / "robots" / "jackal.toml"),  # wherever it is on this machine
        "pedestrian_model": {"mine.npz": 0.5, "orca": 0.5},
        "num_pedestrians": 3,
        "horizon": 5,
    }
    config = TaskConfig().replace(**changes)
    carried = {pathlib.Path(file).name for file in carried_task(config).files}
    assert {"office.yaml", "mine.npz", "mine.json", "jackal.toml"} < carried
    assert carried_task(TaskConfig()) == carried_agent("vfh") == carried_agent("tac") == type(carried_agent("vfh"))()
    setting = {"episodes": 2, "overrides": changes, "quiet": True}
    here = benchmark.evaluate("robot.npz", "smoke", **setting)
    there = benchmark.evaluate("robot.npz", "smoke", executor="ray", ray_address=address, **setting)
    assert there.content == here.content


def test_another_version_of_the_project_is_refused_in_a_line(address, own):
    for name in ("bson", "macid"):
        shutil.copytree(ROOT / name, own / "other" / name, ignore=shutil.ignore_patterns("__pycache__"))
    (own / "other" / "assets").symlink_to(ROOT / "assets")
    with open(own / "other" / "bson" / "metrics.py", "a") as file:
        file.write("# changed\n")
    words = [
        "evaluate",
        "--agent",
        "stop",
        "--suite",
        "smoke",
        "--episodes",
        "1",
        "--videos",
        "0",
        *WORDS,
        "--out",
        "out",
    ]
    ran = subprocess.run(
        [sys.executable, "-m", "bson.cli", *words, "--executor", "ray", "--ray-address", address],
        env={**os.environ, "PYTHONPATH": str(own / "other")}, capture_output=True, text=True, cwd=own,
    )  # fmt: skip
    assert ran.returncode == 2
    assert not (own / "out").exists()
    assert "has another version: bson-macid" in ran.stderr.splitlines()[-1]


@pytest.mark.slow
def test_a_worker_that_dies_again_and_again_is_told_in_a_line(address, own):
    (own / "killer.py").write_text("import os\ndef agent(observation):\n    os.kill(os.getpid(), 9)\n")
    setting = {"executor": "ray", "ray_address": address, "workers": 1, "quiet": True}
    with pytest.raises(UsageError, match="4 workers were lost one after the other"):
        benchmark.evaluate("killer.py", "smoke", episodes=1, overrides=QUICK, **setting)


@pytest.fixture
def silent():
    """HOST:PORT at which somebody listens and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"127.0.0.1:{server.getsockname()[1]}"


def test_an_address_where_no_cluster_answers_is_told_within_seconds(silent, monkeypatch):
    pytest.importorskip("ray")
    begin = time.monotonic()
    with pytest.raises(UsageError, match=f"No Ray cluster answers at '{silent}'.*nothing came within 3 s.*ray start"):
        make_executor("ray", silent)
    with socket.create_server(("127.0.0.1", 0)) as server:
        free = f"127.0.0.1:{server.getsockname()[1]}"
    with pytest.raises(UsageError, match=r"Connection refused.*ray start"):
        make_executor("ray", free)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer():
            connection, _ = server.accept()
            with connection:
                connection.recv(100)
                connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        threading.Thread(target=answer).start()
        with pytest.raises(UsageError, match="another program answers"):
            make_executor("ray", f"127.0.0.1:{server.getsockname()[1]}")
    monkeypatch.setenv("RAY_TMPDIR", "/nowhere")
    for wrong, told in (
        ("auto", "no Ray cluster runs"),
        ("ray://x:1", "client is not used"),
        ("x", "HOST:PORT or auto"),
    ):
        with pytest.raises(UsageError, match=told):
            make_executor("ray", wrong)
    assert time.monotonic() - begin < 10


def test_a_missing_ray_and_flags_without_it_are_told_and_nothing_is_made(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.chdir(tmp_path)
    for flags, told in (
        (["--executor", "ray"], "pip install 'bson-macid[ray]'"),
        (["--workers", "2"], "--workers is for --executor ray"),
        (["--ray-address", "auto"], "--ray-address is for --executor ray"),
    ):
        for words in (["evaluate", "--agent", "stop", "--suite", "smoke"], ["train", "--steps", "100"]):
            if words[0] == "train":
                pytest.importorskip("stable_baselines3")
            assert cli.main([*words, *flags]) == 2
            error = capsys.readouterr().err.splitlines()
            assert len(error) == 1
            assert told in error[0]
    with pytest.raises(UsageError, match=r"Unknown executor 'slurm'\. Choose local or ray"):
        make_executor("slurm")
    assert not list(tmp_path.iterdir())


def test_every_seed_is_in_one_share_whatever_the_workers():
    @dataclasses.dataclass
    class Of:
        workers: int | None

    for count in (0, 1, 5, 16, 100):
        assert shares(list(range(count)), count, Local()) == ([list(range(count))] if count else [])
        for workers in (1, 2, 7, 1000):
            parts = shares(list(range(count)), count, Of(workers))
            assert [seed for part in parts for seed in part] == list(range(count))
            assert all(0 < len(part) <= 16 for part in parts)


@pytest.mark.slow
def test_robots_trained_side_by_side_are_those_trained_here(address, own):
    pytest.importorskip("stable_baselines3")
    from bson.learning.train import TrainConfig
    from macid.policy import read_network

    task = {**QUICK, "goal_distance": (2.0, 5.0), "map_size": 20.0}
    short = {"num_envs": 2, "validate_episodes": 2, "task": task}
    configs = [TrainConfig("ppo", seed, 600, **short) for seed in (0, 1)]
    here = benchmark.train_configs(configs, own / "here")
    there = benchmark.train_configs(configs, own / "there", executor="ray", ray_address=address)
    for one, other in zip(here, there, strict=True):
        (ours, recipe), (theirs, noted) = read_network(one / "policy.npz"), read_network(other / "policy.npz")
        assert [[a.tobytes() for a in layer] for layer in ours] == [[a.tobytes() for a in layer] for layer in theirs]
        assert {**recipe, "seconds": 0, "curve": 0} == {**noted, "seconds": 0, "curve": 0}
        assert {path.name for path in one.iterdir()} == {path.name for path in other.iterdir()}
    with pytest.raises(UsageError, match="already"):
        benchmark.train_configs(configs, own / "there", executor="ray", ray_address=address)
    assert benchmark.train_configs(configs, own / "there", resume=True) == there  # done, wherever that was


@pytest.mark.slow
def test_the_tables_rows_are_the_same_side_by_side(address, own):
    tools = {}
    for name in ("reproduce_tables", "reproduce_table3"):
        if name == "reproduce_table3":
            pytest.importorskip("stable_baselines3")
        spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
        tools[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(tools[name])
    tables, table3 = tools.values()
    for folder in ("here", "there"):
        (own / folder).mkdir()
    policy = ROOT / "assets" / "policies" / "macid-0.npz"
    asked = [tables.evaluation(file, 1, (0.67, 1.33), 1) for file in ("orca", policy)]
    suite, wanted = load_suite("paper"), [("goal", {"horizon": 5}), ("stop", {"horizon": 4, "lcf": (0.0, 1.0)})]
    seeds = suite.drawn(3)
    with make_executor("ray", address) as executor:
        tables.play_missing(executor, own / "there", asked)
        table3.play_missing(executor, own / "there", suite, seeds, wanted)
    for each in asked:
        tables.kept(own / "here", each)
    for agent, changes in wanted:
        table3.scored(own / "here", agent, suite, seeds, **changes)
    names = sorted(path.name for path in (own / "here").iterdir())
    assert len(names) == 4
    assert names == sorted(path.name for path in (own / "there").iterdir())
    for name in names:
        assert json.loads((own / "here" / name).read_text()) == json.loads((own / "there" / name).read_text())
