import itertools
import json
import re

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
        for a, b in itertools.pairwise(sizes)
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


def scans():
    """An observation of a person among others, with some of its rays meeting nothing; and a policy."""
    seen, _ = observations(1, seed=7)
    seen[0, 2:5] = [1.2, -0.3, 0.0]
    seen[0, 5 + 3 * 4 : 5 + 3 * 9] = [7.0, 0.0, 0.0] * 5
    return policy.load_policy("macid"), seen


def ways(made):
    """The three ways to ask a policy: {name: function of an observation and an LCF}."""
    torch = pytest.importorskip("torch", reason="needs the extra 'agents'")
    module = made.to_torch()

    def asked(seen, lcf):
        return module(seen if torch.is_tensor(seen) else torch.as_tensor(seen), lcf).detach().numpy()

    return {
        "numpy": made,
        "jax": lambda seen, lcf: made(jnp.asarray(seen), lcf),
        "torch": asked,
    }


@pytest.mark.parametrize("beyond", [7.5, 30.0, 1e30, np.inf])
def test_a_reading_beyond_the_range_is_a_miss(beyond):
    made, seen = scans()
    there = seen.copy()
    there[0, 5 + 3 * 4 : 5 + 3 * 9] = [beyond, -1.0, 2.0] * 5  # whatever moves there
    for name, asked in ways(made).items():
        assert np.array_equal(asked(there, 0.5), asked(seen, 0.5)), name
    jitted = jax.jit(made)
    assert np.array_equal(jitted(there, 0.5), jitted(seen, 0.5))
    there[:, 5::3] = beyond  # an open field
    clear = there.copy()
    clear[:, 5:] = [7.0, 0.0, 0.0] * observation.RAYS
    assert np.array_equal(made.action(there, 0.5), made.action(clear, 0.5))


@pytest.mark.parametrize("column", [0, 1, 2, 3, 4, 5, 6, 7, 38, 40])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1e7, 1e7])
def test_what_cannot_be_understood_is_refused_and_is_finite_under_jit(column, value):
    made, seen = scans()
    seen[0, column] = value
    ray = (column - 5) % 3 == 0 and column >= 5
    refused = not (ray and value > 0)
    for name, asked in ways(made).items():
        if not refused:
            assert np.isfinite(asked(seen, 0.5)).all(), name
            continue
        with pytest.raises(ValueError, match=re.escape(f" is {value:g};")):
            asked(seen, 0.5)
    if refused:
        with pytest.raises(ValueError, match="can't be understood"):
            made.action(seen, 0.5)
    assert np.isfinite(_ACTION(seen, 0.5)).all()


_ACTION = jax.jit(lambda seen, lcf: policy.load_policy("macid").action(seen, lcf))


def test_a_distance_below_zero_is_no_distance():
    made, seen = scans()
    seen[0, 5] = -0.01
    for asked in ways(made).values():
        with pytest.raises(ValueError, match="column 5, the distance of ray 0.*-0.01"):
            asked(seen, 0.0)


@pytest.mark.parametrize("lcf", [None, np.nan, 5, -2.001, [0.5, np.inf], "1", 1 + 0j, [[0.0, 0.0]], object()])
def test_what_is_no_lcf_is_refused(lcf):
    made, seen = scans()
    for name, asked in ways(made).items():
        with pytest.raises(ValueError, match="LCF"):
            asked(np.repeat(seen, 2, axis=0), lcf)
        assert np.isfinite(asked(np.repeat(seen, 2, axis=0), [-2.0, 2.0])).all(), name
    if isinstance(lcf, float | int):
        assert np.isfinite(_ACTION(seen, jnp.asarray(lcf, jnp.float32))).all()


@pytest.mark.parametrize("seen", [0.0, np.zeros(40), np.zeros((3, 42)), ["a"] * 41, [[0.0] * 41, [0.0]], None, {}])
def test_what_is_no_observation_is_refused(seen):
    made = make()
    with pytest.raises(ValueError, match=r"^(An observation|Observations) "):
        made(seen, 0.0)
    torch = pytest.importorskip("torch", reason="needs the extra 'agents'")
    with pytest.raises(ValueError, match=r"^An observation "):
        made.to_torch()(seen, torch.zeros(()))


def test_flags_whole_numbers_lists_and_doubles_are_numbers():
    made, seen = scans()
    seen[:] = np.round(seen)
    expected = made(seen, 1)
    assert np.isfinite(expected).all()
    flagged = [[*row[:4].tolist(), bool(row[4]), *row[5:]] for row in seen]
    for same in (seen.tolist(), seen.astype(int), seen.astype(float), flagged):
        for name, asked in ways(made).items():
            np.testing.assert_allclose(asked(same, np.int64(1)), expected, atol=1e-5, err_msg=name)
    assert made(np.zeros((0, observation.SIZE)), 0.0).shape == (0, 2)


def test_at_the_goal_and_faster_than_one_can_is_taken_as_it_is():
    made, seen = scans()
    seen[0, :2] = 0.0
    still = made(seen, 0.5)
    assert np.isfinite(still).all()
    seen[0, 2:4] = [2.1, -1.7]  # pushed
    assert np.array_equal(made(seen, 0.5), policy.to_velocity(made.act(seen, np.float32(0.5))))
    assert not np.array_equal(made(seen, 0.5), still)


def test_torch_can_map_and_trace_a_policy():
    torch = pytest.importorskip("torch", reason="needs the extra 'agents'")
    made, seen = scans()
    module, x = made.to_torch(), torch.as_tensor(np.repeat(seen, 3, axis=0))
    expected = made(seen, 0.5)[0]
    mapped = torch.func.vmap(module, in_dims=(0, None))(x, torch.tensor(0.5)).detach()
    np.testing.assert_allclose(mapped, np.tile(expected, (3, 1)), atol=1e-5)
    traced = torch.jit.trace(module, (x, torch.full((3,), 0.5)))
    np.testing.assert_allclose(traced(x[:2], torch.full((2,), 0.5)).detach(), np.tile(expected, (2, 1)), atol=1e-5)
    assert traced(torch.full((2, 41), torch.nan), torch.full((2,), 9.0)).isfinite().all()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_weights_that_are_not_finite_are_refused_when_read(tmp_path, value):
    layers = [tuple(array.copy() for array in layer) for layer in make().layers]
    layers[1][0][3, 4] = value
    with pytest.raises(ValueError, match="weight1 holds"):
        policy.Policy(tuple(layers), {})
    policy.write_network(tmp_path / "mine", layers, {})
    with pytest.raises(ValueError, match="mine.npz' is not a policy .*weight1 holds"):
        policy.load_policy(str(tmp_path / "mine.npz"))


def test_a_policy_that_sees_the_numbers_as_they_are_is_the_same_in_all_three():
    rng = np.random.default_rng(4)
    sizes = (observation.SIZE + 1, 8, policy.ACTIONS)
    layers = [
        (rng.normal(0, 0.1, pair).astype(np.float32), np.zeros(pair[1], np.float32))
        for pair in itertools.pairwise(sizes)
    ]
    made, (seen, lcf) = policy.Policy(tuple(layers), {"inputs": "observation"}), observations(20)
    seen[:, 5] = np.inf
    by_hand = seen.copy()
    by_hand[:, 5:8] = [7.0, 0.0, 0.0]
    x = np.concatenate([by_hand, lcf[:, None] / 2], axis=-1)
    hidden = np.tanh(x @ layers[0][0])
    np.testing.assert_allclose(made.action(seen, lcf), hidden @ layers[1][0], rtol=1e-5, atol=1e-6)
    for name, asked in ways(made).items():
        np.testing.assert_allclose(asked(seen, lcf), made(seen, lcf), atol=1e-5, err_msg=name)
