import dataclasses
import json

import numpy as np
import pytest

from bson.agents import load_agent
from bson.cli import main
from bson.evaluate import format_summary, results, run_episodes
from bson.metrics import METRICS, measure
from bson.report import make_report
from bson.session import Session
from bson.suites import load_suite, suite_names
from bson.task import TaskConfig, spawn
from bson.tracks import make_track
from macid import assets

TRACK = make_track("local", "lidar2d")
SMALL = TaskConfig(num_pedestrians=5, map_size=20.0, goal_distance=(6.0, 15.0), horizon=120)


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
        seeds = []

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


def test_results_are_json_with_the_promised_keys(episodes):
    content = json.loads(json.dumps(results("goal", "smoke", SMALL, episodes), allow_nan=False))
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
    text = format_summary(results("goal", "smoke", SMALL, [late, *episodes[1:]]))
    lines = {line.split()[0]: line.split() for line in text.splitlines()}
    arrived = sum(episode.arrived for episode in episodes[1:])
    assert arrived and lines["time_to_goal"][-3:] == ["down,", str(arrived), f"episode{'s' if arrived > 1 else ''}"]
    assert lines["path_length"][-2:] == ["m", "down"] and lines["SNS"][-1] == "up"


def test_the_report_shows_the_score_and_needs_no_other_file(episodes):
    content = results("goal & co", "smoke", SMALL, episodes, people=5)
    page = make_report(content, episodes, no_video="No video: no GL <here>.")
    assert f"<b>{content['summary']['SNS']:.1f}</b>" in page
    assert "goal &amp; co" in page and "No video: no GL &lt;here&gt;." in page
    assert page.count("data:image/png;base64,") >= 2
    assert 'src="http' not in page and "href=" not in page
    assert all(f"{metric.name}<" in page or f"{metric.name} <" in page for metric in METRICS)


def test_suites_are_as_the_paper_says_and_apart():
    paper = load_suite("paper")
    assert len(set(paper.seeds)) == 100
    (cell,) = paper.cells
    assert cell.name == "all" and paper.axes == {}
    assert (cell.config.people, cell.config.obstacle_density, cell.config.lcf) == (24, 0.0, (-2.0, 2.0))
    assert not set(paper.seeds) & set(load_suite("smoke").seeds)
    assert {"paper", "smoke"} <= set(suite_names())
    assert paper.drawn(3) == list(paper.seeds[:3])
    assert not set(paper.drawn(seed=1)) & set(paper.seeds)
    with pytest.raises(ValueError, match="paper.*smoke"):
        load_suite("papers")
    with pytest.raises(ValueError, match="1 to 100"):
        paper.drawn(101)


def test_standard_has_every_combination_of_three_criteria():
    standard = load_suite("standard")
    assert len(standard.cells) == 27 == len({cell.name for cell in standard.cells})
    assert {axis: len(grades) for axis, grades in standard.axes.items()} == {"obstacles": 3, "people": 3, "temper": 3}
    dense = [cell for cell in standard.cells if cell.name == "maze, dense, adversarial"][0].config
    assert (dense.obstacle_density, dense.people, dense.lcf) == (1.0, 200, (-2.0, -0.67))


def test_every_scenario_has_room_for_all_its_episodes():
    scenarios = load_suite("scenarios")
    assert len(scenarios.cells) == 7
    for cell in scenarios.cells:
        for seed in scenarios.seeds:
            drawn = spawn(cell.config, np.random.default_rng(seed))
            assert len(drawn.people) == cell.config.people > 0


def test_a_digest_follows_all_that_makes_the_episodes(tmp_path):
    paper, scenarios = load_suite("paper"), load_suite("scenarios")
    digests = {load_suite(name).digest for name in suite_names()}
    assert len(digests) == len(suite_names()) and paper.digest == load_suite("paper").digest
    assert dataclasses.replace(paper, seeds=paper.seeds[:-1]).digest != paper.digest
    text = assets.path("maps", "frontal.toml").read_text()
    found = []
    for wall in ("10.0", "9.0"):
        (tmp_path / "frontal.toml").write_text(text.replace("[[-10.0", f"[[-{wall}"))
        cell = dataclasses.replace(scenarios.cells[0], config=TaskConfig(map=str(tmp_path / "frontal.toml")))
        found.append(dataclasses.replace(scenarios, cells=(cell,)).digest)
    assert found[0] != found[1]


def test_a_suite_of_cells_is_summarised_cell_by_cell(tmp_path, capsys):
    out = tmp_path / "out"
    command = ["evaluate", "--agent", "goal", "--suite", "scenarios", "--episodes", "1", "--videos", "0"]
    assert main([*command, "--set", "horizon=5", "--out", str(out)]) == 0
    content = json.loads((out / "results.json").read_text())
    assert [cell["grades"]["scenario"] for cell in content["cells"]][:2] == ["frontal", "crossing"]
    assert len(content["episodes"]) == 7 and content["suite_digest"] is None  # overridden: no longer the suite
    scores = [cell["summary"]["SNS"] for cell in content["cells"]]
    assert content["summary"]["SNS"] == pytest.approx(np.mean(scores))


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
    assert "<b>" in make_report(results("stop", "smoke", config, worst, people=5), worst)
