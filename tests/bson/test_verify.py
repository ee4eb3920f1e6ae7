import json
import math

import pytest

from bson import cli
from bson.evaluation.results import Results
from bson.evaluation.verify import drawn, read_record, record_path, results_hash
from bson.reporting.compare import compare

QUICK = ["--set", "map_size=20.0", "--set", "goal_distance=(6,12)", "--set", "num_pedestrians=3", "--set", "horizon=30"]
AGENT = "def agent(observation):\n    return [0.6, 0.1]\n"
SUITE = """
name = "mine"
description = "two cells"
seeds = [3, 1, 2]
config = { map_size = 20.0, goal_distance = [6.0, 12.0], horizon = 12 }
[axes.people]
few = { num_pedestrians = 1 }
more = { num_pedestrians = 4 }
"""
SECRET = "correct horse battery staple"


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """The content of results.json of a paired evaluation, on two episodes of another set of seeds."""
    out = tmp_path_factory.mktemp("played")
    words = ["evaluate", "--agent", "goal", "--suite", "smoke", "--episodes", "4", "--seed", "2", "--videos", "0"]
    assert cli.main([*words, "--paired", *QUICK, "--out", str(out)]) == 0
    return json.loads((out / "results.json").read_text())


@pytest.fixture
def folder(played, tmp_path):
    """Its folder, to be changed at will."""
    (tmp_path / "results.json").write_text(json.dumps(played))
    return tmp_path


def change(folder, doing):
    content = json.loads((folder / "results.json").read_text())
    doing(content)
    (folder / "results.json").write_text(json.dumps(content))


def verified(folder, *words):
    code = cli.main(["verify", str(folder), *words])
    return code, read_record(folder)


def test_what_was_played_comes_out_again(folder, capsys):
    code, record = verified(folder, "--share", "1")
    assert code == 0 and record.equal and record.problems == record.notes == []
    assert record.results == results_hash(folder / "results.json")
    assert [(each.cell, each.seed) for each in record.episodes] == list(Results.load(folder).rows)
    assert "4 of 4 episodes played again" in capsys.readouterr().out
    assert {path.name for path in folder.iterdir()} == {"results.json", "results.verification.json"}


def _worse(content):
    content["episodes"][2]["SNS"] += 1e-9


def _fault(content):
    row = content["episodes"].pop()
    content["faults"].append({"seed": row["seed"], "cell": row["cell"], "time": 1.0, "what": "qvel"})


@pytest.mark.parametrize(("doing", "told"), [(_worse, "SNS was"), (_fault, "fault was qvel, is None")])
def test_an_episode_that_comes_out_otherwise_is_told_with_what_was_and_is(folder, capsys, doing, told):
    change(folder, doing)
    code, record = verified(folder, "--share", "1")
    assert code == 1 and record.verdict == "differs" and sum(bool(each.differs) for each in record.episodes) == 1
    assert told in capsys.readouterr().out


@pytest.mark.parametrize(
    ("doing", "told"),
    [
        (lambda content: content["summary"].update(SNS=99.0), "SNS of all episodes: the mean was 99.0"),
        (lambda content: content["intervals"].update(SNS=[0.0, 99.0]), "in [0.0, 99.0], its episodes have"),
        (lambda content: content["episodes"].pop(1), "left out: seeds 2000101"),
        (lambda content: content["episodes"][0].update(seed=7), "no episodes of the suite: seeds 7"),
        (lambda content: content["cells"][0]["config"].update(horizon=31), "horizon was 31, the suite has 30"),
        (lambda content: content.update(suite_digest="ffff"), "digest of the suite: was ffff, is None"),
        (lambda content: content.update(frozen_seeds=True), "frozen_seeds is true, the seeds are those of --seed 2"),
        (lambda content: content.pop("frozen_seeds"), "frozen_seeds is true, the seeds are those of --seed 2"),
    ],
)
def test_what_results_say_of_themselves_has_to_hold(folder, capsys, doing, told):
    change(folder, doing)
    code, record = verified(folder, "--seed", "3")
    assert code == 1 and not record.equal and any(told in problem for problem in record.problems)
    assert (
        f"does not hold: {next(problem for problem in record.problems if told in problem)}" in capsys.readouterr().out
    )


def test_other_versions_are_told_and_change_no_verdict(folder, capsys):
    change(folder, lambda content: content["versions"].update(mujoco="3.16.9"))
    change(folder, lambda content: content.update(task_digest="0123"))
    code, record = verified(folder)
    assert code == 0 and record.made_with["mujoco"] == "3.16.9" != record.played_with["mujoco"]
    out = capsys.readouterr().out
    assert "note: mujoco: was 3.16.9, is 3." in out and "was 0123, is" in out


@pytest.mark.parametrize(
    ("doing", "told"),
    [
        (lambda content: content.update(agent="human"), "a person drove"),
        (lambda content: content.update(agent="ros"), "give it by --agent"),
        (lambda content: content.update(agent="os:system"), "'os:system'.*give it by --agent"),
        (lambda content: content.update(engine="warp"), "to a tolerance"),
        (lambda content: content.update(real_time=True), "real time"),
        (lambda content: content.update(track=["local", "mine.py:SENSORS"]), "'mine.py:SENSORS'.*give --sensor"),
        (lambda content: content.update(track=["mine.py:Track", "lidar2d"]), "'mine.py:Track'.*give --track"),
        (lambda content: content.update(suite="papers"), "Unknown suite 'papers'. Choose"),
        (lambda content: content.update(suite="held-out"), "no seeds without its passphrase"),
        (lambda content: content["overrides"].update(people="3"), "Unknown option 'people'"),
    ],
)
def test_what_cannot_be_verified_is_one_line_and_leaves_no_record(folder, capsys, doing, told):
    change(folder, doing)
    assert cli.main(["verify", str(folder)]) == 2
    error = capsys.readouterr().err
    assert all(part in error for part in told.split(".*")) and len(error.splitlines()) == 1
    assert not record_path(folder).exists()


def test_own_agents_and_own_suites_are_named_beside_the_results(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(AGENT)
    (tmp_path / "mine.toml").write_text(SUITE)
    words = ["evaluate", "--agent", "mine.py", "--suite", "mine.toml", "--videos", "0", "--out", "out"]
    assert cli.main(words) == 0
    assert cli.main(["verify", "out", "--agent", "mine.py"]) == 2 and "'mine'" in capsys.readouterr().err
    code, record = verified("out", "--agent", "mine.py", "--suite", "mine.toml", "--share", "1")
    assert code == 0 and [(e.cell, e.seed) for e in record.episodes] == [
        (c, s) for c in ("few", "more") for s in (3, 1, 2)
    ]
    run = Results.load("out")
    compared = compare([run, run])["runs"][0]["summary"]["SNS"]  # of seeds that two cells share
    assert run.intervals["SNS"] == (compared["low"], compared["high"])
    (tmp_path / "mine.py").write_text(AGENT.replace("0.1", "0.2"))
    code, record = verified("out", "--agent", "mine.py", "--suite", "mine.toml", "--share", "0.3", "--seed", "1")
    assert code == 1 and len(record.episodes) == 2 and all("PE" in each.differs for each in record.episodes)


def test_own_metrics_are_compared_where_they_are_given(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text("def way(episode):\n    return 2.0 * episode.travelled\n")
    words = ["evaluate", "--agent", "goal", "--suite", "smoke", "--episodes", "1", "--videos", "0", *QUICK]
    assert cli.main([*words, "--metric", "own.py:way", "--out", "out"]) == 0
    code, record = verified("out")
    assert code == 0 and record.notes == ["not compared, as --metric was not given: way"]
    code, record = verified("out", "--metric", "own.py:way")
    assert code == 0 and record.notes == []
    (tmp_path / "own.py").write_text("def way(episode):\n    return 2.5 * episode.travelled\n")
    code, record = verified("out", "--metric", "own.py:way")
    assert code == 1 and list(record.episodes[0].differs) == ["way"]


def test_the_draw_is_a_share_of_at_least_one_that_its_seed_gives_again():
    episodes = [("all", seed) for seed in range(100)]
    for share, count in ((0.1, 10), (0.101, 11), (0.001, 1), (1.0, 100)):
        found = drawn(episodes, share, 5)
        assert len(found) == len(set(found)) == count and found == sorted(found) == drawn(episodes, share, 5)
    assert drawn(episodes, 0.1, 5) != drawn(episodes, 0.1, 6) and drawn(episodes[:1], 0.1, 5) == episodes[:1]
    often = [sum(episode in drawn(episodes, 0.1, draw) for draw in range(200)) for episode in episodes[::25]]
    assert all(math.isclose(count, 20, abs_tol=15) for count in often)


def test_an_organiser_scores_what_nobody_could_tune_to(tmp_path, monkeypatch, capsys):
    (tmp_path / "secret").write_text(f"{SECRET}\n")
    out, tiny = tmp_path / "out", ["--set", "num_pedestrians=1", *QUICK[:4], "--set", "horizon=2"]
    words = ["evaluate", "--agent", "stop", "--suite", "held-out", "--episodes", "1", "--videos", "0", *tiny]
    assert cli.main([*words, "--out", str(out)]) == 2 and "--passphrase-file" in capsys.readouterr().err
    assert cli.main([*words, "--passphrase-file", str(tmp_path / "secret"), "--out", str(out)]) == 0
    found, text = Results.load(out), (out / "results.json").read_text()
    assert found.suite == "held-out" and len(found.cells) == 27 == len(set(found.seed.tolist()))
    assert SECRET not in text + (out / "report.html").read_text()
    assert cli.main(["verify", str(out)]) == 2
    monkeypatch.setenv("BSON_PASSPHRASE", SECRET)
    assert verified(out)[0] == 0 and len(read_record(out).episodes) == 3
    assert SECRET not in record_path(out).read_text()
    assert cli.main(["compare", str(out), str(out), "--out", str(tmp_path / "compared")]) == 0
    monkeypatch.setenv("BSON_PASSPHRASE", SECRET[::-1])
    capsys.readouterr()
    code, record = verified(out)
    assert code == 2 and record.equal and "made with another one" in capsys.readouterr().err  # as it was
    assert cli.main(["evaluate", "--suite", "paper", "--passphrase-file", str(tmp_path / "secret")]) == 2
