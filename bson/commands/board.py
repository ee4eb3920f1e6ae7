"""What a board is made of: `bson compare`, `bson leaderboard`, `bson verify`."""

import contextlib
import os
import pathlib
import sys
from typing import Any

from bson.commands.flags import add_passphrase, read_passphrase
from macid.command import MOST_SEED, name
from macid.documents import shown
from macid.files import UsageError, check_file


def _compare(args):
    from bson import benchmark
    from bson.reporting.compare import format_comparison

    print(format_comparison(benchmark.compare([_column(word) for word in args.results], args.out)))
    out = pathlib.Path(args.out)
    print(f"Written: {out / 'compare.json'}, {out / 'compare.html'}")
    return 0


def _column(word):
    """What a word of `bson compare` names: a results file or folder, as it is, or the Group NAME=A,B,... of several.
    Raises UsageError."""
    from bson.evaluation.results import Results
    from bson.reporting.compare import Group

    called, equals, sources = word.partition("=")
    if not equals or os.path.lexists(word):
        return word
    if not called or not called.isprintable() or "" in sources.split(","):
        raise UsageError(f"A group of trainings is NAME=RESULTS,RESULTS,..., not {shown(word)}.")
    return Group(tuple(Results.load(source) for source in sources.split(",")), called)


def _leaderboard(args):
    from bson import benchmark

    if args.all and not args.out:
        raise UsageError("--all is of the page that --out writes; the table on its own has all results anyhow.")
    lines, out = [], args.out and pathlib.Path(args.out)
    print(benchmark.leaderboard(args.results, args.readme, out=out, everything=args.all, told=lines.append))
    written = [out / "board.json", out / "board.html"] if out else []
    if args.readme:
        written.append(args.readme)
    if written:
        lines.append(f"Written: {', '.join(map(str, written))}")
    for line in lines:
        print(line, file=sys.stderr)
    return 0


def _verify(args):
    from bson.evaluation.results import Results
    from bson.evaluation.verify import format_verification, record_path, verify, write_record

    suite = args.suite or Results.load(args.results).suite
    out = check_file(args.out or record_path(args.results), "file for --out")
    record = verify(
        args.results,
        agent=args.agent,
        suite=args.suite,
        passphrase=read_passphrase(args, suite),
        track=args.track,
        sensor=args.sensor,
        metrics=args.metric,
        share=args.share,
        draw=args.seed,
        watch=_watch,
    )
    write_record(out, record)
    print(format_verification(record))
    print(f"Written: {out}")
    return 0 if record.equal else 1


@contextlib.contextmanager
def _watch(cell, without_robot, total, done):
    """A progress bar on stderr, for the argument `watch` of `verify`."""
    from tqdm import tqdm

    told = f"{cell}{', without the robot' if without_robot else ''}"
    with tqdm(total=total, initial=done, unit="episode", desc=told, file=sys.stderr, delay=0.5) as bar:
        yield lambda steps, ended: bar.update(ended)


_RESULTS = "folders that bson evaluate wrote, or their results.json"


def add_commands(commands: Any, defaults: dict[str, Any]) -> None:
    """Adds the commands to `commands`, argparse's subparsers; `defaults`: what each is made with."""
    compare = commands.add_parser(
        "compare", help="results beside each other, with paired differences from the first", **defaults
    )
    compare.add_argument(
        "results",
        type=name,
        nargs="+",
        help=f"{_RESULTS}; NAME=A,B,C for those of several trainings of one agent, with intervals over training seeds",
    )
    compare.add_argument("--out", type=name, default="comparison", help="folder for compare.json and compare.html")
    compare.set_defaults(run=_compare)

    leaderboard = commands.add_parser("leaderboard", help="results as a Markdown table, sorted by SNS", **defaults)
    leaderboard.add_argument("results", type=name, nargs="+", help=_RESULTS)
    leaderboard.add_argument(
        "--readme",
        type=name,
        default=None,
        help="also put it into this file, between <!-- leaderboard --> and <!-- /leaderboard -->",
    )
    leaderboard.add_argument(
        "--out",
        type=name,
        default=None,
        help="folder for board.json and board.html: the rows and the page of the results that bson verify found equal",
    )
    leaderboard.add_argument("--all", action="store_true", help="with --out: also those that were not verified, marked")
    leaderboard.set_defaults(run=_leaderboard)

    verify = commands.add_parser(
        "verify",
        help="play a random share of a results file's episodes again, and tell whether all is equal",
        **defaults,
    )
    verify.add_argument("results", type=name, help="a folder that bson evaluate wrote, or its results.json")
    verify.add_argument(
        "--agent",
        type=name,
        default=None,
        help="your own: policy.npz, module:function, or file.py (default: as named there)",
    )
    verify.number("--share", float, 0.0, 1.0, above=True, default=0.1, help="of the episodes; at least one is played")
    verify.number("--seed", int, 0, MOST_SEED, default=None, help="of the draw (default: one that nobody can foresee)")
    verify.add_argument("--suite", type=name, default=None, help="its .toml, where it is your own")
    add_passphrase(verify)
    verify.add_argument("--track", type=name, default=None, help="where it is your own")
    verify.add_argument("--sensor", type=name, default=None, help="where they are your own")
    verify.add_argument(
        "--metric", type=name, action="append", default=[], help="a metric of your own in the results; may be repeated"
    )
    verify.add_argument(
        "--out", type=name, default=None, help="the record (default: results.verification.json beside the results)"
    )
    verify.set_defaults(run=_verify)


DRAW_NOTHING = (_compare, _leaderboard)  # commands that need no OpenGL
