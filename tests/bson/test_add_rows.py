"""tools/add_rows.py: rows of new results in the shipped leaderboard."""

import pathlib
import sys

import add_rows
import pytest
from made_results import scored

from bson import cli
from bson.evaluation.results import Results
from macid.files import UsageError

BOARD = (pathlib.Path(__file__).parents[2] / "assets" / "results" / "leaderboard.md").read_text()


def rows_of(text, suite):
    """The rows of a suite's table, without their frames."""
    block = text[: text.index(f"\n\nSuite `{suite}`")].rpartition("\n\n")[2]
    return [line.strip("| ").split(" | ") for line in block.splitlines()[add_rows.ROWS :]]


def test_a_row_takes_its_rank_and_an_earlier_one_of_the_agent_goes(tmp_path):
    before = rows_of(BOARD, "dense")
    text = add_rows.add(BOARD, Results.load(scored(tmp_path / "a", "newcomer", 60.0, "dense")))
    rows = rows_of(text, "dense")
    assert [int(row[0]) for row in rows] == list(range(1, len(before) + 2))
    scores = [float(row[3].split()[0]) for row in rows]
    assert scores == sorted(scores, reverse=True) and [row[1] for row in rows].count("`newcomer`") == 1
    again = rows_of(add_rows.add(text, Results.load(scored(tmp_path / "b", "newcomer", 99.0, "dense"))), "dense")
    assert again[0][1:4] == ["`newcomer`", "local, lidar2d", "99.0 [99.0, 99.0]"] and len(again) == len(rows)
    for suite in ("paper", "standard", "scenarios", "street"):  # the others are as they were
        assert rows_of(text, suite) == rows_of(BOARD, suite)


def test_what_stays_stays_letter_by_letter(tmp_path):
    row = next(row for row in rows_of(BOARD, "dense") if row[1] == "`mppi`")
    run = Results.load(scored(tmp_path / "a", "newcomer", -5.0, "dense"))  # the last
    without = add_rows.add(BOARD, run).replace(f"| {len(rows_of(BOARD, 'dense')) + 1} | `newcomer`", "\0")
    kept = "\n".join(line for line in without.splitlines() if not line.startswith("\0")) + "\n"
    assert kept == BOARD and row[0] == "1"


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"suite_digest": "0123456789ab"}, "is not of all 90 episodes of today's suite 'dense'"),
        ({"overrides": {"num_pedestrians": "3"}}, "of other settings or seeds"),
        ({"frozen_seeds": False}, "of other settings or seeds"),
    ],
)
def test_other_results_have_no_row(changes, told, tmp_path, monkeypatch, capsys):
    board = tmp_path / "leaderboard.md"
    board.write_text(BOARD)
    monkeypatch.setattr(add_rows, "BOARD", board)
    folders = [
        scored(tmp_path / "good", "good", 50.0, "dense"),
        scored(tmp_path / "bad", "bad", 50.0, "dense", **changes),
    ]
    monkeypatch.setattr(sys, "argv", ["add_rows", *map(str, folders)])
    assert add_rows.main() == 2 and told in capsys.readouterr().err
    assert board.read_text() == BOARD  # the good one's row either
    monkeypatch.setattr(sys, "argv", ["add_rows", str(folders[0])])
    assert add_rows.main() == 0 and "`good`" in board.read_text()


def test_a_suite_without_a_table_has_no_row(tmp_path):
    run = Results.load(scored(tmp_path / "a", "goal", 1.0, "dense"))
    with pytest.raises(UsageError, match="no table of the suite 'dense'"):
        add_rows.add(BOARD.replace("Suite `dense`", "Suite `other`"), run)


def test_results_as_the_command_writes_them_fit(tmp_path):
    out = tmp_path / "out"
    words = ["--agent", "goal", "--suite", "smoke", "--episodes", "1", "--videos", "0", "--out", str(out)]
    assert cli.main(["evaluate", *words]) == 0
    run = Results.load(out)
    table = BOARD.replace("Suite `dense`", "Suite `smoke`")
    assert "| `goal` | local, lidar2d | " in add_rows.add(table, run)
