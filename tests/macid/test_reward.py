import jax.numpy as jnp
import numpy as np
import pytest

from macid.reward import RewardWeights, individual_reward, neighborhood_mean, neighbors


@pytest.mark.parametrize(
    ("terms", "expected"), [((0.03, 0, 0), 0.3), ((-0.03, 1, 0), 0.7), ((0.0, 0, 1), -0.6), ((0.02, 1, 1), 0.6)]
)
def test_equation_5_by_hand(terms, expected):
    assert individual_reward(*terms) == pytest.approx(expected)


def test_weights_are_the_callers():
    assert individual_reward(2.0, 1, 1, RewardWeights(distance=1.0, goal=2.0, collision=1.0)) == pytest.approx(3.0)


@pytest.mark.parametrize("xp", [np, jnp])
def test_arrays_are_taken_by_element(xp):
    reward = individual_reward(xp.asarray([[0.1, 0.0]]), xp.asarray([[False, True]]), xp.asarray([[True, False]]))
    np.testing.assert_allclose(reward, [[0.4, 1.0]], rtol=1e-6)


@pytest.mark.parametrize("xp", [np, jnp])
def test_equation_1_by_hand(xp):
    position = xp.asarray([[0.0, 0.0], [4.9, 0.0], [0.0, 5.1], [8.0, 0.0]])
    near = neighbors(position)
    assert np.asarray(near).tolist() == [
        [False, True, False, False],
        [True, False, False, True],
        [False, False, False, False],
        [False, True, False, False],
    ]
    shared = neighborhood_mean(xp.asarray([[1.0], [2.0], [4.0], [8.0]]), near)[:, 0]
    np.testing.assert_allclose(shared, [2.0, 4.5, 0.0, 2.0])
