"""The last metres before the goal: an episode ends with the first control step that ends within GOAL_RADIUS of the
goal, and route completion (RC) counts what is left of the way. A robot gets nearest to the goal if the step before
the last one ends just outside of that circle, and the last one leads in at full speed."""

import math

import numpy as np

from bson.agents.contract import Setting
from macid.state import GOAL_RADIUS

_SLACK = 0.015  # between the circle and where the last step is to begin [m]
_STEPS = 8  # at most so many control steps before the last one are driven slower
_LEAST = 0.6  # of the speed that the agent wants
_STRAIGHT = 0.3  # off the goal's direction by more than this the robot doesn't drive in [rad]
_OVER = 0.1  # of a step's way: beginning the last step so much farther outside is no worse than driving slower


def well_in(action: np.ndarray, goal: np.ndarray, speed: float, setting: Setting) -> np.ndarray:
    """The `action` (2,) that an agent wants, driven slower where the robot's last step then leads farther into the
    goal's circle; goal: (2,) its place, robot frame [m]; speed: the robot's present one [m/s].

    Only who drives straight to the goal is slowed down, over some last steps, by a few percent each as a rule and
    never below 0.6 of the speed wanted. The speed is taken to change evenly over a control step. A step that is longer
    than the circle's radius is to end in its middle.
    """
    period, wanted = setting.control_period, float(action[0]) * float(setting.top[0])
    distance = math.hypot(*goal)
    outside = min(distance - GOAL_RADIUS - _SLACK, distance - wanted * period)
    if wanted <= 0.0 or outside <= 0.0 or abs(math.atan2(goal[1], goal[0])) > _STRAIGHT:
        return action
    steps = math.ceil(outside / (wanted * period) - _OVER)
    if not 1 <= steps <= _STEPS:
        return action
    share = (outside / period - 0.5 * speed) / (steps - 0.5) / wanted
    return np.array([min(share, 1.0) * action[0], action[1]]) if share >= _LEAST else action
