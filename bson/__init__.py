"""BSON: a benchmark for socially-aware robot navigation among pedestrians of every temper, on MuJoCo."""

import gymnasium as _gymnasium

from macid import forks as _forks  # noqa: F401  (it notes what a process forked from here on has lost)

ENVIRONMENTS = {  # id: the track and the sensor (bson.episodes.tracks)
    f"BSON/{track.capitalize()}{name}-v0": {"track": track, "sensor": name.lower()}
    for track in ("local", "global")
    for name in ("Lidar2D", "Lidar3D", "Camera")
}

for _id, _kwargs in ENVIRONMENTS.items():  # by name, so that MuJoCo and JAX are loaded only when an environment is made
    _gymnasium.register(
        _id, "bson.interfaces.gym:BsonEnv", vector_entry_point="bson.interfaces.by_engine:vector_env", kwargs=_kwargs
    )
