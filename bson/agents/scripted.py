"""Agents without eyes: the floor of every comparison."""

import numpy as np


def stop(observation):
    """Stands still."""
    return np.zeros(2)


class Random:
    """A new random action each control step."""

    def reset(self, seed):
        """Begins the episode of `seed`."""
        self._rng = np.random.default_rng(seed)

    def __call__(self, observation):
        return self._rng.uniform(-1.0, 1.0, 2)


def goal(observation):
    """Drives straight to the goal at 1.6 m/s, whatever stands in the way; turns on the spot while it faces away."""
    x, y = observation["goal"]
    bearing = np.arctan2(y, x)
    return np.array([0.8 * max(0.0, np.cos(bearing)) ** 2, np.clip(1.5 * bearing, -1.0, 1.0)])
