"""The film of a measured model beside real people."""

import pathlib

import numpy as np

from macid.drawing import strokes, video
from macid.human.data import OPEN_PERIOD
from macid.human.replay import Played, Scene

FPS, SPEED = 25, 2.0  # frames a second, and how many times as fast a film plays
SECONDS = 24.0  # of the scene's time
BODY = 0.2  # radius with which real people are drawn [m]
_SIDE, _HEAD = 560, 40  # of a film's halves, and above them [pixels]
_AHEAD = 0.8  # [s]


def film(path: pathlib.Path, scenes: list[Scene], played: Played, name: str, radius: float) -> pathlib.Path:
    """Writes the film `path` (.webm) of the fullest SECONDS of `scenes`: real people left, right the model `name` with
    bodies of `radius` [m]. Returns the path."""
    crowds = [np.isfinite(position[..., 0]).sum(axis=1) for position in played.position]
    which = int(np.argmax([crowd.max() for crowd in crowds]))
    scene, model = scenes[which], played.position[which]
    samples = round(SECONDS / OPEN_PERIOD)
    sums = np.convolve(crowds[which], np.ones(min(samples, len(crowds[which]))), "valid")
    begin = int(np.argmax(sums))
    times = np.arange(0.0, min(samples, len(model) - begin - 1) * OPEN_PERIOD, SPEED / FPS)

    def pictures():
        for time in times:
            page = np.full((_HEAD + _SIDE, 2 * _SIDE, 3), 255, np.uint8)
            left = _half(scene, scene.position, begin, time, BODY, (138, 148, 160))
            right = _half(scene, model, begin, time, radius, (31, 111, 139))
            page[_HEAD:, :_SIDE], page[_HEAD:, _SIDE:] = left, right
            strokes.write(page, f"people, {scene.name}", (12, 27), 0.66, (29, 39, 51))
            strokes.write(page, name, (_SIDE + 12, 27), 0.66, (29, 39, 51))
            yield page

    return video.write_webm(path, pictures(), len(times), FPS)


def _half(scene, position, begin, time, radius, colour):
    """One picture of people at `position` (T, P, 2) at `time` [s] after the sample `begin`."""
    metre = _SIDE / (2 * scene.reach + 2.0)
    canvas = np.full((_SIDE, _SIDE, 3), (242, 245, 247), np.uint8)

    def at(then):
        exact = begin + then / OPEN_PERIOD
        before = min(int(exact), len(position) - 1)
        after = min(before + 1, len(position) - 1)
        along = position[before] + (exact - before) * (position[after] - position[before])
        return np.where(np.isnan(along), position[before], along)

    def pixels(place):
        return np.stack([_SIDE / 2 + metre * place[..., 0], _SIDE / 2 - metre * place[..., 1]], axis=-1)

    now, later = pixels(at(time)), pixels(at(time + _AHEAD))
    for who in np.flatnonzero(~np.isnan(now[:, 0])):
        shade = (176, 180, 184) if scene.stands[who] else colour
        if not np.isnan(later[who, 0]) and not scene.stands[who]:
            strokes.line(canvas, np.array([now[who], later[who]]), shade, 2.0)
        strokes.disc(canvas, now[who], max(2.0, radius * metre), shade)
    return canvas
