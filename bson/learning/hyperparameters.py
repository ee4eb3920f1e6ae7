"""What hyperparameters may be, one rule for a name whichever algorithm has it; their changes, as `KEY=VALUE`; and the
command line of a training."""

import dataclasses
import numbers
import shlex
from collections.abc import Iterable, Mapping
from typing import Any

from bson.evaluation.overrides import as_word, literal, split_pairs
from macid.documents import is_number, shown
from macid.files import UsageError

FLAG = "--hyperparameter"
MOST_LAYERS, MOST_UNITS = 16, 1 << 14
_MOST = 10**9
_NOTHING = object()
# Whole numbers: the least.
_WHOLE = {name: 1 for name in ("rollout", "piece", "batch", "batches", "epochs", "leg", "rounds", "buffer")}
_WHOLE |= {"steps_per_update": 1, "updates": 0, "burn": 0, "warmup": 0, "learning_starts": 0}
# Numbers: from, to.
_SHARES = {name: (0.0, 1.0) for name in ("gamma", "lam")}
_REAL = _SHARES | {"final_learning_rate": (0.0, 10.0), "noise": (0.0, 10.0), "log_std": (-20.0, 2.0)}
_REAL |= {"entropy": (-100.0, 100.0), "q": (1.0, 100.0)}
# Numbers: above 0, to.
_ABOVE = {name: 10.0 for name in ("learning_rate", "actor_learning_rate", "alpha", "clip")}
_ABOVE |= {"tau": 1.0, "keep": 1.0, "value_scale": 1e6}
# Fields of an algorithm that have a flag of their own.
_FLAGS = {"DaggerConfig": {"expert": "--teacher", "shield": "--shield"}}
_FLAGS |= {"BcConfig": {"demonstrations": "--demonstrations"}}


def check(config: Any, **least: int) -> None:
    """Raises ValueError, which says what is valid, where a field of an algorithm's dataclass is not. least: further
    least values of whole numbers."""
    for field in dataclasses.fields(config):
        name, value = field.name, getattr(config, field.name)
        if problem := _problem(name, field.default, value, {**_WHOLE, **least}):
            raise ValueError(f"{name} must be {problem}, not {shown(value)}.")


def _problem(name, usual, value, whole):
    """What `value` has to be; "" where it is."""
    if name == "hidden":
        fits = isinstance(value, tuple | list) and 1 <= len(value) <= MOST_LAYERS
        if not (fits and all(_is_whole(units, 1, MOST_UNITS) for units in value)):
            return f"1 to {MOST_LAYERS} whole numbers from 1 to {MOST_UNITS}, the units of the hidden layers"
    elif name in whole:
        if not _is_whole(value, whole[name], _MOST):
            return f"a whole number of at least {whole[name]}, at most {_MOST:g}"
    elif name in _REAL:
        least, most = _REAL[name]
        if not is_number(value, least, most):
            return f"a number from {least:g} to {most:g}"
    elif name in _ABOVE:
        if not (is_number(value, 0.0, _ABOVE[name]) and value > 0):
            return f"a number above 0, at most {_ABOVE[name]:g}"
    elif isinstance(usual, bool):
        if not isinstance(value, bool):
            return "True or False"
    elif isinstance(usual, str) and not (isinstance(value, str) and value):
        return "text"
    return ""


def _is_whole(value, least, most):
    return isinstance(value, numbers.Integral) and is_number(value, least, most)


def read_changes(pairs: Iterable[str]) -> dict[str, Any]:
    """`KEY=VALUE` words of the flag FLAG as a dict; values are Python literals or plain text. Raises UsageError."""
    return {key: literal(FLAG, key, text) for key, text in split_pairs(FLAG, pairs)}


def changed(config: Any, changes: Mapping[str, Any]) -> Any:
    """The algorithm's dataclass `config` with other values in some fields. Whole numbers may be written as 2e3. Raises
    UsageError, naming the valid choices."""
    if not changes:
        return config
    flags = _FLAGS.get(type(config).__name__, {})
    names = [field.name for field in dataclasses.fields(config) if field.init and field.name not in flags]
    values = {}
    for name, value in changes.items():
        if name in flags:
            raise UsageError(f"{FLAG} {name}: it has a flag of its own, {flags[name]}.")
        if name not in names:
            raise UsageError(f"Unknown hyperparameter {shown(name)}. Choose among {', '.join(names)}.")
        usual = getattr(config, name)
        if isinstance(value, float) and value.is_integer() and _is_whole(usual, -_MOST, _MOST):
            value = int(value)
        values[name] = tuple(value) if isinstance(value, list) and isinstance(usual, tuple) else value
    try:
        return dataclasses.replace(config, **values)
    except UsageError:
        raise
    except (ValueError, TypeError) as error:
        raise UsageError(f"{FLAG}: {error}") from None


def differing(config: Any, usual: Any) -> dict[str, Any]:
    """{name: value} of the fields by which `config` differs from `usual`, or that `usual` lacks; without those that
    have a flag of their own."""
    flags = _FLAGS.get(type(config).__name__, {})
    fields = [field.name for field in dataclasses.fields(config) if field.init and field.name not in flags]
    return {name: getattr(config, name) for name in fields if getattr(config, name) != getattr(usual, name, _NOTHING)}


_STEPS = 1_000_000  # that the command has without --steps, whatever a configuration's default is


def training_command(config: Any, more: Mapping[str, Any], changes: Mapping[str, Any]) -> str:
    """The `bson train` of a TrainConfig or DeviceTrainConfig, with what differs from the defaults. more: further flags,
    {name: value}; those that are None or False are left out; changes: of hyperparameters."""
    fields = ("inputs", "num_envs", "validate_every", "validate_episodes")
    own = {name: value for name in fields if (value := getattr(config, name)) != getattr(type(config), name)}
    flags = {"algo": config.algo, "inputs": own.get("inputs"), "draw": config.draw, **more, "start": config.start}
    flags |= {"seed": config.seed, "steps": None if config.steps == _STEPS else config.steps}
    flags |= {"worlds": own.get("num_envs")}
    flags |= {f"validate-{name}": own.get(f"validate_{name}") for name in ("every", "episodes")}
    words = ["bson", "train"]
    for flag, value in flags.items():
        if value is not None and value is not False:
            words += [f"--{flag}", *([] if value is True else [str(value)])]
    for flag, pairs in (("--set", config.task), (FLAG, changes)):
        for key, value in pairs.items():
            words += [flag, f"{key}={as_word(value)}"]
    return shlex.join(words)
