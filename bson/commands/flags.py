"""Flags that several commands have, and what they say."""

import argparse
import os
import shlex
from collections.abc import Sequence
from typing import Any

from macid.command import Parser, name
from macid.documents import read_bytes, shown_path
from macid.files import UsageError

_MOST_PASSPHRASE = 1 << 12  # bytes of its file


def add_setting(command: Parser, agent: str | None = "vfh", more: str = "") -> None:
    """Adds the flags of an agent and of what it drives in. agent: the default; more: the end of its help."""
    command.add_argument(
        "--agent", type=name, default=agent, help=f"a name (bson list), module:function, or file.py[:function]{more}"
    )
    command.add_argument("--track", type=name, default=None, help="local or global (default: what the agent wants)")
    command.add_argument("--sensor", type=name, default=None, help="lidar2d, ... (default: what the agent wants)")
    add_untrained(command)
    add_task(command)


def add_untrained(command: Parser) -> None:
    """Adds the flag that lets a policy try what it was not trained for."""
    command.add_argument(
        "--untrained-setting",
        action="store_true",
        help="let a trained policy try with another robot, control period or LIDAR than it was trained with",
    )


def add_task(command: Parser) -> None:
    """Adds the flag --set, which changes the task (see overrides)."""
    command.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change a field of the task, e.g. pedestrian_model=orca; may be repeated",
    )


def overrides(args: Any) -> dict[str, Any]:
    """What the flag --set changes of the task."""
    from bson.evaluation.overrides import read_overrides

    return read_overrides(args.set)


def _engine(text):
    """The engine of a robot's worlds, for argparse."""
    from bson.simulation.engines import engine_name

    try:
        engine_name(text)
    except UsageError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def add_engine(command: Parser, of_warp: str) -> None:
    """Adds the flag --engine, a name with or without options, as bson.simulation.engines has them. of_warp: what warp
    does in this command."""
    command.add_argument(
        "--engine",
        type=_engine,
        default="native",
        help=f"native, or warp, MJX-Warp on a GPU if there is one: {of_warp}; with options as in warp:contacts=32",
    )


def add_wire(command: Parser) -> None:
    """Adds the flags of messages that are sent and awaited."""
    command.add_argument("--twist", action="store_true", help="commands as Twist, not as TwistStamped")
    command.number(
        "--timeout",
        float,
        0.0,
        3600.0,
        above=True,
        default=10.0,
        help="with ROS 2: how long a message may stay out [s]",
    )


def add_pace(command: Parser) -> None:
    """Adds the flag by which the world does not wait for a command."""
    command.add_argument(
        "--real-time", action="store_true", help="with --agent ros: a control step each period, not in lockstep"
    )


def add_passphrase(command: Parser) -> None:
    """Adds the flag of the passphrase of the suite `held-out`."""
    command.add_argument(
        "--passphrase-file",
        type=name,
        default=None,
        metavar="FILE",
        help="of the suite held-out: a file with the passphrase on one line (or the variable BSON_PASSPHRASE)",
    )


def read_passphrase(args: Any, suite: str | None = None) -> str | None:
    """The passphrase of the suite `suite` (default: that of the flag --suite): from the file of the flag, or, of
    `held-out`, from the environment; None without either. Raises UsageError."""
    from bson.evaluation.suites import HELD_OUT, PASSPHRASE_VARIABLE

    if (path := args.passphrase_file) is None:
        return os.environ.get(PASSPHRASE_VARIABLE) if (suite or args.suite) == HELD_OUT else None
    try:
        return read_bytes(path, "passphrase", _MOST_PASSPHRASE).decode().rstrip("\r\n")
    except UnicodeDecodeError:
        raise UsageError(f"The passphrase file {shown_path(path)} is no text in UTF-8.") from None


_PLACE = ("--resume",)  # flags that don't change results: without a value here, with one below
_PLACE_WITH = ("--executor", "--ray-address", "--workers")


def command_line(argv: Sequence[str]) -> str:
    """The command line without the flags that don't change results."""
    kept, skip = [], False
    for word in argv:
        if not skip and word not in _PLACE and word.partition("=")[0] not in _PLACE_WITH:
            kept.append(word)
        skip = not skip and word in _PLACE_WITH
    return "bson " + shlex.join(kept)
