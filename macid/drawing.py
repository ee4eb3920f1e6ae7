"""Pictures and films, drawn offscreen with MuJoCo and OpenCV: what films of crowds and of robots have in common.

A pedestrian is drawn as a figure inside its true cylinder (radius 0.35 m if nothing else is said, height 1.7 m),
coloured by its LCF. Pictures are RGB, (height, width, 3) uint8. Drawing needs OpenGL: `gl_problem()` says what is
missing.
"""

import atexit
import contextlib
import copy
import functools
import math
import os
import pathlib
import platform
import sys
import weakref
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from macid.files import UsageError, named, new_file, write_bytes
from macid.state import GOAL_RADIUS, HEIGHT, RADIUS

LCF_RANGE = (-2.0, 2.0)  # the ends of the colour scale
LCF_STOPS = np.array(  # RGB at equal steps of the LCF: ColorBrewer's RdYlBu, safe for the colour-blind
    [[0.78, 0.07, 0.09], [0.98, 0.62, 0.34], [0.98, 0.95, 0.68], [0.52, 0.76, 0.90], [0.10, 0.38, 0.72]]
)

GOAL_RGB = (0.05, 0.62, 0.32)
INK, MUTED, PAPER, PANEL = (38, 43, 51), (112, 119, 130), (255, 255, 255), (244, 245, 247)
NEAR, FAR = 0.05, 300.0  # only what is between these distances is drawn [m]


class Part(NamedTuple):
    """A shape of what stands for a person or a goal."""

    kind: mujoco.mjtGeom
    size: tuple[float, float, float]  #: as MuJoCo's geoms have it [m]
    place: tuple[float, float, float]  #: of its middle: ahead of the axis, to the left, above the ground [m]
    shade: float = 1.0  #: the colour is this share of the whole's; 0: dark, as a visor
    alpha: float = 1.0
    glow: float = 0.0

    def colour(self, rgb: ArrayLike) -> np.ndarray:
        """The part's colour (..., 3), where the whole has the colour `rgb` (..., 3)."""
        return np.broadcast_to(_VISOR_RGB, np.shape(rgb)) if self.shade == 0 else self.shade * np.asarray(rgb)


_VISOR_RGB = (0.1, 0.1, 0.12)
_BOX, _BALL, _TUBE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_ELLIPSOID, mujoco.mjtGeom.mjGEOM_CYLINDER
_WAIST, _HEAD, _VISOR = 1.16, 0.19, 0.13  # height; radius of the head, and how far ahead of its middle eyes are [m]
FIGURE_PARTS = 4  # shapes in a person's figure


def figure(radius: float = RADIUS) -> tuple[Part, ...]:
    """A person inside its cylinder of `radius` [m]: body and head, and a visor where it faces."""
    slim = (1.0 + radius / RADIUS) / 2  # heads differ less than shoulders do
    head, visor = _HEAD * slim, _VISOR * slim
    return (
        Part(_TUBE, (radius, _WAIST / 2, 0), (0, 0, _WAIST / 2), glow=0.15),
        Part(_BALL, (radius, radius, 0.15), (0, 0, _WAIST), glow=0.15),
        Part(_BALL, (head, head, 0.22), (0, 0, HEIGHT - 0.22), shade=0.85, glow=0.15),
        Part(_BOX, (0.10 * slim, visor, 0.045), (visor, 0, HEIGHT - 0.2), shade=0.0),
    )


#: A goal: pole, flag, a disc as large as the goal is, and a translucent column.
GOAL = (
    Part(_TUBE, (0.035, 0.9, 0), (0, 0, 2.1), glow=0.4),
    Part(_BOX, (0.34, 0.012, 0.22), (0.34, 0, 2.78), glow=0.4),
    Part(_TUBE, (GOAL_RADIUS, 0.008, 0), (0, 0, 0.012), alpha=0.75, glow=0.4),
    Part(_TUBE, (GOAL_RADIUS, 1.25, 0), (0, 0, 1.25), alpha=0.22, glow=0.5),
)


_open_stages = weakref.WeakSet()  # to be closed before the graphics library goes
_gl_process = None  # the process in which OpenGL first drew
_gl_failure = None  # what kept MuJoCo from drawing in this process: a second try would abort it


class Unavailable(UsageError, RuntimeError):
    """This machine can't draw; the message says why and how to mend it."""


def gl_problem() -> str | None:
    """Why nothing can be drawn here and how to mend it, in one line; None where all is well."""
    try:
        context = gl_context(16, 16)
    except Unavailable as error:
        return str(error)
    try:
        with current(context):
            offscreen(mujoco.MjSpec().compile()).free()
    except Unavailable as error:
        return str(error)
    finally:
        context.free()
    return None


def gl_context(width: int, height: int) -> Any:
    """An OpenGL context: EGL on Linux (no display needed) unless MUJOCO_GL says otherwise. Raises Unavailable.

    MuJoCo itself picks GLFW, which needs a display, when MUJOCO_GL is unset, and does so as soon as it is imported.
    The context is not left current: see `current`.
    """
    global _gl_process
    if _gl_failure is not None:
        raise Unavailable(_gl_failure)
    if _gl_process not in (None, os.getpid()):  # it would wait for ever for threads that are not there
        raise Unavailable(
            "This process was forked after its parent had drawn, and OpenGL does not survive that. Use processes by "
            "spawn (context='spawn'), or gymnasium.make_vec(id, num_envs=N), which needs none."
        )
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if chosen in ("disable", "disabled", "off", "false", "0"):
        raise Unavailable(f"Drawing is turned off by MUJOCO_GL={chosen}: unset it, or set MUJOCO_GL=egl.")
    try:
        if platform.system() == "Linux" and chosen in ("", "egl"):
            from mujoco.egl import GLContext
        else:
            from mujoco.rendering.classic.gl_context import GLContext
        context = GLContext(width, height)
        if not getattr(context, "_context", True):  # GLFW gives no window and says so in a warning
            raise RuntimeError("no window, as without a display")
        with current(context):
            pass
    except Exception as error:  # each backend fails in its own way: ImportError, AttributeError, GLError, RuntimeError
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise Unavailable(
            f"OpenGL can't draw here ({reason}). Install EGL (on Debian and Ubuntu: apt-get install libegl1 "
            "libgl1-mesa-dri) and set MUJOCO_GL=egl."
        ) from None
    _gl_process = os.getpid()
    return context


@contextlib.contextmanager
def current(gl: Any) -> Iterator[None]:
    """Within, OpenGL goes to the context `gl`; afterwards, to what it went to before.

    A context that stayed current in one thread could not be used by any other.
    """
    backend = type(gl).__module__
    if backend.startswith("mujoco.egl"):
        from OpenGL import EGL

        before, display = EGL.eglGetCurrentContext(), EGL.eglGetCurrentDisplay()
        if not before:
            before, display = EGL.EGL_NO_CONTEXT, sys.modules[backend].EGL_DISPLAY

        def restore():
            EGL.eglMakeCurrent(display, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, before)
    elif backend.startswith("mujoco.glfw"):
        import glfw

        restore = functools.partial(glfw.make_context_current, glfw.get_current_context())
    else:  # OSMesa and CGL draw in memory of their own

        def restore():
            pass

    gl.make_current()
    try:
        yield
    finally:
        restore()


def offscreen(model: mujoco.MjModel) -> mujoco.MjrContext:
    """An MjrContext that draws `model` offscreen, in the OpenGL context that is current. Raises Unavailable."""
    global _gl_failure
    try:
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except mujoco.FatalError as error:
        _gl_failure = f"OpenGL can't draw here ({error}). Unset MUJOCO_GL, or set MUJOCO_GL=egl."
        raise Unavailable(_gl_failure) from None
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    return context


def close_at_exit(stage: "Offscreen") -> None:
    """Has `stage.close()` called before the graphics library goes, if it is still there; call after `gl_context`."""
    close_before_all_else()
    _open_stages.add(stage)


def close_before_all_else() -> None:
    """Has stages closed at exit before the clean-ups that were registered until now, such as an EGL library's own."""
    atexit.unregister(_close_all)
    atexit.register(_close_all)


def _close_all():
    for stage in list(_open_stages):
        stage.close()


def lcf_colour(lcf: float | np.ndarray) -> np.ndarray:
    """The colour of each `lcf` (...), RGB (..., 3) in [0, 1]: red if adversarial (-2), pale yellow at 0, blue at 2."""
    stops = np.linspace(*LCF_RANGE, len(LCF_STOPS))
    return np.stack([np.interp(lcf, stops, channel) for channel in LCF_STOPS.T], axis=-1)


def rgb255(rgb: Iterable[float]) -> tuple[int, ...]:
    """A colour of [0, 1] as OpenCV has it: integers to 255."""
    return tuple(round(255 * float(channel)) for channel in rgb)


def pace(speed: float) -> str:
    """The playback's speed in words."""
    return "real time" if abs(speed - 1) < 0.01 else f"played {speed:.3g} times as fast"


class Offscreen:
    """A model, the coordinates of its bodies, and what draws them offscreen. Close it, or let it go.

    model: as it is to look; it is kept, so give a copy. size: width and height of the largest picture [pixels].
    extra: how many shapes can be added to the scene. Raises Unavailable without OpenGL.
    """

    _gl = _context = None  # when `close` comes before they are made

    def __init__(self, model: mujoco.MjModel, size: Sequence[int] | np.ndarray, extra: int):
        model.vis.global_.offwidth, model.vis.global_.offheight = size
        self._gl = gl_context(*map(int, size))
        close_at_exit(self)
        with self.current():
            self._context = offscreen(model)
        self.model, self.data = model, mujoco.MjData(model)
        self.scene = mujoco.MjvScene(model, model.ngeom + extra)
        self._option = mujoco.MjvOption()
        self._option.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER] = False

    def __del__(self):
        self.close()

    def close(self) -> None:
        """Frees the graphics resources."""
        gl, context = self._gl, self._context
        self._gl = self._context = None
        if gl is not None:
            if context is not None:
                with current(gl):
                    context.free()
            gl.free()

    def current(self) -> AbstractContextManager[None]:
        """Directs OpenGL here within a `with`: see the function `current`. Raises ValueError once closed."""
        if self._gl is None:
            raise ValueError(f"This {type(self).__name__} is closed.")
        return current(self._gl)

    def place(self, camera: mujoco.MjvCamera) -> None:
        """Puts the bodies where `data` has their coordinates, and the model alone into the scene, seen by `camera`."""
        model, data = self.model, self.data
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        mujoco.mjv_updateScene(model, data, self._option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, self.scene)


class Stage(Offscreen):
    """A page with views of one model. Close it, or use it in a `with`; raises Unavailable without OpenGL.

    model: as it looks, its people invisible behind the figures that are added; it is copied. size: width and height of
    the page; views: rectangles x, y, width, height on it; both in pixels at scale 1. samples: 0 or 4, for
    anti-aliasing; on a CPU, 4 takes twice the time.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        size: Sequence[float],
        views: Iterable[Sequence[float]],
        scale: float = 1.0,
        samples: int = 0,
    ):
        self.scale = scale
        self.size = tuple(2 * round(side * scale / 2) for side in size)  #: width, height [pixels]
        model = copy.copy(model)
        quality = model.vis.quality
        quality.offsamples, quality.numquads = samples, 1
        quality.shadowsize, quality.numslices, quality.numstacks = (4096, 32, 16) if samples else (2048, 18, 8)
        names = [model.body(index).name for index in range(model.nbody)]
        for index in range(sum(name.startswith("person") for name in names)):
            model.geom(f"person{index}/cylinder").rgba[3] = 0.0  # a figure stands for it
        self.boxes = [model.body(name).id for name in names if name.startswith("box")]  #: bodies of walls and obstacles
        for index in range(len(self.boxes)):  # coplanar tops would be lit twice where walls meet
            model.geom(f"box{index}").size[2] -= 0.002 * (index % 7)
        self._floor = model.geom("floor").id  # 0: the first in the scene, too
        super().__init__(model, np.max([self.rect(view)[2:] for view in views], axis=0), extra=4000)
        self._free = mujoco.MjvCamera()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def rect(self, view: Sequence[float]) -> tuple[int, ...]:
        """A rectangle of the page at scale 1, in pixels."""
        return tuple(round(value * self.scale) for value in view)

    def pose(self) -> None:
        """Puts the bodies where `data` has their coordinates, and the model alone into the scene."""
        self.place(self._free)
        self.scene.geoms[self._floor].category = mujoco.mjtCatBit.mjCAT_DECOR

    def page(self) -> np.ndarray:
        """An empty page."""
        return np.full((self.size[1], self.size[0], 3), PAPER, np.uint8)

    def add(
        self,
        kind: mujoco.mjtGeom,
        size: ArrayLike,
        place: ArrayLike,
        rgba: ArrayLike,
        yaw: float = 0.0,
        glow: float = 0.0,
        shadow: bool = True,
    ) -> None:
        """Adds a shape to the scene: `size` as MuJoCo's geoms have it [m], turned by `yaw` about the vertical."""
        if self.scene.ngeom >= self.scene.maxgeom:
            return
        c, s = math.cos(yaw), math.sin(yaw)
        geom = self.scene.geoms[self.scene.ngeom]
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
        self.scene.ngeom += 1

    def add_people(self, poses: np.ndarray, colours: np.ndarray, radius: float = RADIUS) -> None:
        """Adds figures at `poses` (K, 3), x, y [m] and yaw [rad], inside the people's cylinders of `radius` [m]: body
        and head in `colours` (K, 3), and a visor where they face."""
        parts = figure(radius)
        for (x, y, yaw), rgb in zip(poses, colours, strict=True):
            c, s = math.cos(yaw), math.sin(yaw)
            for part in parts:
                ahead, _, height = part.place
                rgba = [*part.colour(rgb), part.alpha]
                place = [x + ahead * c, y + ahead * s, height]
                self.add(part.kind, part.size, place, rgba, yaw if ahead else 0.0, part.glow)

    def add_goal(self, goal: np.ndarray) -> None:
        """Adds a disc as large as `goal` (2,) [m] is, a translucent column, and a flag above everybody's head."""
        for part in GOAL:
            rgba = [*part.colour(GOAL_RGB), part.alpha]
            place = [goal[0] + part.place[0], goal[1] + part.place[1], part.place[2]]
            self.add(part.kind, part.size, place, rgba, glow=part.glow, shadow=part.alpha == 1.0)

    def look(
        self,
        place: ArrayLike,
        forward: ArrayLike,
        up: ArrayLike,
        half_height: float,
        near: float = NEAR,
        far: float = FAR,
        orthographic: bool = False,
    ) -> None:
        """Aims the camera. half_height: half the picture's height [m], measured at the distance `near` unless
        orthographic."""
        for camera in self.scene.camera:
            camera.pos, camera.forward, camera.up = place, forward, up
            camera.frustum_center, camera.frustum_width = 0.0, 0.0
            camera.frustum_bottom, camera.frustum_top = -half_height, half_height
            camera.frustum_near, camera.frustum_far = near, far
            camera.orthographic = orthographic
        for light in list(self.scene.lights)[: self.scene.nlight]:
            if light.headlight:
                light.pos, light.dir = place, forward

    def look_down(self, centre: Iterable[float], span: float) -> None:
        """Aims the camera at a map, north up: a square of side `span` [m] around `centre` (2,) [m]."""
        self.look([*centre, 60.0], [0, 0, -1], [0, 1, 0], span / 2, orthographic=True)

    def render(
        self, page: np.ndarray, view: Sequence[float], centre: Iterable[float] | None = None, reach: float | None = None
    ) -> None:
        """Draws into the page's rectangle `view`, with shadows up to `reach` [m] around `centre` where given."""
        opened, context = self.current(), self._context  # raises ValueError once closed
        assert context is not None
        self.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = centre is not None
        if centre is not None:
            context.shadowClip = reach
            for light in list(self.scene.lights)[: self.scene.nlight]:
                if light.castshadow:
                    light.pos = np.array([*centre, 0.0]) - 12.0 * np.array(light.dir)
        left, top, width, height = self.rect(view)
        rect = mujoco.MjrRect(0, 0, width, height)
        pixels = np.empty((height, width, 3), np.uint8)
        with opened:
            mujoco.mjr_render(rect, self.scene, context)
            mujoco.mjr_readPixels(pixels, None, rect, context)
        page[top : top + height, left : left + width] = pixels[::-1]

    def on_map(self, view: Sequence[float], centre: ArrayLike, span: float, place: ArrayLike) -> np.ndarray:
        """Where `view`, a map of `look_down`, shows `place` (..., 2) [m]: (..., 2) pixels x, y of the page,
        continuous."""
        left, top, width, height = self.rect(view)
        offset = (np.asarray(place) - centre) / span
        return np.stack([left + width * (0.5 + offset[..., 0]), top + height * (0.5 - offset[..., 1])], axis=-1)

    def write_label(self, page: np.ndarray, view: Sequence[float], text: str) -> None:
        """Writes what a view is into its corner."""
        left, top, _, _ = self.rect(view)
        unit = self.scale
        width, height = measure(text, 0.44 * unit)
        right, bottom = round(left + width + 16 * unit), round(top + height + 14 * unit)
        page[top:bottom, left:right] = (0.35 * page[top:bottom, left:right] + 0.65 * np.array(INK)).astype(np.uint8)
        write(page, text, (left + 8 * unit, top + height + 6.5 * unit), 0.44 * unit, PAPER)

    def write_header(self, page: np.ndarray, title: str, notes: Iterable[str]) -> None:
        """Writes `title` to the left, cut where it is too long, and `notes` to the right."""
        unit = self.scale
        base = 30 * unit
        notes = "   |   ".join(notes)
        width, _ = measure(notes, 0.5 * unit)
        right = self.size[0] - 12 * unit
        write(page, notes, (right - width, base), 0.5 * unit, MUTED)
        room = right - width - 40 * unit
        while len(title) > 1 and measure(title, 0.66 * unit, bold=True)[0] > room:
            title = title.rstrip(".")[:-1] + "..." if len(title) > 4 else title[:-1]
        write(page, title, (12 * unit, base), 0.66 * unit, INK, bold=True)

    def write_reading(self, page: np.ndarray, place: tuple[float, float], name: str, value: str) -> None:
        """Writes a reading, its name above its value, at `place` x, y."""
        x, y = place
        write(page, name, (x, y), 0.4 * self.scale, MUTED)
        write(page, value, (x, y + 21 * self.scale), 0.56 * self.scale, INK)

    def draw_lcf_scale(
        self, page: np.ndarray, left: float, right: float, top: float, framed: tuple[float, float] | None = None
    ) -> None:
        """Draws the colours of LCFs as a bar between the pixels `left` and `right`, its title above, its ticks below.

        framed: the range of LCFs (least, most) that gets a frame.
        """
        unit = self.scale
        x0, x1, y0, y1 = round(left), round(right), round(top), round(top + 14 * unit)
        write(page, "Pedestrians by LCF", (x0, y0 - 8 * unit), 0.4 * unit, MUTED)
        bar = lcf_colour(np.linspace(*LCF_RANGE, x1 - x0))
        page[y0:y1, x0:x1] = np.round(255 * bar)
        for value, text in ((-2, "-2 adversarial"), (-1, "-1"), (0, "0"), (1, "1"), (2, "cooperative 2")):
            x = x0 + (value + 2) / 4 * (x1 - x0 - 1)
            page[y1 : round(y1 + 4 * unit), round(x) : round(x + max(1, unit))] = INK
            shift = {-2: 0.0, 2: 1.0}.get(value, 0.5) * measure(text, 0.4 * unit)[0]
            write(page, text, (x - shift, y1 + 18 * unit), 0.4 * unit, INK)
        if framed is not None:
            low, high = x0 + (np.clip(framed, *LCF_RANGE) + 2) / 4 * (x1 - x0 - 1)
            line(page, [[low, y0], [high, y0], [high, y1], [low, y1]], INK, 1.6 * unit, closed=True)

    def write_keys(self, page: np.ndarray, left: float, base: float, keys: Iterable[tuple[str, Any, str]]) -> None:
        """Writes the meaning of marks in a row from the pixel `left` on: (text, RGB, "line", "dot" or "ring") each."""
        unit = self.scale
        x, y = left, base - 4 * unit
        for text, rgb, mark in keys:
            if mark == "line":
                line(page, [[x, y], [x + 20 * unit, y]], rgb255(rgb), 3 * unit)
                x += 27 * unit
            elif mark == "dot":
                disc(page, (x + 3 * unit, y), 3 * unit, rgb255(rgb))
                x += 12 * unit
            else:
                ring(page, (x + 5 * unit, y), 5 * unit, rgb255(rgb), 2 * unit)
                x += 17 * unit
            write(page, text, (x, base), 0.4 * unit, INK)
            x += measure(text, 0.4 * unit)[0] + 18 * unit

    def draw_metres(self, canvas: np.ndarray, metre: float, length: float = 5) -> None:
        """Draws the scale of a map, `length` [m] long, into the lower left corner of its picture; metre: a metre in
        pixels."""
        unit, height = self.scale, canvas.shape[0]
        x0, y0, x1 = 14 * unit, height - 14 * unit, 14 * unit + length * metre
        corners = [[x0, y0 - 5 * unit], [x0, y0], [x1, y0], [x1, y0 - 5 * unit]]
        for colour, thickness in ((PAPER, 4.0), (INK, 1.6)):
            line(canvas, corners, colour, thickness * unit)
        write(canvas, f"{length} m", (x0 + 5 * unit, y0 - 6 * unit), 0.42 * unit, INK, halo=True)


def _thick(width):
    return max(1, round(width))


def _font(bold):
    import cv2

    return cv2.FONT_HERSHEY_DUPLEX if bold else cv2.FONT_HERSHEY_SIMPLEX


def measure(text: str, size: float, bold: bool = False) -> Sequence[int]:
    """Width and height [pixels] of `text`."""
    import cv2

    return cv2.getTextSize(text, _font(bold), size, _thick(size))[0]


def write(
    image: np.ndarray,
    text: str,
    place: Iterable[float],
    size: float,
    colour: Sequence[float],
    bold: bool = False,
    halo: bool = False,
) -> None:
    """Writes `text` with its baseline's left end at `place`."""
    import cv2

    where = [round(float(value)) for value in place]
    if halo:
        for offset in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            shifted = [where[0] + offset[0], where[1] + offset[1]]
            cv2.putText(image, text, shifted, _font(bold), size, PAPER, _thick(size), cv2.LINE_AA)
    cv2.putText(image, text, where, _font(bold), size, colour, _thick(size), cv2.LINE_AA)


def _sixteenths(points):
    """Pixels as OpenCV's drawing takes them with shift=4."""
    return np.round(np.asarray(points) * 16).astype(np.int32)


def line(image: np.ndarray, points: ArrayLike, colour: Sequence[float], width: float, closed: bool = False) -> None:
    """Draws a line through `points` (N, 2), in pixels."""
    import cv2

    cv2.polylines(image, [_sixteenths(points)], closed, colour, _thick(width), cv2.LINE_AA, 4)


def polygon(image: np.ndarray, points: ArrayLike, colour: Sequence[float]) -> None:
    """Fills the polygon with the corners `points` (N, 2), in pixels."""
    import cv2

    cv2.fillPoly(image, [_sixteenths(points)], colour, cv2.LINE_AA, 4)


def disc(image: np.ndarray, place: Iterable[float], radius: float, colour: Sequence[float]) -> None:
    """Fills a circle around `place` x, y; in pixels."""
    import cv2

    cv2.circle(image, [round(16 * float(v)) for v in place], round(16 * radius), colour, -1, cv2.LINE_AA, 4)


def ring(image: np.ndarray, place: Iterable[float], radius: float, colour: Sequence[float], width: float) -> None:
    """Draws a circle around `place` x, y; in pixels."""
    import cv2

    cv2.circle(image, [round(16 * float(v)) for v in place], round(16 * radius), colour, _thick(width), cv2.LINE_AA, 4)


def write_png(path: str | os.PathLike[str], picture: np.ndarray) -> pathlib.Path:
    """Saves `picture` as the PNG `path`, all or nothing; returns the path."""
    import cv2

    write_bytes(path, cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes())
    return pathlib.Path(path)


def write_webm(
    path: str | os.PathLike[str],
    pictures: Generator[np.ndarray, None, None],
    number: int,
    fps: float,
    progress: Callable[[int, int], object] | None = None,
) -> pathlib.Path:
    """Writes the `number` pictures of the generator `pictures`, all of one size, as the VP8 video `path` (.webm), which
    browsers play; returns the path.

    progress(done, number) is called after each frame. The generator is closed in the end.
    Raises OSError where `path` can't be written or the film can't be read back. All or nothing: no half file is left.
    """
    import cv2

    path = pathlib.Path(path)
    if path.suffix.lower() != ".webm":
        raise ValueError(f"A film is a .webm file, not {named(path.name)}.")
    with contextlib.closing(pictures), new_file(path, ".webm") as (_, temporary), _ascii_path(temporary) as file:
        writer, done = cv2.VideoWriter(), 0
        with ThreadPoolExecutor(1) as encoder, _no_warnings():
            try:
                written = None
                for done, picture in enumerate(pictures, start=1):
                    frame = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
                    if written is None:
                        with _silent_stderr():  # FFmpeg remarks that WebM has no such tag: it needs none
                            writer.open(file, cv2.VideoWriter.fourcc(*"VP80"), float(fps), frame.shape[1::-1])
                        if not writer.isOpened():
                            raise OSError("OpenCV can't write VP8 video there")
                    else:
                        written.result()
                    written = encoder.submit(writer.write, frame)  # while the next picture is drawn
                    if progress is not None:
                        progress(done, number)
            finally:
                encoder.shutdown()
                with _silent_stderr():
                    writer.release()
        _check_film(file, done)
    return path


def _check_film(file, number):
    """Raises OSError where not all `number` pictures of a film can be read back, or it does not tell its length."""
    import cv2

    with _silent_stderr():
        video = cv2.VideoCapture(file, cv2.CAP_FFMPEG)
        told, found = video.get(cv2.CAP_PROP_FRAME_COUNT), 0
        while video.grab():
            found += 1
        video.release()
    if found < number:
        raise OSError(f"only {found} of its {number} pictures can be read back, as where a disk is full")
    if told < number:  # it is in what FFmpeg writes last
        raise OSError("its end is missing, as where a disk is full")


@contextlib.contextmanager
def _ascii_path(path):
    """`path` as OpenCV takes it, which fails at names that are not UTF-8: by its folder's handle where need be."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        handle = os.open(path.parent, os.O_RDONLY)
        try:
            yield f"/proc/self/fd/{handle}/{path.name}"
        finally:
            os.close(handle)
    else:
        yield str(path)


@contextlib.contextmanager
def _no_warnings():
    """Lets OpenCV not warn, at each picture that a full disk does not take: `_check_film` tells of it."""
    import cv2

    log = cv2.utils.logging
    level = log.setLogLevel(log.LOG_LEVEL_ERROR)
    try:
        yield
    finally:
        log.setLogLevel(level)


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
