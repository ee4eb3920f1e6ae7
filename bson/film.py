"""Films of episodes, drawn offscreen: a chase view, the map, and what the robot's camera sees, side by side.

A pedestrian is drawn as a figure inside its true cylinder (radius 0.35 m, height 1.7 m), coloured by its LCF. Pictures
are RGB, (height, width, 3) uint8. Drawing needs OpenGL: `gl_problem()` says what is missing.
"""

import atexit
import contextlib
import copy
import math
import os
import pathlib
import platform
import tempfile
import weakref

import mujoco
import numpy as np

from macid import geometry, scene
from macid.files import write_bytes
from macid.state import GOAL_RADIUS, HEIGHT, RADIUS

LCF_RANGE = (-2.0, 2.0)  # of the colour scale
LCF_STOPS = np.array(  # RGB at equal steps of the LCF: ColorBrewer's RdYlBu, safe for the colour-blind
    [[0.78, 0.07, 0.09], [0.98, 0.62, 0.34], [0.98, 0.95, 0.68], [0.52, 0.76, 0.90], [0.10, 0.38, 0.72]]
)

_GOAL_RGB = (0.05, 0.62, 0.32)
_PATH_RGB = (0.95, 0.45, 0.0)
_INK, _MUTED, _PAPER = (38, 43, 51), (112, 119, 130), (255, 255, 255)
_TRAIL = 4.0  # of people [s]
_NEAR, _FAR = 0.05, 300.0  # of what is drawn [m]

_PARTS = 4  # of a person's figure
_CHASE_DISTANCE = 5.0  # of the chase camera from the robot [m]
_CHASE_ELEVATION = (math.radians(27), math.radians(74))  # the least, and the most where walls are near

# The page, at scale 1: x, y, width, height [pixels].
_SIZE = (1520, 496)
_CHASE, _MAP, _FRONT = (10, 46, 640, 440), (660, 46, 440, 440), (1110, 46, 400, 224)
_PANEL = (1110, 280, 400, 206)


_open_films = weakref.WeakSet()  # to be closed before the graphics library goes


class Unavailable(RuntimeError):
    """This machine can't draw; the message says why and how to mend it."""


def gl_problem():
    """Why nothing can be drawn here and how to mend it, in one line; None where all is well."""
    try:
        context = _gl_context(16, 16)
    except Unavailable as error:
        return str(error)
    try:
        mujoco.MjrContext(mujoco.MjSpec().compile(), mujoco.mjtFontScale.mjFONTSCALE_100).free()
    except mujoco.FatalError as error:
        return f"OpenGL can't draw here ({error}). Unset MUJOCO_GL, or set MUJOCO_GL=egl."
    finally:
        context.free()
    return None


def _gl_context(width, height):
    """An OpenGL context: EGL on Linux (no display needed) unless MUJOCO_GL says otherwise. Raises Unavailable.

    MuJoCo itself picks GLFW, which needs a display, when MUJOCO_GL is unset, and does so as soon as it is imported.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if chosen in ("disable", "disabled", "off", "false", "0"):
        raise Unavailable(f"Drawing is turned off by MUJOCO_GL={chosen}: unset it, or set MUJOCO_GL=egl.")
    try:
        if platform.system() == "Linux" and chosen in ("", "egl"):
            from mujoco.egl import GLContext
        else:
            from mujoco.rendering.classic.gl_context import GLContext
        context = GLContext(width, height)
        context.make_current()
    except Exception as error:  # each backend fails in its own way: ImportError, AttributeError, GLError, RuntimeError
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise Unavailable(
            f"OpenGL can't draw here ({reason}). Install EGL (on Debian and Ubuntu: apt-get install libegl1 "
            "libgl1-mesa-dri) and set MUJOCO_GL=egl."
        ) from None
    return context


def _close_all():
    for open_film in list(_open_films):
        open_film.close()


def lcf_colour(lcf):
    """RGB (..., 3) in [0, 1] of `lcf` (...): red if adversarial (-2), pale yellow at 0, blue if cooperative (2)."""
    stops = np.linspace(*LCF_RANGE, len(LCF_STOPS))
    return np.stack([np.interp(lcf, stops, channel) for channel in LCF_STOPS.T], axis=-1)


class Film:
    """Draws recorded episodes of one model. Close it, or use it in a `with`; raises Unavailable without OpenGL.

    model: "as it looks" (World.scene); it is copied. scale: of the picture, 1 is 1520 x 496. title: of whom is filmed.
    samples: of anti-aliasing, 0 or 4; on a CPU, 4 takes twice the time.
    """

    def __init__(self, model, scale=1.0, title="", samples=0):
        self.title, self.scale = title, scale
        self.size = tuple(2 * round(side * scale / 2) for side in _SIZE)  #: width, height [pixels]
        self._gl = self._context = None
        model = self._model = copy.copy(model)
        views = [self._rect(view)[2:] for view in (_CHASE, _MAP, _FRONT)]
        model.vis.global_.offwidth, model.vis.global_.offheight = np.max(views, axis=0)
        quality = model.vis.quality
        quality.offsamples, quality.numquads = samples, 1
        quality.shadowsize, quality.numslices, quality.numstacks = (4096, 32, 16) if samples else (2048, 18, 8)
        people = range(sum(model.body(index).name.startswith("person") for index in range(model.nbody)))
        for index in people:
            model.geom(f"person{index}/cylinder").rgba[3] = 0.0  # a figure stands for it
        for index in range(model.nmocap):  # coplanar tops would be lit twice where walls meet
            model.geom(f"box{index}").size[2] -= 0.002 * (index % 7)
        self._boxes = [model.body(f"box{index}").id for index in range(model.nmocap)]
        self._joint = model.joint("robot").qposadr[0]
        self._floor = model.geom("floor").id  # 0: the first in the scene, too
        self._camera = model.camera("robot/front").id
        self._data = mujoco.MjData(model)
        self._gl = _gl_context(model.vis.global_.offwidth, model.vis.global_.offheight)
        if not _open_films:  # after EGL's own clean-up was registered, so that this one comes first
            atexit.unregister(_close_all)
            atexit.register(_close_all)
        _open_films.add(self)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, model.ngeom + 4000)
        self._option = mujoco.MjvOption()
        self._option.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER] = False
        self._free = mujoco.MjvCamera()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def __del__(self):
        self.close()

    def close(self):
        """Frees the graphics resources."""
        gl, context = getattr(self, "_gl", None), getattr(self, "_context", None)
        self._gl = self._context = None
        if gl is not None:
            if context is not None:
                gl.make_current()
                context.free()
            gl.free()

    def frame(self, episode, step=-1, speed=None):
        """The composed picture of `episode` at control step `step`.

        speed: of the playback, for the header.
        """
        if self._gl is None:
            raise ValueError("This Film is closed.")
        step = range(len(episode.pose))[step]
        self._gl.make_current()
        self._pose(episode, step)
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, self._free, mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )
        self._scene.geoms[self._floor].category = mujoco.mjtCatBit.mjCAT_DECOR
        first = self._scene.ngeom
        self._draw_people(episode, step)
        self._draw_goal(episode.goal)
        page = np.full((self.size[1], self.size[0], 3), _PAPER, np.uint8)
        self._aim_front()
        self._render(page, _FRONT)
        self._draw_trails(episode, step)
        centre, span = map_window(episode)
        self._look([*centre, 60.0], [0, 0, -1], [0, 1, 0], span / 2, orthographic=True)
        self._render(page, _MAP, centre, 0.75 * span)
        eye = self._aim_chase(episode, step)
        for person in np.flatnonzero(_hides(episode, step, eye)):
            for part in range(_PARTS):
                self._scene.geoms[first + _PARTS * person + part].rgba[3] = 0.25
        self._render(page, _CHASE, episode.pose[step, :2], 20.0)
        self._mark_map(page, episode, step)
        for view, label in ((_CHASE, "Chase view"), (_MAP, "Map, north up"), (_FRONT, "Robot's camera")):
            self._label_view(page, view, label)
        self._header(page, episode, speed)
        self._panel(page, episode, step)
        return page

    def map_pixel(self, episode, place):
        """Where the map shows `place` (..., 2) [m]: (..., 2) pixels x, y of the picture, continuous."""
        left, top, width, height = self._rect(_MAP)
        centre, span = map_window(episode)
        offset = (np.asarray(place) - centre) / span
        return np.stack([left + width * (0.5 + offset[..., 0]), top + height * (0.5 - offset[..., 1])], axis=-1)

    def _rect(self, rect):
        return tuple(round(value * self.scale) for value in rect)

    def _pose(self, episode, step):
        """Puts the model's bodies where the episode has them."""
        data = self._data
        data.qpos[:] = episode.qpos[step]
        if self._boxes:
            data.mocap_pos[:, :2] = episode.boxes[:, :2]
            data.mocap_pos[:, 2] = self._model.body_pos[self._boxes, 2]
            data.mocap_quat[:] = geometry.yaw_quaternion(episode.boxes[:, 4])
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_camlight(self._model, data)

    def _add(self, kind, size, place, rgba, yaw=0.0, glow=0.0, shadow=True):
        """Adds a shape to the picture: `size` as MuJoCo's geoms have it [m], turned by `yaw` about the vertical."""
        if self._scene.ngeom >= self._scene.maxgeom:
            return
        c, s = math.cos(yaw), math.sin(yaw)
        geom = self._scene.geoms[self._scene.ngeom]
        mujoco.mjv_initGeom(
            geom,
            kind,
            np.array(size, float),
            np.array(place, float),
            np.array([c, -s, 0, s, c, 0, 0, 0, 1.0]),
            np.array(rgba, np.float32),
        )
        geom.category = mujoco.mjtCatBit.mjCAT_DYNAMIC if shadow else mujoco.mjtCatBit.mjCAT_DECOR
        geom.emission, geom.specular, geom.shininess = glow, 0.15, 0.2
        self._scene.ngeom += 1

    def _draw_people(self, episode, step):
        """Figures inside the people's cylinders: LCF-coloured body, head, and a visor where they face."""
        box, ball = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_ELLIPSOID
        tube = mujoco.mjtGeom.mjGEOM_CYLINDER
        waist, head = 1.16, 0.19
        for (x, y, yaw), rgb in zip(episode.people[step], lcf_colour(episode.lcf), strict=True):
            c, s = math.cos(yaw), math.sin(yaw)
            self._add(tube, [RADIUS, waist / 2, 0], [x, y, waist / 2], [*rgb, 1.0], glow=0.15)
            self._add(ball, [RADIUS, RADIUS, 0.15], [x, y, waist], [*rgb, 1.0], glow=0.15)
            self._add(ball, [head, head, 0.22], [x, y, HEIGHT - 0.22], [*(0.85 * rgb), 1.0], glow=0.15)
            self._add(box, [0.10, 0.13, 0.045], [x + 0.13 * c, y + 0.13 * s, HEIGHT - 0.2], [0.1, 0.1, 0.12, 1.0], yaw)

    def _draw_goal(self, goal):
        """A disc as large as the goal is, a translucent column, and a flag above the reach of the robot's camera."""
        tube = mujoco.mjtGeom.mjGEOM_CYLINDER
        x, y = goal
        self._add(tube, [0.035, 0.9, 0], [x, y, 2.1], [*_GOAL_RGB, 1.0], glow=0.4)
        self._add(mujoco.mjtGeom.mjGEOM_BOX, [0.34, 0.012, 0.22], [x + 0.34, y, 2.78], [*_GOAL_RGB, 1.0], glow=0.4)
        self._add(tube, [GOAL_RADIUS, 0.008, 0], [x, y, 0.012], [*_GOAL_RGB, 0.75], glow=0.4, shadow=False)
        self._add(tube, [GOAL_RADIUS, 1.25, 0], [x, y, 1.25], [*_GOAL_RGB, 0.22], glow=0.5, shadow=False)

    def _draw_trails(self, episode, step):
        """The robot's way so far and the people's last seconds, as ribbons on the ground."""
        width = max(0.05, 0.0022 * map_window(episode)[1])
        stride = max(1, round(0.4 / episode.period))
        first = max(0, step - round(_TRAIL / episode.period))
        indices = np.unique(np.append(np.arange(step, first, -stride), first))
        for age, (i, j) in enumerate(zip(indices[:-1], indices[1:], strict=True)):
            alpha = 0.75 * (age + 1) / len(indices)
            for a, b, rgb in zip(episode.people[i], episode.people[j], lcf_colour(episode.lcf), strict=True):
                self._ribbon(a[:2], b[:2], 0.8 * width, 0.004, [*(0.75 * rgb), alpha])
        corner = way = episode.pose[0, :2]
        for place in episode.pose[1 : step + 1, :2]:
            if math.hypot(*(place - corner)) >= 0.3:
                self._ribbon(corner, place, width, 0.008, [*_PATH_RGB, 1.0])
                corner = place
            way = place
        self._ribbon(corner, way, width, 0.008, [*_PATH_RGB, 1.0])

    def _ribbon(self, start, end, half_width, height, rgba):
        dx, dy = end - start
        length = math.hypot(dx, dy)
        if length > 1e-6:
            size = [length / 2, half_width, 0.001]  # without overlaps: OpenGL would light them twice
            place = [*((start + end) / 2), height]
            self._add(mujoco.mjtGeom.mjGEOM_PLANE, size, place, rgba, math.atan2(dy, dx), shadow=False)

    def _look(self, place, forward, up, half_height, near=_NEAR, far=_FAR, orthographic=False):
        """Aims the camera. half_height: of the picture [m], at the distance `near` unless orthographic."""
        for camera in self._scene.camera:
            camera.pos, camera.forward, camera.up = place, forward, up
            camera.frustum_center, camera.frustum_width = 0.0, 0.0
            camera.frustum_bottom, camera.frustum_top = -half_height, half_height
            camera.frustum_near, camera.frustum_far = near, far
            camera.orthographic = orthographic
        for light in list(self._scene.lights)[: self._scene.nlight]:
            if light.headlight:
                light.pos, light.dir = place, forward

    def _aim_front(self):
        axes = self._data.cam_xmat[self._camera].reshape(3, 3)
        fovy = math.radians(self._model.cam_fovy[self._camera])
        self._look(self._data.cam_xpos[self._camera], -axes[:, 2], axes[:, 1], _NEAR * math.tan(fovy / 2))

    def _aim_chase(self, episode, step):
        """Behind and above the robot, higher where a wall would hide it; returns where that is, (3,) [m]."""
        heading, elevation = _chase(episode, step)
        ahead = np.array([math.cos(heading), math.sin(heading), 0.0])
        robot = np.array([*episode.pose[step, :2], 0.25])
        eye = robot + _CHASE_DISTANCE * (np.array([0, 0, math.sin(elevation)]) - math.cos(elevation) * ahead)
        forward = robot + 2.4 * ahead * math.cos(elevation) ** 2 - eye
        forward /= np.linalg.norm(forward)
        right = np.array([ahead[1], -ahead[0], 0.0])
        self._look(eye, forward, np.cross(right, forward), _NEAR * math.tan(math.radians(44) / 2))
        return eye

    def _render(self, page, view, centre=None, reach=None):
        """Draws into the page's rectangle `view`, with shadows up to `reach` [m] around `centre` where given."""
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = centre is not None
        if centre is not None:
            self._context.shadowClip = reach
            for light in list(self._scene.lights)[: self._scene.nlight]:
                if light.castshadow:
                    light.pos = np.array([*centre, 0.0]) - 12.0 * np.array(light.dir)
        left, top, width, height = self._rect(view)
        rect = mujoco.MjrRect(0, 0, width, height)
        pixels = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_render(rect, self._scene, self._context)
        mujoco.mjr_readPixels(pixels, None, rect, self._context)
        page[top : top + height, left : left + width] = pixels[::-1]

    def _mark_map(self, page, episode, step):
        """Start, goal, robot, a scale and the north, on the map."""
        import cv2

        left, top, width, height = self._rect(_MAP)
        canvas = np.ascontiguousarray(page[top : top + height, left : left + width])
        at = lambda place: self.map_pixel(episode, place) - (left, top)
        unit = self.scale
        start, goal = at(episode.pose[0, :2]), at(episode.goal)
        metre = width / map_window(episode)[1]
        _disc(canvas, start, 4.5 * unit, _PAPER)
        _ring(canvas, start, 4.5 * unit, _INK, 1.6 * unit)
        _ring(canvas, goal, max(GOAL_RADIUS * metre, 5 * unit), tuple(round(255 * c) for c in _GOAL_RGB), 2.2 * unit)
        for spot in at(episode.people[step, :, :2]):
            _ring(canvas, spot, RADIUS * metre, _INK, unit)
        x, y, yaw = episode.pose[step]
        c, s = math.cos(yaw), -math.sin(yaw)
        shape = np.array([[1.0, 0.0], [-0.75, 0.68], [-0.4, 0.0], [-0.75, -0.68]]) * 11 * unit
        arrow = at([x, y]) + shape @ np.array([[c, s], [-s, c]])
        points = np.round(arrow * 16).astype(np.int32)
        cv2.polylines(canvas, [points], True, _INK, _thick(3.4 * unit), cv2.LINE_AA, 4)
        cv2.fillPoly(canvas, [points], (255, 200, 20), cv2.LINE_AA, 4)
        for place, text in ((start, "start"), (goal, "goal")):
            size, _ = _measure(text, 0.44 * unit)
            spot = place + (9 * unit, -9 * unit)
            if spot[0] + size > width - 6 * unit:
                spot[0] = place[0] - 9 * unit - size
            spot[1] = max(spot[1], 40 * unit)
            _text(canvas, text, spot, 0.44 * unit, _INK, halo=True)
        length = 5 * metre
        x0, y0 = 14 * unit, height - 14 * unit
        line = np.round(np.array([[x0, y0 - 5 * unit], [x0, y0], [x0 + length, y0], [x0 + length, y0 - 5 * unit]]) * 16)
        for colour, thickness in ((_PAPER, 4.0), (_INK, 1.6)):
            cv2.polylines(canvas, [line.astype(np.int32)], False, colour, _thick(thickness * unit), cv2.LINE_AA, 4)
        _text(canvas, "5 m", (x0 + 5 * unit, y0 - 6 * unit), 0.42 * unit, _INK, halo=True)
        page[top : top + height, left : left + width] = canvas

    def _label_view(self, page, view, text):
        left, top, _, _ = self._rect(view)
        unit = self.scale
        width, height = _measure(text, 0.44 * unit)
        right, bottom = round(left + width + 16 * unit), round(top + height + 14 * unit)
        page[top:bottom, left:right] = (0.35 * page[top:bottom, left:right] + 0.65 * np.array(_INK)).astype(np.uint8)
        _text(page, text, (left + 8 * unit, top + height + 6.5 * unit), 0.44 * unit, _PAPER)

    def _header(self, page, episode, speed):
        unit = self.scale
        base = 30 * unit
        notes = [f"seed {episode.seed}"]
        if speed is not None:
            notes.append("real time" if abs(speed - 1) < 0.01 else f"played {speed:.3g} times as fast")
        notes = "   |   ".join(notes)
        width, _ = _measure(notes, 0.5 * unit)
        right = self.size[0] - 12 * unit
        _text(page, notes, (right - width, base), 0.5 * unit, _MUTED)
        title = self.title or "BSON"
        room = right - width - 40 * unit
        while len(title) > 1 and _measure(title, 0.66 * unit, bold=True)[0] > room:
            title = title.rstrip(".")[:-1] + "..." if len(title) > 4 else title[:-1]
        _text(page, title, (12 * unit, base), 0.66 * unit, _INK, bold=True)

    def _panel(self, page, episode, step):
        """The readings and the legend."""
        import cv2

        unit = self.scale
        left, top, width, height = self._rect(_PANEL)
        page[top : top + height, left : left + width] = (244, 245, 247)
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
            x, y = left + 14 * unit + column * (index % 3), top + 22 * unit + 50 * unit * (index // 3)
            _text(page, name, (x, y), 0.4 * unit, _MUTED)
            _text(page, value, (x, y + 21 * unit), 0.56 * unit, _INK)
        x0, x1 = round(left + 14 * unit), round(left + width - 14 * unit)
        y0, y1 = round(top + 132 * unit), round(top + 146 * unit)
        _text(page, "Pedestrians by LCF", (x0, y0 - 8 * unit), 0.4 * unit, _MUTED)
        bar = lcf_colour(np.linspace(*LCF_RANGE, x1 - x0))
        page[y0:y1, x0:x1] = np.round(255 * bar)
        for value, text in ((-2, "-2 adversarial"), (-1, "-1"), (0, "0"), (1, "1"), (2, "cooperative 2")):
            x = x0 + (value + 2) / 4 * (x1 - x0 - 1)
            page[y1 : round(y1 + 4 * unit), round(x) : round(x + max(1, unit))] = _INK
            shift = {-2: 0.0, 2: 1.0}.get(value, 0.5) * _measure(text, 0.4 * unit)[0]
            _text(page, text, (x - shift, y1 + 18 * unit), 0.4 * unit, _INK)
        y = top + 190 * unit
        keys = (("robot's way", _PATH_RGB), ("people's last 4 s", (0.55, 0.55, 0.55)))
        x = x0
        for text, rgb in keys:
            line = np.round(np.array([[x, y - 4 * unit], [x + 20 * unit, y - 4 * unit]]) * 16).astype(np.int32)
            colour = tuple(round(255 * c) for c in rgb)
            cv2.line(page, line[0].tolist(), line[1].tolist(), colour, _thick(3 * unit), cv2.LINE_AA, 4)
            x += 27 * unit
            _text(page, text, (x, y), 0.4 * unit, _INK)
            x += _measure(text, 0.4 * unit)[0] + 18 * unit
        _ring(page, (x + 5 * unit, y - 4 * unit), 5 * unit, tuple(round(255 * c) for c in _GOAL_RGB), 2 * unit)
        _text(page, "goal", (x + 17 * unit, y), 0.4 * unit, _INK)


def _smoothing(episode, step, seconds):
    """Steps around `step`, those of the episode's, and their Gaussian weights of standard deviation `seconds`."""
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
    """Whether each person (K,) stands between the chase camera at `eye` (3,) [m] and the robot, or in its face."""
    robot, people = episode.pose[step, :2], episode.people[step, :, :2]
    way = eye[:2] - robot
    length = max(math.hypot(*way), 1e-6)
    along = np.clip((people - robot) @ way / length, 0.0, length)
    beside = geometry.norm(people - robot - along[:, None] * way / length)
    return (beside < 3 * RADIUS) & (along > 0.3) & (0.25 + along * (eye[2] - 0.25) / length < HEIGHT + 0.6)


def map_window(episode):
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


def _thick(width):
    return max(1, round(width))


def _font(bold):
    import cv2

    return cv2.FONT_HERSHEY_DUPLEX if bold else cv2.FONT_HERSHEY_SIMPLEX


def _measure(text, size, bold=False):
    """Width and height [pixels] of `text`."""
    import cv2

    return cv2.getTextSize(text, _font(bold), size, _thick(size))[0]


def _text(image, text, place, size, colour, bold=False, halo=False):
    """Writes `text` with its baseline's left end at `place`."""
    import cv2

    where = [round(float(value)) for value in place]
    if halo:
        for offset in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            shifted = [where[0] + offset[0], where[1] + offset[1]]
            cv2.putText(image, text, shifted, _font(bold), size, _PAPER, _thick(size), cv2.LINE_AA)
    cv2.putText(image, text, where, _font(bold), size, colour, _thick(size), cv2.LINE_AA)


def _disc(image, place, radius, colour):
    import cv2

    cv2.circle(image, [round(16 * float(v)) for v in place], round(16 * radius), colour, -1, cv2.LINE_AA, 4)


def _ring(image, place, radius, colour, width):
    import cv2

    cv2.circle(image, [round(16 * float(v)) for v in place], round(16 * radius), colour, _thick(width), cv2.LINE_AA, 4)


def film(model, episode, path, fps=10, max_frames=300, title="", scale=0.75, progress=None):
    """Writes `episode` as the VP8 video `path` (.webm), which browsers play; returns the path.

    A longer episode than `max_frames` steps is thinned out evenly and plays faster; the header says how fast.
    progress(done, total) is called after each frame.
    Raises Unavailable without OpenGL, OSError where `path` can't be written. All or nothing: no half file is left.
    """
    import cv2

    path = pathlib.Path(path)
    if path.suffix.lower() != ".webm":
        raise ValueError(f"A film is a .webm file, not '{path.name}'.")
    if max_frames < 2:
        raise ValueError(f"max_frames must be at least 2, not {max_frames}.")
    last = len(episode.pose) - 1
    stride = max(1, math.ceil(last / (max_frames - 1)))
    steps = [*range(0, last, stride), last]
    temporary = _temporary(path)
    try:
        with Film(model, scale, title) as camera:
            with _silent_stderr():  # of FFmpeg's remark that WebM has no such tag: it needs none
                writer = cv2.VideoWriter(temporary, cv2.VideoWriter_fourcc(*"VP80"), float(fps), camera.size)
            if not writer.isOpened():
                raise OSError(f"OpenCV can't write VP8 video to '{path}'.")
            try:
                for done, step in enumerate(steps, start=1):
                    picture = camera.frame(episode, step, stride * episode.period * fps)
                    writer.write(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
                    if progress is not None:
                        progress(done, len(steps))
            finally:
                writer.release()
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)
        raise
    return path


def still(model, episode, path, step=None, scale=1.0, title=""):
    """Saves `episode` at control step `step` (default: the middle) as the PNG `path`; returns the path."""
    import cv2

    step = len(episode.pose) // 2 if step is None else step
    with Film(model, scale, title, samples=4) as camera:
        picture = camera.frame(episode, step)
    write_bytes(path, cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes())
    return pathlib.Path(path)


@contextlib.contextmanager
def _silent_stderr():
    """Drops what C code prints on stderr."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _temporary(path):
    """An empty file beside `path`, to be renamed. Raises OSError where `path` can't be written."""
    if path.is_dir():
        raise IsADirectoryError(f"Can't write the film '{path}': it is a folder.")
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=".webm")
    except OSError as error:
        raise type(error)(error.errno, f"Can't write the film '{path}': {error.strerror}") from None
    os.close(handle)
    return name
