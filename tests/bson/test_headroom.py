import dataclasses

import make_pages as pages
import numpy as np
import pytest

from bson.agents import load_agent
from bson.episodes.tracks import make_track
from bson.evaluation.headroom import most, most_of
from bson.evaluation.metrics import measure
from bson.evaluation.play import run_episodes
from bson.evaluation.suites import load_suite
from bson.task import TaskConfig, spawn

EMPTY = TaskConfig(num_pedestrians=0, map_size=30.0, goal_distance=(12.0, 16.0))


def drawn(config, seed):
    return spawn(config, np.random.default_rng(seed))


def test_the_most_of_an_open_map_by_hand():
    start = drawn(EMPTY, 4)
    score, completed, speed, efficiency, straight, shortest = most(EMPTY, start)
    distance = float(np.hypot(*(start.goal - start.robot[:2])))
    assert straight == shortest == pytest.approx(distance) and efficiency == speed == 1.0
    assert completed == pytest.approx(1.0 - 0.3 / distance)  # 2 m/s for 0.1 s inside the goal's 0.5 m
    assert score == pytest.approx(100.0 * completed)
    _, _, speed, *_ = most(EMPTY.replace(robot={"name": "jackal", "max_speed": 1.2}), start)
    assert speed == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("agent", "track", "obstacles", "gap"), [("goal", "local", 0.0, 1.5), ("astar", "global", 1.0, 12.0)]
)
def test_no_robot_does_better_than_the_most_and_alone_it_comes_near(agent, track, obstacles, gap):
    config = EMPTY.replace(obstacle_density=obstacles)
    for episode in run_episodes(load_agent(agent), config, make_track(track, "lidar2d"), [1, 2]):
        found = most(config, drawn(config, episode.seed))
        assert episode.arrived and found.SNS - gap < measure(episode)["SNS"] <= found.SNS
        assert found.straight == pytest.approx(episode.start_distance)
        assert found.shortest <= episode.shortest + 1e-9 and (found.shortest > found.straight) == bool(obstacles)


def test_a_suites_most_is_the_mean_over_each_cells_episodes():
    suite = load_suite("smoke")
    suite = dataclasses.replace(suite, seeds=suite.seeds[:3])
    each = [most(suite.cells[0].config, drawn(suite.cells[0].config, seed)) for seed in suite.seeds]
    assert most_of(suite)["all"] == pytest.approx(tuple(np.mean(each, axis=0)))


def test_the_shipped_figures_are_of_todays_suites_and_nobody_beats_them():
    shipped, board = pages.shipped("headroom"), pages.board()
    assert {"paper", "standard", "scenarios", "street", "dense"} <= shipped.keys()
    for name, suite in shipped.items():
        assert suite["digest"] == load_suite(name).digest
        assert list(suite["most"]) == [cell.name for cell in load_suite(name).cells]
        for row in [*board.get(name, {}).values(), *suite["agents"].values()]:
            assert row["SNS"] <= pages.mean_most(suite)
    text = (pages.RESULTS / "leaderboard.md").read_text()
    ranked = [line for line in text.splitlines() if line.startswith("| ") and line[2].isdigit()]
    assert {"paper", "standard"} <= board.keys() and sum(map(len, board.values())) == len(ranked) >= 24
    row = board["standard"]["vfh"]
    assert "| {SNS:.1f} [{low:.1f}, {high:.1f}] |".format(**row) in text and row["low"] < row["SNS"] < row["high"]


def test_the_most_of_paper_follows_from_the_suite():
    score, *_ = most_of(load_suite("paper"))["all"]
    assert score == pytest.approx(pages.shipped("headroom")["paper"]["most"]["all"]["SNS"], abs=0.01)
