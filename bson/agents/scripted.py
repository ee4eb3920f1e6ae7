"""Agents of a few lines: the floor of every comparison."""

import numpy as np

_NEAR = 1.6  # [m]
_AHEAD = slice(280, 440)  # of the 2D LIDAR's 720 beams, the 60 degrees in front


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


def goal(observation, speed=0.8):
    """Drives straight to the goal at 1.6 m/s, whatever stands in the way; turns on the spot while it faces away.

    speed: the share of the Jackal's 2 m/s instead.
    """
    x, y = observation["goal"]
    bearing = np.arctan2(y, x)
    return np.array([speed * max(0.0, np.cos(bearing)) ** 2, np.clip(1.5 * bearing, -1.0, 1.0)])


def stop_and_go(observation):
    """Stands while anything is within 1.6 m in the 60 degrees ahead of the LIDAR; else drives as `goal` does, at 2 m/s."""
    return stop(observation) if observation["lidar"][_AHEAD].min() < _NEAR else goal(observation, speed=1.0)
