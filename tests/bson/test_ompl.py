"""The trees of bson.planners against OMPL's."""

import json
import pathlib
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("ompl")

from ompl_paths import PLANNERS, problem

from bson.planners import path_cost, plan

MAPS = range(4)


@pytest.fixture(scope="module")
def oracle():
    """{"PLANNER MAP": the costs [m] of OMPL's paths of two seeds}."""
    command = [sys.executable, pathlib.Path(__file__).with_name("ompl_paths.py"), *map(str, MAPS)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


@pytest.mark.parametrize("name", PLANNERS)
def test_the_trees_find_ways_where_ompl_does_and_they_cost_as_much(oracle, name):
    ours, theirs, least = [], [], []
    for number in MAPS:
        grid, cost, start, goal = problem(number)
        found = [one for one in oracle[f"{name} {number}"] if one is not None]
        paths = [plan(name, grid, start, goal, cost, seed, PLANNERS[name]) for seed in (1, 2)]
        if found:
            ours.append(np.mean([path_cost(path, grid, cost) for path in paths]))
            theirs.append(np.mean(found))
            least.append(path_cost(plan("astar", grid, start, goal, cost), grid, cost))
    assert len(ours) == len(MAPS)
    assert np.mean(least) * 0.9 <= np.mean(ours) <= 1.1 * np.mean(theirs)  # the least is of ways over cells' centres
    if name == "rrt-star":
        assert np.mean(ours) <= 1.1 * np.mean(least)
