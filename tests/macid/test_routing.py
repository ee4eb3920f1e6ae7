import itertools

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse import csgraph

from macid import geometry
from macid.geometry import point_box_distance
from macid.layout import Layout, load_level, maze_layout, sample_people
from macid.routing import RESOLUTION, Router, lines_are_free, occupancy_grid
from macid.state import RADIUS

ROOM = [[3, 0, 0.1, 3.1, 0], [-3, 0, 0.1, 3.1, 0], [0, 3, 3.1, 0.1, 0], [0, -3, 3.1, 0.1, 0]]
SCREEN = Layout(20.0, [[0.0, -4.0, 0.1, 6.0, 0.0]])  # a wall along y from the lower edge up to y = 2


def clearances(start, path, boxes):
    """Least distance to a box along each leg (W,) [m], by sampling each centimetre."""
    ends = np.concatenate([start[None], path])
    legs = []
    for a, b in itertools.pairwise(ends):
        t = np.linspace(0, 1, 2 + int(100 * np.linalg.norm(b - a)))[:, None]
        legs.append(point_box_distance(a + t * (b - a), boxes).min())
    return np.array(legs)


def length(start, path):
    return np.linalg.norm(np.diff(np.concatenate([start[None], path]), axis=0), axis=-1).sum()


def test_in_the_open_the_path_is_the_goal():
    goal = np.array([7.0, -8.0])
    np.testing.assert_array_equal(Router(Layout(20.0, [])).path(np.array([-9.0, 9.0]), goal), goal[None])


def walkable(start, goals, boxes, radius):
    """lines_are_free, by its definition: every line held against every box."""
    step = goals - start
    length = np.maximum(np.linalg.norm(step, axis=-1), 1e-9)
    beyond = (np.abs(geometry.in_box_frame(start, boxes)) - boxes[:, 2:4]).max(axis=-1)
    grown = boxes.copy()
    grown[:, 2:4] += np.clip(beyond - 1e-9, 0.0, radius)[:, None]
    return (geometry.ray_box_distance(start, step / length[:, None], grown) >= length[:, None]).all(axis=-1)


def plain_grid(layout, radius):
    """Centres of the free cells, and the graph of their neighbours, cell by cell."""
    free = ~occupancy_grid(layout, radius=radius + 0.1)
    number = {tuple(cell): index for index, cell in enumerate(np.argwhere(free).tolist())}
    edges = []
    for (i, j), index in number.items():
        for di, dj in itertools.product((-1, 0, 1), repeat=2):
            corners = {(i + di, j), (i, j + dj), (i + di, j + dj)}
            if (di or dj) and corners <= number.keys():
                edges.append((index, number[i + di, j + dj], RESOLUTION * np.hypot(di, dj)))
    rows, columns, lengths = zip(*sorted(edges), strict=True)
    graph = sparse.csr_matrix((lengths, (rows, columns)), shape=(len(number),) * 2)
    return (np.argwhere(free)[:, ::-1] + 0.5) * RESOLUTION - layout.size / 2, graph


def plain_path(layout, grid, start, goal, radius):
    """Router.path, by its definition: each person, box and point by itself, on a plain_grid."""
    if walkable(start, goal[None], layout.boxes, radius)[0]:
        return goal[None]
    centres, graph = grid
    first, last = (np.linalg.norm(centres - place, axis=-1).argmin() for place in (start, goal))
    for reach in (1.3 * np.hypot(*(goal - start)) + 3.0, np.inf):
        lengths, before = csgraph.dijkstra(graph, indices=last, return_predecessors=True, limit=reach)
        if np.isfinite(lengths[first]):
            break
    path = []
    while first != last:
        path.append(centres[first])
        first = before[first]
    path, corners = np.array([*path, centres[last], goal]), []
    while len(path) > 1:
        seen = walkable(start, path, layout.boxes, radius + 0.05)
        seen = len(path) if seen.all() else max(1, int(np.argmin(seen)))
        start, path = path[seen - 1], path[seen:]
        corners.append(start)
    return np.array([*corners, *path])


@pytest.mark.parametrize("level", [0.3, 0.7, 1.0, 4, "small-boxes"])
def test_the_paths_of_many_are_those_of_each_by_the_definition(level):
    rng = np.random.default_rng(8)
    layout = maze_layout(rng, level, 35.0) if isinstance(level, float) else load_level(level)
    starts, goals = (sample_people(rng, layout, 12, gap=0.15) for _ in range(2))
    router = Router(layout)
    together, grid = router.paths(starts, goals), plain_grid(layout, RADIUS)
    for start, goal, path in zip(starts, goals, together, strict=True):
        np.testing.assert_array_equal(path, plain_path(layout, grid, start, goal, RADIUS))
        np.testing.assert_array_equal(path, router.path(start, goal))
    assert max(map(len, together)) > 2 and Router(layout).paths([], []) == []


@pytest.mark.parametrize("resolution", [0.25, 0.5])
@pytest.mark.parametrize("radius", [0.0, 0.45])
def test_grids_and_lines_are_those_of_every_box_by_itself(resolution, radius):
    layout = load_level("small-boxes")
    axis = (np.arange(round(layout.size / resolution)) + 0.5) * resolution - layout.size / 2
    centres = np.stack(np.meshgrid(axis, axis), axis=-1)
    touched = [point_box_distance(centres, box[None])[..., 0] <= radius for box in layout.boxes]
    np.testing.assert_array_equal(occupancy_grid(layout, resolution, radius), np.any(touched, axis=0))
    rng = np.random.default_rng(1)
    starts, goals = rng.uniform(-24, 24, (2, 30, 2))
    goals[0], goals[1] = starts[0], np.nan  # no line at all, and what is no place
    for start in starts:
        expected = walkable(start, goals, layout.boxes, radius)
        np.testing.assert_array_equal(lines_are_free(start, goals, layout.boxes, radius), expected)


MAZE = maze_layout(np.random.default_rng(5), 1.0, 25.0)


@pytest.mark.parametrize("layout", [MAZE, load_level(4)], ids=["maze", "lv4"])
def test_every_leg_is_clear_for_a_person(layout):
    rng = np.random.default_rng(0)
    router, (starts, goals) = Router(layout), (sample_people(rng, layout, 60, gap=0.15) for _ in range(2))
    several = 0
    for start, goal in zip(starts, goals, strict=True):
        path = router.path(start, goal)
        np.testing.assert_array_equal(path[-1], goal)
        assert clearances(start, path, layout.boxes).min() >= RADIUS - 1e-6
        several += len(path) > 1
    assert several > 20


@pytest.mark.parametrize("gap", [0.34, 0.351, 0.39])
def test_who_stands_at_a_wall_is_not_led_through_it(gap):
    start, goal = np.array([-0.1 - gap, -4.0]), np.array([5.0, -4.0])
    for a, b in ((start, goal), (goal, start)):
        assert clearances(a, Router(SCREEN).path(a, b), SCREEN.boxes).min() >= min(gap, RADIUS) - 1e-6


def test_who_stands_at_a_wall_may_leave_it():
    start = np.array([-0.44, -4.0])
    goals = np.array([[-5.0, -4.0], [-0.45, 1.0], [-5.0, 4.0], [1.0, -4.0]])
    assert lines_are_free(start, goals, SCREEN.boxes).tolist() == [True, True, True, False]


def test_an_unreachable_goal_is_told():
    router = Router(Layout(20.0, ROOM, name="cell"))
    with pytest.raises(ValueError, match=r"'cell': no way from \[0.0, 0.0\] to \[8.0, 8.0\]"):
        router.path(np.zeros(2), np.array([8.0, 8.0]))


def test_a_map_without_a_free_cell_is_told():
    with pytest.raises(ValueError, match="no free cell"):
        Router(Layout(2.0, [[0.0, 0.0, 0.8, 0.8, 0.0]])).path(np.array([-1.0, 0.0]), np.array([1.0, 0.0]))


@pytest.mark.parametrize("x", [2.0, 4.0, 8.0])
def test_the_way_around_a_screen_is_short(x):
    start, goal = np.array([-x, -4.0]), np.array([x, -4.0])
    path = Router(SCREEN).path(start, goal)
    shortest = 2 * np.hypot(x - 0.1, 6.0 + RADIUS)  # a little less than a disc's shortest way
    assert shortest <= length(start, path) <= 1.085 * shortest + 3 * RESOLUTION
    assert len(path) <= 4


def test_the_grid_marks_where_a_disc_touches():
    grid = occupancy_grid(SCREEN, resolution=0.5)
    assert grid.shape == (40, 40)
    row, column = 4, np.arange(40)  # y = -7.75
    x = (column + 0.5) * 0.5 - 10
    np.testing.assert_array_equal(grid[row], (abs(x) <= 0.1 + RADIUS) | (abs(x) >= 10 - RADIUS))
    assert not grid[30, 1:-1].any()  # y = 5.25, above the screen


def test_a_line_is_free_where_a_disc_passes():
    start, goals = np.array([-5.0, 0.0]), np.array([[5.0, 0.0], [5.0, 9.0], [-1.0, 0.0], [-0.3, 0.0]])
    assert lines_are_free(start, goals, SCREEN.boxes).tolist() == [False, True, True, False]
    assert lines_are_free(start, goals[:1], np.zeros((0, 5))).all()
