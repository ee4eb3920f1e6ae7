"""The `bson` command."""

import sys
from collections.abc import Sequence
from typing import Any

from bson.commands import bench, board, data, evaluation, ros, training, view
from macid import start
from macid.command import HelpFormatter, Parser, check_words
from macid.running import run_command, start_mujoco


def _doctor(args):
    from bson import doctor

    return 0 if doctor.run() else 1


def _list(args):
    from bson import ENVIRONMENTS
    from bson.evaluation.suites import HELD_OUT, load_suite, suite_names
    from bson.registry import KINDS, kind

    print("environments  " + ", ".join(ENVIRONMENTS))
    for what, (_, given) in KINDS.items():
        try:
            found = kind(what)
        except ModuleNotFoundError as error:
            print(f"{what:<13} need {error.name}: pip install 'bson-macid[agents]'")
            continue
        print(f"{what:<13} {', '.join(found.names())}{found.forms and f', or {found.forms}'} ({given})")
    for suite in map(load_suite, suite_names()):
        count = f"{len(suite.cells)} cells x {len(suite.seeds)}" if len(suite.cells) > 1 else f"{len(suite.seeds)}"
        print(f"suite         {suite.name}: {suite.description} ({count} seeds)")
    print(f"suite         {HELD_OUT}: cells of standard, seeds that follow from a passphrase (--passphrase-file)")
    return 0


def parser() -> Parser:
    """The command's parser."""
    defaults: dict[str, Any] = {"formatter_class": HelpFormatter}
    root = Parser(prog="bson", description="A benchmark for robots that drive among people.")
    commands = root.add_subparsers(dest="command", required=True, metavar="command")
    for part in (evaluation, board, view, ros, data, training, bench):  # as the help lists them
        part.add_commands(commands, defaults)
    commands.add_parser("doctor", help="check this installation").set_defaults(run=_doctor)
    commands.add_parser("list", help="environments, agents, pedestrians, suites").set_defaults(run=_list)
    return root


_DRAW_NOTHING = (*board.DRAW_NOTHING, *ros.DRAW_NOTHING, *data.DRAW_NOTHING, _doctor, _list)


def main(argv: Sequence[str] | None = None) -> int | str | None:
    """Entry point; returns the exit code. Without `argv`, it runs the command line of this process (see
    macid.start)."""
    if argv is None:
        return start.run("bson", start.bson_command)

    def command():
        check_words(argv)
        args = parser().parse_args(argv)
        args.argv = argv
        start_mujoco(draws=args.run not in _DRAW_NOTHING)
        return args.run(args)

    return run_command("bson", command)


if __name__ == "__main__":
    sys.exit(start.bson())
