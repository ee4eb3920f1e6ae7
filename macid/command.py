"""Command lines: their words and numbers are checked here, once for all commands and tools, before any work begins."""

import argparse
import math
import re
from collections.abc import Iterable
from typing import Any, NoReturn

from macid.executors import EXECUTORS, MOST_WORKERS
from macid.files import UsageError, one_line

MOST_WORLDS = 65_536  # at once
MOST_PEOPLE = 10_000
MOST_SEEDS = 1024  # of a training
MOST_SEED = 2**63 - 1
MOST_TRAINING_SEED = 2**32 - 1  # beyond it, generators of random numbers take the remainder or refuse
MOST_STEPS = 1e12
MOST_PERIOD = 3600.0  # [s]
_NEGATIVE = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$|^-(inf|nan)$")
_NAME = 1000  # characters of an agent's name, a file's
_WORD = 100_000  # of any word: an LCF for each of 2,000 people fits


class HelpFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Help with the defaults that tell something."""

    def _get_help_string(self, action):
        if action.default in (None, False) or "(default" in (action.help or ""):
            return action.help
        return super()._get_help_string(action)


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, and whose numbers have bounds."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = _NEGATIVE  # argparse takes -1e-3 and -inf for flags
        self._bounds = {}

    def number(
        self,
        flag: str,
        kind: type[int] | type[float],
        least: float,
        most: float,
        above: bool = False,
        also: str = "",
        **more: Any,
    ) -> argparse.Action:
        """Adds the flag `flag`: a number of `kind`, int or float, or several, from `least` to `most`. above: whether
        `least` itself is excluded. also: what messages add to the bounds."""
        action = self.add_argument(flag, type=kind, **more)
        self._bounds[action.dest] = flag, least, most, above, also
        return action

    def parse_known_args(self, *args: Any, **kwargs: Any) -> tuple[Any, list[str]]:
        """As argparse's; raises UsageError for a number out of bounds."""
        found, rest = super().parse_known_args(*args, **kwargs)
        for name, (flag, *bounds) in self._bounds.items():
            value = getattr(found, name)
            for one in value if isinstance(value, list) else [value]:
                if one is not None:
                    _check(flag, one, *bounds)
        return found, rest

    def error(self, message: str) -> NoReturn:
        """One line, and exit code 2."""
        self.exit(2, f"{one_line(f'{self.prog}: error: {message} (help: {self.prog} --help)')}\n")


def _check(flag, value, least, most, above, also):
    if least < value <= most or (value == least and not above):
        return
    if not math.isfinite(value):
        problem = f"a number from {_told(least)} to {_told(most)}"
    elif value > most:
        problem = f"at most {_told(most)}"
    else:
        problem = f"above {_told(least)}" if above else f"at least {_told(least)}"
    raise UsageError(f"{flag} must be {problem}{also}, not {_told(value)}.")


def _told(number):
    return f"{number:g}" if isinstance(number, float) else str(number)


PERIOD = {"least": 0.0, "most": MOST_PERIOD, "above": True, "also": " and a multiple of the physics step, 0.02 s"}


def check_words(words: Iterable[str]) -> None:
    """Refuses words of a command line that can't be a name, a path or a value. Raises UsageError."""
    for word in words:
        try:
            word.encode()
        except UnicodeEncodeError:
            raise UsageError(f"{word[:_NAME]!a} is not UTF-8, as names, paths and values are.") from None
        if "\0" in word:
            raise UsageError(f"{word[:_NAME]!a} has a null character.")
        if len(word) > _WORD:
            raise UsageError(f"A word of the command line has {len(word):,} characters; at most {_WORD:,} are read.")


def name(text: str) -> str:
    """A name or a path on a command line, for argparse."""
    if not text or len(text) > _NAME:
        raise argparse.ArgumentTypeError(f"a name has 1 to {_NAME} characters, not {len(text):,}")
    return text


def add_executor(command: Parser) -> None:
    """Adds the flags of macid.executors.make_executor to a Parser."""
    command.add_argument(
        "--executor",
        default="local",
        choices=EXECUTORS,
        help="where the work is done; ray: by workers on this machine's cores, or on a cluster's (extra `ray`)",
    )
    command.add_argument(
        "--ray-address",
        type=name,
        default=None,
        metavar="HOST:PORT",
        help="of the Ray cluster of which this machine is; auto: as ray start noted it (default: this machine alone)",
    )
    command.number(
        "--workers", int, 1, MOST_WORKERS, help="with --executor ray: how many at once (default: one a core)"
    )


def add_address(command: Parser) -> None:
    """Adds the flags of a live page's server (macid.live.server.Server) to a Parser."""
    command.add_argument(
        "--host", type=name, default="127.0.0.1", help="where to listen; another machine's browser needs --token"
    )
    command.number("--port", int, 0, 65_535, default=8080, help="0: any free one")
    command.add_argument(
        "--token", type=name, default=None, help="a word that a browser must bring, of at least 8 characters"
    )
    command.add_argument("--stay", action="store_true", help="go on listening when the last page has been closed")
