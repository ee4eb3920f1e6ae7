import numpy as np
import pytest

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
        ({"pedestrian_model": "crowdnav"}, "orca, social-force, social-force-bodies"),
        ({"lcf": (1.0, -1.0)}, "least <= most"),
        ({"lcf": "high"}, "least, most"),
        ({"map_size": 1.0}, "between 10 and 500"),
        ({"control_period": 0.03}, "multiple of the physics step"),
        ({"control_period": 0.1, "pedestrian_period": 0.06}, "multiple of pedestrian_period"),
        ({"horizon": 0}, "at least 1"),
        ({"goal_distance": (0.0, 1.0)}, "at least 1 m"),
        ({"pedestrians": 3}, "num_pedestrians"),
        ({"num_pedestrians": 10**6}, "at most 2000"),
        ({"obstacle_density": None}, "between 0 and 1"),
        ({"pedestrian_model": ["orca"]}, "must be a name"),
        ({"reward": 3}, "distance, goal, collision"),
        ({"robot": {"max_sped": 1.0}}, "max_speed"),
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
