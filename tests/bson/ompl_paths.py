"""OMPL's RRT and RRT* on the grids of bson.planners, an oracle for the trees: `ompl_paths.py MAP...` prints the costs.

A program of its own: OMPL's random numbers belong to the process, and its bindings tell at the end what they leaked.
"""

import json
import sys

import numpy as np
from ompl import base, geometric, util

from bson.planners import Grid, RrtConfig, RrtStarConfig, path_cost, social_cost
from bson.planners.grid import cost_rate, line_costs
from macid.layout import maze_layout

PLANNERS = {
    "rrt": RrtConfig(samples=6000, step=1.5),
    "rrt-star": RrtStarConfig(samples=6000, step=1.5, enough=400),
}


def problem(number):
    """A maze, what its people cost, a start and a goal [m]."""
    rng = np.random.default_rng(number)
    grid = Grid.from_layout(maze_layout(rng, 0.3 + 0.1 * (number % 7), 20.0)).inflated(0.4)
    cost = social_cost(grid, rng.uniform(-10, 10, (8, 2)), rng.normal(0, 1, (8, 2)))
    largest = np.bincount(grid.regions[grid.regions > 0]).argmax()
    cells = np.argwhere(grid.regions == largest)
    return grid, cost, *grid.centres(cells[[0, -1]])


def _line(grid, rate, start, end):
    return float(line_costs(grid, rate, np.array([start[0], start[1]]), np.array([[end[0], end[1]]]))[0])


class _Lines(base.MotionValidator):
    def __init__(self, information, grid):
        super().__init__(information)
        self.grid = grid

    def checkMotion(self, start, end):
        return bool(np.isfinite(_line(self.grid, None, start, end)))


class _Cost(base.OptimizationObjective):
    def __init__(self, information, grid, rate):
        super().__init__(information)
        self.grid, self.rate = grid, rate

    def motionCost(self, start, end):
        return base.Cost(_line(self.grid, self.rate, start, end))


def path(name, grid, cost, start, goal, seed):
    """OMPL's path (N, 2) [m]; None where it found none. As bson.planners.plan, with PLANNERS's settings."""
    util.RNG.setSeed(seed)  # reaches what is made from here on, whatever OMPL says of it
    config, rate = PLANNERS[name], cost_rate(grid, cost)
    space, bounds = base.RealVectorStateSpace(2), base.RealVectorBounds(2)
    bounds.setLow(0.0)
    for axis, high in enumerate(grid.shape[::-1]):
        bounds.setHigh(axis, float(high))
    space.setBounds(bounds)
    information = base.SpaceInformation(space)
    information.setStateValidityChecker(lambda at: bool(grid.free(grid.unscaled(np.array([at[0], at[1]])))))
    information.setMotionValidator(_Lines(information, grid))
    information.setup()
    ends = []
    for point in grid.scaled([start, goal]):
        ends.append(information.allocState())
        ends[-1][0], ends[-1][1] = point
    wanted = base.ProblemDefinition(information)
    wanted.setStartAndGoalStates(*ends, 1e-6)
    if name == "rrt":
        planner = geometric.RRT(information)
    else:
        planner = geometric.RRTstar(information)
        planner.setKNearest(False)
        wanted.setOptimizationObjective(_Cost(information, grid, rate))
    planner.setRange(config.step / grid.resolution)
    planner.setGoalBias(config.goal_bias)
    planner.setProblemDefinition(wanted)
    planner.setup()
    drawn = 0

    def over():
        nonlocal drawn
        drawn += 1
        if name == "rrt" or drawn <= config.enough:
            return drawn > config.samples
        return drawn > config.samples or bool(np.isfinite(planner.bestCost().value()))

    planner.solve(base.PlannerTerminationCondition(over))
    if not wanted.hasExactSolution():
        return None
    return grid.unscaled(np.array([[at[0], at[1]] for at in wanted.getSolutionPath().getStates()]))


if __name__ == "__main__":
    util.setLogLevel(util.LogLevel.LOG_NONE)
    costs = {}
    for number in map(int, sys.argv[1:]):
        grid, cost, start, goal = problem(number)
        for name in PLANNERS:
            paths = [path(name, grid, cost, start, goal, seed) for seed in (1, 2)]
            costs[f"{name} {number}"] = [None if one is None else path_cost(one, grid, cost) for one in paths]
    print(json.dumps(costs))
