"""Trainings in the workers of a Ray cluster of this machine alone give the policies that they give in this process."""

import csv
import dataclasses
import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import tempfile
import time

import pytest

from macid import benchmark
from macid.executors import Carried, call, make_executor
from macid.learning.jobs import Group, train_groups
from macid.policy import load_policy

SMALL = {"level": 1, "nworld": 1, "rollout": 20, "episode": 2, "agent_steps": 2000}  # four updates


def layers(folder):
    return [array.tobytes() for layer in load_policy(str(folder / "policy.npz")).layers for array in layer]


@dataclasses.dataclass(frozen=True)
class Counting:
    """A training that counts to `until`, and dies once at 2 if its seed is 3."""

    until: int
    armed: str
    name: str = "counting"
    seed: int = 0


def count(configs, out, show):
    for config in configs:
        folder = out / f"{config.name}-{config.seed}"
        saved = folder / "checkpoint.npz"
        done = int(saved.read_text()) if saved.exists() else 0
        while done < config.until:
            done += 1
            saved.write_text(str(done))
            show(done)
            if config.seed == 3 and done == 2 and os.path.exists(config.armed):
                time.sleep(2.5)
                os.unlink(config.armed)
                os.kill(os.getpid(), signal.SIGKILL)
        (folder / "policy.npz").write_text(f"{done} {os.getpid()}")


def test_a_training_whose_worker_is_killed_goes_on_from_its_checkpoint(tmp_path, capsys):
    ray = pytest.importorskip("ray")
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
    (tmp_path / "armed").touch()
    configs = [Counting(4, str(tmp_path / "armed"), seed=seed) for seed in (3, 5)]
    shown, done = [], lambda config, folder: (folder / "policy.npz").exists()
    with make_executor("ray", workers=2) as executor:
        assert executor.workers == 2
        folders = train_groups(
            executor,
            [Group(count, (config,)) for config in configs],
            tmp_path / "out",
            False,
            lambda config, number: shown.append((config.seed, number)),
            done,
        )
        squares = {}
        executor.run(call, [lambda n=n: (pow, {"base": n, "exp": 2}) for n in range(5)], squares.__setitem__, Carried())
    assert squares == {n: n * n for n in range(5)}
    assert [folder.name for folder in folders] == ["counting-3", "counting-5"]
    ends = [(folder / "policy.npz").read_text().split() for folder in folders]
    assert [number for number, _ in ends] == ["4", "4"]
    assert str(os.getpid()) not in [process for _, process in ends]
    assert "a worker was lost" in capsys.readouterr().err
    for seed in (3, 5):  # whoever was killed went on from its second step
        assert [number for one, number in shown if one == seed] == [1, 2, 3, 4]
    assert not list(pathlib.Path("/tmp").glob("macid-ray-*"))


@pytest.mark.slow
def test_seeds_side_by_side_are_the_seeds_alone_and_go_on_wherever_they_began(tmp_path):
    pytest.importorskip("ray")
    quiet = {"show": lambda line: None}
    for seed in (0, 1):
        benchmark.train("macid", tmp_path / "alone", seed=seed, **SMALL, **quiet)
    folders = benchmark.train("macid", tmp_path / "apart", seeds=2, executor="ray", workers=2, **SMALL, **quiet)
    for folder in folders:
        alone = tmp_path / "alone" / folder.name
        assert layers(folder) == layers(alone)
        assert len(list(csv.DictReader((folder / "curve.csv").open()))) == 4
        assert json.loads((folder / "config.json").read_text()) == json.loads((alone / "config.json").read_text())
    with pytest.raises(ValueError, match="already"):
        benchmark.train("macid", tmp_path / "apart", seeds=2, executor="ray", **SMALL, **quiet)
    # both policies are lost, but not the checkpoints
    for folder in folders:
        (folder / "policy.npz").unlink()
    benchmark.train("macid", tmp_path / "apart", seeds=2, resume=True, **SMALL, **quiet)
    assert all(layers(folder) == layers(tmp_path / "alone" / folder.name) for folder in folders)
    # seeds that were begun at once go on at once
    begun = benchmark.train("macid", tmp_path / "begun", seeds=2, **SMALL, **quiet)
    before = [layers(folder) for folder in begun]
    for folder in begun:
        (folder / "policy.npz").unlink()
    with make_executor("ray", workers=1) as executor:
        benchmark.train("macid", tmp_path / "begun", seeds=2, resume=True, executor=executor, **SMALL, **quiet)
    assert [layers(folder) for folder in begun] == before


@pytest.mark.slow
def test_ctrl_c_ends_the_command_and_its_cluster(tmp_path):
    pytest.importorskip("ray")
    temporary = pathlib.Path(tempfile.mkdtemp(dir="/tmp"))  # a short path, for sockets
    words = ["train", "--executor", "ray", "--workers", "1", "--worlds", "1", "--out", str(tmp_path / "runs")]
    process = subprocess.Popen(
        [sys.executable, "-m", "macid.cli", *words],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "TMPDIR": str(temporary)},
    )
    ours = tmp_path / "runs" / "macid-0"
    while not list(temporary.glob("macid-ray-*/session_latest")) or not ours.exists():
        assert process.poll() is None
        time.sleep(0.2)
    time.sleep(5)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert error.splitlines()[-1] == "macid: interrupted"
    assert not list(temporary.glob("macid-ray-*"))
    shutil.rmtree(temporary)
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)
