"""The engines that simulate a crowd, behind one call: `make_engine(name, model, number, boxes, nworld)`.

| name | what | for |
|---|---|---|
| `native` | MuJoCo's threaded batch simulator, reached from jitted code by a callback | CPUs |
| `mjx` | MuJoCo in JAX | any device of JAX's, several at once |
| `warp` | MuJoCo Warp's kernels, the extra `warp` | NVIDIA GPUs; a CPU for tests, slowly |

Each is functional, `step(state, command) -> state`, can sit in a jitted `lax.scan`, and is read as the same
`CrowdState` (`macid.engines.base.Engine`). Callers never ask which engine runs: an engine says what it can do. An
engine's options follow its name: `warp:contacts=4,solver=cg` (`macid.engines.warp.WarpOptions`).

A new engine is a file in this folder and a line in ENGINES.
"""

import dataclasses
import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

from macid.files import UsageError

if TYPE_CHECKING:
    from macid.engines.base import Engine

ENGINES = {
    "native": "macid.engines.native:NativeEngine",
    "mjx": "macid.engines.mjx:MjxEngine",
    "warp": "macid.engines.warp:WarpEngine",
}
WARP_PACKAGE = "warp-lang==1.18.0"  # the version for mujoco-mjx 3.17.0


def engine_name(text: str) -> str:
    """`text`, the name of an engine with or without options, if there is such an engine. Raises UsageError, naming the
    valid ones."""
    name = text.partition(":")[0]
    if name not in ENGINES:
        raise UsageError(f"Unknown engine '{name}'. Choose one of {', '.join(ENGINES)}.")
    return text


def has_warp() -> bool:
    """Whether the package that the engine `warp` needs is installed."""
    return importlib.util.find_spec("warp") is not None


def best_engine() -> tuple[str, str]:
    """The fastest engine on JAX's default device, and the reason, in a clause."""
    import jax

    device = jax.devices()[0]
    if device.platform == "cpu":
        return "native", "JAX has no GPU here"
    if device.platform != "gpu":
        return "mjx", f"JAX has a device of the kind {device.platform}"
    if not has_warp():
        return "mjx", f"JAX has a GPU, {device.device_kind}; 'warp' is faster: pip install {WARP_PACKAGE}"
    return "warp", f"JAX has a GPU, {device.device_kind}"


def engine_kind(text: str) -> tuple[Any, Any]:
    """(the class, its options) of the engine `text`, as for `make_engine`. Raises UsageError as `make_engine` does."""
    name, _, options = engine_name(text).partition(":")
    module, _, attribute = ENGINES[name].partition(":")
    if name == "warp" and not has_warp():
        raise UsageError(f"The engine 'warp' needs the package warp-lang: pip install {WARP_PACKAGE} (extra 'warp').")
    kind = getattr(importlib.import_module(module), attribute)
    return kind, read_options(name, kind.options, options)


def make_engine(text: str, model: Any, number: int, boxes: Any, nworld: int) -> "Engine":
    """The engine `text`, a name of ENGINES with or without options, for `nworld` worlds of `model` (mujoco.MjModel, see
    `macid.scene.crowd_spec`), whose crowd has `number` people among `boxes` (B, 5).

    Raises UsageError for an unknown engine or option, and where the engine's package is not installed.
    """
    kind, options = engine_kind(text)
    return kind(model, number, boxes, nworld, options)


def read_options(name: str, kind: Any, text: str) -> Any:
    """The dataclass `kind` of the engine `name`, with the fields that `text`, FIELD=VALUE,..., gives. Raises
    UsageError."""
    fields = {field.name: type(field.default) for field in dataclasses.fields(kind)}
    given = {}
    for part in filter(None, text.split(",")):
        field, _, value = part.partition("=")
        if field not in fields:
            choices = f"Choose one of {', '.join(fields)}." if fields else "It has none."
            raise UsageError(f"The engine '{name}' has no option '{field}'. {choices}")
        try:
            given[field] = fields[field](int(value) if fields[field] is bool else value)
        except ValueError:
            raise UsageError(
                f"The engine's option {field} must be of its default's kind, {getattr(kind(), field)}, not '{value}'."
            ) from None
    try:
        return kind(**given)
    except ValueError as error:
        raise UsageError(f"The engine '{name}': {error}") from None
