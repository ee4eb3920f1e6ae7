import dataclasses

import numpy as np
import pytest
from scipy import ndimage

from macid import layout as layouts
from macid.geometry import box_corners
from macid.layout import Layout, load_layout, load_level, maze_layout, random_layout, sample_goals, sample_people
from macid.routing import occupancy_grid
from macid.state import RADIUS

OPEN = Layout(20.0, [])


def is_connected(layout):
    return ndimage.label(~occupancy_grid(layout, resolution=0.1 if layout.size < 30 else 0.2))[1] == 1


def least_distance(points, others):
    distance = np.linalg.norm(points[:, None] - others, axis=-1)
    return np.where(distance > 0, distance, np.inf).min()


@pytest.mark.parametrize(("level", "people"), [(1, 25), (2, 50), (3, 100), (4, 200)])
def test_levels(level, people):
    layout = load_level(level)
    assert (layout.pedestrians, layout.size) == (people, 50.0)
    assert len(layout.obstacles) > 0
    assert abs(box_corners(layout.obstacles)).max() <= layout.size / 2
    assert is_connected(layout)


@pytest.mark.parametrize("level", layouts.OTHER_LEVELS)
def test_levels_of_other_kinds_are_connected_and_have_room(level):
    layout = load_level(level)
    assert layout.name == level.replace("-", " ") and is_connected(layout)
    assert abs(box_corners(layout.obstacles)).max() <= layout.size / 2 + 1e-9
    starts = sample_people(np.random.default_rng(0), layout, layout.pedestrians)
    assert sample_goals(np.random.default_rng(0), layout, starts).shape == starts.shape


def test_a_closed_room_is_not_connected():
    room = [[3, 0, 0.1, 3.1, 0], [-3, 0, 0.1, 3.1, 0], [0, 3, 3.1, 0.1, 0], [0, -3, 3.1, 0.1, 0]]
    assert is_connected(OPEN) and not is_connected(Layout(20.0, room))


@pytest.mark.parametrize("size", [15.0, 25.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_mazes_grow_wall_by_wall_and_stay_connected(seed, size):
    fewer = np.empty((0, 5))
    most = layouts.max_maze_walls(size)
    for density in (0.0, 0.3, 0.7, 1.0):
        maze = maze_layout(np.random.default_rng(seed), density, size)
        assert len(maze.obstacles) == round(density * most)
        np.testing.assert_array_equal(maze.obstacles[: len(fewer)], fewer)
        assert is_connected(maze)
        assert maze.routed == (density > 0)
        fewer = maze.obstacles
    cells = round(size / layouts.CORRIDOR)
    assert most == 2 * cells * (cells - 1) - (cells**2 - 1)


def test_a_full_maze_has_one_way_only():
    maze = maze_layout(np.random.default_rng(2), 1.0, 25.0)
    extra = []
    for i in range(4):  # a wall more, between any neighbours that none parts yet, cuts the map
        for j in range(5):
            wall = np.array([-12.5 + (i + 1) * 5, -12.5 + (j + 0.5) * 5, 2.65, 0.15, np.pi / 2])
            if np.linalg.norm(maze.obstacles[:, :2] - wall[:2], axis=-1).min() > 0.1:
                extra.append(wall)
    assert extra
    for wall in extra[:4]:
        assert not is_connected(Layout(25.0, np.concatenate([maze.obstacles, wall[None]])))


def test_random_layouts_keep_passages_and_are_connected():
    layout = random_layout(np.random.default_rng(0), 8, size=25.0)
    assert len(layout.obstacles) == 8
    assert abs(box_corners(layout.obstacles)).max() <= 12.5 - 1.6 + 1e-9
    assert is_connected(layout)
    t = np.linspace(0, 1, 60)[:, None]
    corners = box_corners(layout.obstacles)
    outline = [np.concatenate([a + t * (b - a) for a, b in zip(c, np.roll(c, -1, 0), strict=True)]) for c in corners]
    for i in range(8):
        for j in range(i):
            assert least_distance(outline[i], outline[j]) >= 1.6 - 1e-9


@pytest.mark.parametrize("draw", [lambda rng: random_layout(rng, 5), lambda rng: maze_layout(rng, 0.5)])
def test_the_same_seed_gives_the_same_layout(draw):
    one, same, other = (draw(np.random.default_rng(seed)).obstacles for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    assert one.shape == other.shape and not np.array_equal(one, other)


def test_people_stand_free_of_each_other_of_obstacles_and_of_who_was_there():
    layout = random_layout(np.random.default_rng(0), 4, size=20.0)
    taken = np.array([[0.0, 0.0], [5.0, 5.0]])
    places = sample_people(np.random.default_rng(1), layout, 60, gap=0.3, taken=taken, keep_off=1.5)
    assert places.shape == (60, 2)
    assert abs(places).max() <= 10 - RADIUS - 0.3
    assert layouts.clearance(places, layout.boxes).min() >= RADIUS + 0.3
    assert least_distance(places, places) >= 2 * RADIUS + 0.3
    assert least_distance(places, taken) >= 2 * RADIUS + 0.3 + 1.5
    np.testing.assert_array_equal(
        places, sample_people(np.random.default_rng(1), layout, 60, gap=0.3, taken=taken, keep_off=1.5)
    )


def test_goals_are_free_and_as_far_as_asked():
    layout = random_layout(np.random.default_rng(0), 4, size=20.0)
    starts = sample_people(np.random.default_rng(1), layout, 50)
    goals = sample_goals(np.random.default_rng(2), layout, starts, distance=(6.0, 9.0), gap=0.4)
    apart = np.linalg.norm(goals - starts, axis=-1)
    assert apart.min() >= 6.0 and apart.max() <= 9.0
    assert layouts.clearance(goals, layout.boxes).min() >= RADIUS + 0.4


@pytest.mark.parametrize(
    ("draw", "told"),
    [
        (lambda rng: sample_people(rng, Layout(3.0, [], name="cupboard"), 20), r"of 20 people.*'cupboard'.*Lower"),
        (lambda rng: sample_goals(rng, Layout(5.0, [], name="hut"), np.zeros((1, 2))), r"'hut'.*8 to 24 m.*\[0.0, 0"),
        (lambda rng: random_layout(rng, 50, size=10.0), r"Only \d+ of 50 obstacles fit"),
    ],
)
def test_no_room_is_told(draw, told):
    with pytest.raises(layouts.NoFreeSpace, match=told):
        draw(np.random.default_rng(0))


def test_people_count_follows_the_density():
    assert [layouts.person_count(d, 50.0) for d in (0.0, 0.5, 1.0)] == [0, 100, 200]
    assert layouts.person_count(1.0, 25.0) == 50


@pytest.mark.parametrize("density", [-0.1, 1.1, float("nan")])
def test_bad_densities_name_the_range(density):
    with pytest.raises(ValueError, match="pedestrian_density must be between 0 and 1"):
        layouts.person_count(density, 50.0)
    with pytest.raises(ValueError, match="obstacle_density must be between 0 and 1"):
        maze_layout(np.random.default_rng(0), density)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("size = ", "is not TOML"),
        ("size = 9.0\nobstacles = []\nseize = 1", "unknown key 'seize'.*size, name, obstacles"),
        ("size = -9.0\nobstacles = []", "'size': it must be a number .* above 0"),
        ("size = 9.0\nobstacles = [[0.0, 0.0, 1.0, 0.0, 0.0]]", "half_x.*halves above 0"),
        ("size = 9.0\nobstacles = [[0.0, 0.0, 1.0, nan, 0.0]]", r"obstacles\[0\]\[3\]': a number.*not nan"),
        ("size = 9.0\nobstacles = [" + 5 * "[1.0, 1.0, 1.0, 1.0]," + "]", "half_x"),
        ("size = 9.0\nobstacles = [[1.0, 1.0, 1.0], [1.0]]", "half_x"),
        ("size = 'wide'\nobstacles = []", r"'size': it must be a number \[m\].*, not 'wide'"),
        ("size = true", r"'size': it must be a number \[m\].*, not True"),
        ("size = 9.0\nobstacles = 3", "'obstacles': it must be a list of rows x, y, half_x, half_y, yaw.*, not 3"),
        ("size = 9.0\nobstacles = 'none'", "'obstacles': it must be a list"),
        ("size = 9.0\nobstacles = [3]", "half_x"),
        ("size = 9.0\nobstacles = [[]]", "half_x"),
        ("size = 9.0\nobstacles = [['1', '1', '1', '1', '1']]", "half_x"),
        ("size = 9.0\nobstacles = [[1.0, 1.0]]\nwalls = [[0, 0, 1, 1]]", "obstacles must be finite rows x"),
        ("size = 9.0\nwalls = 3", "'walls': it must be a list of rows x0, y0, x1, y1.*, not 3"),
        ("size = 9.0\nwalls = {a = 1}", "'walls': it must be a list"),
        ("size = 9.0\nwalls = [3]", r"walls\[0\]': it must be a list, not 3 \(a list of rows x0, y0, x1, y1"),
        ("size = 9.0\nwalls = ['1234']", r"walls\[0\]': it must be a list, not '1234' \(a list of rows x0, y0, x1, y1"),
        ("size = 9.0\nwalls = [[0, 0, 1, nan]]", r"walls\[0\]\[3\]': a number .*, not nan"),
        ("size = 9.0\nregions = 3", "'regions': it must be a table of robot_start, .* a list of rows x, y, half_x"),
        ("size = 9.0\nregions = ['robot_goal']", "'regions': it must be a table"),
        ("size = 9.0\nregions = {robot_goal = 3}", "'regions.robot_goal': it must be a list of rows x"),
        ("size = 9.0\nregions = {robot_goal = [[1, 2]]}", "region robot_goal must be finite rows x"),
        ("size = 9.0\nroutes = 3", r"'routes': it must be a list of routes, .*each a list of points \(x, y\).*, not 3"),
        ("size = 9.0\nroutes = [3]", r"routes\[0\]': it must be a list .* not 3 .*points \(x, y\)"),
        ("size = 9.0\nroutes = ['left']", r"routes\[0\]': it must be a list .* not 'left' .*points \(x, y\)"),
        ("size = 9.0\nrouted = 'yes'", "'routed': it must be true or false.*, not 'yes'"),
        ("size = 9.0\npedestrians = 2.5", "'pedestrians': it must be a whole number from 0 to 2000, not 2.5"),
        ("size = 9.0\npedestrians = -1", "'pedestrians': it must be a whole number from 0 to 2000, not -1"),
        ("size = 9.0\nname = 3", "'name': it must be a text of 1 to 100 characters, not 3"),
    ],
)
def test_a_bad_file_is_told(tmp_path, text, told):
    file = tmp_path / "bad.toml"
    file.write_text(text)
    with pytest.raises(ValueError, match=f"bad.toml.*{told}"):
        load_layout(file)


def test_a_good_file(tmp_path):
    file = tmp_path / "good.toml"
    file.write_text('name = "mine"\nsize = 9\nobstacles = [[1, 2, 0.5, 0.6, 0.1]]\nrouted = true\npedestrians = 3')
    layout = load_layout(file)
    assert (layout.name, layout.size, layout.routed, layout.pedestrians) == ("mine", 9, True, 3)
    np.testing.assert_array_equal(layout.obstacles, [[1, 2, 0.5, 0.6, 0.1]])


def test_walls_of_a_file_are_boxes_after_its_obstacles(tmp_path):
    file = tmp_path / "walls.toml"
    text = "size = 9.0\nwalls = [[-1, 2, 3, 2], [0, 0, 0, -2]]\n"
    along, down = [1.0, 2.0, 2.15, 0.15, 0.0], [0.0, -1.0, 1.15, 0.15, -np.pi / 2]
    file.write_text(text)
    np.testing.assert_allclose(load_layout(file).obstacles, [along, down])
    assert load_layout(file).routed
    file.write_text(f"{text}obstacles = [[1, 2, 0.5, 0.6, 0.1]]\nrouted = false")
    np.testing.assert_allclose(load_layout(file).obstacles, [[1, 2, 0.5, 0.6, 0.1], along, down])
    assert not load_layout(file).routed
    file.write_text("size = 9.0")
    assert load_layout(file).obstacles.shape == (0, 5) and not load_layout(file).routed


@pytest.mark.parametrize("level", [0, 5, "1"])
def test_an_unknown_level_names_the_levels(level):
    with pytest.raises(ValueError, match="Choose one of 1, 2, 3, 4"):
        load_level(level)


def test_a_layout_is_frozen():
    rows = np.array([[0.0, 0.0, 1.0, 1.0, 0.0]])
    layout = Layout(20.0, rows)
    with pytest.raises(ValueError, match="read-only"):
        layout.obstacles[0, 0] = 3.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        layout.size = 3.0
    rows[0, 0] = 3.0  # the caller's array stays its own
    assert layout.obstacles[0, 0] == 0.0


def test_the_outer_walls_leave_exactly_the_map():
    points = np.array([[9.0, 0.0], [-9.0, 0.0], [0.0, 9.0], [0.0, -9.0]])
    np.testing.assert_allclose(layouts.clearance(points, OPEN.boxes), 1.0)
    assert len(OPEN.boxes) == 4
    corners = np.array([[x, y] for x in (-10.1, 10.1) for y in (-10.1, 10.1)])
    assert (layouts.clearance(corners, OPEN.boxes) == 0).all()
