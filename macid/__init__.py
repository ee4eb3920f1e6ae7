"""Pedestrian crowds on MuJoCo, each person's temper set by one number, the local coordination factor (LCF)."""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from macid.policy import load_policy

__all__ = ["load_policy"]


def __getattr__(name):
    """`load_policy`, once it is asked for: the commands begin in macid.start, before anything that takes long."""
    if name not in ("load_policy", "policy"):
        raise AttributeError(f"module 'macid' has no attribute '{name}'")
    policy = importlib.import_module("macid.policy")
    return policy if name == "policy" else policy.load_policy


def __dir__():
    return sorted([*globals(), *__all__])
