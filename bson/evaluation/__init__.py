"""Evaluations: agents play many episodes, in this process or elsewhere, and are scored."""
