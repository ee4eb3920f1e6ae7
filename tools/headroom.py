"""The head-room of suites: the most that the metric has, and where agents stand between this and doing nothing.

    tools/headroom.py [--suites paper standard ...] [--runs RESULTS ...]

Writes assets/results/headroom.json, from which tools/make_pages.py makes headroom.md. The most follows from the suites'
maps (bson.evaluation.headroom): nothing is played. What agents score is taken from `--runs`, results that `bson
evaluate` wrote, each on a suite's own episodes, in place of earlier figures of the agent there. A suite whose digest
changed loses its earlier figures.
"""

import argparse
import math
import sys

import make_pages as pages

from bson.evaluation.headroom import most_of
from bson.evaluation.results import Results
from bson.evaluation.suites import load_suite, suite_names
from macid import command
from macid.command import Parser, check_words
from macid.files import UsageError, write_bytes
from macid.running import run_command

DIGITS = 4


def rounded(values):
    """{name: number} with few digits."""
    return {name: round(value, DIGITS if name == "SNS" else DIGITS + 1) for name, value in values.items()}


def check_whole(run, suite):
    """Raises UsageError for Results `run` on other episodes than the suite's, or in other settings."""
    content, episodes = run.content, sum(map(len, suite.of_cells()))
    if content.get("suite_digest") != suite.digest or len(run.rows) + len(content.get("faults", [])) != episodes:
        raise UsageError(f"'{run.source}' is not of all {episodes} episodes of today's suite '{suite.name}'.")
    if content.get("overrides") or not content.get("frozen_seeds", True):
        raise UsageError(f"'{run.source}' is of other settings or seeds than those of the suite '{suite.name}'.")


def standing(run, suite):
    """What the Results `run` tell of an agent on a suite: its SNS with the interval, and that of each cell. Raises
    UsageError as check_whole."""
    check_whole(run, suite)
    low, high = run.intervals["SNS"]
    cells = dict(zip(run.cells, run.cell_means("SNS"), strict=True))
    return {
        "SNS": round(run.summary["SNS"], DIGITS),
        "low": round(low, DIGITS),
        "high": round(high, DIGITS),
        "success": round(run.summary["success"], 3),
        "Coll": round(run.summary["Coll"], DIGITS),
        "cells": {name: round(float(value), DIGITS) for name, value in cells.items() if math.isfinite(value)},
    }


def run(args):
    """Writes headroom.json; returns the exit code."""
    content = pages.shipped("headroom") if (pages.RESULTS / "headroom.json").exists() else {}
    runs = [Results.load(source) for source in args.runs or []]
    for name in args.suites or [name for name in suite_names() if name not in ("smoke", "paper-slow")]:
        suite, before = load_suite(name), content.get(name, {})
        agents = before.get("agents", {}) if before.get("digest") == suite.digest else {}
        agents |= {each.agent: standing(each, suite) for each in runs if each.suite == name}
        content[name] = {
            "digest": suite.digest,
            "most": {cell: rounded(most._asdict()) for cell, most in most_of(suite).items()},
            "agents": dict(sorted(agents.items())),
        }
        print(f"{name}: {pages.mean_most(content[name]):.1f} at most, {len(agents)} agents", file=sys.stderr)
    if strange := [each for each in runs if each.suite not in content]:
        raise UsageError(f"'{strange[0].source}' is of the suite '{strange[0].suite}': name it with --suites.")
    write_bytes(pages.RESULTS / "headroom.json", (pages.json_lines(dict(sorted(content.items())), 3) + "\n").encode())
    return 0


def main():
    """Entry point."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suites", type=command.name, nargs="+", help="(default: all but smoke and paper-slow)")
    parser.add_argument("--runs", type=command.name, nargs="+", help="folders of bson evaluate, or their results.json")

    def read_and_run():
        check_words(sys.argv[1:])
        return run(parser.parse_args())

    return run_command("headroom", read_and_run)


if __name__ == "__main__":
    sys.exit(main())
