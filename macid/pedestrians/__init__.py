"""Pedestrian models behind one call: `controller(state, boxes, goals, lcf) -> command`.

state: CrowdState (..., K); boxes: (..., B, 5) rows of `geometry.BOX_COLUMNS`; goals: (..., K, 2) [m]; lcf: (..., K).
command: (..., K, 3), world-frame velocity [m/s] and yaw rate [rad/s], for the controller's `period` [s].
"""

import functools

from macid.pedestrians.orca import ORCA
from macid.pedestrians.social_force import SocialForce
from macid.state import RADIUS

MODELS = {
    "social-force": SocialForce,
    "social-force-bodies": functools.partial(SocialForce, body_radius=RADIUS),
    "orca": ORCA,
}


def make_controller(name, period):
    """The pedestrian model `name`, deciding every `period` [s]. Raises ValueError for an unknown name."""
    if name not in MODELS:
        raise ValueError(f"Unknown pedestrian model '{name}'. Choose one of {', '.join(sorted(MODELS))}.")
    return MODELS[name](period=period)
