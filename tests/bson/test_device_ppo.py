"""PPO in worlds on a device."""

import json
import signal
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("warp")

import jax
import jax.numpy as jnp

from bson.agents import learned
from bson.features import Features, remember, vector
from bson.interfaces.functional import BsonFuncEnv
from bson.learning import device_ppo
from bson.learning.device_ppo import DevicePpoConfig, DeviceTrainConfig, Noted, train
from bson.simulation.pool import draw, draw_all
from bson.simulation.scene import structure
from macid.files import UsageError
from macid.learning.curves import read_checkpoint

EMPTY = {"num_pedestrians": 0, "map_size": 14.0, "goal_distance": (3.0, 6.0), "horizon": 60}


def test_features_on_a_device_are_those_of_agents():
    rng = np.random.default_rng(0)
    ours, scans = Features(3), jnp.zeros((3, 5, 36))
    for step in range(7):
        seen = {
            "goal": rng.uniform(-9, 9, (3, 2)).astype(np.float32),
            "velocity": rng.uniform(-2, 2, (3, 2)).astype(np.float32),
            "lidar": rng.uniform(0.1, 30, (3, 720)).astype(np.float32),
        }
        wanted = (ours.step if step else ours.begin)(np.arange(3), seen)
        scans = remember(scans, jnp.asarray(seen["lidar"]), jnp.full(3, step == 0))
        np.testing.assert_allclose(vector(scans, jax.tree.map(jnp.asarray, seen)), wanted, atol=1e-6)


def small(steps, inputs="scans", draw=None, task=EMPTY, **more):
    chosen = DevicePpoConfig(rollout=4, batches=2, epochs=1, piece=2)
    return DeviceTrainConfig(0, steps, task, 4, "ppo", "warp", chosen, 64, 1, inputs, draw, **more)


@pytest.mark.slow
@pytest.mark.parametrize("inputs", ["scans", "gru-scans"])
def test_training_writes_what_numpy_runs_and_goes_on_as_if_it_was_not_interrupted(inputs, tmp_path, monkeypatch):
    rows = []

    def show(steps, figures, validation=False):
        if not validation:
            rows.append((steps, figures))

    config = small(64, inputs)
    monkeypatch.setattr(device_ppo, "_SITTING", 2)
    folder = train(config, tmp_path / "whole", show=show, workers=0)
    assert [steps for steps, _ in rows] == [16, 32, 48, 64]
    assert all(np.isfinite(list(figures.values())).all() for _, figures in rows)
    factory = learned.load(str(folder / "policy.npz"))
    assert factory.kind is learned.KINDS[inputs]
    recipe = json.loads((folder / "policy.json").read_text())
    assert recipe["validations"] == [{"steps": 64} | recipe["validation"]] and recipe.get("inputs", "scans") == inputs
    with pytest.raises(UsageError, match="--resume"):
        train(config, tmp_path / "whole", workers=0)
    before = (folder / "policy.npz").read_bytes()
    train(config, tmp_path / "whole", resume=True, workers=0)  # there is nothing left to do
    assert (folder / "policy.npz").read_bytes() == before

    told = []

    def stop(steps, figures, validation=False):
        told.append(steps)
        if len(told) == 1:
            signal.raise_signal(signal.SIGINT)  # Ctrl-C

    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "parts", show=stop, workers=0)
    assert told == [16, 32]  # the second was already under way
    parts = train(config, tmp_path / "parts", resume=True, workers=0)
    one, other = (read_checkpoint(each, Noted)[0] for each in (folder, parts))
    assert one.keys() == other.keys()
    for name, array in one.items():
        assert np.array_equal(array, other[name], equal_nan=array.dtype.kind == "f"), name
    curves = [
        [line.split(",")[:1] + line.split(",")[2:] for line in text.splitlines()]
        for text in ((each / "curve.csv").read_text() for each in (folder, parts))
    ]
    assert curves[0] == curves[1]


@pytest.mark.slow
@pytest.mark.parametrize("inputs", ["scans", "gru-scans"])
def test_the_return_rises(inputs, tmp_path):
    hyperparameters = DevicePpoConfig(rollout=32, batches=4, epochs=6, learning_rate=3e-3, piece=16)
    config = DeviceTrainConfig(0, 20 * 32 * 64, EMPTY, 64, hyperparameters=hyperparameters, inputs=inputs)
    rows = []

    def show(steps, figures, validation=False):
        if not validation:
            rows.append(figures)

    train(config, tmp_path, show=show, workers=0)
    ended = [row for row in rows if row["episodes"]]
    first, last = (np.mean([row["return"] for row in part]) for part in (ended[:4], ended[-4:]))
    assert last > first + 1.0


# --- episodes with settings of their own

DRAW = """
name = "mine"
description = "a test"
[[kinds]]
share = 1
[kinds.config]
lcf = {{ among = [[-2.0, 0.0], [1.0, 2.0]] }}
goal_distance = {{ among = [[3.0, 5.0], [4.0, 6.0]] }}
num_pedestrians = {{ among = [0, 1, 3] }}
obstacle_density = {{ from = 0.0, to = 0.5 }}
{more}
[[validation]]
map_size = 14.0
num_pedestrians = 0
goal_distance = [3.0, 6.0]
horizon = 5
"""


def drawn(tmp_path, more=""):
    (tmp_path / "mine.toml").write_text(DRAW.format(more=more))
    return str(tmp_path / "mine.toml")


def test_each_episode_has_a_setting_of_its_own_in_worlds_with_room_for_all(tmp_path):
    task = {"map_size": 20.0, "horizon": 60}
    episodes = small(64, draw=drawn(tmp_path), task=task).episodes
    largest = episodes.largest
    assert largest.people == 3 and largest.obstacle_density == 0.5 and episodes.shortest == 3.0
    both = draw_all(largest, range(40), settings=episodes)
    assert both.people.shape == (40, 3, 3) and both.boxes.shape[1] == structure(largest)[2][0]
    there = (np.abs(both.people[..., 0]) < 10).sum(axis=-1)
    assert {*there} == {0, 1, 3} and len({*(np.abs(both.boxes[..., 0]) < 11).sum(axis=-1)}) > 3
    assert (both.start_distance >= 3.0).all() and (both.start_distance <= 6.0).all()
    for seed in range(4):  # who is there is as in a world of the episode's own setting
        setting = next(episodes(seed))
        own = draw(setting, seed)
        assert there[seed] == setting.people == len(own.people)
        assert setting.lcf in ((-2.0, 0.0), (1.0, 2.0)) and setting.horizon == 60
        for name in ("people", "boxes", "lcf", "turns"):
            whole, part = getattr(both, name)[seed], getattr(own, name)
            np.testing.assert_array_equal(whole[: len(part)], part)
        width = own.ways.shape[1]
        np.testing.assert_array_equal(both.ways[seed, : there[seed], :width], own.ways)
        np.testing.assert_array_equal(both.goal[seed], own.goal)
        assert (both.turns[seed] >= 1).all()
    again = draw_all(largest, range(3, 5), settings=episodes)
    np.testing.assert_array_equal(again.people, both.people[3:5])


@pytest.mark.slow
def test_who_is_missing_is_neither_seen_nor_met(tmp_path):
    episodes = small(64, draw=drawn(tmp_path), task={"map_size": 20.0}).episodes
    seed = next(seed for seed in range(99) if next(episodes(seed)).people == 1)
    setting, seen = next(episodes(seed)), []
    for config, settings in ((episodes.largest, episodes), (setting, None)):
        env = BsonFuncEnv("local", "lidar2d", 1, task=config)
        params = jax.tree.map(jnp.asarray, draw_all(config, [seed], settings=settings))
        states = jax.vmap(env.initial, in_axes=(0, None))(jnp.arange(1), params)
        transition = jax.jit(jax.vmap(env.transition))
        for _ in range(15):
            states = transition(states, jnp.array([[0.6, 0.1]]))
        seen.append((states.pose, states.readings["lidar"], states.counts, states.motion.qpos[:, :3]))
    for one, other in zip(*seen, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-3)


@pytest.mark.slow
def test_a_draw_is_trained_on_and_chosen_by_its_validation(tmp_path):
    folder = train(small(32, draw=drawn(tmp_path), task={"map_size": 14.0, "horizon": 60}), tmp_path, workers=0)
    assert folder.name == "ppo-warp-mine-0"
    assert json.loads((folder / "policy.json").read_text())["validations"]


def test_what_a_device_can_t_do_is_refused(tmp_path):
    with pytest.raises(UsageError, match=r"episodes may differ in lcf, .*, not in map_size \(kinds\[0\]\)"):
        small(32, draw=drawn(tmp_path, "map_size = 20.0"))
    with pytest.raises(UsageError, match="leave companions out"):
        small(32, draw=drawn(tmp_path), task={"companions": 0.5})
    with pytest.raises(UsageError, match="--inputs of scans, gru-scans, not gru"):
        small(32, "gru")
    with pytest.raises(UsageError, match="--inputs gru-scans, not scans"):
        small(32, start="gru")
    with pytest.raises(UsageError, match="--start gru: its inputs are gru"):
        train(small(32, "gru-scans", start="gru"), tmp_path)
    assert not list(tmp_path.glob("ppo*"))


def test_what_trains_on_a_device_needs_neither_torch_nor_dm_control():
    program = "import sys, bson.learning.device_ppo; print(sorted({'torch', 'dm_control'} & set(sys.modules)))"
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert told.stdout == "[]\n"
