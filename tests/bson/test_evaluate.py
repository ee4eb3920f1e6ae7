import dataclasses
import html
import json
from typing import ClassVar

import numpy as np
import pytest

from bson.agents import load_agent
from bson.cli import main
from bson.episodes.session import Session
from bson.episodes.tracks import make_track
from bson.evaluation.metrics import METRICS, measure
from bson.evaluation.play import format_summary, pair, results, run_episodes
from bson.evaluation.store import basis, files_digest
from bson.evaluation.suites import Cell
from bson.reporting.report import make_report
from bson.task import TaskConfig
from macid import assets
from macid.drawing import gl

TRACK = make_track("local", "lidar2d")
SMALL = TaskConfig(num_pedestrians=5, map_size=20.0, goal_distance=(6.0, 15.0), horizon=120)
CELLS = [Cell((), SMALL)]


@pytest.fixture(scope="module")
def episodes():
    return run_episodes(load_agent("goal"), SMALL, TRACK, [3, 1, 4, 15], batch=2)


def test_episodes_come_in_the_order_of_their_seeds_and_whole(episodes):
    assert [episode.seed for episode in episodes] == [3, 1, 4, 15]
    for episode in episodes:
        steps = len(episode.pose)
        assert episode.duration == pytest.approx(0.1 * (steps - 1))
        assert episode.people.shape == (steps, 5, 3) and episode.nearest_person.shape == (steps,)
        assert episode.arrived == (episode.final_distance <= 0.5)
        assert episode.arrived or steps == 121
        assert episode.final_distance == pytest.approx(np.hypot(*(episode.goal - episode.pose[-1, :2])))
        way = np.linalg.norm(np.diff(episode.pose[:, :2], axis=0), axis=-1).sum()
        assert way <= episode.travelled + 1e-9 and episode.travelled == pytest.approx(way, rel=0.02)


def test_an_episode_does_not_depend_on_the_batch(episodes):
    alone = run_episodes(load_agent("goal"), SMALL, TRACK, [4], batch=1)[0]
    assert np.array_equal(alone.qpos, episodes[2].qpos)
    assert measure(alone) == measure(episodes[2])


def test_the_evaluation_and_a_plain_loop_give_the_same_episode(episodes):
    session = Session(SMALL, TRACK, 1)
    observation, done = session.reset([0], [3]), False
    goal = load_agent("goal")()
    while not done:
        action = goal({key: value[0] for key, value in observation.items()})
        observation, _, terminated, truncated = session.step([0], action[None])
        done = terminated[0] or truncated[0]
    assert session.world.travelled[0] == episodes[0].travelled
    assert session.world.collisions[0] == episodes[0].collisions


def test_a_class_gets_an_object_a_world_and_is_reset_with_each_seed():
    class Noted:
        seeds: ClassVar[list[int]] = []

        def reset(self, seed):
            self.seeds.append(seed)

        def __call__(self, observation):
            return [0.0, 0.0]

    run_episodes(Noted, SMALL.replace(horizon=3), TRACK, [7, 8, 9], batch=2)
    assert sorted(Noted.seeds) == [7, 8, 9]


def test_an_episode_has_what_the_metrics_need(episodes):
    for episode in episodes:
        assert episode.shortest == pytest.approx(episode.start_distance)
        assert episode.timed_out != episode.arrived
        assert episode.robot_radius == pytest.approx(0.31, abs=0.001)
        assert 0 <= episode.collisions_robot_on_person <= episode.collisions_person
        moved = np.diff(episode.people[..., :2], axis=0) / 0.1
        mean = (episode.people_velocity[1:] + episode.people_velocity[:-1]) / 2
        assert np.median(np.abs(moved - mean)) < 0.05
    assert not np.isnan([list(measure(episode).values()) for episode in episodes]).any()


def test_the_shortest_way_in_a_maze_goes_around_its_walls():
    config = TaskConfig(num_pedestrians=0, obstacle_density=1.0, horizon=1)
    episodes = run_episodes(load_agent("stop"), config, TRACK, [0, 1, 2])
    ways = [episode.shortest / episode.start_distance for episode in episodes]
    assert min(ways) >= 1.0 - 1e-9 and max(ways) > 1.3


@pytest.fixture(scope="module")
def pairs():
    """Two episodes of a robot that stands where nobody comes near, and one of a robot that people meet."""
    config = TaskConfig(num_pedestrians=3, horizon=80, pedestrian_model="social-force")
    return config, pair(config, run_episodes(load_agent("stop"), config, TRACK, [0, 3, 7]))


def test_a_robot_that_is_far_from_everybody_changes_nothing_and_another_does(pairs):
    for episode in pairs[1][:2]:
        assert np.linalg.norm(episode.people[..., :2] - episode.pose[:, None, :2], axis=-1).min() > 15.0
        assert np.array_equal(episode.people, episode.people_alone)
        assert measure(episode)["delay"] == np.inf  # it met nobody
    met = pairs[1][2]
    assert met.nearest_person.min() < 2.5
    assert np.array_equal(met.people[0], met.people_alone[0])
    assert not np.array_equal(met.people[-1], met.people_alone[-1])
    assert measure(met)["detour"] != 0.0


def test_a_pair_does_not_depend_on_the_batch_and_is_played_once(pairs):
    config, episodes = pairs
    bare = [dataclasses.replace(episode, people_alone=None) for episode in episodes]
    bare[1] = dataclasses.replace(bare[1], pose=bare[1].pose[:30])  # shorter
    told = []
    again = pair(config, [episodes[0], *bare[1:]], lambda steps, episode: told.append(episode), batch=1)
    assert again[0] is episodes[0]
    assert np.array_equal(again[1].people_alone, episodes[1].people_alone[:30])
    assert np.array_equal(again[2].people_alone, episodes[2].people_alone)
    assert len(told) == 29 + 80
    assert {id(episode) for episode in told if episode is not None} == {id(again[1]), id(again[2])}


@pytest.fixture(scope="module")
def broken(tmp_path_factory):
    """The episodes of the fixture `episodes`, but physics fails in that of seed 1 after half a second."""
    step = Session.step

    def failing(self, ids, action):
        for index in ids:
            if self.world.seed[index] == 1 and self.world.steps[index] == 5:
                self.world.engine.qvel[index, 3] = np.nan
        return step(self, ids, action)

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("log"))  # MuJoCo writes its warnings there
        patch.setattr(Session, "step", failing)
        return run_episodes(load_agent("goal"), SMALL, TRACK, [3, 1, 4, 15], batch=2)


def test_an_episode_in_which_physics_fails_is_named_and_the_others_are_as_ever(broken, episodes):
    assert [bool(episode.fault) for episode in broken] == [False, True, False, False]
    assert "QVEL" in broken[1].fault and "person1/x" in broken[1].fault
    for one, other in zip(broken, episodes, strict=True):
        assert np.isfinite(one.qpos).all()
        assert one.fault or np.array_equal(one.qpos, other.qpos)
    assert pair(SMALL, broken[1:2]) == broken[1:2]  # nothing is played for it


def test_a_failed_episode_is_counted_and_never_scored(broken):
    content = json.loads(json.dumps(results("goal", "smoke", CELLS, [broken]), allow_nan=False))
    assert content["faults"] == [{"seed": 1, "cell": "all", "time": 0.5, "what": broken[1].fault}]
    assert [row["seed"] for row in content["episodes"]] == [3, 4, 15]
    assert content["counts"]["SNS"] == content["cells"][0]["episodes"] == 3
    mean = np.mean([measure(episode)["SNS"] for episode in broken if not episode.fault])
    assert content["summary"]["SNS"] == pytest.approx(mean)
    assert "1 episode" in format_summary(content) and broken[1].fault in format_summary(content)
    with pytest.raises(ValueError, match="all episodes.*Seed 1.*0.5 s.*person1/x"):
        results("goal", "smoke", CELLS, [broken[1:2]])


def test_a_cell_whose_episodes_all_failed_has_no_means(broken):
    cells = [Cell((("way", "short"),), SMALL), Cell((("way", "long"),), SMALL)]
    content = results("goal", "smoke", cells, [broken[1:2], broken[2:]])
    assert [cell["episodes"] for cell in content["cells"]] == [0, 2] and content["cells"][0]["summary"] == {}
    assert [row["cell"] for row in content["episodes"]] == ["long", "long"]
    assert content["summary"] == content["cells"][1]["summary"]


def test_results_are_json_with_the_promised_keys(episodes):
    content = json.loads(json.dumps(results("goal", "smoke", CELLS, [episodes]), allow_nan=False))
    assert {"agent", "suite", "config", "versions", "summary", "episodes"} <= set(content)
    assert list(content["summary"])[:5] == ["SNS", "RC", "Coll", "SP", "PE"]
    assert content["summary"]["SNS"] == pytest.approx(np.mean([row["SNS"] for row in content["episodes"]]))
    assert content["config"]["num_pedestrians"] == 5
    assert list(content["metrics"]) == list(measure(episodes[0]))
    assert content["metrics"]["nearest_person"] == {
        "unit": "m",
        "better": "up",
        "what": "least surface-to-surface distance to a person, at control steps",
    }
    assert content["counts"]["SNS"] == 4 and set(content["counts"]) == set(content["summary"])


def test_the_summary_in_words_counts_the_episodes_behind_a_mean(episodes):
    late = dataclasses.replace(episodes[0], arrived=False, timed_out=True)
    text = format_summary(results("goal", "smoke", CELLS, [[late, *episodes[1:]]]))
    lines = {line.split()[0]: line.split() for line in text.splitlines()}
    arrived = sum(episode.arrived for episode in episodes[1:])
    assert arrived and lines["time_to_goal"][-3:] == ["down,", str(arrived), f"episode{'s' if arrived > 1 else ''}"]
    assert lines["path_length"][-2:] == ["m", "down"] and lines["SNS"][-1] == "up"


def test_the_report_shows_the_score_and_needs_no_other_file(episodes):
    content = results("goal & co", "smoke", CELLS, [episodes])
    page = make_report(content, episodes, no_video="No video: no GL <here>.")
    assert f"<b>{content['summary']['SNS']:.1f}</b>" in page
    assert "goal &amp; co" in page and "No video: no GL &lt;here&gt;." in page
    assert page.count("data:image/png;base64,") >= 2
    assert 'src="http' not in page and "href=" not in page
    assert all(f"{metric.name}<" in page or f"{metric.name} <" in page for metric in METRICS)


def test_a_suite_of_cells_is_summarised_and_filmed_cell_by_cell(tmp_path, capsys):
    out, number = tmp_path / "out", 0 if gl.gl_problem() else 1
    command = ["evaluate", "--agent", "goal", "--suite", "scenarios", "--episodes", "1", "--videos", str(number)]
    assert main([*command, "--set", "horizon=5", "--out", str(out)]) == 0
    content = json.loads((out / "results.json").read_text())
    assert [cell["grades"]["scenario"] for cell in content["cells"]][:2] == ["frontal", "crossing"]
    assert len(content["episodes"]) == 7 and content["suite_digest"] is None  # overridden: no longer the suite
    assert [row["cell"] for row in content["episodes"]] == [cell["name"] for cell in content["cells"]]
    scores = {cell["name"]: cell["summary"]["SNS"] for cell in content["cells"]}
    assert content["summary"]["SNS"] == pytest.approx(np.mean(list(scores.values())))
    ends = {min(scores, key=scores.get), max(scores, key=scores.get)} if number else set()
    assert {path.name for path in out.glob("videos/*")} == {f"seed-7000-{name}.webm" for name in ends}
    page = html.unescape((out / "report.html").read_text())
    assert all(f"seed 7000 in '{name}', the" in page for name in ends)


def test_an_agent_may_bring_sensors_of_its_own_and_people_are_told_of_one_by_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(
        "from bson.sensors import Imu, Lidar2D\n"
        "def agent(observation):\n"
        "    assert observation['lidar'].shape == (90,)\n"
        "    return [0.0, 0.0]\n"
        "agent.sensor = (Imu(noise=1.0), Lidar2D(beams=90))\n"
    )
    command = ["evaluate", "--agent", "own.py", "--suite", "smoke", "--episodes", "2", "--videos", "0", "--paired"]
    command += ["--set", "horizon=60", "--set", "pedestrian_model=orca", "--set", "num_pedestrians=40", "--out", "own"]
    assert main(command) == 0
    content = json.loads((tmp_path / "own" / "results.json").read_text())
    assert content["track"] == ["local", "Imu + Lidar2D"]
    assert [(one["kind"], one["noise"]) for one in content["sensors"]] == [("Imu", 1.0), ("Lidar2D", 0.0)]
    for row in content["episodes"]:
        for name, values in row["people"].items():
            assert len(values) == 40
            told = [value for value in values if value is not None]
            assert (row[name] is None) == (not told)
            if told:
                assert row[name] == pytest.approx(np.mean(told), abs=1e-3)
    assert any(row["detour"] is not None for row in content["episodes"])


def test_the_digest_of_the_task_follows_the_content_of_its_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def digest():
        cells = [Cell((), TaskConfig(map="m.toml", pedestrian_model="p.npz", num_pedestrians=1, goal_distance=(2, 9)))]
        return files_digest(basis("goal", ["local", "lidar2d"], cells, False))

    def put(size, policy):
        (tmp_path / "m.toml").write_text(f"size = {size}")
        for suffix in (".npz", ".json"):
            (tmp_path / f"p{suffix}").write_bytes(assets.path("policies", policy + suffix).read_bytes())

    put(20.0, "macid-0")
    before = digest()
    assert digest() == before
    put(21.0, "macid-0")
    assert digest() != before
    put(20.0, "macid-1")
    assert digest() != before


def test_a_straight_free_drive_in_simulation_scores_its_route_completion():
    config = TaskConfig(num_pedestrians=0, map_size=60.0, goal_distance=(30.0, 40.0))
    (episode,) = run_episodes(lambda: lambda o: [0.9, 0.5 * np.arctan2(o["goal"][1], o["goal"][0])], config, TRACK, [0])
    done = measure(episode)
    assert episode.arrived and done["Coll"] == 0
    assert done["SNS"] == pytest.approx(100 * done["RC"], rel=0.005)


def test_the_report_bears_episodes_that_all_went_wrong():
    config = SMALL.replace(horizon=2)
    episodes = run_episodes(load_agent("stop"), config, TRACK, [1, 2])
    worst = [dataclasses.replace(e, nearest_person=e.nearest_person * 0 - 0.1, final_distance=99.0) for e in episodes]
    assert "<b>" in make_report(results("stop", "smoke", [Cell((), config)], [worst]), worst)
