import itertools

import numpy as np
import pytest

from bson.episodes.effects import find_effects
from bson.episodes.record import Episode
from bson.evaluation.metrics import GROUPS, METRICS, PARTS, measure, spread_by_score, summarise, time_to_collision

TOUCH = 0.31 + 0.35  # between the centres of robot and person, as discs [m]


def episode(start=20.0, final=0.0, travelled=20.0, duration=10.0, collisions=0, nearest=(3.0, 2.0), **more):
    steps = len(more.get("velocity", nearest))
    fields = {
        "seed": 0,
        "start_distance": start,
        "shortest": start,
        "final_distance": final,
        "travelled": travelled,
        "duration": duration,
        "arrived": final <= 0.5,
        "timed_out": final > 0.5,
        "collisions": collisions,
        "collisions_person": collisions,
        "collisions_robot_on_person": 0,
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
        "people_velocity": np.zeros((steps, 0, 2)),
        "qpos": np.zeros((steps, 7)),
        "period": 0.1,
        "robot_radius": 0.31,
    }
    return Episode(**{**fields, **more})


def speeds(*values):
    """An episode whose speed ahead is `values` at its T + 1 control steps of 0.1 s."""
    return episode(velocity=np.column_stack([values, np.zeros(len(values))]).astype(float))


def meeting(place, velocity, speed=1.0, yaw=0.0):
    """One instant: the robot in the origin at `speed` along `yaw`, one person at `place` with `velocity`."""
    return episode(
        nearest=(1.0,),
        pose=np.array([[0.0, 0.0, yaw]]),
        velocity=np.array([[speed, 0.3]]),
        people=np.array([[[*place, 2.0]]], float),
        people_velocity=np.array([[velocity]], float),
    )


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
        (
            {"final": 22.0, "travelled": 2.0, "duration": 1.0, "collisions": 40},
            -0.1 * 50.0,
        ),  # and into walls: no better
    ],
)
def test_sns_by_hand(changes, expected):
    assert measure(episode(**changes))["SNS"] == pytest.approx(expected)


@pytest.mark.parametrize("final", [0.4, 10.0, 20.0, 22.0, 60.0])
def test_no_score_rises_with_collisions(final):
    scores = [measure(episode(start=20.0, final=final, travelled=25.0, collisions=count))["SNS"] for count in range(60)]
    assert all(before >= after for before, after in itertools.pairwise(scores))


def test_personal_space_and_nearest_person_by_hand():
    done = measure(episode(nearest=(3.0, 1.0, 0.5, 2.0)))
    assert done["nearest_person"] == 0.5
    assert done["personal_space"] == 0.5


def test_shares_of_time_in_the_spaces_of_a_person_by_hand():
    done = measure(episode(nearest=(4.0, 3.0, 1.0, 0.5, 0.4, 0.45, 1.2, 3.6)))
    assert (done["intimate_space"], done["personal_space"], done["social_space"]) == (1 / 8, 4 / 8, 6 / 8)
    assert done["nearest_person_mean"] == pytest.approx(14.15 / 8)
    assert done["nearest_person"] == 0.4


@pytest.mark.parametrize(
    ("place", "velocity", "moving", "expected"),
    [
        ((3.0, 0.0), (0.0, 0.0), {}, 3.0 - TOUCH),  # a person ahead stands
        ((3.0, 0.0), (-1.0, 0.0), {}, (3.0 - TOUCH) / 2),  # head-on
        ((3.0, 0.0), (0.5, 0.0), {}, (3.0 - TOUCH) / 0.5),  # caught up with
        ((3.0, 0.0), (1.0, 0.0), {}, np.inf),  # as fast
        ((3.0, 0.0), (2.0, 0.0), {}, np.inf),  # walks away
        ((-3.0, 0.0), (0.0, 0.0), {}, np.inf),  # behind
        ((-3.0, 0.0), (3.0, 0.0), {}, (3.0 - TOUCH) / 2),  # from behind
        ((3.0, 0.7), (0.0, 0.0), {}, np.inf),  # passed by
        ((3.0, 0.5), (0.0, 0.0), {}, 3.0 - np.sqrt(TOUCH**2 - 0.25)),  # brushed
        ((2.0, -2.0), (0.0, 1.0), {}, 2.0 - TOUCH / np.sqrt(2)),  # crossing: both at (2, 0) after 2 s
        ((3.0, 0.0), (-1.0, 0.0), {"speed": 0.0}, 3.0 - TOUCH),  # the robot stands
        ((3.0, 0.0), (0.0, 0.0), {"speed": 0.0}, np.inf),  # both stand
        ((0.0, 3.0), (0.0, 0.0), {"yaw": np.pi / 2}, 3.0 - TOUCH),  # ahead is where the robot looks
        ((-3.0, 0.0), (0.0, 0.0), {"speed": -1.0}, 3.0 - TOUCH),  # driving back
        ((0.5, 0.0), (5.0, 0.0), {}, 0.0),  # there already, parting
        ((0.0, 0.0), (0.0, 0.0), {"speed": 0.0}, 0.0),  # in one another
    ],
)
def test_time_to_collision_by_hand(place, velocity, moving, expected):
    done = meeting(place, velocity, **moving)
    assert time_to_collision(done) == pytest.approx([expected])
    assert measure(done)["time_to_collision"] == pytest.approx(expected)


def test_time_to_collision_is_the_least_over_people_and_steps():
    people = np.array([[[9.0, 0, 0], [-9.0, 0, 0]], [[8.0, 0, 0], [-8.0, 0, 0]]])
    done = episode(
        velocity=np.array([[0.0, 0], [1.0, 0]]), people=people, people_velocity=np.array([[[-1.0, 0], [2, 0]]] * 2)
    )
    np.testing.assert_allclose(time_to_collision(done), [(9 - TOUCH) / 2, (8 - TOUCH) / 2])
    assert measure(done)["time_to_collision"] == pytest.approx((8 - TOUCH) / 2)
    assert time_to_collision(episode()).tolist() == [np.inf, np.inf]


def test_speed_acceleration_and_jerk_by_hand():
    done = measure(speeds(0.0, 1.0, 1.0, 0.5, -0.5))
    values = {
        name: [done[f"{name}_{kind}"] for kind in ("min", "mean", "max")] for name in ("speed", "acceleration", "jerk")
    }
    assert values["speed"] == pytest.approx([0.5, 0.75, 1.0])
    assert values["acceleration"] == pytest.approx([-10.0, 6.25, 10.0])  # 10, 0, -5, -10
    assert values["jerk"] == pytest.approx([-100.0, 200 / 3, -50.0])  # -100, -50, -50


def test_stalled_time_by_hand():
    assert measure(speeds(0.0, 1.0, 0.05, -0.05, 0.1, -1.0))["stalled_time"] == pytest.approx(0.2)
    assert measure(speeds(0.0, 0.0, 0.0, 0.0))["stalled_time"] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, 1.0),
        ({"travelled": 40.0}, 0.5),
        ({"travelled": 40.0, "shortest": 30.0}, 0.75),  # around a wall
        ({"travelled": 19.6}, 1.0),  # the last 0.5 m are not driven
        ({"final": 0.6}, 0.0),
        ({"travelled": 0.0, "final": 20.0}, 0.0),
    ],
)
def test_spl_by_hand(changes, expected):
    assert measure(episode(**changes))["SPL"] == pytest.approx(expected)


def test_ends_collisions_and_ways_by_hand():
    there = measure(
        episode(
            collisions=9, collisions_person=6, collisions_robot_on_person=2, collisions_obstacle=3, collisions_wall=1
        )
    )
    kinds = ("person", "robot_on_person", "person_on_robot", "obstacle", "wall")
    assert [there[f"Coll_{kind}"] for kind in kinds] == [6, 2, 4, 3, 1]
    assert (there["success"], there["timeout"], there["time"], there["time_to_goal"]) == (1, 0, 10, 10)
    late = measure(episode(final=3.0, travelled=25.0))
    assert (late["success"], late["timeout"], late["time"], late["time_to_goal"]) == (0, 1, 10, np.inf)
    assert (there["path_length"], late["path_length"]) == (20.0, 25.0)
    assert measure(episode(final=3.0, timed_out=False))["timeout"] == 0  # cut off otherwise


@pytest.mark.parametrize("steps", [0, 1])
def test_an_episode_of_hardly_any_step_has_all_metrics(steps):
    alone = {"nearest": (np.inf,) * (steps + 1), "travelled": 0.0, "duration": 0.1 * steps, "final": 20.0}
    done = measure(episode(**alone))
    infinite = {name for name, value in done.items() if not np.isfinite(value)}
    paired = {"delay", "detour", "added_contact"}
    assert infinite == {"nearest_person", "nearest_person_mean", "time_to_collision", "time_to_goal"} | paired
    assert not any(np.isnan(value) for value in done.values())
    assert all(
        done[f"{name}_{kind}"] == 0 for name in ("speed", "acceleration", "jerk") for kind in ("min", "mean", "max")
    )
    assert done["stalled_time"] == pytest.approx(0.1 * steps)


STRAIGHT = np.array([[0, 0], [1, 0], [2, 0], [3, 0], [4, 0]])  # places a second apart; the goal is (3, 0)
LATE = np.array([[0, 0], [1, 0], [1, 0], [2, 0], [3, 0]])
AROUND = np.array([[0, 0], [1, 1], [2, 0], [3, 0], [4, 0]])
NEVER = np.array([[0, 0], [0, 1], [0, 0], [0, 1], [0, 0]])
BESIDE = np.array([[0, -9], [1, -9], [2, -0.705], [3, -0.705], [4, -0.72]])  # touches whoever goes straight, twice
NEAR, FAR, LEFT, DOWN = [1.5, 4.0], [1.5, -20.0], [0, 1], [0, -9]


def paired(people, alone, robot=NEAR):
    """delay, detour, added_contact. people, alone: the ways (5, 2) of each with the robot at `robot`, and without
    it."""
    ways = [np.pad(np.array(rows, float), [(0, 0), (0, 0), (0, 1)]).swapaxes(0, 1) for rows in (people, alone)]
    steps, number = ways[0].shape[:2]
    pose = np.column_stack([np.broadcast_to(robot, (steps, 2)), np.zeros(steps)])
    goals = np.array([[3.0, way[0][1]] for way in people])
    done = episode(people=ways[0], people_alone=ways[1], people_goals=goals, pose=pose, period=1.0,
                   velocity=np.zeros((steps, 2)), people_velocity=np.zeros((steps, number, 2)),
                   nearest=np.full(steps, 1.0))  # fmt: skip
    return [measure(done)[name] for name in ("delay", "detour", "added_contact")]


@pytest.mark.parametrize(
    ("people", "alone", "expected"),
    [
        ([STRAIGHT], [STRAIGHT], [0.0, 0.0, 0.0]),
        ([LATE], [STRAIGHT], [1.0, 0.0, 0.0]),
        ([STRAIGHT], [LATE], [-1.0, 0.0, 0.0]),  # a robot may be of use
        ([AROUND], [STRAIGHT], [0.0, 2 * 2**0.5 - 2, 0.0]),
        ([NEVER], [STRAIGHT], [1.0, 4.0, 0.0]),  # not there by the end, at 4 s, and 4 m for nothing
        ([STRAIGHT], [NEVER], [-1.0, -4.0, 0.0]),
        ([NEVER], [NEVER], [np.inf, 0.0, 0.0]),  # whether it would be late, nobody knows
        ([LATE, STRAIGHT + LEFT], [STRAIGHT, STRAIGHT + LEFT], [0.5, 0.0, 0.0]),  # the mean of both
        ([LATE, STRAIGHT + DOWN], [STRAIGHT, STRAIGHT + DOWN], [1.0, 0.0, 0.0]),  # the other was not met
        ([STRAIGHT, BESIDE], [STRAIGHT, STRAIGHT + DOWN], [0.0, 0.0, 2.0]),
        ([STRAIGHT, BESIDE + DOWN], [STRAIGHT, BESIDE], [0.0, 0.0, -2.0]),
    ],
)
def test_what_the_robot_does_to_others_by_hand(people, alone, expected):
    assert paired(people, alone) == pytest.approx(expected)


def test_only_whom_the_robot_met_on_the_way_to_the_first_goal_counts():
    assert paired([LATE], [STRAIGHT], FAR) == [np.inf] * 3
    at_the_end = [FAR, FAR, FAR, FAR, [4.0, 1.0]]
    assert paired([STRAIGHT], [LATE], at_the_end) == [np.inf] * 3  # it was there already
    assert paired([LATE], [STRAIGHT], at_the_end)[0] == 1.0
    for distance, met in ((3.599, True), (3.601, False)):
        assert np.isfinite(paired([NEVER], [STRAIGHT], [-distance - TOUCH, 0.0])[0]) == met


def test_without_its_pair_an_episode_says_nothing_about_others():
    done = measure(meeting((1.0, 0.0), (0.0, 0.0)))
    assert [done[name] for name in ("delay", "detour", "added_contact")] == [np.inf] * 3


def test_the_table_of_metrics_is_whole():
    assert tuple(metric.name for metric in METRICS[:5]) == PARTS
    groups = [group for group, _ in itertools.groupby(METRICS, lambda m: m.group)]
    assert [*groups, "own"] == list(GROUPS)
    assert list(measure(episode())) == [metric.name for metric in METRICS]
    assert len({metric.name for metric in METRICS}) == len(METRICS)
    for metric in METRICS:
        assert metric.better in ("up", "down", "") and metric.what
    assert {metric.name for metric in METRICS if not metric.better} == {"speed_min", "speed_mean", "speed_max"}


def test_infinite_values_do_not_enter_a_mean_and_are_counted():
    measured = [measure(episode(final=final, duration=duration)) for final, duration in ((0, 10), (9, 50), (0, 20))]
    summary = summarise(measured)
    assert (summary["time_to_goal"]["mean"], summary["time_to_goal"]["count"]) == (15.0, 2)
    assert (summary["time"]["mean"], summary["time"]["count"]) == (80 / 3, 3)
    assert "time_to_collision" not in summary


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
    assert summarise([]) == {}
    assert summary["personal_space"]["mean"] == 0.0


def test_spread_goes_evenly_from_the_worst_score_to_the_best():
    episodes = [episode(collisions=c) for c in (3, 0, 9, 5, 1)]
    assert [e.collisions for e in spread_by_score(episodes, 3)] == [9, 3, 0]
    assert [e.collisions for e in spread_by_score(episodes, 99)] == [9, 5, 3, 1, 0]
    assert spread_by_score(episodes[:1], 2) == episodes[:1]


def test_metrics_are_of_the_episodes_radius():
    head_on = {
        "nearest": (1.0,),
        "pose": np.zeros((1, 3)),
        "velocity": np.array([[1.0, 0.0]]),
        "people": np.array([[[5.0, 0.0, 0.0]]]),
        "people_velocity": np.array([[[-1.0, 0.0]]]),
    }
    for radius in (0.2, 0.35):
        met = episode(**head_on, person_radius=radius)
        assert time_to_collision(met)[0] == pytest.approx((5.0 - 0.31 - radius) / 2.0)
    walk = np.zeros((3, 2, 3))
    walk[:, 0, 0] = walk[:, 1, 0] = [0.0, 1.0, 2.0]
    apart, close = walk.copy(), walk.copy()
    apart[:, 1, 1], close[:, 1, 1] = 3.0, 0.5
    paired = {"people": close, "people_alone": apart, "people_goals": np.array([[9.0, 0.0], [9.0, 3.0]])}
    for radius, touched in ((0.2, 0.0), (0.35, 0.2)):
        found = find_effects(episode(nearest=(1.0,) * 3, pose=np.zeros((3, 3)), person_radius=radius, **paired))
        np.testing.assert_allclose(found["added_contact"], touched)
