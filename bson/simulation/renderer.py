"""Pictures of the cameras in a batch's worlds, drawn offscreen: one OpenGL context for all worlds and cameras."""

import copy
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from macid.drawing.gl import Offscreen


def draw_plainly(quality: Any) -> None:
    """Sets the visual quality of an MjModel or MjSpec for cameras: no shadows and no anti-aliasing. A pixel is only the
    ray through its middle, so that its depth is the depth of one surface."""
    quality.offsamples, quality.shadowsize, quality.numquads, quality.numstacks = 0, 0, 1, 2


class Renderer(Offscreen):
    """Draws the pictures of `model`'s cameras in `nworld` worlds, without shadows; a picture has its camera's
    resolution.

    model: as sensors see it; it is copied. Close the Renderer, or drop the last reference to it. Raises
    macid.drawing.gl.Unavailable without OpenGL.
    """

    def __init__(self, model: mujoco.MjModel, nworld: int):
        model, self._nworld = copy.copy(model), nworld
        draw_plainly(model.vis.quality)
        super().__init__(model, model.cam_resolution.max(axis=0), extra=100)
        assert self._context is not None  # until `close`
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._frames = {}

    def view(self, name: str) -> int:
        """The view of the camera `name`: a number. Cameras with the same picture have the same number."""
        model = self.model
        same = np.ones(model.ncam, bool)
        for field in ("bodyid", "pos", "quat", "resolution", "sensorsize", "intrinsic"):
            rows = getattr(model, f"cam_{field}").reshape(model.ncam, -1)
            same &= (rows == rows[model.camera(name).id]).all(axis=-1)
        return int(np.flatnonzero(same)[0])

    def look(self, view: int, ids: np.ndarray, fill: Callable, now: int) -> tuple[np.ndarray, np.ndarray]:
        """The pictures of the worlds `ids`: RGB (n, H, W, 3) uint8 and depth (n, H, W) float32 [m].

        Depth is measured along the optical axis, not along the pixel's ray. fill(index, data) writes the state of world
        `index` into the MjData `data`. now: a number that changes when worlds do; a view is drawn once for each `now`,
        however many sensors share it.
        """
        if view not in self._frames:
            width, height = self.model.cam_resolution[view]
            self._frames[view] = (
                np.full(self._nworld, -1),
                np.zeros((self._nworld, height, width, 3), np.uint8),
                np.zeros((self._nworld, height, width), np.float32),
            )
        drawn, rgb, depth = self._frames[view]
        stale = ids[drawn[ids] != now]
        if len(stale):
            with self.current():
                for index in stale:
                    self._draw(fill, view, index, rgb[index], depth[index])
            drawn[stale] = now
        return rgb[ids], depth[ids]

    def _draw(self, fill, view, index, rgb, depth):
        """Draws world `index` into `rgb` (H, W, 3) and `depth` (H, W)."""
        fill(index, self.data)
        self._camera.fixedcamid = view
        self.place(self._camera)
        rect = mujoco.MjrRect(0, 0, depth.shape[1], depth.shape[0])
        mujoco.mjr_render(rect, self.scene, self._context)
        mujoco.mjr_readPixels(rgb, depth, rect, self._context)
        rgb[:], depth[:] = rgb[::-1].copy(), depth[::-1].copy()  # OpenGL's first row is the lowest
        camera = self.scene.camera[0]
        near, far = float(camera.frustum_near), float(camera.frustum_far)
        depth[:] = near * far / (near + depth.astype(np.float64) * (far - near))  # 1 is near, 0 far
