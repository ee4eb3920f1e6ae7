"""Pedestrian crowds on MuJoCo, each person's temper set by one number, the local coordination factor (LCF)."""

TYPE_CHECKING = False  # as typing's, which takes longer to import than all the rest of this file
if TYPE_CHECKING:
    from macid.policy import load_policy

__all__ = ["load_policy"]


def __getattr__(name):
    """`load_policy`, once it is asked for: the commands begin in macid.start, before anything that takes long."""
    if name not in ("load_policy", "policy"):
        raise AttributeError(f"module 'macid' has no attribute '{name}'")
    from importlib import import_module

    policy = import_module("macid.policy")
    return policy if name == "policy" else policy.load_policy


def __dir__():
    return sorted([*globals(), *__all__])
