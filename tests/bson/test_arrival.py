"""Into the goal's circle: as far as one control step leads, in real worlds, by robots of all speeds."""

import math

import numpy as np
import pytest

from bson.agents import Setting
from bson.agents.arrival import well_in
from bson.agents.mppi import Mppi
from bson.agents.shield import Shield
from bson.episodes.tracks import make_track
from bson.evaluation.play import run_episodes
from bson.robot import robot_names
from bson.task import TaskConfig
from macid.state import GOAL_RADIUS

SETTING = Setting.default()
STEP = 0.2  # way of a control step at top speed [m]
AHEAD, HALF = np.array([1.0, 0.0]), np.array([0.5, 0.0])


class ToGoal:
    """A policy that turns to the goal and drives at a share of top speed."""

    def __init__(self, share=1.0):
        self.share = share

    def __call__(self, observation):
        x, y = observation["goal"]
        bearing = math.atan2(y, x)
        return np.array([self.share * (abs(bearing) < 0.3), np.clip(2.0 * bearing, -1.0, 1.0)])


@pytest.mark.parametrize("share", [1.0, 0.7])
@pytest.mark.parametrize("start", np.arange(1.8, 2.2, 0.023))
def test_an_even_drive_ends_as_far_inside_as_a_step_leads(start, share):
    left, speed, wish = start, 2.0 * share, np.array([share, 0.0])
    while left > GOAL_RADIUS:
        wanted = 2.0 * well_in(wish, np.array([left, 0.0]), speed, SETTING)[0]
        left -= 0.1 * (speed + wanted) / 2
        speed = wanted
    assert GOAL_RADIUS - share * STEP - 1e-9 <= left < GOAL_RADIUS - 0.75 * share * STEP


def test_it_only_ever_slows_a_robot_down_and_never_to_less_than_0_6():
    rng = np.random.default_rng(0)
    for _ in range(2000):
        goal, speed = rng.uniform(-2.5, 2.5, 2), rng.uniform(-2.0, 2.0)
        action = rng.uniform(-1.0, 1.0, 2)
        found = well_in(action, goal, speed, SETTING)
        assert found[1] == action[1]
        assert found[0] == action[0] or 0.6 * action[0] <= found[0] < action[0]


@pytest.mark.parametrize(
    ("action", "goal"),
    [
        (AHEAD, (3.0, 0.0)),  # far away
        (AHEAD, (0.75, 0.75)),  # not straight ahead
        (AHEAD, (-1.0, 0.0)),
        (-AHEAD, (1.0, 0.0)),  # backing
        (AHEAD, (0.51, 0.0)),  # the last step
    ],
)
def test_elsewhere_the_action_is_the_agents(action, goal):
    assert well_in(action, np.array(goal), 2.0, SETTING) is action


def test_a_mirrored_goal_gives_the_same_speed():
    left, right = (well_in(np.array([1.0, w]), np.array([1.2, 0.1 * w]), 1.9, SETTING) for w in (1.0, -1.0))
    assert left[0] == right[0] < 1.0


def ends(make, config, track, seeds):
    """How far from the goal episodes end [m]."""
    episodes = run_episodes(make, config, make_track(track, "lidar2d"), seeds, "it", nthread=1)
    assert all(episode.arrived for episode in episodes)
    return np.array([episode.final_distance for episode in episodes])


@pytest.mark.parametrize("robot", robot_names())
@pytest.mark.parametrize("period", [0.1, 0.2, 0.4, 0.5])
def test_behind_the_shield_a_robot_ends_deep_in_the_circle(robot, period):
    config = TaskConfig(num_pedestrians=0, robot=robot, control_period=period, goal_distance=(5.0, 9.0))
    bare = ends(lambda setting: ToGoal(), config, "local", range(6))
    found = ends(lambda setting: Shield(ToGoal(), setting), config, "local", range(6))
    step = min(config.robot.max_speed * period, GOAL_RADIUS)
    assert found.mean() < bare.mean() - 0.1 * step
    assert found.mean() < GOAL_RADIUS - 0.8 * step


def test_mppi_ends_deep_in_the_circle():
    config = TaskConfig(num_pedestrians=0, goal_distance=(5.0, 9.0))
    found = ends(Mppi, config, "global", range(8))
    assert found.mean() < 0.36 and found.max() < 0.42
