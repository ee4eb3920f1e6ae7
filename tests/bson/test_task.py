import dataclasses
import itertools

import numpy as np
import pytest

from bson.evaluation.suites import Cell
from bson.task import TaskConfig, spawn
from macid import geometry
from macid.layout import NoFreeSpace
from macid.state import RADIUS


def test_defaults_are_the_papers():
    config = TaskConfig()
    assert (config.people, config.obstacle_density, config.lcf) == (24, 0.0, (-2.0, 2.0))
    assert (config.reward.distance, config.reward.goal, config.reward.collision) == (1.0, 2.0, 1.0)
    assert (config.control_period, config.horizon, config.map_size) == (0.1, 1000, 50.0)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"pedestrian_density": 1.5}, "between 0 and 1"),
        ({"obstacle_density": -0.1}, "between 0 and 1"),
        ({"obstacle_density": float("nan")}, "between 0 and 1"),
        ({"num_pedestrians": -1}, "at least 0"),
        ({"num_pedestrians": 2.5}, "whole number"),
        ({"num_pedestrians": 3, "pedestrian_density": 0.1}, "not both"),
        ({"pedestrian_model": "crowdnav"}, "orca, social-force, social-force-bodies, social-force-progress"),
        ({"lcf": (1.0, -1.0)}, "least <= most"),
        ({"lcf": "high"}, "least, most"),
        ({"map_size": 1.0}, "between 10 and 500"),
        ({"control_period": 0.03}, "multiple of the physics step"),
        ({"control_period": 0.1, "pedestrian_period": 0.06}, "multiple of pedestrian_period"),
        ({"horizon": 0}, "at least 1"),
        ({"map": "hal"}, "Choose one of blind-corner, .*hall, office"),
        ({"map": 3}, "a name or a file"),
        ({"map": "hall", "obstacle_density": 0.5}, "its own obstacles"),
        ({"goal_distance": (0.0, 1.0)}, "at least 1 m"),
        ({"pedestrians": 3}, "num_pedestrians"),
        ({"num_pedestrians": 10**6}, "at most 2000"),
        ({"obstacle_density": None}, "between 0 and 1"),
        ({"pedestrian_model": ["orca"]}, "must be a name"),
        ({"pedestrian_model": {"orca": -1.0}}, "must be a name or"),
        ({"pedestrian_model": {"orca": 1.0, "orca2": 1.0}}, "Unknown pedestrian model 'orca2'"),
        ({"lcf_each": [0.0, 1.0]}, "lcf_each must be 24 numbers"),
        ({"reward": 3}, "distance, goal, collision"),
        ({"robot": {"max_sped": 1.0}}, "max_speed"),
        ({"robot": {"max_speed": -1.0}}, "max_speed must be a number above 0"),
        ({"robot": "jakal"}, "Unknown robot 'jakal'. Choose one of courier, diffbot, jackal, or a .toml file"),
        ({"robot": {"name": "jakal"}}, "courier, diffbot, jackal"),
        ({"robot": "no/such.toml"}, "no robot file 'no/such.toml'"),
        ({"robot": 3}, "one of courier, diffbot, jackal, a .toml file, or a dict of name, max_speed"),
        ({"control_period": 1e9}, "at most 10 s"),
    ],
)
def test_a_wrong_value_is_told_and_the_valid_ones_are_named(changes, named):
    with pytest.raises(ValueError, match=named):
        TaskConfig().replace(**changes)


def test_density_is_a_share_of_the_densest_crowd_and_replaces_a_count():
    assert TaskConfig(pedestrian_density=1.0).people == 200
    assert TaskConfig(num_pedestrians=7).replace(pedestrian_density=0.5).people == 100
    assert TaskConfig(pedestrian_density=0.5).replace(num_pedestrians=7).people == 7
    assert TaskConfig(pedestrian_density=0.0).people == 0


def test_one_lcf_stands_for_a_range_and_a_long_pedestrian_period_is_cut():
    assert TaskConfig(lcf=1).lcf == (1.0, 1.0)
    assert TaskConfig(control_period=0.06, pedestrian_period=0.1).decision_period == 0.06
    assert TaskConfig(reward={"goal": 5.0}).reward.goal == 5.0


@pytest.mark.parametrize("density", [0.0, 0.5, 1.0])
def test_spawns_are_free_apart_and_as_far_from_the_goal_as_asked(density):
    config = TaskConfig(num_pedestrians=40, obstacle_density=density)
    for seed in range(5):
        drawn = spawn(config, np.random.default_rng(seed))
        everybody = np.concatenate([drawn.robot[None, :2], drawn.people[:, :2]])
        apart = np.linalg.norm(everybody[:, None] - everybody, axis=-1) + 9 * np.eye(len(everybody))
        assert apart.min() >= 2 * RADIUS + 0.2 - 1e-9
        assert apart[0].min() >= 2 * RADIUS + 1.0
        assert geometry.point_box_distance(everybody, drawn.layout.boxes[None]).min() >= RADIUS + 0.2 - 1e-9
        assert 15.0 <= np.hypot(*(drawn.goal - drawn.robot[:2])) <= 40.0
        assert (np.abs(drawn.lcf) <= 2.0).all()


def test_a_map_without_room_is_told():
    with pytest.raises(NoFreeSpace, match="Lower the pedestrian"):
        spawn(TaskConfig(num_pedestrians=400, map_size=12.0, goal_distance=(5, 8)), np.random.default_rng(0))
    with pytest.raises(NoFreeSpace, match="no free goal"):
        spawn(TaskConfig(num_pedestrians=1, map_size=12.0, goal_distance=(30, 40)), np.random.default_rng(0))


SHELVES = "walls = [" + ", ".join(f"[-6, {y}, 6, {y}]" for y in np.arange(-5.4, 6, 1.2).round(1).tolist()) + "]"


@pytest.mark.parametrize(
    ("text", "people", "told"),
    [
        (SHELVES, 0, "^The robot finds no room in map .*0.85 m .* is asked for, and the most there is is 0.45 m"),
        (
            "[regions]\nrobot_start = [[-5.7, 0, 0.2, 0.2, 0]]",
            0,
            "^The robot .* region robot_start .* most there is is 0.50 m",
        ),
        (
            "[regions]\nrobot_goal = [[-5.7, 0, 0.2, 0.2, 0]]",
            0,
            "region robot_goal .* by the robot: 0.85 m .* is 0.50 m",
        ),
        (
            "[regions]\npeople_start = [[-5.9, 0, 0.1, 2, 0]]",
            5,
            "^Only 0 of 5 people .* people_start .* 0.55 m .* is 0.20 m",
        ),
        (
            "[regions]\npeople_start = [[-4, 0, 0.2, 0.2, 0]]",
            5,
            "^Only 1 of 5 people found room in region people_start",
        ),
        ("routes = [[[-4, 0], [4, 0]]]", 100, r"^Only \d+ of 100 people .* routes\[0\] .*Lower the pedestrian"),
    ],
)
def test_who_finds_no_room_is_told_with_what_was_asked_for_and_what_there_is(tmp_path, text, people, told):
    (tmp_path / "map.toml").write_text(f"size = 12.0\n{text}\n")
    config = TaskConfig(map=str(tmp_path / "map.toml"), num_pedestrians=people, goal_distance=(3.0, 10.0))
    with pytest.raises(NoFreeSpace, match=told):
        spawn(config, np.random.default_rng(0))


def test_a_map_that_is_too_small_is_named(tmp_path):
    (tmp_path / "map.toml").write_text("size = 5.0\n")
    with pytest.raises(ValueError, match="Map '.*map.toml' is 5 m wide.*10 to 500 m"):
        TaskConfig(map=str(tmp_path / "map.toml"))


def test_a_map_from_a_file_brings_its_size_people_and_regions():
    config = TaskConfig(map="hall")
    assert (config.map_size, config.people) == (24.0, 12)
    assert TaskConfig(map="hall", num_pedestrians=5).people == 5
    drawn = spawn(config, np.random.default_rng(0))
    regions = drawn.layout.regions
    assert geometry.point_box_distance(drawn.robot[:2], regions["robot_start"]).min() == 0
    assert geometry.point_box_distance(drawn.goal, regions["robot_goal"]).min() == 0
    for person, (place, goal) in enumerate(zip(drawn.people[:, :2], drawn.people_goals, strict=True)):
        route = drawn.layout.routes[person % 3]
        assert goal.tolist() in (route[0].tolist(), route[-1].tolist())
        dense = np.concatenate([np.linspace(a, b, 50) for a, b in itertools.pairwise(route)])
        assert np.linalg.norm(dense - place, axis=-1).min() <= 1.5


def test_a_goal_that_cannot_be_reached_is_told(tmp_path):
    (tmp_path / "cut.toml").write_text(
        "size = 20.0\nwalls = [[0.0, -10.0, 0.0, 10.0]]\n[regions]\n"
        "robot_start = [[-5.0, 0.0, 2.0, 5.0, 0.0]]\nrobot_goal = [[5.0, 0.0, 2.0, 5.0, 0.0]]\n"
    )
    with pytest.raises(NoFreeSpace, match="can't reach its goal"):
        spawn(
            TaskConfig(map=str(tmp_path / "cut.toml"), num_pedestrians=0, goal_distance=(3.0, 15.0)),
            np.random.default_rng(0),
        )


ROOM = "size = 24.0\nwalls = [[-4, -4, 4, -4], [4, -4, 4, 4], [4, 4, -4, 4], [-4, 4, -4, -4]]\n"


def test_people_keep_to_the_part_of_the_map_that_they_can_reach(tmp_path):
    (tmp_path / "room.toml").write_text(ROOM)
    config = TaskConfig(map=str(tmp_path / "room.toml"), num_pedestrians=30, goal_distance=(8.0, 20.0))
    for seed in range(10):
        drawn = spawn(config, np.random.default_rng(seed))
        places = np.concatenate([drawn.people[:, :2], drawn.people_goals, drawn.robot[None, :2], drawn.goal[None]])
        assert (np.abs(places).max(axis=-1) > 4).all()  # the room is too small for the robot's way


def test_people_who_cannot_reach_their_goal_are_told(tmp_path):
    (tmp_path / "room.toml").write_text(
        ROOM + "[regions]\npeople_start = [[0, 0, 3, 3, 0]]\npeople_goal = [[10, 0, 1, 8, 0]]\n"
    )
    (tmp_path / "route.toml").write_text(ROOM + "routes = [[[-10, 0], [10, 0]]]\n")
    for name, message in (("room", "no free goal that can be reached"), ("route", "no way from")):
        config = TaskConfig(map=str(tmp_path / f"{name}.toml"), num_pedestrians=4, goal_distance=(8.0, 20.0))
        if name == "route":  # people begin beside it, also in the room
            config = config.replace(num_pedestrians=25)
        with pytest.raises(NoFreeSpace, match=message):
            spawn(config, np.random.default_rng(0))


def test_models_are_mixed_by_their_shares():
    config = TaskConfig(num_pedestrians=400, pedestrian_model={"orca": 3, "social-force": 1})
    assert config.model_shares == {"orca": 0.75, "social-force": 0.25}
    assert hash(config) == hash(config.replace())
    drawn = spawn(config.replace(map_size=100.0), np.random.default_rng(0))
    assert 0.18 < drawn.models.mean() < 0.32


def test_each_pedestrian_may_have_an_lcf_of_its_own():
    given = np.linspace(-1.0, 1.0, 5)
    drawn = spawn(TaskConfig(num_pedestrians=5, lcf_each=given), np.random.default_rng(0))
    np.testing.assert_allclose(drawn.lcf, given)
    other = spawn(TaskConfig(num_pedestrians=5), np.random.default_rng(0))
    np.testing.assert_array_equal(drawn.people, other.people)


def test_a_robot_is_a_name_or_numbers_changed():
    assert TaskConfig(robot="jackal") == TaskConfig()
    slow = TaskConfig(robot={"name": "diffbot", "max_speed": 0.5})
    assert slow.robot == dataclasses.replace(TaskConfig(robot="diffbot").robot, max_speed=0.5)
    assert TaskConfig(robot=dataclasses.asdict(slow.robot)) == slow  # as a run's results have it
    assert TaskConfig(robot={"max_speed": 1.0}).robot.name == "jackal"


def test_a_suites_content_knows_other_robots_only():
    content = [Cell((), TaskConfig(robot=name)).content[1]["robot"] for name in ("jackal", "diffbot")]
    assert set(content[1]) - set(content[0]) == {"files"}
