"""A page with views of a model, of its people, their goals and their tempers."""

import copy
import math
from collections.abc import Iterable, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from macid.drawing.colours import GOAL_RGB, INK, LCF_RANGE, MUTED, PAPER, lcf_colour, rgb255
from macid.drawing.figures import GOAL, figure
from macid.drawing.gl import Offscreen
from macid.drawing.strokes import disc, line, measure, ring, write
from macid.state import RADIUS

NEAR, FAR = 0.05, 300.0  # only what is between these distances is drawn [m]


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
