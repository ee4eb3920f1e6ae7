"""Flags that several commands have, and what they say."""

import argparse
import sys
from collections.abc import Callable
from typing import Any

from macid import engines
from macid.command import Parser
from macid.files import UsageError
from macid.state import MAX_SPEED, RADII, RADIUS, TOP_SPEED

MODELS = "a rule, a shipped policy, or a policy file (.npz)"
_ENGINE = "native (CPU), mjx or warp (GPU), with options as in warp:contacts=4 (default: the best there is; it is told)"
PRESETS = ["fast", "gpu", "human", "paper", "paper-batch", "paper-ppo"]
ROLLOUT = {"kind": int, "least": 1, "most": 1_000_000}


def _engine(text):
    """The name of an engine, for argparse."""
    try:
        return engines.engine_name(text)
    except UsageError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def add_engine(command: Parser) -> None:
    """Adds the flag --engine (see chosen_engine)."""
    command.add_argument("--engine", type=_engine, default=None, help=_ENGINE)


def chosen_engine(args: Any) -> tuple[str, str | None]:
    """(the engine to use, what to tell of it on stderr); --engine, else the best there is."""
    if args.engine:
        engines.engine_kind(args.engine)
        return args.engine, None
    engine, why = engines.best_engine()
    return engine, f"engine {engine}: {why}"


def after(note: str | None, show: Callable[[str], object]) -> Callable[[str], None]:
    """`show`, before whose first line `note` is told on stderr: what is refused before work begins is one line."""
    notes = [note] if note else []

    def tell(line):
        while notes:
            say(notes.pop())
        show(line)

    return tell


def say(line: str) -> None:
    """Tells a line on stderr, at once."""
    print(line, file=sys.stderr, flush=True)


def read_preferred_speed(text: str) -> Any:
    """A preferred speed, for argparse: a number, LO:HI, or human."""
    from macid.traits import check_preferred_speed

    try:
        parts = [float(part) for part in text.split(":")]
    except ValueError:
        parts = [text]
    try:
        return check_preferred_speed(parts[0] if len(parts) == 1 else tuple(parts))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def add_people(command: Parser) -> None:
    """Adds the flags that say what people are like."""
    command.number("--radius", float, *RADII, default=RADIUS, help="of people [m]")
    command.add_argument(
        "--preferred-speed",
        type=read_preferred_speed,
        help="at which people want to walk [m/s]: a number, LO:HI, or human (default: each model's own)",
    )
    command.number("--max-speed", float, 0.1, TOP_SPEED, default=MAX_SPEED, help="of people [m/s]")
    command.number("--companions", float, 0.0, 1.0, help="share of people who walk in twos and threes (default: none)")


def read_level(text: str) -> int | str:
    """A level, for argparse: its number, or its name."""
    return int(text) if text.isdecimal() else text
