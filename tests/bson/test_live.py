"""`bson live`: driving by a person and by agents, what is kept of it, and the page in a real browser."""

import itertools
import json
import re
import signal
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from browser import Browser, chromium, until

from bson import benchmark, cli
from bson.agents import Setting, load_agent, made_for
from bson.episodes.tracks import make_track
from bson.evaluation import metrics
from bson.evaluation.driven import Driven, read_driven, score_so_far
from bson.evaluation.play import run_episodes
from bson.evaluation.results import Results
from bson.evaluation.suites import Cell, load_suite
from bson.interfaces.drive import PERSON, Course, Drive, action_of
from bson.task import TaskConfig
from macid.files import UsageError

TRACK = "local", "lidar2d"
CONFIG = TaskConfig(num_pedestrians=3, horizon=6, map_size=20.0, goal_distance=(6.0, 12.0), pedestrian_model="standing")
GOAL = load_agent("goal")()  # turns to the goal and drives on


def drive(config=CONFIG, seed=0, agent=None, name=PERSON):
    """A Drive to its end; a person drives as the agent `goal` does."""
    made = Drive(config, make_track(*TRACK), seed, agent, name)
    return finish(made)


def finish(made):
    while not made.ended:
        made.action = np.asarray(GOAL(made.observations[-1]))
        made.tick()
    return made


def test_keys_drive_as_they_lie():
    for share in (1.0, 0.4):
        assert action_of(frozenset(["KeyW"]), share).tolist() == [share, 0]
        assert action_of(frozenset(["ArrowDown", "KeyD"]), share).tolist() == [-share, -share]
    for keys in itertools.combinations(["KeyW", "KeyA", "KeyS", "KeyD", "ArrowUp", "ArrowLeft"], 3):
        mirror = {"KeyA": "KeyD", "KeyD": "KeyA", "ArrowLeft": "ArrowRight"}
        mirrored = action_of(frozenset(mirror.get(key, key) for key in keys))
        np.testing.assert_array_equal(mirrored, action_of(frozenset(keys)) * [1, -1])
        assert not action_of(frozenset([*keys, "Space"])).any()
    assert not action_of(frozenset(["KeyW", "KeyS", "KeyQ"])).any()


def test_a_drive_is_the_episode_that_is_evaluated():
    (wanted,) = run_episodes(lambda: load_agent("goal")(), CONFIG, make_track(*TRACK), [5], "goal")
    by_agent, by_person = drive(seed=5, agent=load_agent("goal"), name="goal"), drive(seed=5)
    for made in (by_agent, by_person):
        found = made.episode()
        for name in ("pose", "people", "qpos", "collisions_so_far", "lcf", "goal"):
            np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
        assert metrics.measure(found) == metrics.measure(wanted)
        assert score_so_far(made)[0] == ("SNS so far", f"{metrics.sns(wanted):.1f}")
    assert (by_agent.drivers, by_person.drivers) == ({"goal"}, {PERSON})
    assert by_person.ended == "Out of time." and not by_person.why_not_human


def test_taking_over_and_what_counts():
    made = Drive(CONFIG, make_track(*TRACK), 1, load_agent("goal"), "goal")
    made.tick()
    made.hand_over(None)
    finish(made)
    assert made.drivers == {"goal", PERSON} and made.why_not_human == "goal and person drove it"
    made.begin(CONFIG, 1)
    made.set_lcf(1.0)
    made.draw_lcf()
    assert finish(made).why_not_human == ""
    made.begin(CONFIG, 1)
    made.tick()
    made.set_lcf(1.0)
    assert (made.lcf == 1.0).all()
    assert "set by hand" in finish(made).why_not_human

    def broken(observation):
        return [np.nan, 0.0]

    made.begin(CONFIG, 1, load_agent(broken), "broken")
    made.tick()
    assert made.driver == PERSON and "two finite numbers" in made.trouble


def test_beams_end_on_what_stands_there():
    made = Drive(CONFIG.replace(num_pedestrians=1, map_size=20.0), make_track(*TRACK), 3)
    points = made.scan()
    met = points[~np.isnan(points).any(axis=1)]
    reach = np.abs(met[:, :2]).max(axis=1)
    at_person = np.hypot(*(met[:, :2] - made.now("people")[0, :2]).T)
    assert len(points) == 720 and len(met) > 100
    assert np.all((np.abs(reach - 10.0) < 0.01) | (np.abs(at_person - 0.35) < 0.01))
    assert np.ptp(met[:, 2]) < 0.05


def test_a_course_goes_on_to_what_was_not_driven():
    settings = {"all": CONFIG}
    endless, suite = Course(settings, (), 7), Course(settings, (3, 9, 4))
    assert endless.after(None) == 7 and endless.after(7) == 8 and endless.after(None, frozenset([7, 8])) == 9
    assert [suite.after(seed) for seed in (None, 3, 9, 4, 100)] == [3, 9, 4, 3, 3]
    assert suite.after(None, frozenset([3])) == 9 and suite.after(9, frozenset([3, 4])) == 9
    assert suite.why_not("all", CONFIG, 4) == "" and "seed" in suite.why_not("all", CONFIG, 5)
    assert "setting" in suite.why_not("all", CONFIG.replace(lcf=1.0), 4) and endless.why_not("all", CONFIG, 5) == ""


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """The folder of two episodes of the suite `smoke`, made short, that a person drove, and its task's changes."""
    out = tmp_path_factory.mktemp("human")
    suite, changes = load_suite("smoke"), {"horizon": 5, "num_pedestrians": 3, "pedestrian_model": "standing"}
    cells = [Cell((), suite.cells[0].config.replace(**changes))]
    kept = Driven(out, "smoke", cells, TRACK, suite_digest=None, overrides={k: str(v) for k, v in changes.items()})
    made = Drive(cells[0].config, make_track(*TRACK), suite.seeds[0])
    assert "Kept: 1" in kept.keep(finish(made), "all")
    made.begin(cells[0].config, suite.seeds[1])
    assert "Kept: 2" in kept.keep(finish(made), "all")
    return out, changes, cells, suite


def test_people_stand_in_the_tables(driven, tmp_path, capsys):
    out, changes, _, suite = driven
    found = Results.load(out)
    assert found.agent == "human" and found.seed.tolist() == list(suite.seeds[:2])
    other = benchmark.evaluate(
        "goal", "smoke", out=tmp_path / "goal", episodes=2, overrides=changes, videos=0, quiet=True
    )
    for name, values in other.metrics.items():  # this person drives as `goal` does
        np.testing.assert_array_equal(found.metrics[name], values)
    assert cli.main(["compare", str(out), str(tmp_path / "goal"), "--out", str(tmp_path / "compared")]) == 0
    assert cli.main(["leaderboard", str(out), str(tmp_path / "goal")]) == 0
    assert "| `human` | local, lidar2d |" in capsys.readouterr().out


def test_only_what_a_person_drove_alone_and_first_is_kept(driven, tmp_path):
    out, _, cells, suite = driven
    before = (out / "results.json").read_bytes()
    kept = Driven(out, "smoke", cells, TRACK, suite_digest=None)  # goes on with what is there
    assert kept.seeds("all") == set(suite.seeds[:2])
    made = Drive(cells[0].config, make_track(*TRACK), suite.seeds[0])
    assert "driven before, and the first drive counts" in kept.keep(finish(made), "all")
    made.begin(cells[0].config, suite.seeds[2], load_agent("goal"), "goal")
    assert "Not kept: goal drove it" in kept.keep(finish(made), "all")
    other = finish(Drive(cells[0].config, make_track("global", "lidar2d"), suite.seeds[2]))
    assert "another agent's sensors" in kept.keep(other, "all")
    assert (out / "results.json").read_bytes() == before
    changed = [Cell((), cells[0].config.replace(horizon=7))]
    with pytest.raises(UsageError, match=r"were driven under other conditions: cells changed since\. Name another"):
        Driven(out, "smoke", changed, TRACK)


def test_what_a_person_did_can_be_learned_from(driven, tmp_path):
    pytest.importorskip("stable_baselines3")
    from bson.learning import dataset, imitation
    from bson.learning import train as training

    out, changes, cells, _ = driven
    config = cells[0].config
    for episode, seen, actions in read_driven(out, config):
        assert len(actions) == 5 and len(seen["lidar"]) == len(episode.pose) == 6
        for step, action in enumerate(actions):
            np.testing.assert_array_equal(action, np.clip(GOAL({k: v[step] for k, v in seen.items()}), -1, 1))
    recorded = dataset.demonstrations(str(out), config, 100)
    assert [len(x) for _, x, _ in recorded] == [5, 5]
    # An agent that learned on such features, asked with what was recorded, acts as it does in the world.
    ppo = made_for(load_agent("ppo"), Setting.of(config, make_track(*TRACK)))
    for (_, x, _), (_, seen, actions) in zip(recorded, read_driven(out, config), strict=True):
        ppo.reset(0)
        acted = [ppo({key: values[step] for key, values in seen.items()}) for step in range(len(actions))]
        np.testing.assert_allclose(ppo.act(x), acted, atol=1e-6)
    bc = imitation.BcConfig(demonstrations=str(out), keep=1.0, hidden=(8,), batch=4, epochs=2)
    task = {name: changes[name] for name in ("horizon", "num_pedestrians", "pedestrian_model")}
    made = training.TrainConfig("bc", steps=100, task=task, validate_episodes=1, hyperparameters=bc)
    folder = training.train(made, tmp_path)
    assert json.loads((folder / "policy.json").read_text())["hyperparameters"]["demonstrations"] == str(out)
    with pytest.raises(UsageError, match="was driven at a control period and top speeds of 0.1 s, .* not 0.2 s"):
        dataset.demonstrations(str(out), config.replace(control_period=0.2), 100)


def test_demonstrations_that_do_not_fit_are_one_line(driven, tmp_path, capsys):
    pytest.importorskip("stable_baselines3")
    words = ["--algo", "bc", "--demonstrations", str(driven[0]), "--set", "control_period=0.2"]
    assert cli.main(["train", *words, "--out", str(tmp_path / "runs")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "was driven at a control period and top speeds of 0.1 s" in error
    assert not (tmp_path / "runs").exists()
    with pytest.raises(UsageError, match="has no episodes that a person drove"):
        read_driven(tmp_path, driven[2][0].config)
    copied = tmp_path / "cut"
    (copied / "episodes").mkdir(parents=True)
    for file in (driven[0] / "episodes").iterdir():
        content = file.read_bytes()
        (copied / "episodes" / file.name).write_bytes(content[:-9] if file.suffix == ".npz" else content)
    with pytest.raises(UsageError, match="is damaged. Delete it"):
        read_driven(copied, driven[2][0].config)


BAD = {
    "--host 0.0.0.0": "--host 0.0.0.0 lets other machines in: give a --token",
    "--agent nobody": "Unknown agent 'nobody'",
    "--suite nothing": "Unknown suite 'nothing'",
    "--cell all": "--cell is one of a suite: give --suite, too.",
    "--suite smoke --cell none": "Suite 'smoke' has no cell 'none'. Choose one of 'all'.",
    "--sensor sonar": "Unknown sensor 'sonar'",
    "--set num_pedestrians=-1": "num_pedestrians must be a whole number",
    "--set num_pedestrians=200 --set map_size=10": "people found room",
    "--agent tac --set control_period=0.2": "Agent 'tac'",
    "--out /dev/null": "Can't write to '/dev/null'",
}


@pytest.mark.parametrize("words", BAD)
def test_bad_input_is_one_line_and_leaves_nothing(words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["live", *words.split()]) == 2
    told = capsys.readouterr()
    assert told.out == "" and told.err.count("\n") == 1 and BAD[words] in told.err
    assert not list(tmp_path.iterdir())


def test_the_page_in_a_browser(tmp_path):
    """The command as a user gives it: keys move the robot, the knob turns everybody, a drive is kept, and closing the
    page ends the process."""
    chromium()
    out, code = (
        tmp_path / "human",
        "import macid.live.server as s, bson.cli as c; s.LINGER = 1.0; raise SystemExit(c.main())",
    )
    words = ["live", "--port", "0", "--out", str(out), "--set", "horizon=400", "--set", "pedestrian_model=standing"]
    words += ["--set", "map_size=20.0", "--set", "goal_distance=(6, 12)", "--set", "num_pedestrians=4"]
    process: Any = subprocess.Popen(
        [sys.executable, "-c", code, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        url = re.search(r"http://\S+", process.stdout.readline())[0]
        with Browser() as browser:
            page = browser.open(url)
            until(lambda: page.reading("Time") not in (None, "0.0 of 40 s"))
            assert page.reading("Way driven") == "0.00 m" and page.reading("Drives") == PERSON
            page.key("KeyW", True)
            until(lambda: float((page.reading("Way driven") or "0").split()[0]) > 0.5)
            page.key("KeyW", False)
            until(lambda: page.reading("Speed") == "0.00 m/s")
            picture = page.screenshot(tmp_path / "page.png")
            seen = picture[:, : picture.shape[1] // 2].reshape(-1, 3)
            assert len(np.unique(seen // 16, axis=0)) > 8
            assert page.reading("Counts") == "yes"
            page.slide("LCF of all", "Home")
            until(lambda: page.reading("LCF: mean, least, most") == "-2.00, -2.00, -2.00")
            until(lambda: page.reading("Counts") == "no: LCFs were set by hand")
            page.slide("Density", "End")
            until(lambda: page.reading("Counts") == "no: its setting was changed on the page")
            page.close()
            assert process.wait(30) == 0
        assert process.stderr.read() == "" and not out.exists()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        process.stderr.close()


def test_ctrl_c_ends_it_in_one_line(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "bson.cli", "live", "--port", "0", "--stay", "--out", str(tmp_path / "human")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline().startswith("Open http://127.0.0.1:")
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and errors == "bson: interrupted\n" and not (tmp_path / "human").exists()
