"""BSON: a benchmark for socially-aware robot navigation among pedestrians of every temper, on MuJoCo."""

from bson.env import register as _register

_register()
