import numpy as np
import pytest

from bson.metrics import Episode, measure, spread_by_score, summarise


def episode(start=20.0, final=0.0, travelled=20.0, duration=10.0, collisions=0, nearest=(3.0, 2.0), **more):
    steps = 2
    fields = {
        "seed": 0,
        "start_distance": start,
        "final_distance": final,
        "travelled": travelled,
        "duration": duration,
        "arrived": final <= 0.5,
        "collisions": collisions,
        "collisions_person": collisions,
        "collisions_obstacle": 0,
        "collisions_wall": 0,
        "collisions_so_far": np.zeros(steps, int),
        "nearest_person": np.array(nearest),
        "goal": np.zeros(2),
        "boxes": np.zeros((4, 5)),
        "lcf": np.zeros(0),
        "pose": np.zeros((steps, 3)),
        "velocity": np.zeros((steps, 2)),
        "people": np.zeros((steps, 0, 3)),
        "qpos": np.zeros((steps, 7)),
        "period": 0.1,
    }
    return Episode(**{**fields, **more})


def test_a_straight_free_run_at_full_speed_scores_a_hundred_times_its_route_completion():
    done = measure(episode(start=20.0, final=0.4, travelled=19.6, duration=19.6 / 1.5))
    assert done["SNS"] == pytest.approx(100 * done["RC"])
    assert done["RC"] == pytest.approx(0.98)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, 100.0),  # 2 m/s scores no more than 1.5 m/s
        ({"duration": 20.0}, 75.0),  # 1 m/s: SP 0.5
        ({"duration": 80.0}, 50.0),  # 0.25 m/s: SP 0
        ({"travelled": 40.0}, 75.0),  # PE 0.5, SP 1
        ({"final": 10.0, "travelled": 10.0, "duration": 5.0}, 50.0),  # half the route
        ({"collisions": 1}, 95.0),
        ({"collisions": 10}, 100 * 0.95**10),
        ({"final": 20.0, "travelled": 0.0}, 0.0),  # did not move
        ({"final": 22.0, "travelled": 2.0, "duration": 1.0}, -0.1 * 50.0),  # away from the goal: RC < 0, PE 0, SP 1
    ],
)
def test_sns_by_hand(changes, expected):
    assert measure(episode(**changes))["SNS"] == pytest.approx(expected)


def test_personal_space_and_nearest_person_by_hand():
    done = measure(episode(nearest=(3.0, 1.0, 0.5, 2.0)))
    assert done["nearest_person"] == 0.5
    assert done["personal_space"] == 0.5


def test_mean_of_episodes_is_eq_6_and_its_interval_covers_it():
    measured = [measure(episode(collisions=c)) for c in (0, 1, 5, 20)]
    sns = summarise(measured)["SNS"]
    assert sns["mean"] == pytest.approx(100 * (1 + 0.95 + 0.95**5 + 0.95**20) / 4)
    assert sns["low"] < sns["mean"] < sns["high"]
    assert summarise(measured)["SNS"] == sns


def test_bootstrap_interval_is_as_wide_as_theory_says():
    values = np.random.default_rng(1).normal(10.0, 2.0, 400)
    interval = summarise([{"x": value} for value in values])["x"]
    half = (interval["high"] - interval["low"]) / 2
    assert half == pytest.approx(1.96 * values.std() / np.sqrt(400), rel=0.05)


def test_metrics_without_people_leave_out_the_distance_to_them():
    summary = summarise([measure(episode(nearest=(np.inf, np.inf)))])
    assert "nearest_person" not in summary
    assert summary["personal_space"]["mean"] == 0.0


def test_spread_goes_evenly_from_the_worst_score_to_the_best():
    episodes = [episode(collisions=c) for c in (3, 0, 9, 5, 1)]
    assert [e.collisions for e in spread_by_score(episodes, 3)] == [9, 3, 0]
    assert [e.collisions for e in spread_by_score(episodes, 99)] == [9, 5, 3, 1, 0]
    assert spread_by_score(episodes[:1], 2) == episodes[:1]
