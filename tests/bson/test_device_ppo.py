"""PPO in worlds on a device."""

import numpy as np
import pytest

pytest.importorskip("warp")

import jax
import jax.numpy as jnp

from bson.agents import learned
from bson.features import FEATURES, Features, remember, vector
from bson.learning.device_ppo import DevicePpoConfig, DeviceTrainConfig, train
from macid.files import UsageError

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


@pytest.mark.slow
def test_training_writes_what_numpy_runs_and_goes_on_from_its_checkpoint(tmp_path):
    def config(steps):
        return DeviceTrainConfig(0, steps, EMPTY, 4, hyperparameters=DevicePpoConfig(rollout=4, batches=2, epochs=1))

    rows = []
    folder = train(config(32), tmp_path, show=lambda steps, figures: rows.append((steps, figures)), workers=0)
    assert [steps for steps, _ in rows] == [16, 32]
    assert all(np.isfinite(list(figures.values())).all() for _, figures in rows)
    agent = learned.load(str(folder / "policy.npz"))()
    assert (np.abs(agent.act(np.zeros((1, FEATURES), np.float32))) <= 1).all()
    with pytest.raises(UsageError, match="--resume"):
        train(config(32), tmp_path, workers=0)
    before = (folder / "policy.npz").read_bytes()
    train(config(32), tmp_path, resume=True, workers=0)  # there is nothing left to do
    assert (folder / "policy.npz").read_bytes() == before


@pytest.mark.slow
def test_the_return_rises(tmp_path):
    hyperparameters = DevicePpoConfig(rollout=32, batches=4, epochs=6, learning_rate=3e-3)
    config = DeviceTrainConfig(0, 20 * 32 * 64, EMPTY, 64, hyperparameters=hyperparameters)
    rows = []
    train(config, tmp_path, show=lambda steps, figures: rows.append(figures), workers=0)
    ended = [row for row in rows if row["episodes"]]
    first, last = (np.mean([row["return"] for row in part]) for part in (ended[:4], ended[-4:]))
    assert last > first + 1.0
