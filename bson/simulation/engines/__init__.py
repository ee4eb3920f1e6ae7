"""The engines, which compute physics, rays and pictures of many worlds: one file for each engine, all with the
interface `base.Engine`."""

from typing import Any

from macid.engines import read_options
from macid.files import UsageError

NAMES = ("native", "warp")


def engine_name(text: str) -> str:
    """The name of the engine `text`, a name of NAMES with or without options, as in `warp:contacts=32`. Raises
    UsageError, naming the valid ones."""
    name = text.partition(":")[0] if isinstance(text, str) else text
    if name not in NAMES:
        raise UsageError(f"Unknown engine {text!r}. Choose 'native' or 'warp'.")
    return name


def engine_limits(text: str) -> Any:
    """The options of the engine `text` as a WarpConfig; for native, which has none, as macid.engines.base.NO_OPTIONS.
    Raises UsageError, naming the valid ones."""
    from macid.engines.base import NoOptions

    name, options = engine_name(text), text.partition(":")[2]
    if name == "native":
        return read_options(name, NoOptions, options)
    from bson.simulation.engines.warp import WarpConfig

    return read_options(name, WarpConfig, options)
