"""A suite's head-room: the most that its metric has, whoever drives, cell by cell."""

from typing import NamedTuple

import numpy as np

from bson.episodes.record import shortest_way
from bson.evaluation.metrics import Driven, path_efficiency, route_completion, sns, speed_score
from bson.evaluation.suites import Suite
from bson.task import Spawn, TaskConfig, spawn
from macid.state import GOAL_RADIUS


class Most(NamedTuple):
    """The best drive of an episode that can be told beforehand, or the mean over several."""

    SNS: float
    RC: float
    SP: float
    PE: float
    straight: float  #: from start to goal, as the crow flies [m]
    shortest: float  #: around walls [m]


def most(config: TaskConfig, drawn: Spawn) -> Most:
    """The most of an episode of `config` that begins as `drawn`.

    The robot touches nothing and takes the shortest way around walls at its top speed. It ends at the first control
    step within GOAL_RADIUS of the goal, at best one control step's way inside. Its way is at least the shortest one
    less what is left to the goal; the shortest one is the router's for half the robot's width, as SPL's is for its
    radius. The router keeps 0.05 m off corners where there is room: who cuts them closer gains a point at most in a
    maze, and none elsewhere. Nobody's way is longer for the people's sake: among many of them nobody may get there.
    """
    robot, start, goal = config.robot, drawn.robot[:2], drawn.goal
    straight = float(np.hypot(*(goal - start)))
    shortest = max(straight, shortest_way(drawn.layout, start, goal, robot.half_width))
    left = max(0.0, GOAL_RADIUS - robot.max_speed * config.control_period)
    way = shortest - left
    drive = Driven(straight, left, way, way / robot.max_speed, 0)
    parts = route_completion(drive), speed_score(drive), path_efficiency(drive)
    return Most(sns(drive), *parts, straight, shortest)


def most_of(suite: Suite) -> dict[str, Most]:
    """{cell: the mean of `most` over its episodes}."""
    found = {}
    for cell, seeds in zip(suite.cells, suite.of_cells(), strict=True):
        each = [most(cell.config, spawn(cell.config, np.random.default_rng(seed))) for seed in seeds]
        found[cell.name] = Most(*np.mean(each, axis=0).tolist())
    return found
