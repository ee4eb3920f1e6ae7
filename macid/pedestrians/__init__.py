"""Pedestrian models behind one call: `controller(state, boxes, goals, lcf) -> command`.

state: CrowdState (..., K); boxes: (..., B, 5) rows of `geometry.BOX_COLUMNS`; goals: (..., K, 2) [m]; lcf: (..., K).
command: (..., K, 3), world-frame velocity [m/s] and yaw rate [rad/s], for the controller's `period` [s].

Names and files are checked without JAX, which the models are made of and which takes long to load.
"""

import importlib

from macid.policy import load_policy, policy_names
from macid.state import RADIUS


def _rule(name, **options):
    """Makes the rule `module:class` of this package, deciding every `period` [s]."""

    def make(period):
        module, _, kind = name.partition(":")
        return getattr(importlib.import_module(f"macid.pedestrians.{module}"), kind)(period=period, **options)

    return make


MODELS = {
    "social-force": _rule("social_force:SocialForce"),
    "social-force-progress": _rule("social_force:SocialForce", step_by_progress=True),
    "social-force-bodies": _rule("social_force:SocialForce", step_by_progress=True, body_radius=RADIUS),
    "orca": _rule("orca:ORCA"),
    "standing": _rule("standing:Standing"),
}


def model_names() -> list[str]:
    """The names that `make_controller` takes: rules, and the methods that shipped policies were trained by; sorted.

    A method's name stands for its first seed; `name-SEED` is another of its policies.
    """
    return sorted([*MODELS, *{name.rpartition("-")[0] for name in policy_names()}])


def _policy(name):
    """The Policy that moves the model `name`, None for a rule. Raises ValueError for an unknown name."""
    if name in MODELS:
        return None
    if name.endswith(".npz") or name in policy_names() or name in model_names():
        return load_policy(name)
    raise ValueError(f"Unknown pedestrian model '{name}'. Choose one of {', '.join(model_names())}, or a .npz file.")


def check_model(name: str) -> None:
    """Raises ValueError unless `make_controller` can make the pedestrian model `name`."""
    _policy(name)


def make_controller(name: str, period: float):
    """The pedestrian model `name`, deciding every `period` [s]: a rule, a shipped policy ("macid", "macid-2"), or a
    policy file (.npz). Raises ValueError for an unknown name."""
    if (policy := _policy(name)) is None:
        return MODELS[name](period=period)
    from macid.pedestrians.learned import Learned

    return Learned(policy, period)
