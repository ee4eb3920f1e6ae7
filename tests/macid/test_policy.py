import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from macid import observation, policy
from macid.state import MAX_SPEED, MAX_YAW_RATE


def make(seed=0):
    rng = np.random.default_rng(seed)
    sizes = (policy.FEATURES + 1, *policy.HIDDEN, policy.ACTIONS)
    layers = tuple(
        (rng.normal(0, 0.3, (a, b)).astype(np.float32), rng.normal(0, 0.1, b).astype(np.float32))
        for a, b in zip(sizes[:-1], sizes[1:], strict=True)
    )
    return policy.Policy(layers, {"method": "macid", "period": 0.02})


def observations(number, seed=1):
    rng = np.random.default_rng(seed)
    seen = rng.normal(0, 1, (number, observation.SIZE)).astype(np.float32)
    seen[:, :2] *= 10
    seen[:, 5::3] = rng.uniform(0.3, 7.0, (number, observation.RAYS))
    return seen, rng.uniform(-2, 2, number).astype(np.float32)


@pytest.mark.parametrize("name", [None, "macid", "macid-tri", "copo"])
def test_numpy_jax_and_torch_agree(name):
    made, (seen, lcf) = policy.load_policy(name) if name else make(), observations(200)
    expected = made(seen, lcf)
    np.testing.assert_allclose(jax.jit(made)(jnp.asarray(seen), jnp.asarray(lcf)), expected, atol=1e-5)
    torch = pytest.importorskip("torch", reason="needs the extra 'agents'")
    module = made.to_torch()
    np.testing.assert_allclose(module(torch.as_tensor(seen), torch.as_tensor(lcf)).detach(), expected, atol=1e-5)
    seen = seen.astype(float)  # and one LCF for all
    np.testing.assert_allclose(module(torch.as_tensor(seen), 0.5).detach(), made(seen, 0.5), atol=1e-5)


def test_saved_equals_loaded_and_is_small(tmp_path):
    made, (seen, lcf) = make(), observations(50)
    made.save(tmp_path / "mine")
    loaded = policy.load_policy(str(tmp_path / "mine.npz"))
    assert np.array_equal(loaded(seen, lcf), made(seen, lcf))
    assert loaded.recipe == made.recipe and loaded.period == 0.02
    assert (tmp_path / "mine.npz").stat().st_size < 100_000


def test_actions_are_within_a_pedestrians_limits_and_lcf_matters():
    made, (seen, lcf) = make(), observations(500)
    action = made(seen, lcf)
    assert (action[:, 0] >= 0).all() and (action[:, 0] <= MAX_SPEED).all()
    assert (np.abs(action[:, 1]) <= MAX_YAW_RATE).all()
    assert not np.allclose(made(seen, 1.5), made(seen, -1.5), atol=1e-3)


def test_lists_and_single_observations_are_taken():
    made, (seen, _) = make(), observations(3)
    assert np.allclose(made(seen[0].tolist(), 0.5), made(seen[:1], np.array([0.5], np.float32))[0])


def test_features_are_of_the_order_of_one_and_named_columns_in_order():
    seen = np.zeros((1, observation.SIZE), np.float32)
    seen[0, :2] = [0.0, 24.0]
    seen[0, 2:5] = [1.5, -1.0, 1.0]
    seen[0, 5::3] = 7.0
    seen[0, 5], seen[0, 6] = 0.35, -3.0
    features = policy.features(seen)[0]
    np.testing.assert_allclose(features[:6], [0, 1, 1, 1, -1, 1], atol=1e-5)
    np.testing.assert_allclose(features[6:9], [0.95, -2.0, 0.0], atol=1e-5)
    assert (features[9::3] == 0).all() and features.shape == (policy.FEATURES,)


@pytest.mark.parametrize(("name", "told"), [("macdi", "Choose one of"), ("none.npz", "no policy file")])
def test_an_unknown_policy_is_told(name, told):
    with pytest.raises(ValueError, match=told):
        policy.load_policy(name)


def test_a_broken_file_and_a_wrong_observation_are_told(tmp_path):
    (tmp_path / "bad.npz").write_bytes(b"no zip")
    (tmp_path / "bad.json").write_text(json.dumps({}))
    with pytest.raises(ValueError, match="is not a policy"):
        policy.load_policy(str(tmp_path / "bad.npz"))
    policy.write_network(tmp_path / "empty", [], {})
    with pytest.raises(ValueError, match="is not a policy"):
        policy.load_policy(str(tmp_path / "empty.npz"))
    policy.write_network(tmp_path / "robot", [(np.zeros((114, 2), np.float32), np.zeros(2, np.float32))], {})
    with pytest.raises(ValueError, match="no pedestrians' policy: it takes 114 numbers, not 43"):
        policy.load_policy(str(tmp_path / "robot.npz"))
    with pytest.raises(ValueError, match="41 columns"):
        make()(np.zeros(40), 0.0)
