"""Films show what happened: people coloured by LCF, robot and goal where they are; all or nothing on disk."""

import dataclasses
import os

import numpy as np
import pytest

from bson import robot
from bson.episodes import film
from bson.episodes.record import Episode
from macid import scene
from macid.drawing import gl

PROBLEM = gl.gl_problem()
needs_gl = pytest.mark.skipif(PROBLEM is not None, reason=str(PROBLEM))

SIZE = 20.0  # of the map [m]
START, GOAL = np.array([-5.0, -2.0]), np.array([6.0, 3.0])
WALLS = [[0, 10, 10, 0.1, 0], [0, -10, 10, 0.1, 0], [10, 0, 0.1, 10, 0], [-10, 0, 0.1, 10, 0]]


@pytest.fixture(scope="module")
def model():
    spec = scene.base_spec(SIZE)
    scene.add_people(spec, 2)
    scene.add_boxes(spec, np.array([*WALLS, [2.0, -4.0, 1.5, 0.1, 0.5]]), movable=True)
    robot.add_robot(spec, robot.JACKAL)
    return spec.compile()


def straight(steps, lcf=(-2.0, 2.0)):
    """An episode of `steps` control steps from START towards GOAL at 1 m/s, past two people who stand."""
    towards = (GOAL - START) / np.hypot(*(GOAL - START))
    way = START + 0.1 * np.arange(steps + 1)[:, None] * towards
    pose = np.column_stack([way, np.full(steps + 1, np.arctan2(towards[1], towards[0]))])
    people = np.broadcast_to([[-3.0, 4.0, 0.0], [3.0, 5.0, 1.0]], (steps + 1, 2, 3))
    return Episode(
        seed=7,
        start_distance=float(np.hypot(*(GOAL - START))),
        shortest=float(np.hypot(*(GOAL - START))),
        final_distance=float(np.hypot(*(GOAL - way[-1]))),
        travelled=0.1 * steps,
        duration=0.1 * steps,
        arrived=False,
        timed_out=True,
        collisions=0,
        collisions_so_far=np.zeros(len(pose), int),
        collisions_person=0,
        collisions_robot_on_person=0,
        collisions_obstacle=0,
        collisions_wall=0,
        nearest_person=np.ones(steps + 1),
        goal=GOAL,
        boxes=np.array([*WALLS, [2.0, -4.0, 1.5, 0.1, 0.5]]),
        lcf=np.array(lcf),
        pose=pose,
        velocity=np.tile([1.0, 0.0], (steps + 1, 1)),
        people=people,
        people_velocity=np.zeros((steps + 1, 2, 2)),
        qpos=np.hstack([people.reshape(steps + 1, -1), robot.spawn_qpos(*pose.T), np.zeros((steps + 1, 4))]),
        period=0.1,
        robot_radius=0.31,
    )


def patch(picture, pixel, radius=3):
    """Mean colour (3,) around `pixel` x, y of a picture."""
    x, y = np.floor(pixel).astype(int)
    return picture[y - radius : y + radius + 1, x - radius : x + radius + 1].reshape(-1, 3).mean(axis=0)


@needs_gl
def test_people_robot_and_goal_are_where_the_map_says(model):
    episode = straight(30)
    before = model.geom_rgba.copy()
    with film.Film(model) as camera:
        picture = camera.frame(episode, 20)
        swapped = camera.frame(dataclasses.replace(episode, lcf=-episode.lcf), 20)
        red, blue = camera.map_pixel(episode, episode.people[20, :, :2])
        assert patch(picture, red)[0] - patch(picture, red)[2] > 40 > -40 > np.subtract(*patch(picture, blue)[[0, 2]])
        assert patch(swapped, red)[2] > patch(swapped, red)[0]
        goal = patch(picture, camera.map_pixel(episode, episode.goal))
        assert goal[1] > 1.5 * goal[0] and goal[1] > 1.5 * goal[2]
        yellow = patch(picture, camera.map_pixel(episode, episode.pose[20, :2]), radius=2)
        assert yellow[0] > 180 and yellow[1] > 130 and yellow[2] < 100
        east, north = camera.map_pixel(episode, START + np.eye(2)) - camera.map_pixel(episode, START)
        assert east[0] > 0 == east[1] and north[1] < 0 == north[0]
    assert picture.shape == (camera.size[1], camera.size[0], 3) and picture.dtype == np.uint8
    assert np.array_equal(model.geom_rgba, before), "The world's model is not the film's to change."


@needs_gl
def test_every_view_shows_something_and_steps_differ(model):
    episode = straight(30)
    with film.Film(model) as camera:
        first, last = camera.frame(episode, 0), camera.frame(episode, -1)
    for left, top, width, height in (film._CHASE, film._MAP, film._FRONT):
        view = slice(top, top + height), slice(left, left + width)
        assert first[view].std() > 10
        assert (first[view] != last[view]).any()
    with pytest.raises(ValueError, match="closed"):
        camera.frame(episode)


@needs_gl
def test_the_robot_is_visible_behind_a_wall(model):
    episode = straight(30)
    heading, elevation = film._chase(episode, 15)
    boxes = episode.boxes.copy()
    behind = episode.pose[15, :2] - 0.9 * np.array([np.cos(heading), np.sin(heading)])
    boxes[4] = [*behind, 0.1, 2, heading]
    assert film._chase(dataclasses.replace(episode, boxes=boxes), 15)[1] > elevation + 0.2


@needs_gl
def test_film_reads_back(model, tmp_path):
    import cv2

    ticks = []
    path = film.film(model, straight(30), tmp_path / "a.webm", max_frames=9, progress=lambda *done: ticks.append(done))
    video = cv2.VideoCapture(str(path))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    assert len(frames) == len(ticks) == 9 and ticks[-1] == (9, 9)
    assert frames[0].shape == (372, 1140, 3)
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(10)
    assert frames[0][:6].mean() > 240 and frames[0].std() > 20
    assert os.listdir(tmp_path) == ["a.webm"]


@needs_gl
def test_a_failed_film_leaves_nothing(model, tmp_path):
    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        film.film(model, straight(3), tmp_path / "a.webm", progress=stop)
    assert os.listdir(tmp_path) == []


def test_an_unwritable_place_is_named(model, tmp_path):
    with pytest.raises(OSError, match="nowhere"):
        film.film(model, straight(3), tmp_path / "nowhere" / "a.webm")
    with pytest.raises(ValueError, match="webm"):
        film.film(model, straight(3), tmp_path / "a.mp4")


@needs_gl
def test_still(model, tmp_path):
    import cv2

    path = film.still(model, straight(10), tmp_path / "a.png", scale=0.5)
    assert cv2.imread(str(path)).shape == (248, 760, 3)
