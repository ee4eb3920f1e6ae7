"""Pedestrian models behind one call: `controller(state, boxes, goals, lcf) -> command`.

state: CrowdState (..., K); boxes: (..., B, 5) rows of `geometry.BOX_COLUMNS`; goals: (..., K, 2) [m]; lcf: (..., K).
command: (..., K, 3), world-frame velocity [m/s] and yaw rate [rad/s], for the controller's `period` [s].
"""

import functools

from macid.pedestrians.learned import Learned
from macid.pedestrians.orca import ORCA
from macid.pedestrians.social_force import SocialForce
from macid.pedestrians.standing import Standing
from macid.policy import load_policy, policy_names
from macid.state import RADIUS

MODELS = {
    "social-force": SocialForce,
    "social-force-progress": functools.partial(SocialForce, step_by_progress=True),
    "social-force-bodies": functools.partial(SocialForce, step_by_progress=True, body_radius=RADIUS),
    "orca": ORCA,
    "standing": Standing,
}


def model_names():
    """The names that `make_controller` takes: rules, and the methods that shipped policies were trained by; sorted.

    A method's name stands for its policy of the first seed; `name-SEED` is the policy of another seed.
    """
    return sorted([*MODELS, *{name.rpartition("-")[0] for name in policy_names()}])


def make_controller(name, period):
    """The pedestrian model `name`, deciding every `period` [s]: a rule, a shipped policy ("macid", "macid-2"), or a
    policy file (.npz). Raises ValueError for an unknown name."""
    if name in MODELS:
        return MODELS[name](period=period)
    if name.endswith(".npz") or name in policy_names() or name in model_names():
        return Learned(load_policy(name), period)
    raise ValueError(f"Unknown pedestrian model '{name}'. Choose one of {', '.join(model_names())}, or a .npz file.")
