"""The vector environment that `gymnasium.make_vec` makes, by its engine."""

from typing import Any

import gymnasium

from bson.interfaces.gym import BsonVectorEnv
from macid.documents import shown


def vector_env(engine: str = "native", **arguments: Any) -> gymnasium.vector.VectorEnv:
    """BsonVectorEnv; with engine="warp" bson.interfaces.vector.WarpVectorEnv. Raises ValueError for another engine,
    UsageError without MJX-Warp."""
    if engine == "native":
        return BsonVectorEnv(**arguments)
    if engine == "warp":
        from bson.interfaces.vector import WarpVectorEnv

        return WarpVectorEnv(**arguments)
    raise ValueError(f"Unknown engine {shown(engine)}. Choose 'native' or 'warp'.")
