"""The board: a row for each evaluation that was verified (bson.evaluation.verify), as board.json, and the page
board.html with a card for each agent."""

import pathlib
from collections.abc import Sequence
from typing import Any

import msgspec

from bson.evaluation.results import Results
from bson.evaluation.verify import read_record, results_hash, why_unverified
from bson.reporting import page
from bson.reporting.cards import FILE, card_of
from bson.reporting.heatmap import Scale, Tile, cell_maps
from bson.reporting.leaderboard import COLUMNS, by_suite, played
from bson.reporting.page import DASH, render
from macid.files import UsageError

FORMAT = 1  # of board.json
_FIGURES = ("SNS", *(metric for metric, _, _ in COLUMNS))


def board_row(run: Results, unverified: str | None) -> dict[str, Any]:
    """An item of `rows` in board.json: all that a board shows of an evaluation. unverified: why it is not to be
    trusted; None where it was verified."""
    content, record, card = run.content, read_record(run.source), card_of(run)
    return {
        "suite": run.suite,
        "suite_digest": content.get("suite_digest"),
        "task_digest": content.get("task_digest"),
        "overrides": content.get("overrides", {}),
        "frozen_seeds": content.get("frozen_seeds", True),
        "cells": len(run.cells),
        "episodes": len(played(run)),
        "faults": len(content.get("faults", [])),
        "agent": run.agent,
        "track": content.get("track"),
        "scores": {
            name: dict(zip(("mean", "low", "high"), (run.summary[name], *run.intervals[name]), strict=True))
            for name in _FIGURES
            if name in run.summary
        },
        "card": None if card is None else msgspec.to_builtins(card),
        "results": results_hash(run.source),
        "unverified": unverified,
        "verification": None
        if record is None
        else {"played": len(record.episodes), "of": record.count, "draw": record.draw, "notes": record.notes},
        "versions": content["versions"],
    }


def make_board(runs: Sequence[Results], everything: bool = False) -> tuple[dict[str, Any], list[str]]:
    """The content of board.json, and what is to be told in lines.

    runs: Results that were read from files. everything: also those that were not verified, which are marked. Raises
    ValueError where none is left, or where runs of one suite differ in its version, setting or episodes.
    """
    lines, kept = [], []
    for run in runs:
        reason = why_unverified(run.source)
        if reason:
            lines.append(f"{'unverified' if everything else 'left out'}: '{run.source}' was {reason}. bson verify it.")
        if everything or not reason:
            kept.append((run, reason))
    if not kept:
        raise UsageError("None of the results was verified: bson verify each, or show all with --all.")
    reasons = {id(run): reason for run, reason in kept}
    rows = [board_row(run, reasons[id(run)]) for group in by_suite([run for run, _ in kept]) for run in group]
    lines += [
        f"no card: {agent}. Put a {FILE} with `who` beside its results."
        for agent in dict.fromkeys(row["agent"] for row in rows if row["card"] is None)
    ]
    return {"format": FORMAT, "rows": rows}, lines


def _figures(row):
    """The texts of a row's figures, the SNS first, and of the SNS's interval."""
    scores, forms = row["scores"], (("SNS", "{:.1f}"), *((name, form) for name, _, form in COLUMNS))
    figures = [form.format(scores[name]["mean"]) if name in scores else DASH for name, form in forms]
    return {
        "figures": figures,
        "interval": "[{low:.1f}, {high:.1f}]".format(**scores["SNS"]) if "SNS" in scores else "",
    }


def make_page(content: dict[str, Any]) -> str:
    """The page board.html as text. content: the content of board.json."""
    suites: dict[str, list[dict[str, Any]]] = {}
    for row in content["rows"]:
        suites.setdefault(row["suite"], []).append(row)
    parts = []
    for name, rows in suites.items():
        tiles = [
            Tile({"agent": row["agent"]}, *(row["scores"].get("SNS", {}).get(key) for key in ("mean", "low", "high")))
            for row in rows
        ]
        parts.append(
            {
                "name": name,
                "first": rows[0],
                "changed": ", ".join(f"{key} = {value}" for key, value in rows[0]["overrides"].items()),
                "plot": cell_maps(tiles, Scale(0.0, 100.0), "SNS", "of 100, more is better", 1)
                if len(rows) > 1
                else "",
                "rows": [row | _figures(row) for row in rows],
            }
        )
    cards = {row["agent"]: row["card"] for row in content["rows"] if row["card"] is not None}
    return render(
        "board.html",
        title="BSON leaderboard",
        headings=["SNS", *(heading for _, heading, _ in COLUMNS)],
        suites=parts,
        cards=cards,
        told=(("sees", "sees"), ("trained", "trained"), ("paper", "source"), ("command", "command")),
    )


def publish(runs: Sequence[Results], out: str | pathlib.Path, everything: bool = False) -> list[str]:
    """Writes board.json and board.html to the folder `out`, as `bson leaderboard --out` does; returns what is to be
    told in lines. Raises ValueError as make_board does."""
    content, lines = make_board(runs, everything)
    page.publish(out, "board", content, make_page(content))
    return lines
