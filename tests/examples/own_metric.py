"""A metric of one's own: how long the robot stands still while somebody is near.

bson evaluate --agent vfh --suite smoke --metric own_metric.py:waiting
"""

import numpy as np


def waiting(episode):
    """time below 0.1 m/s with a person nearer than 1.2 m, surface to surface"""
    still = np.abs(episode.velocity[:, 0]) < 0.1
    return float((still & (episode.nearest_person < 1.2)).sum() * episode.period)


waiting.unit, waiting.better = "s", "down"
