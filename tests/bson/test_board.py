import json

import pytest

from bson import cli
from bson.agents import agent_names
from bson.evaluation.metrics import summarise
from bson.evaluation.results import Results
from bson.evaluation.verify import Replayed, Verification, read_record, record_path, results_hash, write_record
from bson.reporting.board import make_board, make_page
from bson.reporting.cards import card_of, shipped_cards

VERSIONS = {"mujoco": "3.17.0"}


def evaluated(folder, agent, scores, suite="made", **changes):
    """A folder with results of an agent, {seed: SNS}."""
    folder.mkdir()
    rows = [{"cell": "all", "seed": seed, "SNS": score, "Coll": 0.0} for seed, score in scores.items()]
    summary = summarise([{"SNS": row["SNS"], "Coll": 0.0} for row in rows])
    content = {
        "agent": agent,
        "suite": suite,
        "suite_digest": "0123456789ab",
        "overrides": {},
        "track": ["local", "lidar2d"],
        "versions": VERSIONS,
        "summary": {name: row["mean"] for name, row in summary.items()},
        "intervals": {name: [row["low"], row["high"]] for name, row in summary.items()},
        "cells": [{"name": "all", "grades": {}, "config": {}}],
        "episodes": rows,
    }
    (folder / "results.json").write_text(json.dumps(content | changes))
    return folder


def record(folder, verdict="equal", **changes):
    """A record of the results in `folder`, as bson verify writes it."""
    told = {"draw": 1, "share": 0.5, "count": 2, "episodes": [Replayed("all", 1, {})], "problems": [], "notes": []}
    told |= {"made_with": VERSIONS, "played_with": VERSIONS, "results": results_hash(folder), "agent": "goal"}
    told |= {"suite": "made", "replayed_agent": "goal", "verdict": verdict}
    write_record(record_path(folder), Verification(**(told | changes)))


@pytest.fixture
def three(tmp_path):
    """Folders of results: verified, verified and then changed, never verified."""
    folders = [evaluated(tmp_path / name, name, {1: k, 2: k + 9.0}) for k, name in enumerate(("goal", "vfh", "tac"))]
    for folder in folders[:2]:
        record(folder)
    text = (folders[1] / "results.json").read_text()
    (folders[1] / "results.json").write_text(text.replace("3.17.0", "3.17.1"))
    return folders


def test_the_board_has_what_was_verified_and_tells_what_it_leaves_out(three, tmp_path, check_page, capsys):
    out = tmp_path / "board"
    assert cli.main(["leaderboard", *map(str, three), "--out", str(out)]) == 0
    table, told = capsys.readouterr()
    assert table.count("| 1 |") == 1 and all(f"`{name}`" in table for name in ("goal", "vfh", "tac"))  # as ever
    assert f"left out: '{three[1]}' was changed since it was verified" in told
    assert f"left out: '{three[2]}' was never verified" in told
    (row,) = json.loads((out / "board.json").read_text())["rows"]
    assert row["agent"] == "goal" and row["results"] == results_hash(three[0]) and row["unverified"] is None
    assert row["scores"]["SNS"] == {"mean": 4.5, "low": 0.0, "high": 9.0} and row["episodes"] == 2
    assert row["card"]["who"] == shipped_cards()["goal"].who
    page = (out / "board.html").read_text()
    check_page(page)
    assert "1 of 2" in page and "drives straight to the goal, blind" in page and "vfh" not in page


def test_all_of_them_are_shown_with_why_they_are_not_to_be_trusted(three, tmp_path, check_page, capsys):
    out = tmp_path / "board"
    assert cli.main(["leaderboard", *map(str, three), "--out", str(out), "--all"]) == 0
    assert "unverified: " in capsys.readouterr().err
    rows = json.loads((out / "board.json").read_text())["rows"]
    assert [(row["agent"], bool(row["unverified"])) for row in rows] == [("tac", True), ("vfh", True), ("goal", False)]
    page = (out / "board.html").read_text()
    check_page(page)
    assert "no: never verified" in page and "no: changed since it was verified" in page
    assert "Lee et al." in page and "1,000,000 control steps" in page  # the card of tac


def test_a_record_that_found_a_difference_or_none_at_all_is_no_verification(three, tmp_path, capsys):
    record(three[0], "differs")
    assert cli.main(["leaderboard", *map(str, three), "--out", str(tmp_path / "out")]) == 2
    assert "None of the results was verified" in capsys.readouterr().err and not (tmp_path / "out").exists()
    record_path(three[0]).write_text('{"verdict": "equal"}')
    assert cli.main(["leaderboard", str(three[0]), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "verification" in error and str(three[0]) in error and len(error.splitlines()) == 1


def test_a_board_ranks_only_who_sat_the_same_exam(three, tmp_path):
    fewer = evaluated(tmp_path / "fewer", "sac", {1: 5.0})
    with pytest.raises(ValueError, match="same episodes"):
        make_board([Results.load(three[0]), Results.load(fewer)], everything=True)


def test_a_record_is_read_back_as_it_was_written(three):
    found = read_record(three[0])
    assert found.equal and found.results == results_hash(three[0] / "results.json")
    assert read_record(three[0] / "results.json") == found and read_record(three[2]) is None


def test_own_agents_bring_their_cards(tmp_path, check_page, capsys):
    folder = evaluated(tmp_path / "mine", "mine.py", {1: 5.0}, command="bson evaluate --agent mine.py")
    assert card_of(Results.load(folder)) is None
    content, lines = make_board([Results.load(folder)], everything=True)
    assert any("no card: mine.py" in line for line in lines) and content["rows"][0]["card"] is None
    check_page(make_page(content))
    (folder / "card.toml").write_text('who = "a <b>bold</b> one, by us"\ntrained = "on 3 maps"\n')
    card = card_of(Results.load(folder))
    assert (card.trained, card.command) == ("on 3 maps", "bson evaluate --agent mine.py")
    page = make_page(make_board([Results.load(folder)], everything=True)[0])
    check_page(page)
    assert "a &lt;b&gt;bold" in page
    for wrong, told in (('whom = "x"', "whom"), ('who = ""', "who"), ('who = "a\\nb"', "one line")):
        (folder / "card.toml").write_text(wrong)
        with pytest.raises(ValueError, match=f"card.toml.*{told}"):
            card_of(Results.load(folder))


def test_every_agent_of_the_shipped_board_has_a_card():
    import make_pages as pages

    cards = shipped_cards()
    assert cards.keys() <= set(agent_names())
    assert {agent for rows in pages.board().values() for agent in rows} <= cards.keys()
