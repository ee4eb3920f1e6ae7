"""An agent of one's own: it drives to the goal, and the slower, the nearer what its LIDAR sees ahead.

bson evaluate --agent own_agent.py --suite smoke
"""

import numpy as np

SLOW = 2.0  # where something is nearer than this, it slows down [m]


class agent:
    """Made once a world, with the Setting in which it is to drive (bson.agents.Setting)."""

    track, sensor = "local", "lidar2d"

    def __init__(self, setting):
        self.top = setting.top  # what an action of 1 stands for [m/s, rad/s]
        (lidar,) = (each for each in setting.sensors if each.key == "lidar")
        self.ahead = np.abs(lidar.angles) < 0.5  # [rad]

    def __call__(self, observation):
        x, y = observation["goal"]  # in the robot's frame [m]
        bearing = np.arctan2(y, x)
        room = observation["lidar"][self.ahead].min()
        speed = max(np.cos(bearing), 0.0) * min(1.5, self.top[0]) * np.clip(room / SLOW - 0.2, 0.0, 1.0)
        return np.clip(np.array([speed, 2.0 * bearing]) / self.top, -1.0, 1.0)
