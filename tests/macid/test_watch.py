"""Films of crowds show what happened: people in their LCF's colour where the map says, until they leave; whole on
disk."""

import dataclasses
import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest

from macid import metrics, watch
from macid.cli import main
from macid.crowd import CrowdConfig
from macid.drawing import gl
from macid.drawing.colours import lcf_colour
from macid.evaluate import evaluate_level
from macid.layout import Layout
from macid.state import parking_place

PROBLEM = gl.gl_problem()
needs_gl = pytest.mark.skipif(PROBLEM is not None, reason=str(PROBLEM))

BOX = [-5.0, 5.0, 1.5, 0.5, 0.3]
PLACES = np.array([[-6.0, 0.0], [2.0, 0.0], [-9.0, 0.0], [4.0, -6.0]])  # the first has the second ahead, third behind


def recording(lcf=(0.0, -2.0, 2.0, 1.0), leaves=None, steps=100):
    """Four people who stand and look east for `steps` of 0.02 s; `leaves`: at which step (4,) each leaves the map."""
    walking = np.arange(steps + 1)[:, None] < (np.full(4, steps + 1) if leaves is None else np.asarray(leaves))
    position = np.where(walking[..., None], PLACES, parking_place(np.arange(4)))
    layout = Layout(20.0, [BOX], pedestrians=4)
    collisions = np.zeros((steps + 1, 4), int)
    goals = PLACES + np.array([0.0, 3.0])
    yaw = np.zeros((steps + 1, 4))
    return watch.Recording(
        "macid", 1, 7, layout, 0.02, (-2.0, 2.0), np.array(lcf), goals, position, yaw, walking, collisions
    )


def colour(picture, pixel):
    """Mean colour (3,) in [0, 1] of the 3 x 3 pixels around `pixel` x, y."""
    x, y = np.floor(pixel).astype(int)
    return picture[y - 1 : y + 2, x - 1 : x + 2].reshape(-1, 3).mean(axis=0) / 255


def eye_view(picture):
    left, top, width, height = watch._EYE
    return picture[top + 30 : top + height, left : left + width]  # below its label


@needs_gl
def test_people_are_where_the_map_says_in_their_colour():
    lcf = np.array([0.0, -2.0, 2.0, 1.0])
    with watch.Film(recording(lcf)) as one, watch.Film(recording(-lcf)) as other:
        pictures = one.frame(1.0), other.frame(1.0)
        for picture, sign in zip(pictures, (1.0, -1.0), strict=True):
            for place, each in zip(one.map_pixel(PLACES), sign * lcf, strict=True):
                np.testing.assert_allclose(colour(picture, place), lcf_colour(each), atol=0.03)
        floor, wall = (colour(pictures[0], one.map_pixel(place)) for place in ([1.0, 4.0], BOX[:2]))
        assert floor.min() > 0.8 and wall.max() < 0.7
        east, north = one.map_pixel([[1.0, 0.0], [0.0, 1.0]]) - one.map_pixel([0.0, 0.0])
        assert east[0] > 0 == east[1] and north[1] < 0 == north[0]
    assert pictures[0].shape == (one.size[1], one.size[0], 3) and pictures[0].dtype == np.uint8
    with pytest.raises(ValueError, match="closed"):
        one.frame(0.0)


@needs_gl
def test_who_has_left_is_not_drawn():
    there, gone = recording(), recording(leaves=[101, 50, 101, 101])
    with watch.Film(there, follow=0) as stays, watch.Film(gone, follow=0) as leaves:
        place = stays.map_pixel(PLACES[1])
        for time in (0.0, 0.98):
            assert np.array_equal(stays.frame(time), leaves.frame(time))
        before, after = stays.frame(1.5), leaves.frame(1.5)
    red = lcf_colour(-2.0)
    np.testing.assert_allclose(colour(before, place), red, atol=0.03)
    assert colour(after, place).min() > 0.8  # the floor
    middle = eye_view(before).shape[1] // 2
    for picture, seen in ((before, True), (after, False)):
        strip = eye_view(picture)[:, middle - 5 : middle + 5].astype(int)
        assert ((strip[..., 0] > 150) & (strip[..., 0] > 3 * strip[..., 2])).any() == seen


@needs_gl
def test_eyes_see_what_is_ahead_and_when_they_leave_look_through_somebody_elses():
    with watch.Film(recording(), follow=0) as all_there, watch.Film(recording(leaves=[101, 101, 0, 101]), 0) as fewer:
        assert np.array_equal(eye_view(all_there.frame(0.0)), eye_view(fewer.frame(0.0)))  # the third is behind
    with watch.Film(recording(leaves=[50, 60, 40, 101]), follow=0, scale=0.25) as film:
        assert [film.watched(time) for time in (0.0, 0.98)] == [0, 0]
        assert film.watched(1.0) in (1, 3) and film.watched(1.2) == film.watched(2.0) == 3
        film.frame(1.5)
    with watch.Film(recording(leaves=[50, 60, 40, 90]), scale=0.25) as film:
        film.frame(2.0)  # nobody is left


@needs_gl
def test_contacts_are_marked():
    touched = recording()
    touched.collisions[60:, 1] = 1
    with watch.Film(recording()) as without, watch.Film(touched) as film:
        left, top, width, height = film.rect(watch._MAP)
        for time, shown in ((1.0, False), (1.24, True), (1.9, False)):
            pictures = [each.frame(time)[top : top + height, left : left + width] for each in (without, film)]
            differs = np.argwhere((pictures[0] != pictures[1]).any(axis=-1))
            assert bool(len(differs)) == shown
            if shown:
                x, y = film.map_pixel(PLACES[1]) - (left, top)
                assert np.abs(differs - [y, x]).max() < 40


def test_between_decisions_people_move_evenly_and_who_leaves_stays_until_then():
    steps = recording(leaves=[3, 101, 101, 101], steps=4)
    steps = dataclasses.replace(steps, period=0.1)
    steps.position[3, 1], steps.yaw[2:, 1] = [3.0, 1.0], -3.0
    steps.yaw[3:, 1] = 3.0
    moment = steps.at(0.25)
    np.testing.assert_allclose(moment.position[:2], [PLACES[0], [2.5, 0.5]])
    assert abs(moment.yaw[1]) == pytest.approx(np.pi, abs=1e-9)  # the short way round
    assert moment.walking.tolist() == [True] * 4 and steps.at(0.3).walking.tolist() == [False, True, True, True]
    np.testing.assert_array_equal(steps.at(99.0).position, steps.at(0.4).position)
    assert steps.duration == pytest.approx(0.4)


def test_a_recording_is_the_episode_that_evaluate_scores():
    config = CrowdConfig(duration=4.0, period=0.1, lcf=(0.0, 1.0))
    recorded = watch.record("social-force", 1, config, seed=3)
    row = evaluate_level("social-force", 1, episodes=1, seed=3, config=config)
    assert row["CP"] == pytest.approx(metrics.collision_penalty(recorded.collisions[-1])) and row["CP"] > 0
    assert row["arrived"] == pytest.approx(100 * (1 - recorded.walking[-1].mean()))
    assert recorded.position.shape == (41, 25, 2) and recorded.walking[0].all() and not recorded.collisions[0].any()
    on_map = np.abs(recorded.position).max(axis=-1) < 25.0
    assert np.array_equal(on_map, recorded.walking)


def read(path):
    import cv2

    video = cv2.VideoCapture(str(path))
    frames = []
    while (got := video.read())[0]:
        frames.append(got[1])
    return frames, video.get(cv2.CAP_PROP_FPS)


@needs_gl
@pytest.mark.parametrize(("speed", "number"), [(1, 51), (2, 26)])
def test_a_film_is_whole_and_lasts_as_long_as_the_episode(tmp_path, speed, number):
    ticks = []
    path = tmp_path / "a.webm"
    watch.film(recording(), path, speed, scale=0.5, progress=lambda *done: ticks.append(done))
    frames, fps = read(path)
    assert len(frames) == len(ticks) == number and ticks[-1] == (number, number)
    assert fps == 25 and frames[0].shape == (380, 750, 3) and frames[-1].std() > 20
    assert number / fps == pytest.approx(2.0 / speed, abs=0.07)
    assert os.listdir(tmp_path) == ["a.webm"]


@needs_gl
def test_a_film_that_is_stopped_leaves_nothing(tmp_path):
    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        watch.film(recording(), tmp_path / "a.webm", scale=0.25, progress=stop)
    assert os.listdir(tmp_path) == []


@needs_gl
def test_the_command_makes_films_and_pictures(tmp_path, capsys):
    command = ["watch", "--pedestrian", "social-force", "--level", "v1", "--seconds", "0.4", "--scale", "0.5"]
    assert main([*command, "--out", str(tmp_path / "new" / "a.webm")]) == 0
    assert main([*command, "--out", str(tmp_path / "a.png"), "--at", "0.1", "--follow", "24"]) == 0
    assert len(read(tmp_path / "new" / "a.webm")[0]) == 11
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"
    out, progress = capsys.readouterr()
    assert "a.webm" in out and "a.png" in out and "11/11" in progress and "social-force on v1" in progress


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (["--pedestrian", "orka"], "Unknown pedestrian model 'orka'. Choose one of "),
        (["--level", "5"], "Unknown level 5. Choose one of 1, 2, 3, 4, v1"),
        (["--level", "v9"], "Unknown level 'v9'. Choose one of 1, 2, 3, 4, v1"),
        (["--out", "a.mp4"], "must end in .webm (a film) or .png (a picture), not 'a.mp4'"),
        (["--out", "{folder}/b.webm"], "is a folder. Name a file"),
        (["--out", "{file}/below/a.webm"], "Name a folder that you can write to"),
        (["--seed", "-1"], "--seed must be at least 0, not -1"),
        (["--seconds", "0"], "above 0 and at most 600, not 0"),
        (["--seconds", "nan"], "above 0 and at most 600, not nan"),
        (["--period", "0.03"], "multiple of the physics step 0.02 s, not 0.03"),
        (["--lcf", "1", "0"], "range (least, most)"),
        (["--follow", "25"], "--follow must be 0 to 24"),
        (["--scale", "9"], "--scale must be 0.25 to 2, not 9"),
        (["--at", "1"], "let --out end in .png"),
        (["--at", "21", "--out", "{folder}/a.png"], "--at must be 0 to 20"),
    ],
)
def test_a_wrong_request_is_one_line_and_exit_code_2(tmp_path, monkeypatch, capsys, wrong, told):
    monkeypatch.setattr(gl, "gl_problem", lambda: None)
    (tmp_path / "file").write_text("mine")
    (tmp_path / "b.webm").mkdir()
    wrong = [word.format(file=tmp_path / "file", folder=tmp_path) for word in wrong]
    assert main(["watch", "--pedestrian", "orca", "--level", "1", "--out", str(tmp_path / "a.webm"), *wrong]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("macid: error: ") and err.count("\n") == 1 and told in err
    assert sorted(os.listdir(tmp_path)) == ["b.webm", "file"]


def test_without_gl_the_command_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gl, "gl_problem", lambda: "no EGL here")
    assert main(["watch", "--pedestrian", "orca", "--out", str(tmp_path / "a.webm")]) == 2
    assert "No pictures here: no EGL here" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        main(["watch", "--speed", "3"])
    assert stop.value.code == 2 and os.listdir(tmp_path) == []


def test_macid_needs_no_bson():
    code = "import sys; sys.modules['bson'] = None; import macid.watch; assert 'cv2' not in sys.modules"
    root = pathlib.Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
