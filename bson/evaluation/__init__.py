"""Evaluations: agents on many episodes, wherever these are played."""
