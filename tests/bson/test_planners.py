import dataclasses
import heapq
import itertools
import math

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse import csgraph

from bson.planners import (
    PLANNERS,
    AStarConfig,
    CarrtStarConfig,
    Grid,
    NoPath,
    PurePursuit,
    RrtConfig,
    RrtStarConfig,
    SocialCostConfig,
    nearest_on,
    path_cost,
    plan,
    shortcut,
    social_cost,
)
from bson.planners.trees import RrtStar
from macid.layout import Layout, maze_layout
from macid.routing import occupancy_grid

TREES = ("rrt", "rrt-star", "carrt-star")
COST_AWARE = ("dijkstra", "astar", "rrt-star", "carrt-star")
QUICK = {
    "rrt": RrtConfig(samples=4000, step=1.5),
    "rrt-star": RrtStarConfig(samples=4000, step=1.5, enough=150),
    "carrt-star": CarrtStarConfig(samples=4000, step=1.5, enough=150),
}
OPEN = Grid(np.zeros((80, 80), bool), 0.25, (-10.0, -10.0))
SCREEN = Grid.from_layout(Layout(20.0, [[0.0, -4.0, 0.2, 6.0, 0.0]])).inflated(0.3)  # a wall from the edge up to y = 2
MAZE = Grid.from_layout(maze_layout(np.random.default_rng(5), 0.6, 20.0)).inflated(0.4)


def length(path):
    return np.linalg.norm(np.diff(path, axis=0), axis=-1).sum()


def dense(path, spacing):
    """Points along a path, `spacing` [m] apart or closer."""
    legs = [
        a + np.linspace(0, 1, 2 + int(np.linalg.norm(b - a) / spacing))[:, None] * (b - a)
        for a, b in itertools.pairwise(path)
    ]
    return np.concatenate(legs)


def is_clear(path, grid):
    """Whether a path stays on the map and out of its obstacles, by sampling each 2 mm."""
    x, y = ((dense(path, 0.002) - grid.origin) / grid.resolution).T
    rows, columns = grid.shape
    on_map = (x >= 0).all() and (y >= 0).all() and (x < columns).all() and (y < rows).all()
    return on_map and not grid.occupied[y.astype(int), x.astype(int)].any()


def random_grid(seed, share=0.3):
    """A grid of 15 x 22 cells (start (0, 0) and goal, the last one, free), and a cost map."""
    rng = np.random.default_rng(seed)
    occupied = rng.random((15, 22)) < share
    occupied[0, 0] = occupied[-1, -1] = False
    return Grid(occupied, 0.5, (3.0, -7.0)), rng.exponential(2.0, occupied.shape)


def oracle(grid, cost):
    """Least cost [m] from cell (0, 0) to the last one, by SciPy on a graph made cell by cell."""
    rows, columns = grid.shape
    cost = np.zeros(grid.shape) if cost is None else cost
    graph = sparse.lil_matrix((rows * columns,) * 2)
    for i, j in np.argwhere(~grid.occupied):
        for di in (-1, 0, 1):
            for dj in (-1, 0, 1):
                a, b = i + di, j + dj
                if (di, dj) == (0, 0) or not (0 <= a < rows and 0 <= b < columns):
                    continue
                if grid.occupied[[a, a, i], [b, j, b]].any():  # no cutting of corners
                    continue
                mean = 1 + (cost[i, j] + cost[a, b]) / 2
                graph[i * columns + j, a * columns + b] = grid.resolution * np.hypot(di, dj) * mean
    return csgraph.dijkstra(graph.tocsr(), indices=0)[-1]


# --- the grid


def test_cells_are_centred_as_in_ros():
    grid = Grid(np.zeros((3, 5), bool), 0.5, (10.0, -2.0))
    np.testing.assert_allclose(grid.centres([[0, 0], [2, 4]]), [[10.25, -1.75], [12.25, -0.75]])
    cells = np.argwhere(~grid.occupied)
    np.testing.assert_array_equal(grid.cells(grid.centres(cells)), cells)
    np.testing.assert_array_equal(grid.cells([9.9, -0.4]), [3, -1])


def test_a_layouts_grid_is_its_occupancy_grid():
    layout = maze_layout(np.random.default_rng(1), 0.5, 25.0)
    grid = Grid.from_layout(layout, 0.25, 0.3)
    np.testing.assert_array_equal(grid.occupied, occupancy_grid(layout, 0.25, 0.3))
    np.testing.assert_array_equal(grid.origin, [-12.5, -12.5])
    assert Grid.from_layout(layout, 0.3).resolution == 25.0 / 83


@pytest.mark.parametrize("radius", [0.0, 0.3, 0.8, 1.2])
def test_inflation_is_the_distance_to_squares_and_to_the_edge(radius):
    grid, _ = random_grid(3, share=0.05)
    centres = grid.centres(np.argwhere(np.ones(grid.shape, bool)))
    squares = grid.centres(np.argwhere(grid.occupied))
    beyond = np.maximum(np.abs(centres[:, None] - squares) - grid.resolution / 2, 0)
    distance = np.hypot(*np.moveaxis(beyond, -1, 0)).min(axis=1)
    far = grid.origin + grid.resolution * np.array(grid.shape[::-1])
    distance = np.minimum(distance, np.minimum(centres - grid.origin, far - centres).min(axis=1)).reshape(grid.shape)
    np.testing.assert_allclose(grid.clearance, distance, atol=1e-12)
    np.testing.assert_array_equal(grid.inflated(radius).occupied, grid.occupied | (distance <= radius))


def test_lines_agree_with_dense_sampling():
    grid, cost = random_grid(0, share=0.08)
    rng = np.random.default_rng(0)
    starts, ends = grid.origin + rng.uniform(-0.02, 1.02, (2, 400, 2)) * grid.resolution * grid.shape[::-1]
    ends[:200] = starts[:200] + 0.2 * (ends[:200] - starts[:200])
    free = grid.lines_are_free(starts, ends)
    assert 80 < free.sum() < 320
    for start, end, line_free in zip(starts, ends, free, strict=True):
        path = np.array([start, end])
        assert is_clear(path, grid) == line_free
        assert np.isfinite(path_cost(path, grid, cost)) == line_free
        if line_free:
            i, j = grid.cells(dense(path, 0.001)).T
            assert path_cost(path, grid, cost) == pytest.approx(length(path) * (1 + cost[i, j].mean()), rel=0.02)
            assert path_cost(path, grid) == pytest.approx(length(path))


@pytest.mark.parametrize(
    ("start", "end", "free"),
    [
        ((0.5, 0.5), (2.5, 0.5), True),
        ((0.5, 1.5), (0.999, 1.5), True),
        ((0.5, 1.5), (1.0, 1.5), False),
        ((1.0, 0.5), (1.0, 2.5), False),  # along the obstacle's side
        ((0.5, 1.5), (1.5, 0.5), False),  # by its corner
        ((0.4, 1.5), (1.4, 0.5), True),
        ((0.5, 0.5), (0.0, 0.5), False),  # to the map's edge
        ((0.5, 0.5), (0.5, 0.5), True),
        ((1.5, 1.5), (1.5, 1.5), False),
    ],
)
def test_who_touches_an_obstacle_is_in_it(start, end, free):
    grid = Grid([[0, 0, 0], [0, 1, 0], [0, 0, 0]], 1.0, (0.0, 0.0))
    assert grid.lines_are_free(start, end) == grid.lines_are_free(end, start) == free
    assert not free or grid.free([start, end]).all()
    assert grid.lines_are_free(np.zeros((0, 2)), end).shape == (0,) and path_cost([start], grid) == 0.0


def test_the_nearest_free_place():
    np.testing.assert_array_equal(SCREEN.nearest_free([3.3, 3.3]), [3.3, 3.3])
    place = SCREEN.nearest_free([0.05, -4.0])
    assert SCREEN.free(place) and np.abs(place - [0.05, -4.0]).max() < 0.8
    with pytest.raises(NoPath, match="no free cell"):
        Grid([[1]], 1.0, (0, 0)).nearest_free([0.5, 0.5])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ((np.zeros(3), 1.0, (0, 0)), "rows, columns"),
        ((np.zeros((2, 2)), 0.0, (0, 0)), "resolution"),
        ((np.zeros((2, 2)), 1.0, (0, np.nan)), "origin"),
    ],
)
def test_what_is_no_grid_is_told(fields, message):
    with pytest.raises(ValueError, match=message):
        Grid(*fields)


# --- the cost of people


def test_social_cost_is_its_formula():
    rng = np.random.default_rng(0)
    people, velocity = rng.uniform(-11, 11, (9, 2)), rng.normal(0, 1, (9, 2))
    velocity[0] = 0
    config = SocialCostConfig(weight=4.0, sigma=0.5, stretch=0.7)
    x, y = np.moveaxis(OPEN.centres(np.argwhere(~OPEN.occupied)).reshape(*OPEN.shape, 2), -1, 0)
    expected = np.zeros(OPEN.shape)
    for (px, py), (vx, vy) in zip(people, velocity, strict=True):
        yaw = np.arctan2(vy, vx)
        along = np.cos(yaw) * (x - px) + np.sin(yaw) * (y - py)
        aside = np.cos(yaw) * (y - py) - np.sin(yaw) * (x - px)
        sigma = np.where(along > 0, 0.5 + 0.7 * np.hypot(vx, vy), 0.5)
        expected += 4.0 * np.exp(-(along**2) / (2 * sigma**2) - aside**2 / (2 * 0.5**2))
    cost = social_cost(OPEN, people, velocity, config)
    assert (cost >= 0).all()
    np.testing.assert_allclose(cost, expected, atol=9 * 4.0 / 1000)
    one_by_one = sum(social_cost(OPEN, p[None], v[None], config) for p, v in zip(people, velocity, strict=True))
    np.testing.assert_allclose(cost, one_by_one)
    assert not social_cost(OPEN, np.zeros((0, 2)), np.zeros((0, 2))).any()


def test_people_cost_most_ahead():
    i = 40
    cost = social_cost(OPEN, [[0.125, 0.125]], [[1.5, 0.0]])
    assert cost.max() == cost[i, 40] == SocialCostConfig().weight
    assert cost[i, 46] > 3 * cost[i, 34] > 0  # 1.5 m ahead and behind
    np.testing.assert_allclose(cost[i, 34], cost[i + 6, 40])
    np.testing.assert_allclose(cost[1:], cost[:0:-1])  # left and right
    standing = social_cost(OPEN, [[0.125, 0.125]], [[0.0, 0.0]])
    np.testing.assert_allclose(standing, standing.T)


def test_people_need_velocities():
    with pytest.raises(ValueError, match="same number of finite rows"):
        social_cost(OPEN, np.zeros((2, 2)), np.zeros((1, 2)))


# --- planners


@pytest.mark.parametrize("with_cost", [False, True], ids=["length", "cost"])
@pytest.mark.parametrize("seed", range(8))
def test_dijkstra_and_a_star_are_optimal(seed, with_cost):
    grid, cost = random_grid(seed)
    cost = cost if with_cost else None
    start, goal = grid.centres([[0, 0], np.array(grid.shape) - 1])
    least = oracle(grid, cost)
    for name in ("dijkstra", "astar"):
        if np.isinf(least):
            with pytest.raises(NoPath):
                plan(name, grid, start, goal, cost)
            continue
        path = plan(name, grid, start, goal, cost)
        assert path_cost(path, grid, cost) == pytest.approx(least, rel=1e-12)
        assert is_clear(path, grid)
        np.testing.assert_array_equal(path[[0, -1]], [start, goal])


def plain_a_star(grid, cost, start, goal, weight):
    """The cells from `start` to `goal` that A* finds, by its definition: on the whole grid, cell by cell."""
    rate = 1 + cost

    def left(cell):
        dx, dy = (abs(a - b) for a, b in zip(cell, goal, strict=True))
        return weight * (max(dx, dy) + (math.sqrt(2.0) - 1.0) * min(dx, dy))

    costs, before, closed, heap = {start: 0.0}, {}, set(), [(left(start), start)]
    while goal not in closed:
        _, (i, j) = heapq.heappop(heap)
        if (i, j) in closed:
            continue
        closed.add((i, j))
        for di, dj in itertools.product((-1, 0, 1), repeat=2):
            a, b = i + di, j + dj
            on_map = 0 <= a < grid.shape[0] and 0 <= b < grid.shape[1]
            if (a, b) in closed or not on_map or grid.occupied[[a, a, i], [b, j, b]].any():
                continue
            there = costs[i, j] + math.sqrt(di * di + dj * dj) * (0.5 * rate[i, j] + 0.5 * rate[a, b])
            if there < costs.get((a, b), math.inf):
                costs[a, b], before[a, b] = there, (i, j)
                heapq.heappush(heap, (there + left((a, b)), (a, b)))
    way = [goal]
    while way[-1] != start:
        way.append(before[way[-1]])
    return way[::-1]


@pytest.mark.parametrize("weight", [0.0, 0.6, 1.0, 1.8])
def test_of_equal_ways_a_star_takes_that_of_the_plain_algorithm(weight):
    rng = np.random.default_rng(3)
    people = social_cost(MAZE, rng.uniform(-10, 10, (8, 2)), rng.normal(0, 1, (8, 2)))
    for grid, cost in ((MAZE, people), (MAZE, 0 * people), (OPEN, np.zeros(OPEN.shape))):
        cells = np.argwhere(grid.regions == grid.regions[tuple(grid.cells(grid.nearest_free([-8.0, -8.0])))])
        for first, last in rng.choice(cells, (3, 2)):
            path = plan("astar", grid, *grid.centres([first, last]), cost, config=AStarConfig(weight))
            way = plain_a_star(grid, cost, tuple(first.tolist()), tuple(last.tolist()), weight)
            np.testing.assert_array_equal(grid.cells(path), way)
            if weight == 0:
                np.testing.assert_array_equal(plan("dijkstra", grid, *grid.centres([first, last]), cost), path)


def test_the_random_grids_have_ways():
    assert sum(np.isfinite(oracle(random_grid(seed)[0], None)) for seed in range(8)) >= 4


@pytest.mark.parametrize("weight", [0.0, 2.0])
def test_the_heuristics_weight_bounds_the_cost(weight):
    start, goal = MAZE.nearest_free([-8.0, -8.0]), MAZE.nearest_free([8.0, 8.0])
    least = path_cost(plan("dijkstra", MAZE, start, goal), MAZE)
    cost = path_cost(plan("astar", MAZE, start, goal, config=AStarConfig(weight)), MAZE)
    assert least * (1 - 1e-12) <= cost <= max(weight, 1 + 1e-12) * least


@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize("grid", [SCREEN, MAZE], ids=["screen", "maze"])
def test_paths_are_free_from_start_to_goal(name, grid):
    rng = np.random.default_rng(2)
    cost = social_cost(grid, rng.uniform(-10, 10, (6, 2)), rng.normal(0, 1, (6, 2)))
    for _ in range(3):
        start, goal = (
            grid.centres(cell) + 0.12 * rng.uniform(-1, 1, 2) for cell in rng.permutation(grid_free(grid))[:2]
        )
        path = plan(name, grid, start, goal, cost, rng=1, config=QUICK.get(name))
        np.testing.assert_array_equal(path[[0, -1]], [start, goal])
        assert is_clear(path, grid) and np.isfinite(path_cost(path, grid))
        short = shortcut(path, grid, cost)
        np.testing.assert_array_equal(short[[0, -1]], [start, goal])
        assert is_clear(short, grid) and len(short) <= len(path)
        assert path_cost(short, grid, cost) <= path_cost(path, grid, cost) + 1e-6
        if name in TREES:
            assert np.linalg.norm(np.diff(path, axis=0), axis=-1).max() <= 4.0 + 1e-9


def grid_free(grid):
    return np.argwhere(~grid.occupied)


@pytest.mark.parametrize("name", PLANNERS)
def test_the_same_seed_gives_the_same_path(name):
    start, goal, config = (-6.0, -7.0), (6.0, -7.0), QUICK.get(name)
    one = plan(name, SCREEN, start, goal, rng=np.random.default_rng(4), config=config)
    np.testing.assert_array_equal(one, plan(name, SCREEN, start, goal, rng=4, config=config))
    other = plan(name, SCREEN, start, goal, rng=5, config=config)
    assert (name in TREES) == (one.shape != other.shape or not np.array_equal(one, other))


@pytest.mark.parametrize("name", PLANNERS)
def test_an_enclosed_goal_has_no_path(name):
    occupied = np.zeros((9, 9), bool)
    occupied[3:6, 3:6] = True
    occupied[4, 4] = False
    grid = Grid(occupied, 1.0, (0.0, 0.0))
    with pytest.raises(NoPath, match=r"no way from \[0.5, 0.5\] to \[4.5, 4.5\]"):
        plan(name, grid, (0.5, 0.5), (4.5, 4.5))
    with pytest.raises(NoPath, match="no way"):  # only by two corners that touch
        plan(name, Grid([[0, 1], [1, 0]], 1.0, (0.0, 0.0)), (0.5, 0.5), (1.5, 1.5))


@pytest.mark.parametrize("name", ["dijkstra", "astar"])
def test_grid_paths_cut_no_corner(name):
    path = plan(name, Grid([[0, 1], [0, 0]], 1.0, (0.0, 0.0)), (0.5, 0.5), (1.5, 1.5))
    np.testing.assert_allclose(path, [[0.5, 0.5], [0.5, 1.5], [1.5, 1.5]])


@pytest.mark.parametrize("name", TREES)
def test_too_few_samples_find_no_path(name):
    few = dataclasses.replace(QUICK[name], samples=3)
    with pytest.raises(NoPath, match="within 3 samples"):
        plan(name, SCREEN, (-6.0, -7.0), (6.0, -7.0), config=few)


@pytest.mark.parametrize("name", PLANNERS)
def test_start_and_goal_may_share_a_cell_or_be_one(name):
    for goal in ((0.12, 0.13), (0.1, 0.1)):
        path = plan(name, OPEN, (0.1, 0.1), goal, config=QUICK.get(name))
        np.testing.assert_array_equal(path[[0, -1]], [(0.1, 0.1), goal])
        assert length(path) == pytest.approx(np.hypot(*np.subtract(goal, (0.1, 0.1))))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "rrt*"}, "Unknown planner 'rrt\\*'. Choose one of dijkstra, astar, rrt, rrt-star, carrt-star"),
        ({"start": (-10.5, 0.0)}, r"start \[-10.5, 0.0\] is off the map"),
        ({"goal": (0.0, -4.0)}, r"goal \[0.0, -4.0\] is in an obstacle"),
        ({"goal": (0.0, np.nan)}, "goal must be two finite numbers"),
        ({"cost": np.zeros((3, 3))}, "cost map"),
        ({"cost": np.full(SCREEN.shape, -0.1)}, "cost map"),
        ({"config": RrtConfig()}, "configured by a AStarConfig"),
        ({"known": [0.0, 1.0]}, "known path"),
    ],
)
def test_what_cannot_be_planned_is_told(changes, message):
    arguments = {"name": "astar", "grid": SCREEN, "start": (-6.0, 0.0), "goal": (6.0, 0.0), **changes}
    with pytest.raises(ValueError, match=message) as error:
        plan(**arguments)
    assert not isinstance(error.value, NoPath)


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        (RrtConfig, {"samples": 0}),
        (RrtStarConfig, {"step": -1.0}),
        (RrtConfig, {"goal_bias": 1.5}),
        (CarrtStarConfig, {"elites": 13}),
        (AStarConfig, {"weight": -1.0}),
        (SocialCostConfig, {"sigma": 0.0}),
        (PurePursuit, {"lookahead": 0.0}),
    ],
)
def test_settings_without_sense_are_told(kind, fields):
    with pytest.raises(ValueError, match=next(iter(fields))):
        kind(**fields)


@pytest.mark.parametrize("with_cost", [False, True], ids=["length", "cost"])
@pytest.mark.parametrize("name", ["rrt-star", "carrt-star"])
def test_more_samples_make_no_path_worse(name, with_cost):
    start, goal = (-6.0, -7.0), (6.0, -7.0)
    cost = social_cost(SCREEN, [[0.5, 4.0], [-3.0, -3.0], [4.0, 0.0]], [[1, 0], [0, 1], [-1, -1]])
    cost = cost if with_cost else None
    best = path_cost(shortcut(plan("astar", SCREEN, start, goal, cost), SCREEN, cost), SCREEN, cost)
    for seed in range(1 + (name == "rrt-star")):
        costs = [
            path_cost(
                plan(name, SCREEN, start, goal, cost, seed, dataclasses.replace(QUICK[name], enough=n)), SCREEN, cost
            )
            for n in (0, 200, 700)
        ]
        assert (np.diff(costs) <= 1e-9).all() and costs[-1] < costs[0]
        assert 0.97 * best <= costs[-1] <= 1.06 * best


@pytest.mark.parametrize("name", TREES)
def test_a_known_path_is_where_the_trees_begin(name):
    start, goal = (-6.0, -7.0), (6.0, -7.0)
    known = np.array([(-4.0, 2.0), (-0.5, 3.5), (0.7, 3.5), (5.0, -5.0), goal])
    at_once = dataclasses.replace(QUICK[name], samples=1)
    path = plan(name, SCREEN, start, goal, rng=1, config=at_once, known=known)
    assert length(path) <= length(np.vstack([start, known])) + 1e-9
    if name == "rrt":
        np.testing.assert_allclose(length(path), length(np.vstack([start, known])))
    better = plan(name, SCREEN, start, goal, rng=1, config=QUICK[name], known=known)
    assert length(better) <= length(path) + 1e-9 and is_clear(better, SCREEN)


@pytest.mark.parametrize("name", TREES)
def test_of_a_blocked_known_path_the_free_beginning_serves(name):
    through = [(-3.0, 0.0), (3.0, 0.0), (6.0, -7.0)]  # the second leg crosses the wall
    path = plan(name, SCREEN, (-6.0, -7.0), (6.0, -7.0), config=QUICK[name], known=through)
    assert is_clear(path, SCREEN)
    few = dataclasses.replace(QUICK[name], samples=3)
    with pytest.raises(NoPath):
        plan(name, SCREEN, (-6.0, -7.0), (6.0, -7.0), config=few, known=through)


def test_the_nearest_leg_and_its_point():
    path = np.array([(0.0, 0.0), (4.0, 0.0), (4.0, 4.0)])
    for place, leg, foot in (
        ((1.0, 2.0), 0, (1.0, 0.0)),
        ((5.0, 3.0), 1, (4.0, 3.0)),
        ((-1.0, -1.0), 0, (0.0, 0.0)),
        ((6.0, 9.0), 1, (4.0, 4.0)),
    ):
        found = nearest_on(path, np.array(place))
        assert found[0] == leg and found[1].tolist() == list(foot)


def test_rewiring_keeps_the_trees_costs_true():
    cost = social_cost(SCREEN, [[0.5, 4.0], [-3.0, -3.0], [4.0, 0.0]], [[1, 0], [0, 1], [-1, -1]])
    ends = (np.array([(-6.0, -7.0), (6.0, -7.0)]) - SCREEN.origin) / SCREEN.resolution
    known = (np.array([(-4.0, 2.0), (-0.5, 3.5), (0.7, 3.5)]) - SCREEN.origin) / SCREEN.resolution
    tree = RrtStar(SCREEN, 1 + cost, *ends, np.random.default_rng(0), QUICK["rrt-star"], known)
    tree.path()
    points = SCREEN.origin + SCREEN.resolution * tree.points
    assert len(tree.parents) > 60
    for node, parent in enumerate(tree.parents):
        if parent is None:
            assert node == 0 and tree.costs[0] == 0
            continue
        edge = path_cost(points[[parent, node]], SCREEN, cost) / SCREEN.resolution
        assert tree.costs[node] == pytest.approx(tree.costs[parent] + edge)
        assert [node in children for children in tree.children].index(True) == parent


def test_rewiring_makes_no_node_costlier(monkeypatch):
    changes, lower = [], RrtStar.lower
    monkeypatch.setattr(RrtStar, "lower", lambda self, node, by: (changes.append(by), lower(self, node, by)))
    rng = np.random.default_rng(0)
    cost = social_cost(OPEN, rng.uniform(-9, 9, (20, 2)), rng.normal(0, 1, (20, 2)))
    plan("rrt-star", OPEN, (-9.0, -9.0), (9.0, 9.0), cost, 0, RrtStarConfig(enough=800))
    assert len(changes) > 500 and max(changes) < 0


def test_rrt_star_is_shorter_than_rrt():
    start, goal = (-6.0, -7.0), (6.0, -7.0)
    for seed in range(3):
        rrt, star = (length(plan(n, SCREEN, start, goal, rng=seed, config=QUICK[n])) for n in ("rrt", "rrt-star"))
        assert star < rrt


def test_carrt_star_with_only_the_straight_candidate_is_rrt_star():
    rng = np.random.default_rng(0)
    cost = social_cost(SCREEN, rng.uniform(-10, 10, (6, 2)), rng.normal(0, 1, (6, 2)))
    straight = dataclasses.replace(QUICK["carrt-star"], candidates=1, elites=1, iterations=0)
    paths = [
        plan(name, SCREEN, (-6.0, -7.0), (6.0, -7.0), cost, 3, config)
        for name, config in (("rrt-star", QUICK["rrt-star"]), ("carrt-star", straight))
    ]
    np.testing.assert_allclose(*paths)


@pytest.mark.parametrize("name", PLANNERS)
def test_who_heeds_the_cost_goes_around_a_crowd(name):
    start, goal = np.array([-8.0, 0.1]), np.array([8.0, 0.1])
    y = np.arange(-4.0, 4.5, 0.8)
    cost = social_cost(OPEN, np.stack([0 * y, y], axis=-1), np.tile([0.5, 0.0], (len(y), 1)))

    def social(path):
        return path_cost(path, OPEN, cost) - path_cost(path, OPEN)

    straight = np.array([start, goal])
    path = plan(name, OPEN, start, goal, cost, 0, QUICK.get(name))
    around = np.abs(path[np.abs(path[:, 0]).argmin(), 1]) > 4.0
    if name in COST_AWARE:
        assert around and social(path) < 0.2 * social(straight)
        short = shortcut(path, OPEN, cost)
        assert social(short) < 0.2 * social(straight)
        assert path_cost(path, OPEN, cost) < path_cost(straight, OPEN, cost)
    else:
        np.testing.assert_array_equal(path, plan(name, OPEN, start, goal, None, 0, QUICK.get(name)))


def test_shortcuts_are_straight_in_the_open():
    start, goal = np.array([-8.1, -3.0]), np.array([7.3, 4.4])
    path = plan("astar", OPEN, start, goal)
    np.testing.assert_array_equal(shortcut(path, OPEN), [start, goal])


def test_a_blocked_path_has_no_shortcut():
    with pytest.raises(ValueError, match="touches an occupied cell"):
        shortcut([[-6.0, -4.0], [6.0, -4.0]], SCREEN)
    assert path_cost([[-6.0, -4.0], [6.0, -4.0]], SCREEN) == np.inf


# --- following

CORNER = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 5.0]])


def drive(follower, pose, path, period=0.1, steps=400):
    """Poses (T, 3) and commands (T, 2) of an ideal unicycle until the follower stops."""
    pose, poses, commands = np.array(pose, dtype=float), [], []
    for _ in range(steps):
        v, w = follower(pose, path)
        poses.append(pose.copy())
        commands.append((v, w))
        if (v, w) == (0.0, 0.0):
            break
        yaw = pose[2] + w * period / 2
        pose = pose + period * np.array([v * np.cos(yaw), v * np.sin(yaw), w])
    return np.array(poses), np.array(commands)


def off_path(points, path):
    """Distance (T,) [m] of points to the nearest of a path's, 1 mm apart."""
    return np.array([np.linalg.norm(dense(path, 0.001) - p, axis=-1).min() for p in points])


@pytest.mark.parametrize("period", [0.02, 0.1])
@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.0, np.pi])
def test_the_follower_reaches_the_end_and_stays_near(yaw, period):
    follower = PurePursuit()
    poses, commands = drive(follower, [0.0, 0.0, yaw], CORNER, period, 2000)
    assert np.linalg.norm(poses[-1, :2] - CORNER[-1]) <= follower.tolerance
    assert off_path(poses[::3, :2], CORNER).max() < 0.25  # [m]
    assert (commands[:, 0] >= 0).all() and commands[:, 0].max() == follower.max_speed
    assert (commands[:, 0] <= follower.max_speed).all()
    assert np.abs(commands[:, 1]).max() <= follower.max_yaw_rate + 1e-9
    assert (commands[-2, 0]) < 0.5  # slow near the end
    at_corner = np.linalg.norm(poses[:, :2] - CORNER[1], axis=-1) < 0.4
    assert commands[at_corner, 0].min() < 0.8 * follower.max_speed


def test_a_path_that_comes_back_to_the_robot_is_no_trouble():
    speed, rate = PurePursuit()(np.zeros(3), [(0.0, 0.0), (0.4, 0.0), (0.0, 0.0)])
    assert np.isfinite([speed, rate]).all() and speed > 0


def test_who_is_off_the_path_comes_back():
    poses, _ = drive(PurePursuit(), [1.0, 2.0, 0.0], CORNER)
    assert np.linalg.norm(poses[-1, :2] - CORNER[-1]) <= 0.1
    assert off_path(poses[::3, :2], CORNER)[-8:].max() < 0.05


@pytest.mark.parametrize("side", [1, -1])
def test_a_pose_behind_turns_on_the_spot(side):
    v, w = PurePursuit()([3.0, 0.0, side * 3.0], CORNER)
    assert v == 0.0 and w == -side * 2.0


def test_a_mirrored_or_moved_path_mirrors_or_keeps_the_command():
    rng = np.random.default_rng(0)
    follower = PurePursuit()
    for _ in range(50):
        pose, turn, shift = rng.uniform((-1, -1, -3), (7, 6, 3)), rng.uniform(-3, 3), rng.uniform(-9, 9, 2)
        v, w = follower(pose, CORNER)
        assert 0 <= v <= follower.max_speed and abs(w) <= follower.max_yaw_rate + 1e-9
        np.testing.assert_allclose(follower(pose * [1, -1, -1], CORNER * [1, -1]), (v, -w), atol=1e-9)
        matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        moved = np.array([*(matrix @ pose[:2] + shift), pose[2] + turn])
        np.testing.assert_allclose(follower(moved, CORNER @ matrix.T + shift), (v, w), atol=1e-6)


def test_at_the_end_the_follower_stops():
    for path in (CORNER, CORNER[[-1, -1]], CORNER[-1:]):
        assert PurePursuit()([6.05, 5.0, 1.0], path) == (0.0, 0.0)
    assert PurePursuit()([6.0, 4.0, np.pi / 2], CORNER[-1:])[0] > 0


def test_the_follower_drives_a_planned_path():
    path = shortcut(plan("astar", MAZE, MAZE.nearest_free([-8.0, -8.0]), MAZE.nearest_free([8.0, 8.0])), MAZE)
    poses, _ = drive(PurePursuit(), [*path[0], 0.0], path)
    assert np.linalg.norm(poses[-1, :2] - path[-1]) <= 0.1
    assert off_path(poses[::3, :2], path).max() < 0.25
