import math

import numpy as np
import pytest
from scipy.stats import spearmanr

from macid.metrics import collision_penalty, mean_by_section, path_efficiency, rank_correlation, success_rate

ARRIVED = np.array([True, True, True, False])
COLLISIONS = np.array([0, 9, 10, 0])


def test_success_needs_arrival_and_fewer_than_n_collisions():
    assert success_rate(ARRIVED, COLLISIONS) == 50.0
    assert success_rate(ARRIVED, COLLISIONS, tolerated=11) == 75.0
    assert success_rate(ARRIVED, COLLISIONS, tolerated=0) == 0.0
    assert success_rate(ARRIVED.reshape(2, 2), COLLISIONS.reshape(2, 2)) == 50.0


def test_collision_penalty_is_the_mean_over_everybody():
    assert collision_penalty(COLLISIONS) == 4.75


def test_path_efficiency_counts_who_arrived_and_is_at_most_one():
    distance, travelled = np.array([10.0, 10.0, 10.0, 10.0]), np.array([20.0, 9.5, 12.5, 1.0])
    assert path_efficiency(ARRIVED, distance, travelled) == pytest.approx(100 * (0.5 + 1.0 + 0.8) / 3)
    assert path_efficiency(ARRIVED[:1], distance[:1], np.zeros(1)) == 100.0


def test_path_efficiency_of_nobody_is_not_a_number():
    assert math.isnan(path_efficiency(np.zeros(3, bool), np.ones(3), np.ones(3)))


def test_rank_correlation_is_spearmans():
    values = np.random.default_rng(0).integers(0, 5, (20, 7))
    for row in values:
        assert rank_correlation(row) == pytest.approx(spearmanr(range(7), row).statistic)
    assert rank_correlation([3.0, 2.0, 1.0]) == pytest.approx(-1.0)
    for without in ([1.0, 1.0, 1.0], [1.0], [1.0, np.nan]):
        assert np.isnan(rank_correlation(without))


def test_means_by_section():
    lcf, collisions = np.array([[-2.0, -0.5, 2.0], [0.0, 1.9, -2.0]]), np.array([[1, 2, 3], [4, 5, 6]])
    means, counts = mean_by_section(lcf, collisions, [-2.0, -1.0, 0.0, 1.0, 2.0])
    np.testing.assert_allclose(means, [3.5, 2.0, 4.0, 4.0])
    assert counts.tolist() == [2, 1, 1, 2] and np.isnan(mean_by_section(lcf, collisions, [0.1, 0.2, 2.0])[0][0])
