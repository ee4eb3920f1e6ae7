import itertools

import cv2
import numpy as np
import pytest
from scipy import ndimage

from macid.geometry import point_box_distance
from macid.layout import Layout, NoFreeSpace, load_layout, most_clearance, sample_goals, sample_people
from macid.maps import load_map, map_names, rectangles
from macid.routing import Router, occupancy_grid, rest_of_route


def write_map(folder, picture, **fields):
    cv2.imwrite(str(folder / "floor.pgm"), picture)
    lines = {"image": "floor.pgm", "resolution": 0.5, "origin": "[-3.0, 2.0, 0.0]", "negate": 0, **fields}
    (folder / "floor.yaml").write_text("".join(f"{key}: {value}\n" for key, value in lines.items()))
    return str(folder / "floor.yaml")


@pytest.mark.parametrize("seed", range(4))
def test_rectangles_cover_exactly_the_solid_cells(seed):
    solid = ndimage.binary_dilation(np.random.default_rng(seed).random((17, 24)) < 0.08, np.ones((2, 3)))
    boxes = rectangles(solid, 0.5)
    axis = (np.arange(24) + 0.5) * 0.5 - 6.0
    inside = point_box_distance(np.stack(np.meshgrid(axis, axis), axis=-1), boxes) == 0
    square = np.ones((24, 24), bool)
    square[3:20] = solid
    np.testing.assert_array_equal(inside.any(axis=-1), square)
    assert (inside.sum(axis=-1) <= 1).all()  # none twice
    assert len(boxes) < square.sum() / 2


def test_an_image_is_read_as_map_server_reads_it(tmp_path):
    picture = np.full((8, 8), 254, np.uint8)
    picture[1, 2] = 0  # second row from above: y = 2.5 ... 3
    picture[6, 5] = 205  # unknown
    layout = load_map(write_map(tmp_path, picture))
    assert (layout.size, layout.name, layout.routed) == (4.0, "floor", True)
    np.testing.assert_allclose(sorted(layout.obstacles[:, :2].tolist()), [[-0.75, 1.25], [0.75, -1.25]])
    np.testing.assert_allclose(layout.obstacles[:, 2:4], 0.25)
    turned = load_map(write_map(tmp_path, 255 - picture, negate=1))
    np.testing.assert_allclose(turned.obstacles[:, :2], layout.obstacles[:, :2])


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"image": "none.pgm"}, "can't read its image 'none.pgm'"),
        ({"resolution": -1}, "'resolution': it must be a number above 0 .*not -1"),
        ({"origin": "[0, 0]"}, "'origin': it must be a list of 3"),
        ({"mode": "grey"}, "'mode': it must be one of trinary, scale, raw, not 'grey'"),
        ({"free_thresh": 0.7}, "'free_thresh': it must be below occupied_thresh, 0.65, not 0.7"),
        ({"negate": 2}, "'negate': it must be"),
        ({"resolution": ".nan"}, "'resolution': it must be a number above 0 .*not nan"),
        ({"resolution": "wide"}, "'resolution': it must be a number above 0"),
    ],
)
def test_a_wrong_image_map_is_told(tmp_path, fields, told):
    with pytest.raises(ValueError, match=told):
        load_map(write_map(tmp_path, np.full((4, 4), 254, np.uint8), **fields))


def test_wrong_names_and_files_are_told(tmp_path):
    with pytest.raises(ValueError, match="Unknown map 'hal'. Choose one of blind-corner, .*hall, office"):
        load_map("hal")
    with pytest.raises(ValueError, match="no map file"):
        load_map(str(tmp_path / "none.toml"))
    (tmp_path / "bad.yaml").write_text("a: [1")
    with pytest.raises(ValueError, match="not YAML"):
        load_map(str(tmp_path / "bad.yaml"))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("walls = [[0, 0, 1]]", "a wall is four numbers"),
        ("regions = {robot = [[0, 0, 1, 1, 0]]}", "unknown region 'robot'. Choose among robot_start"),
        ("regions = {robot_goal = []}", "robot_goal has no box"),
        ("routes = [[[0, 0]]]", "two or more points"),
        ("routes = [[[0, 0], [0, 50]]]", "on the map"),
        ("rooms = 3", "unknown key 'rooms'. Choose among size, name"),
    ],
)
def test_a_wrong_layout_file_is_told(tmp_path, text, told):
    (tmp_path / "map.toml").write_text(f"size = 20.0\n{text}\n")
    with pytest.raises(ValueError, match=told):
        load_layout(tmp_path / "map.toml")


@pytest.mark.parametrize("name", map_names())
def test_on_the_shipped_maps_every_goal_is_reached(name):
    layout = load_map(name)
    free = ~occupancy_grid(layout, resolution=0.2)
    labels, _ = ndimage.label(free)
    if not layout.regions:
        assert np.bincount(labels[free]).max() > 0.97 * free.sum()
    for start in layout.regions.get("robot_start", []):
        for goal in layout.regions["robot_goal"]:
            Router(layout).path(start[:2], goal[:2])
    for route in layout.routes:
        for start, end in itertools.pairwise(route):
            Router(layout).path(start, end)


def test_walls_stand_where_they_were_drawn():
    boxes = load_map("hall").boxes
    assert (point_box_distance(np.array([[0.0, -6.0], [0.0, 1.6]]), boxes).min(axis=-1) == 0).all()
    assert point_box_distance(np.array([0.0, 0.0]), boxes).min() == pytest.approx(1.35)


def test_people_stand_and_go_only_where_they_may():
    layout, rng = load_map("hall"), np.random.default_rng(0)
    left, right = layout.regions["robot_start"], layout.regions["robot_goal"]
    starts = sample_people(rng, layout, 20, region=left)
    goals = sample_goals(rng, layout, starts, (5.0, 30.0), region=right)
    assert (point_box_distance(starts, left) == 0).all() and (point_box_distance(goals, right) == 0).all()
    with pytest.raises(NoFreeSpace):
        sample_goals(rng, layout, starts, (1.0, 2.0), region=right)


def test_the_rest_of_a_route():
    route = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]])
    np.testing.assert_array_equal(rest_of_route(route, np.array([1.0, 0.5]), route[-1]), route[1:])
    np.testing.assert_array_equal(rest_of_route(route, np.array([4.5, 2.0]), route[-1]), route[2:])
    np.testing.assert_array_equal(rest_of_route(route, np.array([4.5, 2.0]), route[0]), route[1::-1])


BOX, WALL = "obstacles = [[0, 0, 1, 1, 0]]", "walls = [[0, -6, 0, 6]]"
CLOSET = "obstacles = [[3, 3, 1.2, 0.1, 0], [3, 5, 1.2, 0.1, 0], [2, 4, 0.1, 1.2, 0], [4, 4, 0.1, 1.2, 0]]"
DOOR = "walls = [[0, -6, 0, -{0}], [0, {0}, 0, 6]]"  # 0.3 m less on each side


@pytest.mark.parametrize(
    ("solid", "route", "told"),
    [
        (BOX, [[-4, 0], [0, 0.5], [4, 0]], r"routes\[0\]\[1\], \[0.0, 0.5\], is 0.00 m from a box or wall"),
        (BOX, [[0, 0], [4, 0]], r"routes\[0\]\[0\]"),
        (BOX, [[4, 0], [1.2, 0]], r"routes\[0\]\[1\].* is 0.20 m from .* needs 0.35 m"),
        (WALL, [[-4, 0], [0.1, 0]], r"is 0.00 m"),
        ("", [[-4, 0], [5.8, 0]], r"\[5.8, 0.0\], is 0.20 m"),
        (WALL, [[-4, 0], [4, 0]], r"routes\[0\] has no way for a person.* from \[-4.0, 0.0\] to \[4.0, 0.0\]"),
        (WALL + "\nrouted = false", [[-4, 0], [4, 0]], "no way for a person"),
        (DOOR.format(0.4), [[-4, 0], [4, 0]], "no way for a person"),
        (CLOSET, [[-4, 0], [3, 4]], r"no way .* to \[3.0, 4.0\]"),
        (CLOSET, [[3, 4], [-4, 0], [-4, 4]], r"no way .* from \[3.0, 4.0\]"),
    ],
)
def test_a_route_that_nobody_can_walk_is_refused_at_load(tmp_path, solid, route, told):
    (tmp_path / "map.toml").write_text(f"size = 12.0\n{solid}\nroutes = [{route}]\n")
    with pytest.raises(ValueError, match=f"map.toml.*{told}"):
        load_map(str(tmp_path / "map.toml"))


@pytest.mark.parametrize(
    ("solid", "route"),
    [
        (BOX, [[-4, 0], [4, 0]]),  # people find their way around
        (BOX, [[1.35, 0], [5.65, 5.65]]),
        (DOOR.format(0.8), [[-4, 0], [4, 0]]),
        (CLOSET, [[2.9, 4], [3.1, 4]]),
    ],
)
def test_a_route_that_a_person_can_walk_is_taken(tmp_path, solid, route):
    (tmp_path / "map.toml").write_text(f"size = 12.0\n{solid}\nroutes = [{route}]\n")
    assert len(load_map(str(tmp_path / "map.toml")).routes) == 1


@pytest.mark.parametrize("half", [0.02, 0.4, 1.7])
def test_the_most_clearance_is_that_of_the_best_place(half):
    layout = Layout(12.0, [[0.0, 0.0, 2.0, 2.0, 0.3]])
    region = np.array([[4.0, 0.0, half, half, 0.0]])
    grid = np.linspace(-half, half, 200)
    places = region[0, :2] + np.stack(np.meshgrid(grid, grid), axis=-1)
    best = point_box_distance(places, layout.boxes).min(axis=-1).max()
    assert most_clearance(layout, region) == pytest.approx(best, abs=0.01)
    assert most_clearance(Layout(10.0, [])) == pytest.approx(5.0, abs=0.01)
    assert most_clearance(Layout(10.0, [[0.0, 0.0, 6.0, 6.0, 0.0]])) == 0


def test_a_whole_size_stays_whole(tmp_path):
    (tmp_path / "map.toml").write_text("size = 20\n")
    image = write_map(tmp_path, np.full((4, 4), 254, np.uint8), resolution=2)
    for file, size in ((tmp_path / "map.toml", 20), (image, 8)):
        assert repr(load_map(str(file)).size) == str(size)  # digests of suites have it so
