"""OpenGL, offscreen: its contexts, and why there may be none."""

import atexit
import contextlib
import functools
import os
import platform
import sys
import weakref
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any

import mujoco
import numpy as np

from macid.files import UsageError

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
