import math

import numpy as np
import pytest

from macid.metrics import collision_penalty, path_efficiency, success_rate

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
