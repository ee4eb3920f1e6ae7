"""Films of episodes, drawn offscreen: a chase view, the map, and the picture of the robot's camera, side by side.

Pictures are RGB, (height, width, 3) uint8. Drawing needs OpenGL: `macid.drawing.gl.gl_problem()` says whether something
for it is missing.
"""

import itertools
import math
import pathlib
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from bson.episodes.record import Episode
from macid import geometry, scene
from macid.drawing import strokes, video
from macid.drawing.colours import GOAL_RGB, INK, PANEL, PAPER, lcf_colour, rgb255
from macid.drawing.figures import FIGURE_PARTS
from macid.drawing.stage import NEAR, Stage
from macid.state import GOAL_RADIUS, HEIGHT

PATH_RGB = (0.95, 0.45, 0.0)
_TRAIL = 4.0  # length of people's trails [s]
_CHASE_DISTANCE = 5.0  # distance of the chase camera from the robot [m]
_CHASE_ELEVATION = (math.radians(27), math.radians(74))  # the least, and the greatest, used where walls are near

# The page, at scale 1: x, y, width, height [pixels].
_SIZE = (1520, 496)
_CHASE, _MAP, _FRONT = (10, 46, 640, 440), (660, 46, 440, 440), (1110, 46, 400, 224)
_READINGS = (1110, 280, 400, 206)


class RobotStage(Stage):
    """A Stage with a robot, whose camera it can look through."""

    def __init__(self, model: mujoco.MjModel, *more: Any, **options: Any):
        super().__init__(model, *more, **options)
        self._camera = model.camera("robot/front").id

    def put(self, qpos: np.ndarray, boxes: np.ndarray) -> None:
        """Puts the model's bodies where `qpos` (nq,) and `boxes` (B, 5) have them."""
        self.data.qpos[:] = qpos
        if self.boxes:
            self.data.mocap_pos[:, :2] = boxes[:, :2]
            self.data.mocap_pos[:, 2] = self.model.body_pos[self.boxes, 2]
            self.data.mocap_quat[:] = geometry.yaw_quaternion(boxes[:, 4])
        self.pose()

    def aim_front(self) -> None:
        """Looks through the robot's camera."""
        axes = self.data.cam_xmat[self._camera].reshape(3, 3)
        fovy = math.radians(self.model.cam_fovy[self._camera])
        self.look(
            self.data.cam_xpos[self._camera],
            -axes[:, 2],
            axes[:, 1],
            scene.CAMERA_NEAR * math.tan(fovy / 2),
            scene.CAMERA_NEAR,
        )


class Eye(RobotStage):
    """The picture of the robot's camera, as films have it. Close it, or use it in a `with`. Raises Unavailable without
    OpenGL.

    model: "as it looks" (World.scene); it is copied.
    """

    size_seen = 320, 180  #: width, height [pixels]

    def __init__(self, model: mujoco.MjModel):
        super().__init__(model, self.size_seen, [(0, 0, *self.size_seen)])

    def picture(
        self,
        qpos: np.ndarray,
        boxes: np.ndarray,
        people: np.ndarray,
        colours: np.ndarray,
        goal: np.ndarray,
        radius: float,
    ) -> np.ndarray:
        """RGB (height, width, 3) uint8 of the world at `qpos` (nq,) and `boxes` (B, 5), with `people` (K, 3), x, y [m]
        and yaw [rad], of `radius` [m], in `colours` (K, 3), and the `goal` (2,) [m]."""
        self.put(qpos, boxes)
        self.add_people(people, colours, radius)
        self.add_goal(goal)
        page = self.page()
        self.aim_front()
        self.render(page, (0, 0, *self.size_seen))
        return page


class Film(RobotStage):
    """Draws recorded episodes of one model. Close the Film, or use it in a `with`. Raises Unavailable without OpenGL.

    model: "as it looks" (World.scene); it is copied. scale: the picture's; 1 is 1520 x 496 pixels. title: the name of
    the filmed agent. samples: of anti-aliasing, 0 or 4; on a CPU, 4 takes twice the time.
    """

    def __init__(self, model: mujoco.MjModel, scale: float = 1.0, title: str = "", samples: int = 0):
        super().__init__(model, _SIZE, (_CHASE, _MAP, _FRONT), scale, samples)
        self.title = title

    def frame(self, episode: Episode, step: int = -1, speed: float | None = None) -> np.ndarray:
        """The composed picture of `episode` at control step `step`.

        speed: the playback's speed, for the header.
        """
        step = range(len(episode.pose))[step]
        self.put(episode.qpos[step], episode.boxes)
        first = self.scene.ngeom
        self.add_people(episode.people[step], lcf_colour(episode.lcf), episode.person_radius)
        self.add_goal(episode.goal)
        page = self.page()
        self.aim_front()
        self.render(page, _FRONT)
        self._draw_trails(episode, step)
        centre, span = map_window(episode)
        self.look_down(centre, span)
        self.render(page, _MAP, centre, 0.75 * span)
        eye = self._aim_chase(episode, step)
        for person in np.flatnonzero(_hides(episode, step, eye)):
            for part in range(FIGURE_PARTS):
                self.scene.geoms[first + FIGURE_PARTS * person + part].rgba[3] = 0.25
        self.render(page, _CHASE, episode.pose[step, :2], 20.0)
        self._mark_map(page, episode, step)
        for view, label in ((_CHASE, "Chase view"), (_MAP, "Map, north up"), (_FRONT, "Robot's camera")):
            self.write_label(page, view, label)
        notes = [f"seed {episode.seed}"]
        if speed is not None:
            notes.append(video.pace(speed))
        self.write_header(page, self.title or "BSON", notes)
        self._panel(page, episode, step)
        return page

    def map_pixel(self, episode: Episode, place: Any) -> np.ndarray:
        """The pixels (..., 2), x and y of the picture, not rounded, at which the map shows `place` (..., 2) [m]."""
        return self.on_map(_MAP, *map_window(episode), place)

    def _draw_trails(self, episode, step):
        """The robot's way so far and the people's last seconds, as ribbons on the ground."""
        width = max(0.05, 0.0022 * map_window(episode)[1])
        stride = max(1, round(0.4 / episode.period))
        first = max(0, step - round(_TRAIL / episode.period))
        indices = np.unique(np.append(np.arange(step, first, -stride), first))
        for age, (i, j) in enumerate(itertools.pairwise(indices)):
            alpha = 0.75 * (age + 1) / len(indices)
            for a, b, rgb in zip(episode.people[i], episode.people[j], lcf_colour(episode.lcf), strict=True):
                self._ribbon(a[:2], b[:2], 0.8 * width, 0.004, [*(0.75 * rgb), alpha])
        corner = way = episode.pose[0, :2]
        for place in episode.pose[1 : step + 1, :2]:
            if math.hypot(*(place - corner)) >= 0.3:
                self._ribbon(corner, place, width, 0.008, [*PATH_RGB, 1.0])
                corner = place
            way = place
        self._ribbon(corner, way, width, 0.008, [*PATH_RGB, 1.0])

    def _ribbon(self, start, end, half_width, height, rgba):
        dx, dy = end - start
        length = math.hypot(dx, dy)
        if length > 1e-6:
            size = [length / 2, half_width, 0.001]  # no overlaps: OpenGL would light them twice
            place = [*((start + end) / 2), height]
            self.add(mujoco.mjtGeom.mjGEOM_PLANE, size, place, rgba, math.atan2(dy, dx), shadow=False)

    def _aim_chase(self, episode, step):
        """Puts the camera behind and above the robot, higher where a wall would hide it; returns its place (3,) [m]."""
        heading, elevation = _chase(episode, step)
        ahead = np.array([math.cos(heading), math.sin(heading), 0.0])
        robot = np.array([*episode.pose[step, :2], 0.25])
        eye = robot + _CHASE_DISTANCE * (np.array([0, 0, math.sin(elevation)]) - math.cos(elevation) * ahead)
        forward = robot + 2.4 * ahead * math.cos(elevation) ** 2 - eye
        forward /= np.linalg.norm(forward)
        right = np.array([ahead[1], -ahead[0], 0.0])
        self.look(eye, forward, np.cross(right, forward), NEAR * math.tan(math.radians(44) / 2))
        return eye

    def _mark_map(self, page, episode, step):
        """Draws start, goal, robot, a scale and the north on the map."""
        left, top, width, height = self.rect(_MAP)
        canvas = np.ascontiguousarray(page[top : top + height, left : left + width])

        def at(place):
            return self.map_pixel(episode, place) - (left, top)

        unit = self.scale
        start, goal = at(episode.pose[0, :2]), at(episode.goal)
        metre = width / map_window(episode)[1]
        strokes.disc(canvas, start, 4.5 * unit, PAPER)
        strokes.ring(canvas, start, 4.5 * unit, INK, 1.6 * unit)
        strokes.ring(canvas, goal, max(GOAL_RADIUS * metre, 5 * unit), rgb255(GOAL_RGB), 2.2 * unit)
        for spot in at(episode.people[step, :, :2]):
            strokes.ring(canvas, spot, episode.person_radius * metre, INK, unit)
        x, y, yaw = episode.pose[step]
        c, s = math.cos(yaw), -math.sin(yaw)
        shape = np.array([[1.0, 0.0], [-0.75, 0.68], [-0.4, 0.0], [-0.75, -0.68]]) * 11 * unit
        arrow = at([x, y]) + shape @ np.array([[c, s], [-s, c]])
        strokes.line(canvas, arrow, INK, 3.4 * unit, closed=True)
        strokes.polygon(canvas, arrow, (255, 200, 20))
        for place, text in ((start, "start"), (goal, "goal")):
            size, _ = strokes.measure(text, 0.44 * unit)
            spot = place + np.array([9 * unit, -9 * unit])
            if spot[0] + size > width - 6 * unit:
                spot[0] = place[0] - 9 * unit - size
            spot[1] = max(spot[1], 40 * unit)
            strokes.write(canvas, text, spot, 0.44 * unit, INK, halo=True)
        self.draw_metres(canvas, metre)
        page[top : top + height, left : left + width] = canvas

    def _panel(self, page, episode, step):
        """Draws the readings and the legend."""
        unit = self.scale
        left, top, width, height = self.rect(_READINGS)
        page[top : top + height, left : left + width] = PANEL
        distance = math.hypot(*(episode.goal - episode.pose[step, :2]))
        nearest = episode.nearest_person[step]
        readings = [
            ("Time", f"{step * episode.period:.1f} s"),
            ("Speed", f"{round(float(episode.velocity[step, 0]), 2) + 0.0:.2f} m/s"),
            ("To the goal", f"{distance:.1f} m"),
            ("Nearest person", f"{max(nearest, 0.0):.2f} m" if np.isfinite(nearest) else "-"),
            ("In collision", f"{episode.collisions_so_far[step]} steps"),
        ]
        column = width / 3
        for index, (name, value) in enumerate(readings):
            place = left + 14 * unit + column * (index % 3), top + 22 * unit + 50 * unit * (index // 3)
            self.write_reading(page, place, name, value)
        x0, x1 = round(left + 14 * unit), round(left + width - 14 * unit)
        self.draw_lcf_scale(page, x0, x1, top + 132 * unit)
        keys = [("robot's way", PATH_RGB, "line"), ("people's last 4 s", (0.55, 0.55, 0.55), "line")]
        self.write_keys(page, x0, top + 190 * unit, [*keys, ("goal", GOAL_RGB, "ring")])


def _smoothing(episode, step, seconds):
    """The episode's steps around `step`, and their Gaussian weights of standard deviation `seconds`."""
    reach = round(2 * seconds / episode.period)
    steps = np.arange(max(0, step - reach), min(len(episode.pose), step + reach + 1))
    weights = np.exp(-0.5 * ((steps - step) * episode.period / seconds) ** 2)
    return steps, weights / weights.sum()


def _heading(episode, step):
    """The robot's heading [rad], smoothed."""
    steps, weights = _smoothing(episode, step, 0.7)
    yaw = episode.pose[steps, 2]
    return math.atan2(weights @ np.sin(yaw), weights @ np.cos(yaw))


def _chase(episode, step):
    """Heading and elevation [rad] of the chase camera: low, but high enough to see the robot over any wall near it."""
    steps, weights = _smoothing(episode, step, 0.6)
    headings = np.array([_heading(episode, i) for i in steps])
    behind = -np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    distance = geometry.ray_box_distance(episode.pose[steps, :2], behind[:, None], episode.boxes)[:, 0]
    heights = np.where(np.arange(len(episode.boxes)) < 4, scene.OUTER_WALL_HEIGHT, scene.WALL_HEIGHT)
    low, high = _CHASE_ELEVATION
    slope = np.where(distance < _CHASE_DISTANCE, heights / np.maximum(distance - 0.25, 0.05), 0.0)
    slope = slope.max(axis=-1, initial=0.0)
    return _heading(episode, step), weights @ np.clip(np.arctan(slope), low, high)


def _hides(episode, step, eye):
    """Whether each person (K,) stands between the chase camera at `eye` (3,) [m] and the robot, or close before the
    camera."""
    robot, people = episode.pose[step, :2], episode.people[step, :, :2]
    way = eye[:2] - robot
    length = max(math.hypot(*way), 1e-6)
    along = np.clip((people - robot) @ way / length, 0.0, length)
    beside = geometry.norm(people - robot - along[:, None] * way / length)
    return (
        (beside < 3 * episode.person_radius) & (along > 0.3) & (0.25 + along * (eye[2] - 0.25) / length < HEIGHT + 0.6)
    )


def map_window(episode: Episode) -> tuple[np.ndarray, float]:
    """Centre (2,) [m] and side [m] of the square that the map shows: the robot's way and the goal, with a margin."""
    places = np.vstack([episode.pose[:, :2], episode.goal])
    low, high = places.min(axis=0), places.max(axis=0)
    centre = (low + high) / 2
    corners = geometry.box_corners(episode.boxes[:4]).reshape(-1, 2)
    edge_low, edge_high = corners.min(axis=0) - 0.4, corners.max(axis=0) + 0.4
    span = min(max((high - low).max() + 7.0, 18.0), (edge_high - edge_low).max())
    room = np.maximum(edge_high - edge_low - span, 0.0) / 2
    middle = (edge_low + edge_high) / 2
    return np.clip(centre, middle - room, middle + room), float(span)


def film(
    model: mujoco.MjModel,
    episode: Episode,
    path: str | pathlib.Path,
    fps: Any = 10,
    max_frames: int = 300,
    title: str = "",
    scale: float = 0.75,
    progress: Callable[..., object] | None = None,
) -> Any:
    """Writes `episode` as the VP8 video `path` (.webm), which browsers play; returns the path.

    A longer episode than `max_frames` steps is thinned out evenly and plays faster; the header says how fast.
    progress(done, total) is called after each frame. Raises Unavailable without OpenGL, OSError where `path` can't be
    written. A failure leaves no half-written file.
    """
    if max_frames < 2:
        raise ValueError(f"max_frames must be at least 2, not {max_frames}.")
    last = len(episode.pose) - 1
    stride = max(1, math.ceil(last / (max_frames - 1)))
    steps = [*range(0, last, stride), last]

    def pictures():
        with Film(model, scale, title) as camera:
            for step in steps:
                yield camera.frame(episode, step, stride * episode.period * fps)

    return video.write_webm(path, pictures(), len(steps), fps, progress)


def still(
    model: mujoco.MjModel,
    episode: Episode,
    path: str | pathlib.Path,
    step: int | None = None,
    scale: float = 1.0,
    title: str = "",
) -> Any:
    """Saves `episode` at control step `step` (default: the middle) as the PNG `path`; returns the path."""
    step = len(episode.pose) // 2 if step is None else step
    with Film(model, scale, title, samples=4) as camera:
        return video.write_png(path, camera.frame(episode, step))
