"""Films of a crowd, drawn offscreen: the whole map from above, and the view of one of its people, at eye height.

A person's colour is its LCF. Pictures are RGB, (height, width, 3) uint8. Drawing needs OpenGL:
`macid.drawing.gl.gl_problem()` says what is missing.
"""

import dataclasses
import math
import os
import pathlib
from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from macid import geometry, metrics, scene
from macid.crowd import CONFIG, Crowd, CrowdConfig, snapshot
from macid.drawing import strokes, video
from macid.drawing.colours import GOAL_RGB, INK, MUTED, PANEL, PAPER, lcf_colour, rgb255
from macid.drawing.stage import NEAR, Stage
from macid.evaluate import level_name, level_seed
from macid.files import UsageError
from macid.layout import WALL_THICKNESS, Layout, load_level
from macid.pedestrians import is_learned, make_controller
from macid.state import GOAL_RADIUS, RADIUS

FPS = 25
EYE_HEIGHT = 1.6  # [m]
_FIELD_OF_VIEW = math.radians(84)  # of the eye, from left to right
_PITCH = math.radians(-10)
_TRAIL = 2.0  # [s]
_TOUCH = 0.2  # a contact is shown so long [s]: a contact of a single step would flash by
_CONTACT_RGB, _TRAIL_RGB, RULE_RGB = (0.84, 0.0, 0.55), (0.55, 0.55, 0.55), (0.61, 0.55, 0.78)
_FLOOR, _GRID, _OBSTACLE, _WALL = (226, 228, 230), (212, 214, 217), (158, 146, 132), (112, 119, 130)
_TUBE = mujoco.mjtGeom.mjGEOM_CYLINDER

# The page, at scale 1: x, y, width, height [pixels].
_SIZE = (1500, 760)
_MAP, _READINGS = (10, 46, 704, 704), (724, 46, 766, 60)
_EYE, _LEGEND = (724, 116, 766, 520), (724, 646, 766, 104)


class Moment(NamedTuple):
    """A crowd at one instant."""

    position: np.ndarray  #: (K, 2) [m]; without meaning for a person who has left
    yaw: np.ndarray  #: (K,) [rad]
    walking: np.ndarray  #: (K,) bool: on the map
    touching: np.ndarray  #: (K,) bool: in contact now or in the last 0.2 s
    collisions: np.ndarray  #: (K,) steps of 0.02 s in contact so far


@dataclasses.dataclass(frozen=True)
class Recording:
    """One episode of a crowd of K people, T decisions. World frame; metres, seconds, radians."""

    pedestrian: str
    level: int | str
    seed: int
    layout: Layout
    period: float
    lcf_range: tuple[float, float]
    lcf: np.ndarray  # (K,)
    goals: np.ndarray  # (K, 2)
    position: np.ndarray  # (T + 1, K, 2)
    yaw: np.ndarray  # (T + 1, K)
    walking: np.ndarray  # (T + 1, K) bool: on the map
    collisions: np.ndarray  # (T + 1, K) steps of 0.02 s in contact so far
    radius: float = RADIUS  # everybody's [m]

    @property
    def duration(self) -> float:
        """The episode's length [s]."""
        return (len(self.position) - 1) * self.period

    @property
    def colours(self) -> np.ndarray:
        """Everybody's colour, RGB (K, 3) in [0, 1]: the LCF's, or one colour for all where a rule has no use for
        LCFs."""
        return lcf_colour(self.lcf) if is_learned(self.pedestrian) else np.tile(RULE_RGB, (len(self.lcf), 1))

    def at(self, time: float) -> Moment:
        """The Moment at `time` [s], people's places interpolated between decisions."""
        last = len(self.position) - 1
        exact = min(max(time / self.period, 0.0), last)
        step = min(int(exact + 1e-6), last)
        then, share = min(step + 1, last), max(exact - step, 0.0)
        stays = self.walking[then]  # a person who leaves has its next place off the map
        move = np.where(stays[:, None], self.position[then] - self.position[step], 0.0)
        turn = np.where(stays, geometry.wrap_angle(self.yaw[then] - self.yaw[step]), 0.0)
        before = max(0, step - max(1, round(_TOUCH / self.period)))
        return Moment(
            self.position[step] + share * move,
            self.yaw[step] + share * turn,
            self.walking[step],
            self.walking[step] & (self.collisions[step] > self.collisions[before]),
            self.collisions[step],
        )

    def last_step(self, person: int) -> int:
        """The last of the T + 1 steps at which `person` is on the map."""
        return int(np.flatnonzero(self.walking[:, person])[-1])


def record(pedestrian: str, level: int | str, config: CrowdConfig = CONFIG, seed: int = 0) -> Recording:
    """A Recording of the episode that `macid evaluate --episodes 1` plays with the same arguments.

    config's `number` is overridden by the level's. Raises UsageError where physics fails.
    """
    controller = make_controller(pedestrian, config.period)
    layout = load_level(level)
    config = dataclasses.replace(config, number=layout.people)
    crowd = Crowd(layout, config)
    start = crowd.reset(np.random.default_rng((seed, *level_seed(level))))
    end, moments = crowd.rollout(start, controller, record=snapshot)
    if what := crowd.engine.faults(end.physics)[0]:
        raise UsageError(f"Physics failed in the episode of seed {seed}: {what}. Choose another --seed.")
    last = snapshot(crowd.engine.read(end.physics), end)
    fields = [np.concatenate([each, final[None]])[:, 0] for each, final in zip(moments, last, strict=True)]
    lcf, goals = np.asarray(start.lcf)[0], np.asarray(start.goals)[0]
    least, most = config.lcf
    about = pedestrian, level, seed, layout, config.period, (least, most), lcf, goals
    return Recording(*about, *fields, radius=config.person.radius)


def worth_following(recording: Recording, step: int = 0) -> int:
    """The index of a person on the map at `step` whose way from then on is long and near the middle of the crowd."""
    walking, position = recording.walking[step:], recording.position[step:]
    counts = np.maximum(walking.sum(axis=1, keepdims=True), 1)
    middle = (position * walking[..., None]).sum(axis=1) / counts
    way = (geometry.norm(np.diff(position, axis=0)) * walking[1:]).sum(axis=0)
    off = (geometry.norm(position - middle[:, None]) * walking).sum(axis=0) / np.maximum(walking.sum(axis=0), 1)
    return int(np.argmax(np.where(walking[0], way - off, -np.inf)))


class Film(Stage):
    """Draws a recording. Close it, or use it in a `with`; raises Unavailable without OpenGL.

    follow: the person whose eyes to look through (default: `worth_following`); when it has left, somebody else's.
    scale: the picture's size, 1 for 1500 x 760. samples: 0 or 4, for anti-aliasing.
    """

    def __init__(self, recording: Recording, follow: int | None = None, scale: float = 1.0, samples: int = 0):
        super().__init__(scene.crowd_spec(recording.layout, 0).compile(), _SIZE, (_MAP, _EYE), scale, samples)
        self.recording = recording
        step, self._watched = 0, {}  # {the step from which on a person is watched: the person}
        while recording.walking[step:].any():
            chosen = follow if step == 0 and follow is not None else worth_following(recording, step)
            self._watched[step] = chosen
            step = recording.last_step(chosen) + 1
        self._bright = [rgb255(rgb) for rgb in recording.colours]
        self._faint = [rgb255(rgb) for rgb in 0.7 * recording.colours]
        self._span = recording.layout.size + 2 * WALL_THICKNESS + 0.4
        self._ground = self._draw_ground()

    def frame(self, time: float, speed: float | None = None) -> np.ndarray:
        """The composed picture at `time` [s]. speed: the playback's, for the header."""
        recording, moment = self.recording, self.recording.at(time)
        page = self.page()
        self._draw_map(page, time, moment)
        self._draw_eye_view(page, time, moment)
        low, high = recording.lcf_range
        title = f"{recording.pedestrian} on {level_name(recording.level)}: {len(recording.lcf)} people"
        if is_learned(recording.pedestrian):
            title += f", LCF {low:.3g}" if low == high else f", LCF {low:.3g} to {high:.3g}"
        notes = [f"seed {recording.seed}"]
        if speed is not None:
            notes.append(video.pace(speed))
        self.write_header(page, title, notes)
        self._panels(page, time, moment)
        return page

    def map_pixel(self, place: ArrayLike) -> np.ndarray:
        """Where the map shows `place` (..., 2) [m]: (..., 2) pixels x, y of the picture, continuous."""
        return self.on_map(_MAP, (0.0, 0.0), self._span, place)

    def watched(self, time: float) -> int:
        """The index of the person whose eyes show the crowd at `time` [s]."""
        return self._watched[max(step for step in self._watched if step <= time / self.recording.period + 1e-6)]

    def _gaze(self, time):
        """Place (2,) [m] and heading [rad] of the watched person's eyes; those of its last moment on the map if it has
        left."""
        recording, person = self.recording, self.watched(time)
        time = min(time, recording.last_step(person) * recording.period)
        centre, reach = round(time / recording.period), round(0.8 / recording.period)
        steps = np.arange(max(0, centre - reach), min(len(recording.yaw), centre + reach + 1))
        weights = np.exp(-0.5 * ((steps - centre) * recording.period / 0.4) ** 2)  # heads turn more calmly than bodies
        yaw = recording.yaw[steps, person]
        return recording.at(time).position[person], math.atan2(weights @ np.sin(yaw), weights @ np.cos(yaw))

    def _draw_eye_view(self, page, time, moment):
        """What the watched person sees."""
        recording, person = self.recording, self.watched(time)
        place, heading = self._gaze(time)
        self.pose()
        ahead, left = geometry.heading(heading + np.array([0.0, math.pi / 2]))
        offset = moment.position - place
        depth, aside = np.maximum(offset @ ahead, 0.0), np.abs(offset @ left)
        seen = moment.walking & (offset @ ahead > -1.0) & (aside < depth * math.tan(_FIELD_OF_VIEW / 2) + 2.0)
        seen[person] = False
        for x, y in moment.position[seen]:  # in place of shadows, which take as long as all the rest
            self.add(_TUBE, [1.2 * recording.radius, 0.002, 0], [x, y, 0.003], [0.0, 0.0, 0.0, 0.25], shadow=False)
        poses = np.column_stack([moment.position, moment.yaw])[seen]
        self.add_people(poses, recording.colours[seen], recording.radius)
        if moment.walking[person]:
            self.add_goal(recording.goals[person])
        forward = np.array([*(math.cos(_PITCH) * ahead), math.sin(_PITCH)])
        half_height = NEAR * math.tan(_FIELD_OF_VIEW / 2) * _EYE[3] / _EYE[2]
        self.look([*place, EYE_HEIGHT], forward, np.cross(forward, [*left, 0.0]), half_height)
        self.render(page, _EYE)
        label = f"What person {person} sees"
        if is_learned(recording.pedestrian):
            label += f" (LCF {recording.lcf[person]:.2f})"
        if not moment.walking[person]:
            label = "Everybody has arrived"
        self.write_label(page, _EYE, label)

    def _on_ground(self, place):
        """`map_pixel`, counted from the corner of the map's own picture."""
        return self.map_pixel(place) - self.rect(_MAP)[:2]

    def _draw_ground(self):
        """The map's picture without people: a grid of 5 m, obstacles, walls."""
        _, _, width, height = self.rect(_MAP)
        ground = np.full((height, width, 3), _FLOOR, np.uint8)
        half = self.recording.layout.size / 2
        for offset in np.arange(-half, half, 5.0):
            for ends in ([[offset, -half], [offset, half]], [[-half, offset], [half, offset]]):
                strokes.line(ground, self._on_ground(ends), _GRID, 1.0)
        for index, corners in enumerate(self._on_ground(geometry.box_corners(self.recording.layout.boxes))):
            strokes.polygon(ground, corners, _WALL if index < 4 else _OBSTACLE)
        self.draw_metres(ground, width / self._span)
        return ground

    def _draw_map(self, page, time, moment):
        """People, their trails and goals, and where the watched person looks."""
        import cv2

        left, top, width, height = self.rect(_MAP)
        canvas, at = self._ground.copy(), self._on_ground
        unit, metre, recording = self.scale, width / self._span, self.recording
        walkers = np.flatnonzero(moment.walking)
        layer = canvas.copy()
        place, heading = self._gaze(time)
        watched = self.watched(time)
        fan = heading + np.linspace(-0.5, 0.5, 9) * _FIELD_OF_VIEW
        strokes.polygon(layer, at(np.vstack([place, place + 6.0 * geometry.heading(fan)])), PAPER)
        cv2.addWeighted(layer, 0.6, canvas, 0.4, 0.0, canvas)
        layer = canvas.copy()
        ages = np.linspace(_TRAIL, 0.0, 9)
        ways = at(np.stack([recording.at(max(0.0, time - age)).position for age in ages], axis=1))
        for person, goal in zip(walkers, at(recording.goals[walkers]), strict=True):
            strokes.disc(layer, goal, 2 * unit, self._faint[person])
            strokes.line(layer, ways[person], self._faint[person], 2 * unit)
        cv2.addWeighted(layer, 0.55, canvas, 0.45, 0.0, canvas)
        radius = recording.radius * metre
        noses = at(moment.position + 0.75 * recording.radius * geometry.heading(moment.yaw))
        spots = at(moment.position)
        for person in np.flatnonzero(moment.touching):
            strokes.disc(canvas, spots[person], radius + 4 * unit, rgb255(_CONTACT_RGB))
        for person in walkers:
            strokes.disc(canvas, spots[person], radius, self._bright[person])
            strokes.ring(canvas, spots[person], radius, INK, unit)
            strokes.disc(canvas, noses[person], 0.3 * radius, INK)
        if moment.walking[watched]:
            for colour, thickness in ((PAPER, 4.0), (INK, 1.6)):
                strokes.ring(canvas, at(place), radius + 6.5 * unit, colour, thickness * unit)
            goal = at(recording.goals[watched])
            strokes.ring(canvas, goal, max(GOAL_RADIUS * metre, 5 * unit), rgb255(GOAL_RGB), 2.2 * unit)
        page[top : top + height, left : left + width] = canvas

    def _panels(self, page, time, moment):
        """The readings and the legend."""
        unit, recording = self.scale, self.recording
        for panel in (_READINGS, _LEGEND):
            left, top, width, height = self.rect(panel)
            page[top : top + height, left : left + width] = PANEL
        left, top, width, _ = self.rect(_READINGS)
        readings = [
            ("Time", f"{time:.1f} s"),
            ("On the map", f"{moment.walking.sum()}"),
            ("Arrived", f"{100 * (1 - moment.walking.mean()):.1f} %"),
            ("In contact", f"{moment.touching.sum()}"),
            ("Collision steps a person (CP)", f"{metrics.collision_penalty(moment.collisions):.1f}"),
        ]
        for (name, value), x in zip(readings, (0.0, 0.16, 0.34, 0.51, 0.67), strict=True):
            self.write_reading(page, (left + 14 * unit + x * width, top + 22 * unit), name, value)
        left, top, width, _ = self.rect(_LEGEND)
        x0, x1 = round(left + 14 * unit), round(left + width - 14 * unit)
        if not is_learned(recording.pedestrian):
            note = f"'{recording.pedestrian}' is a rule without LCFs: everybody has one colour."
            strokes.write(page, note, (x0, top + 36 * unit), 0.44 * unit, MUTED)
        else:
            self.draw_lcf_scale(page, x0, x1, top + 30 * unit, recording.lcf_range)
        keys = [
            ("last 2 s", _TRAIL_RGB, "line"),
            ("goal", _TRAIL_RGB, "dot"),
            ("in contact", _CONTACT_RGB, "ring"),
            ("who looks", np.array(INK) / 255, "ring"),
            ("its goal", GOAL_RGB, "ring"),
        ]
        self.write_keys(page, x0, top + 90 * unit, keys)


def film(
    recording: Recording,
    path: str | os.PathLike[str],
    speed: float = 1.0,
    follow: int | None = None,
    scale: float = 0.75,
    progress: Callable[[int, int], object] | None = None,
) -> pathlib.Path:
    """Writes `recording` as the VP8 video `path` (.webm) of 25 frames/s, played `speed` times as fast; returns the
    path.

    progress(done, total) is called after each frame.
    Raises Unavailable without OpenGL, OSError where `path` can't be written. All or nothing: no half file is left.
    """
    times = np.linspace(0.0, recording.duration, max(2, round(recording.duration * FPS / speed) + 1))

    def pictures():
        with Film(recording, follow, scale) as camera:
            for time in times:
                yield camera.frame(time, speed)

    return video.write_webm(path, pictures(), len(times), FPS, progress)


def still(
    recording: Recording,
    path: str | os.PathLike[str],
    time: float | None = None,
    follow: int | None = None,
    scale: float = 1.0,
) -> pathlib.Path:
    """Saves `recording` at `time` [s] (default: the middle) as the PNG `path`; returns the path."""
    time = recording.duration / 2 if time is None else time
    with Film(recording, follow, scale, samples=4) as camera:
        return video.write_png(path, camera.frame(time))
