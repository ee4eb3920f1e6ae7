import copy
import json
import os
import shutil

import numpy as np
import pytest

from bson import cli
from bson.evaluation.metrics import summarise
from bson.evaluation.results import Results
from bson.reporting.compare import (
    LEAST_PAIRS,
    Group,
    check_comparable,
    compare,
    differences,
    format_comparison,
    make_page,
)
from bson.reporting.leaderboard import BEGIN, END, fill_readme, leaderboard

QUICK = ["--set", "map_size=20.0", "--set", "goal_distance=(6,12)", "--set", "num_pedestrians=3", "--set", "horizon=30"]


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Results of two agents on six episodes."""
    out = tmp_path_factory.mktemp("results")
    for agent in ("stop", "goal"):
        command = ["evaluate", "--agent", agent, "--suite", "smoke", "--episodes", "6", "--videos", "0"]
        assert cli.main([*command, *QUICK, "--out", str(out / agent)]) == 0
    return out


@pytest.fixture
def runs(folders):
    """The two, to be changed at will."""
    return [Results.load(folders / "stop"), Results.load(folders / "goal")]


def _run(agent, rows, **changes):
    """Results whose episodes `rows` are {(cell, seed): {metric: value}}."""
    cells = dict.fromkeys(cell for cell, _ in rows)
    summary = summarise([{name: np.inf if v is None else v for name, v in row.items()} for row in rows.values()])
    content = {
        "agent": agent,
        "suite": "made",
        "suite_digest": "0123456789ab",
        "task_digest": "0123",
        "overrides": {},
        "track": ["local", "lidar2d"],
        "versions": {"mujoco": "3.17.0"},
        "summary": {name: row["mean"] for name, row in summary.items()},
        "intervals": {name: [row["low"], row["high"]] for name, row in summary.items()},
        "cells": [{"name": cell, "grades": {"people": cell}, "config": {"horizon": 1000}} for cell in cells],
        "episodes": [{"cell": cell, "seed": seed, **row} for (cell, seed), row in rows.items()],
        "faults": [],
    }
    return Results(content | changes, f"results/{agent}")


def _scores(agent, scores, cell="all", **changes):
    return _run(agent, {(cell, seed): {"SNS": score, "Coll": 1.0} for seed, score in scores.items()}, **changes)


def test_episodes_are_paired_by_cell_and_seed_whatever_their_order():
    ours = _run("ours", {("few", 1): {"SNS": 40.0}, ("many", 1): {"SNS": 10.0}, ("few", 2): {"SNS": 90.0}})
    theirs = _run("theirs", {("many", 1): {"SNS": 13.0}, ("few", 2): {"SNS": 84.0}, ("few", 1): {"SNS": 43.0}})
    found = compare([ours, theirs])
    row = found["runs"][1]["difference"]["SNS"]  # +3, +3, -6
    assert row["mean"] == pytest.approx(0.0) and row["count"] == 3
    assert (row["low"], row["high"]) == pytest.approx((-6.0, 3.0))
    few, many = found["cells"]
    assert few["runs"][1]["difference"]["SNS"]["mean"] == pytest.approx(-1.5)
    assert many["runs"][1]["difference"]["SNS"]["mean"] == pytest.approx(3.0)
    assert found["runs"][0]["difference"] is None and few["runs"][0]["summary"]["SNS"]["mean"] == pytest.approx(65.0)


def test_the_interval_of_a_difference_is_that_of_the_pairs_not_of_the_runs():
    base = {seed: 30.0 * (seed % 3) for seed in range(12)}
    found = compare([_scores("a", base), _scores("b", {seed: score + 2.0 for seed, score in base.items()})])
    row = found["runs"][1]["difference"]["SNS"]
    assert (row["low"], row["mean"], row["high"]) == pytest.approx((2.0, 2.0, 2.0)) and row["differs"]
    own = found["runs"][1]["summary"]["SNS"]
    assert own["high"] - own["low"] > 10.0


def test_the_bootstrap_is_the_one_of_the_summary():
    rng = np.random.default_rng(4)
    ours, theirs = rng.normal(size=(2, 20))
    expected = summarise([{"SNS": x} for x in theirs - ours])["SNS"]
    row = differences([{"SNS": x} for x in theirs], [{"SNS": x} for x in ours])["SNS"]
    assert {name: row[name] for name in expected} == expected


def test_a_difference_is_marked_where_its_interval_excludes_0_and_there_are_enough_pairs():
    def marked(values):
        return differences([{"SNS": x} for x in values], [{"SNS": 0.0}] * len(values))["SNS"]["differs"]

    assert marked([5.0] * LEAST_PAIRS) and marked([-5.0] * LEAST_PAIRS)
    assert not marked([5.0] * (LEAST_PAIRS - 1))
    assert not marked([5.0, -5.0] * LEAST_PAIRS) and not marked([0.0] * 20)


def test_cells_that_share_seeds_are_no_more_pairs_than_their_seeds():
    """The same lead in each of three cells: the interval of one, as evaluate prints it; of five seeds no mark."""
    rng = np.random.default_rng(9)
    base, lead = 50.0 + 10.0 * rng.normal(size=12), 4.0 + 5.0 * rng.normal(size=12)

    def found(cells, seeds):
        keys = [(cell, seed) for cell in cells for seed in range(seeds)]
        scores = [{key: {"SNS": each[key[1]]} for key in keys} for each in (base, base + lead)]
        return compare([_run(agent, rows) for agent, rows in zip("ab", scores, strict=True)])["runs"][1]

    one, three = found(["few"], 12), found(["few", "some", "many"], 12)
    for part in ("summary", "difference"):
        low, high = one[part]["SNS"]["low"], one[part]["SNS"]["high"]
        assert (three[part]["SNS"]["low"], three[part]["SNS"]["high"]) == pytest.approx((low, high))
    lead[:] = 4.0
    assert found(["few", "some"], 6)["difference"]["SNS"]["differs"]
    assert not found(["few", "some"], 5)["difference"]["SNS"]["differs"]


def test_values_that_are_infinite_in_either_run_do_not_enter():
    ours = _run("ours", {("all", seed): {"SNS": 1.0, "time": time} for seed, time in enumerate((5.0, None, None, 7.0))})
    theirs = _run("theirs", {("all", seed): {"SNS": 1.0, "time": t} for seed, t in enumerate((6.0, 3.0, None, None))})
    row = compare([ours, theirs])["runs"][1]["difference"]["time"]
    assert row["count"] == 1 and row["mean"] == 1.0


def test_runs_that_are_the_same_differ_by_nothing(runs):
    found = compare([runs[1], runs[1]])
    for row in found["runs"][1]["difference"].values():
        assert (row["mean"], row["low"], row["high"], row["differs"]) == (0.0, 0.0, 0.0, False)
    assert [run["name"] for run in found["runs"]] == [f"goal ({runs[1].source})"] * 2


def test_the_order_of_the_runs_turns_the_sign(runs):
    there, back = (compare(each)["runs"][1]["difference"] for each in (runs, runs[::-1]))
    assert there["SNS"]["mean"] > 10.0 and there["SNS"]["differs"] and back["SNS"]["differs"]
    for name, row in there.items():
        assert (back[name]["mean"], back[name]["low"]) == pytest.approx((-row["mean"], -row["high"]), abs=1e-9)
        assert back[name]["differs"] == row["differs"]


def test_summaries_are_those_of_the_runs_themselves(runs):
    for run, row in zip(runs, compare(runs)["runs"], strict=True):
        for name, mean in run.content["summary"].items():
            assert row["summary"][name]["mean"] == pytest.approx(mean)
            assert [row["summary"][name]["low"], row["summary"][name]["high"]] == pytest.approx(
                run.content["intervals"][name]
            )


def test_only_shared_episodes_are_compared_and_it_is_said():
    found = compare([_scores("a", {1: 10.0, 2: 20.0, 3: 90.0}), _scores("b", {2: 21.0, 1: 11.0, 9: 0.0, 8: 0.0})])
    assert found["episodes"] == 2 and found["runs"][0]["summary"]["SNS"]["mean"] == pytest.approx(15.0)
    assert found["runs"][1]["difference"]["SNS"]["mean"] == pytest.approx(1.0)
    assert "Only the 2 episodes" in found["notes"][0] and "a has 3, b has 4" in found["notes"][0]
    assert found["notes"][0] in format_comparison(found) and found["notes"][0] in make_page(found)
    assert compare([_scores("a", {1: 1.0}), _scores("b", {1: 2.0})])["notes"] == []


def test_faults_and_other_versions_are_noted():
    fault = {"seed": 3, "cell": "all", "time": 1.0, "what": "qvel"}
    other = _scores("b", {1: 2.0}, faults=[fault], versions={"mujoco": "3.18.0"})
    notes = compare([_scores("a", {1: 1.0, 3: 5.0}), other])["notes"]
    assert any("b: 1 episode" in note for note in notes) and any("3.17.0, 3.18.0" in note for note in notes)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"suite": "paper"}, "suite 'made' against 'paper'"),
        ({"suite_digest": "ffff"}, "digest of the suite '0123456789ab' against 'ffff'"),
        ({"overrides": {"horizon": "5"}, "suite_digest": None}, "--set nothing against horizon=5"),
        (
            {"cells": [{"name": "all", "grades": {}, "config": {"horizon": 7}}]},
            "horizon is 1000 against 7 in cell 'all'",
        ),
        ({"task_digest": "ffff"}, "a map, a robot or the pedestrians' weights changed"),
    ],
)
def test_runs_that_cannot_be_compared_are_refused_by_what_differs(changes, told):
    pair = [_scores("a", {1: 1.0}), _scores("b", {1: 1.0}, **changes)]
    for refuse in (check_comparable, compare):
        with pytest.raises(ValueError, match="results/a.*results/b") as caught:
            refuse(pair)
        assert told in str(caught.value)


def test_one_run_or_no_shared_episode_is_refused():
    with pytest.raises(ValueError, match="at least two"):
        compare([_scores("a", {1: 1.0})])
    with pytest.raises(ValueError, match="seeds 1 to 2.*seeds 1000001 to 1000002.*--seed"):
        compare([_scores("a", {1: 1.0, 2: 1.0}), _scores("b", {1000001: 1.0, 1000002: 1.0})])


def test_compare_writes_a_page_that_needs_no_other_file(folders, check_page, tmp_path, capsys):
    out = tmp_path / "out"
    sources = [str(folders / "stop"), str(folders / "goal" / "results.json")]
    assert cli.main(["compare", *sources, "--out", str(out)]) == 0
    told = capsys.readouterr().out
    content = json.loads((out / "compare.json").read_text())
    page = (out / "compare.html").read_text()
    check_page(page)
    assert content["overrides"]["horizon"] == "30" and [run["name"] for run in content["runs"]] == ["stop", "goal"]
    mean = content["runs"][1]["difference"]["SNS"]["mean"]
    assert f"+{mean:.1f} [" in told and f"+{mean:.1f} [" in page and "personal_space" in told
    assert {path.name for path in out.iterdir()} == {"compare.json", "compare.html"}


@pytest.mark.parametrize("axes", [1, 2])
def test_cells_are_compared_on_the_page(check_page, axes):
    grades = [{"people": p, "temper": t} if axes == 2 else {"people": p + t} for p in "ab" for t in "cd"]
    cells = [{"name": ", ".join(each.values()), "grades": each, "config": {}} for each in grades]
    pair = []
    for agent, gain in (("x & y", 0.0), ("z", 12.0)):
        rows = {(cell["name"], s): {"SNS": 5.0 * s + gain, "success": 1.0} for cell in cells for s in range(7)}
        pair.append(_run(agent, rows, cells=cells))
    content = compare(pair)
    page, text = make_page(content), format_comparison(content)
    check_page(page)
    assert page.count("+12.0 *") == 4 and "x &amp; y" in page and "x & y" not in page
    assert page.count('<table class="heat">') == (3 if axes == 2 else 0)
    assert text.count("+12.0 [+12.0, +12.0] *") == 5 and all(cell["name"] in text for cell in cells)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (None, "No results in"),
        ("{", "not JSON"),
        ("[]", "no 'agent'"),
        ('{"agent": "goal"}', "no 'suite'"),
        ("old", "no 'cell'"),
    ],
)
def test_what_is_no_results_file_is_refused(folders, tmp_path, capsys, text, told):
    path = tmp_path / "results.json"
    if text == "old":
        content = json.loads((folders / "goal" / "results.json").read_text())
        for row in content["episodes"]:
            del row["cell"]
        text = json.dumps(content)
    if text is not None:
        path.write_text(text)
    for command in ("compare", "leaderboard"):
        more = ["--out", str(tmp_path / "out")] if command == "compare" else []
        assert cli.main([command, str(folders / "stop"), str(tmp_path), *more]) == 2
        error = capsys.readouterr().err
        assert told in error and str(tmp_path) in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def _ranked(text):
    """(rank, agent) of the rows of a Markdown table."""
    rows = [[word.strip() for word in line.split("|")[1:3]] for line in text.splitlines() if line.startswith("| ")]
    return [(int(rank), agent.split("`")[1]) for rank, agent in rows if rank.isdigit()]


def test_the_leaderboard_is_sorted_whatever_the_order():
    scores = {"a": 10.0, "b": 90.0, "c": 50.0, "d": -5.0}
    made = [_scores(agent, {1: score, 2: score}) for agent, score in scores.items()]
    text = leaderboard(made)
    assert _ranked(text) == [(1, "b"), (2, "c"), (3, "a"), (4, "d")]
    assert _ranked(leaderboard(made[::-1])) == _ranked(text)
    assert "digest `0123456789ab`" in text and "2 episodes" in text and "90.0 [90.0, 90.0]" in text
    assert "`bson evaluate --agent AGENT --suite made --episodes 2`" in text


def test_each_suite_has_a_table_of_its_own():
    made = [_scores("a", {1: 5.0}), _scores("b", {1: 1.0}, suite="other"), _scores("c", {1: 7.0})]
    text = leaderboard(made)
    assert _ranked(text) == [(1, "c"), (2, "a"), (1, "b")] and text.count("| rank |") == 2


def test_a_leaderboard_ranks_only_who_sat_the_same_exam():
    first, fewer = _scores("a", {1: 5.0, 2: 5.0}), _scores("b", {1: 1.0})
    with pytest.raises(ValueError, match="results/a.*results/b.*same episodes"):
        leaderboard([first, fewer])
    with pytest.raises(ValueError, match="digest"):
        leaderboard([first, _scores("b", {1: 1.0, 2: 1.0}, suite_digest="ffff")])
    faulty = copy.deepcopy(fewer)
    faulty.content["faults"] = [{"seed": 2, "cell": "all", "time": 0.5, "what": "qvel"}]
    assert "`b` (1 faulty)" in leaderboard([first, faulty])


def test_the_readme_gets_the_table_between_its_marks_and_nothing_else_changes(folders, tmp_path, capsys):
    readme = tmp_path / "README.md"
    before, after = "# Title\n\nText | é\n\n", "\n\nMore.\n"
    readme.write_text(f"{before}{BEGIN}\nold\n{END}{after}")
    command = ["leaderboard", str(folders / "stop"), str(folders / "goal"), "--readme", str(readme)]
    assert cli.main(command) == 0
    text = readme.read_text()
    table = capsys.readouterr().out.strip()
    assert text == f"{before}{BEGIN}\n{table}\n{END}{after}" and "old" not in text
    assert _ranked(text) == [(1, "goal"), (2, "stop")]
    assert "--set map_size=20.0 --set 'goal_distance=(6, 12)'" in text
    assert cli.main(command) == 0 and readme.read_text() == text
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]


def test_a_readme_that_is_refused_leaves_no_board(folders, tmp_path, capsys):
    (tmp_path / "README.md").write_text("no marks")
    words = ["--readme", str(tmp_path / "README.md"), "--out", str(tmp_path / "board"), "--all"]
    assert cli.main(["leaderboard", str(folders / "stop"), *words]) == 2
    assert BEGIN in capsys.readouterr().err and not (tmp_path / "board").exists()


@pytest.mark.parametrize("text", ["no marks", BEGIN, END, f"{END}\n{BEGIN}", f"{BEGIN}{END}{BEGIN}{END}", None])
def test_a_readme_without_its_two_marks_is_left_alone(tmp_path, text):
    path = tmp_path / "README.md"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match="README.md.*<!-- leaderboard -->.*<!-- /leaderboard -->"):
        fill_readme(path, "table")
    assert path.exists() == (text is not None) and (text is None or path.read_text() == text)


def test_a_readme_keeps_its_line_ends_and_permissions_and_a_link_to_it_stays(tmp_path):
    path = tmp_path / "README.md"
    path.write_bytes(f"caf\u00e9\r\n{BEGIN}\r\nold\r\n{END}\r\nend".encode())
    path.chmod(0o640)
    (tmp_path / "link.md").symlink_to("README.md")
    fill_readme(tmp_path / "link.md", "a\nb")
    assert path.read_bytes() == f"caf\u00e9\r\n{BEGIN}\r\na\r\nb\r\n{END}\r\nend".encode()
    assert path.stat().st_mode & 0o777 == 0o640 and (tmp_path / "link.md").is_symlink()


@pytest.mark.parametrize("content", [b"caf\xe9", b"\xff\xfe", "folder", "fifo"])
def test_what_is_no_readme_is_told_in_one_line(tmp_path, content):
    path = tmp_path / "README.md"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        {"folder": path.mkdir, "fifo": lambda: os.mkfifo(path)}[content]()
    with pytest.raises(ValueError, match="README.md") as caught:
        fill_readme(path, "table")
    assert "\n" not in str(caught.value)


def _trained(scores):
    """Results of several trainings of one agent, {seed: score} each."""
    return tuple(_scores(f"tac-{seed}", each) for seed, each in enumerate(scores))


def test_several_trainings_are_one_column_with_an_interval_over_them():
    easy = {seed: 50.0 + seed for seed in range(8)}
    worse = {seed: score - 30.0 for seed, score in easy.items()}
    trained = Group(_trained([easy, worse, easy, worse]), "tac")
    found = compare([trained, _scores("vfh", easy)])
    tac, vfh = found["runs"]
    assert (tac["name"], tac["training_seeds"], vfh["training_seeds"]) == ("tac", 4, 1)
    row, alone = tac["summary"]["SNS"], vfh["summary"]["SNS"]
    assert row["mean"] == pytest.approx(alone["mean"] - 15.0) and row["count"] == 32
    assert row["high"] - row["low"] > 4 * (alone["high"] - alone["low"])
    difference = vfh["difference"]["SNS"]
    assert difference["mean"] == pytest.approx(15.0) and not difference["differs"]  # 2 in 16 draws have no bad training
    assert any("tac: 4 training seeds" in note for note in found["notes"])
    assert any("these agents for trainings of one: tac-0, tac-1, tac-2, tac-3" in note for note in found["notes"])
    pair = found["improvement"][0]
    assert (pair["of"], pair["over"]) == (1, 0) and pair["SNS"]["paired"]["value"] == pytest.approx(0.75)
    assert pair["SNS"]["paired"]["ties"] == pytest.approx(0.5) and not pair["SNS"]["differs"]


def test_a_group_of_one_is_the_run_itself(runs):
    alone, grouped = compare(runs), compare([Group((run,)) for run in runs])
    assert alone == grouped


def test_pairs_are_judged_by_what_is_better(check_page):
    rows = [{("all", seed): {"SNS": 10.0 * k + seed, "Coll": 5.0 - k} for seed in range(9)} for k in range(3)]
    content = compare([_run(name, each) for name, each in zip("abc", rows, strict=True)])
    told = [(pair["of"], pair["over"]) for pair in content["improvement"]]
    assert told == [(1, 0), (2, 0), (2, 1)]
    for pair in content["improvement"]:
        for metric in ("SNS", "Coll"):
            assert pair[metric]["paired"]["value"] == 1.0 and pair[metric]["differs"]
    means = [run["interquartile_mean"]["SNS"]["value"] for run in content["runs"]]
    assert means == pytest.approx([4.0, 14.0, 24.0])
    page, text = make_page(content), format_comparison(content)
    check_page(page)
    assert text.count("1.00 [1.00, 1.00] *") == page.count("1.00 [1.00, 1.00] *") == 6 and "c over b" in text


def test_groups_are_named_on_the_command_line(folders, tmp_path, capsys):
    stop, goal = folders / "stop", folders / "goal"
    words = [f"both={stop},{goal}", str(goal), "--out", str(tmp_path / "out")]
    assert cli.main(["compare", *words]) == 0
    content = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert [(run["name"], run["training_seeds"]) for run in content["runs"]] == [("both", 2), ("goal", 1)]
    assert "over training seeds and episodes" in (tmp_path / "out" / "compare.html").read_text()
    shutil.copytree(goal, tmp_path / "copy")
    for words in (["compare", f"a={goal},{tmp_path / 'copy'}", str(stop)], ["leaderboard", str(goal), str(goal)]):
        assert cli.main(words) == 2 and "are the same results: name them once" in capsys.readouterr().err
    for wrong in (f"={stop}", f"both={stop},", "both="):
        assert cli.main(["compare", wrong, str(goal)]) == 2
        assert "NAME=RESULTS,RESULTS" in capsys.readouterr().err
