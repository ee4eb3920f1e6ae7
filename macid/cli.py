"""The `macid` command."""

import sys
from collections.abc import Sequence

from macid import start
from macid.command import Parser, check_words
from macid.commands import evaluation, human, training, view
from macid.running import run_command, start_mujoco


def parser() -> Parser:
    """The command's parser."""
    root = Parser(prog="macid", description="Pedestrian crowds on MuJoCo.")
    commands = root.add_subparsers(dest="command", required=True, metavar="command")
    for part in (evaluation, view, training, human):  # as the help lists them
        part.add_commands(commands)
    return root


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code. Without `argv`, it is the command of this process (see macid.start)."""
    if argv is None:
        return start.run("macid", start.macid_command)

    def command():
        check_words(argv)
        args = parser().parse_args(argv)
        args.argv = argv
        start_mujoco(draws=args.run not in view.DRAW_NOTHING)
        return args.run(args)

    return run_command("macid", command)


if __name__ == "__main__":
    sys.exit(start.macid())
