"""Puts results into the shipped leaderboard: a row for each, in place of the earlier row of its agent and suite.

    bson evaluate --agent mine.py --suite dense --out scored/mine-dense
    tools/add_rows.py scored/mine-dense scored/...

Writes assets/results/leaderboard.md, with ranks anew. Results are of all of a suite's own episodes under its own
settings, by the native engine. tools/headroom.py and tools/make_pages.py take the same results (--runs).
"""

import pathlib
import re
import sys

from headroom import check_whole

from bson.evaluation.results import Results
from bson.evaluation.suites import load_suite
from bson.reporting.leaderboard import leaderboard
from macid import command
from macid.command import Parser, check_words
from macid.files import UsageError, write_bytes
from macid.running import run_command

BOARD = pathlib.Path(__file__).parents[1] / "assets" / "results" / "leaderboard.md"
ROWS = 2  # lines of a table before its rows


def named(row):
    """The agent of a table's row."""
    return re.search("`([^`]+)`", row)[1]


def merged(table, row):
    """The lines of a table with `row` in place of its agent's, the best SNS first, ranked."""
    rows = [one for one in table[ROWS:] if named(one) != named(row)] + [row]
    rows.sort(key=lambda one: -float(one.split(" | ")[3].split()[0]))
    return table[:ROWS] + [re.sub(r"^\| \d+ ", f"| {rank} ", one) for rank, one in enumerate(rows, start=1)]


def add(text, run):
    """The leaderboard `text` with the row of the Results `run`. Raises UsageError where it has no such suite."""
    blocks = text.rstrip("\n").split("\n\n")  # a table, its caption, a table, ...
    new = leaderboard([run]).split("\n\n")[0].splitlines()
    for index in range(0, len(blocks), 2):
        if blocks[index + 1].startswith(f"Suite `{run.suite}`"):
            table = merged(blocks[index].splitlines(), new[ROWS])
            blocks[index] = "\n".join(table)
            if not any("(1)" in one for one in table):
                told = [line for line in blocks[index + 1].splitlines() if not line.startswith("(1)")]
                blocks[index + 1] = "\n".join(told)
            return "\n\n".join(blocks) + "\n"
    raise UsageError(f"The leaderboard has no table of the suite '{run.suite}'.")


def run(args):
    """Writes the leaderboard; returns the exit code."""
    text = BOARD.read_text()
    for source in args.results:
        one = Results.load(source)
        check_whole(one, load_suite(one.suite))
        text = add(text, one)
    write_bytes(BOARD, text.encode())
    return 0


def main():
    """Entry point."""
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("results", type=command.name, nargs="+", metavar="FOLDER")

    def read_and_run():
        check_words(sys.argv[1:])
        return run(parser.parse_args())

    return run_command("add_rows", read_and_run)


if __name__ == "__main__":
    sys.exit(main())
