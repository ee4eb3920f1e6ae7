"""Pedestrian crowds on MuJoCo, each person's temper set by one number, the local coordination factor (LCF)."""

from macid.policy import load_policy

__all__ = ["load_policy"]
