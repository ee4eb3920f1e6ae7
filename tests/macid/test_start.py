"""Ctrl-C at any moment of a real command: one line, exit code 130, and what is worth keeping is kept."""

import os
import pathlib
import signal
import subprocess
import sys
import time

import jax
import pytest

import macid
from macid import start
from macid.learning.config import PRESETS, TrainConfig
from macid.learning.train import train

ROOT = pathlib.Path(macid.__file__).parents[1]
_TICK = os.sysconf("SC_CLK_TCK")
TASK = ("map_size=20.0", "goal_distance=(6,12)", "num_pedestrians=3", "horizon=400")
SET = [word for each in TASK for word in ("--set", each)]
COMMANDS = {
    "bson list": ["list"],
    "bson doctor": ["doctor"],
    "bson evaluate": ["evaluate", "--agent", "stop", "--suite", "paper", "--videos", "1", "--out", "out", *SET],
    "bson train": ["train", "--steps", "1e6", "--worlds", "4", "--out", "out", *SET],
    "macid evaluate": ["evaluate", "--pedestrian", "macid", "--levels", "1", "4", "--out", "out.json"],
    "macid watch": ["watch", "--pedestrian", "macid", "--level", "1", "--out", "out.webm"],
    "macid train": ["train", "--level", "1", "--worlds", "4", "--agent-steps", "1e9", "--out", "out"],
}


def used(pid):
    """Seconds of CPU time of a process so far; None once it has ended. Delays by it don't depend on the machine's
    load."""
    try:
        fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else (int(fields[11]) + int(fields[12])) / _TICK


def interrupt(command, delay, folder):
    """Runs a command's process, sends it one SIGINT after `delay` [s of its CPU time]; its exit code and stderr, or
    None if it had ended by then."""
    program = command.split()[0]
    code = f"import sys; from macid.start import {program}; sys.argv[0] = {program!r}; sys.exit({program}())"
    words = [sys.executable, "-c", code, *COMMANDS[command]]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    with subprocess.Popen(words, cwd=folder, env=environment, **pipes) as process:
        while (seconds := used(process.pid)) is not None and seconds < delay:
            time.sleep(0.005)
        if seconds is None:
            process.communicate()
            return None
        process.send_signal(signal.SIGINT)
        try:
            return process.returncode, process.communicate(timeout=120)[1], process.wait()
        except subprocess.TimeoutExpired:
            process.kill()
            raise


def check(command, delay, folder):
    """Whether Ctrl-C came in time; asserts that it ended as it should."""
    folder.mkdir(exist_ok=True)
    ended = interrupt(command, delay, folder)
    if ended is None:
        return False
    _, told, code = ended
    lines = [line for line in told.splitlines() if line.strip()]
    assert code == 130, (command, delay, code, told)
    assert lines[-1] == f"{command.split()[0]}: interrupted", (command, delay, told)
    assert "Traceback" not in told and "Exception ignored" not in told, (command, delay, told)
    assert "".join(lines).count("interrupted") == 1
    return True


@pytest.mark.parametrize(
    ("command", "delay"), [("bson list", 0.1), ("bson evaluate", 1.0), ("macid evaluate", 2.0), ("macid train", 2.5)]
)
def test_ctrl_c_is_one_line_and_130(tmp_path, command, delay):
    assert check(command, delay, tmp_path)
    if command == "macid train":
        assert not list(tmp_path.rglob("checkpoint*"))


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_ctrl_c_at_any_moment(tmp_path, command):
    delays = [0.1 + 0.15 * number for number in range(40)]
    came = [check(command, delay, tmp_path / f"{number}") for number, delay in enumerate(delays)]
    print(f"{command}: {sum(came)} of {sum(came)} interrupted in time ended as they should")
    assert sum(came) >= 3


def interrupt_myself():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)  # Python calls the handler before this ends


def test_deferred_waits_while_there_is_something_to_keep_and_a_second_one_does_not():
    before, kept = signal.getsignal(signal.SIGINT), False
    with start.deferred(lambda: kept) as interrupted, pytest.raises(KeyboardInterrupt):
        interrupt_myself()
    with start.deferred(lambda: kept) as interrupted:
        kept = True
        assert not interrupted()
        interrupt_myself()
        assert interrupted()
        with pytest.raises(KeyboardInterrupt):
            interrupt_myself()
    assert signal.getsignal(signal.SIGINT) is before


def test_a_training_keeps_the_iteration_in_which_ctrl_c_came(tmp_path, monkeypatch):
    fast = PRESETS["fast"]["ppo"]
    config = TrainConfig(level=1, nworld=1, rollout=4, episode=2, agent_steps=300, ppo=fast)  # 3 iterations
    arrived, fetch = [], jax.device_get

    def interrupted(logs):
        arrived.append(logs)
        if len(arrived) == 2:
            interrupt_myself()
        return fetch(logs)

    with monkeypatch.context() as patch:
        patch.setattr(jax, "device_get", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train(config, tmp_path, show=lambda line: None)
    (rows,) = tmp_path.rglob("curve.csv")
    assert rows.read_text().count("\n") == 3 and len(arrived) == 2  # a header and two iterations
    assert list(tmp_path.rglob("checkpoint*")) and not list(tmp_path.rglob("policy*"))
