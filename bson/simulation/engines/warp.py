"""The robot's worlds in MuJoCo Warp: physics of many worlds at once on a GPU, and on a CPU for tests.

The engine's functions are pure functions of one world: jax.vmap maps them over many worlds, which Warp then steps
together. Warp keeps the hundred or so arrays of a step to itself. Only configuration, velocity, command and the boxes'
places pass between JAX and Warp, once a control step. On a GPU the kernels of a step are captured as a CUDA graph. The
capture happens when a number of worlds is first asked for, and not while JAX computes: JAX may free memory then, which
is forbidden during a capture.

A step agrees with MuJoCo's own to a tolerance, not bit for bit, and on a GPU two runs agree no better than that.
"""

import dataclasses
import functools
import itertools
import logging
import threading
import warnings
import weakref
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from macid.documents import is_number, shown
from macid.engines import WARP_PACKAGE, has_warp
from macid.files import UsageError

# Of WarpConfig's numbers, the least valid one and the kind.
_NUMBERS = (
    ("iterations", 1, int),
    ("ls_iterations", 1, int),
    ("tolerance", 0, float),
    ("contacts", 0, float),
    ("rows", 0, float),
)
SOLVERS = {"newton": mujoco.mjtSolver.mjSOL_NEWTON, "cg": mujoco.mjtSolver.mjSOL_CG}


@dataclasses.dataclass(frozen=True)
class WarpConfig:
    """The engine's limits: of the solver, and room for contacts.

    contacts: room for contacts in all worlds together is 64 plus this number per world; people and a robot in a crowd
    have a dozen. rows: room for constraint rows in each world is 64 plus this number per person. Where a world needs
    more of either, the error tells which. tolerance: of the solver; Warp's default, 1e-6, displaces a robot with
    slipping wheels by millimetres. graph: whether a GPU's kernels are captured as a CUDA graph.
    """

    solver: str = "newton"
    iterations: int = 8
    ls_iterations: int = 16
    tolerance: float = 1e-8
    contacts: float = 16.0
    rows: float = 6.0
    graph: bool = True

    def __post_init__(self):
        if self.solver not in SOLVERS:
            raise ValueError(f"solver must be one of {', '.join(SOLVERS)}, not {shown(self.solver)}.")
        for name, least, kind in _NUMBERS:
            value = getattr(self, name)
            if not is_number(value, least) or (kind is int and not isinstance(value, int)):
                what = "a whole number" if kind is int else "a number"
                raise ValueError(f"{name} must be {what} of at least {least}, not {shown(value)}.")
        if not isinstance(self.graph, bool):
            raise ValueError(f"graph must be True or False, not {shown(self.graph)}.")


def warp_config(limits: Any = None) -> WarpConfig:
    """The WarpConfig with `limits`, a dict of its fields, or None. Raises ValueError, naming the valid ones."""
    names = [field.name for field in dataclasses.fields(WarpConfig)]
    if not (limits is None or isinstance(limits, dict)) or set(limits or ()) - set(names):
        raise ValueError(f"limits must be a dict of fields of WarpConfig, {', '.join(names)}, not {shown(limits)}.")
    return WarpConfig(**(limits or {}))


class OutOfRoom(UsageError, RuntimeError):
    """Physics had too little room for contacts or constraint rows: its results are wrong. The text names the number to
    raise."""


class Motion(NamedTuple):
    """The part of MuJoCo's state that a world's next step depends on."""

    qpos: Any  #: (nq,)
    qvel: Any  #: (nv,)
    warmstart: Any  #: (nv,)
    ctrl: Any  #: (nu,)


def check_warp() -> None:
    """Raises UsageError where Warp is not installed."""
    if not has_warp():
        raise UsageError(
            f"The engine 'warp' needs the package warp-lang: pip install {WARP_PACKAGE} (the extra 'warp')."
        )


@functools.cache
def _warp():
    """(warp, mujoco_warp, the functions that JAX calls). Raises UsageError where Warp is not installed."""
    check_warp()
    import warp
    from mujoco.mjx.third_party import mujoco_warp

    warp.config.log_level = logging.ERROR  # Warp would print a line on itself, and one for each kernel that it compiles

    floats, vectors, quaternions = (warp.array(dtype=kind, ndim=2) for kind in (float, warp.vec3, warp.quat))
    given = dict.fromkeys(("qpos", "qvel", "warmstart", "ctrl"), floats)
    given |= {"mocap_pos": vectors, "mocap_quat": quaternions}
    step_out = {**dict.fromkeys(("next_qpos", "next_qvel", "next_warmstart"), floats)}
    step_out |= {"record": warp.array(dtype=float, ndim=3), "overflow": warp.array(dtype=int, ndim=1)}

    def step(
        handle,
        number,
        qpos,
        qvel,
        warmstart,
        ctrl,
        mocap_pos,
        mocap_quat,
        next_qpos,
        next_qvel,
        next_warmstart,
        record,
        overflow,
    ):
        given = qpos, qvel, warmstart, ctrl, mocap_pos, mocap_quat
        _batches[handle].step(number, given, (next_qpos, next_qvel, next_warmstart, record, overflow))

    def sense(handle, qpos, qvel, warmstart, ctrl, mocap_pos, mocap_quat, sensordata):
        _batches[handle].sense((qpos, qvel, warmstart, ctrl, mocap_pos, mocap_quat), sensordata)

    step.__annotations__ = {"handle": int, "number": int, **given, **step_out}
    sense.__annotations__ = {"handle": int, **given, "sensordata": floats}
    none = warp.JaxCallableGraphMode.NONE
    return (
        warp,
        mujoco_warp,
        warp.jax_callable(step, num_outputs=5, graph_mode=none, vmap_method=None),
        warp.jax_callable(sense, num_outputs=1, graph_mode=none, vmap_method=None),
    )


_handles = itertools.count()
_batches = weakref.WeakValueDictionary()  # by handle, weakly: programs that JAX compiled must not keep worlds alive


class WarpEngine:
    """Physics of the worlds of one MjSpec: functions of one world, for jax.vmap.

    model: the MjModel, with the solver's limits of `config`. people: the number of pedestrians, the first bodies of the
    model. Raises UsageError where Warp is not installed, ValueError for a model with features that MJX-Warp lacks.
    """

    def __init__(self, spec: mujoco.MjSpec, people: int, config: Any = None):
        warp, mujoco_warp, _, _ = _warp()
        self.config = config = config or WarpConfig()
        self.people = people
        spec.option.iterations, spec.option.ls_iterations = config.iterations, config.ls_iterations
        spec.option.solver = SOLVERS[config.solver]
        self.model = model = spec.compile()
        if model.na:
            raise ValueError("The engine 'warp' has no motors with a state of their own (dyntype).")
        self.rows = 64 + int(np.ceil(config.rows * people))  #: room for constraint rows in each world
        self._device = warp.device_from_jax(jax.devices()[0])
        with warp.ScopedDevice(self._device), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # walls have no friction of their own, see macid.scene.add_boxes
            self._model = mujoco_warp.put_model(model)
        self._model.opt.tolerance.fill_(config.tolerance)
        self._model.opt.warn_overflow = 0  # `explain` reports it
        boxes = np.flatnonzero(model.body_mocapid >= 0)
        self._heights = jnp.asarray(model.body_pos[boxes[np.argsort(model.body_mocapid[boxes])], 2], jnp.float32)
        self._made = {}  # {number of worlds: its _Batch}
        self._step = functools.cache(lambda number: _mapped(functools.partial(self._step_worlds, number)))
        self._sense = _mapped(self._sense_worlds)

    def rest(self, qpos: Any) -> Any:
        """The Motion of a world at rest in the configuration `qpos` (nq,)."""
        nv, nu = self.model.nv, self.model.nu
        return Motion(qpos, jnp.zeros(nv, jnp.float32), jnp.zeros(nv, jnp.float32), jnp.zeros(nu, jnp.float32))

    def step(self, motion: Any, boxes: Any, number: int) -> Any:
        """`number` physics steps of a world in `motion` among `boxes` (B, 5): the Motion after them, the configuration
        after each (number, nq), and `overflow`.

        overflow: 0, or bits (Warp's OverflowType) that name what ran out of room; `explain` puts them into words.
        """
        qpos, qvel, warmstart, record, overflow = self._step(number)(*motion, *self._placed(boxes))
        return Motion(qpos, qvel, warmstart, motion.ctrl), record, overflow & _LOST

    def sensordata(self, motion: Any, boxes: Any) -> Any:
        """The readings (nsensordata,) of MuJoCo's own sensors (the IMU) in a world."""
        (read,) = self._sense(*motion, *self._placed(boxes))
        return read

    def contacts(self, nworld: int) -> int:
        """The number of contacts for which `nworld` worlds together have room."""
        return 64 + int(np.ceil(self.config.contacts * nworld))

    def explain(self, overflow: int) -> str:
        """The bits `overflow` of a step, in words, as one sentence."""
        told = []
        if overflow & _ROWS:
            told.append(
                f"a world needs more than {self.rows} constraint rows: raise WarpConfig.rows ({self.config.rows:g}), "
                f"as by --engine warp:rows={2 * self.config.rows or 6:g}"
            )
        if overflow & ~_ROWS:
            told.append(
                f"there are too many contacts: raise WarpConfig.contacts ({self.config.contacts:g} a world), as by "
                f"--engine warp:contacts={2 * self.config.contacts or 16:g}"
            )
        return "Physics ran out of room: " + "; ".join(told) + "."

    def _placed(self, boxes):
        """The poses of `boxes` (B, 5) for Warp: places (B, 3) and quaternions (B, 4)."""
        half = boxes[:, 4] / 2
        zero = jnp.zeros_like(half)
        quaternions = jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], axis=-1)
        return jnp.concatenate([boxes[:, :2], self._heights[:, None]], axis=-1), quaternions

    def _batch(self, nworld):
        if nworld not in self._made:
            self._made[nworld] = _Batch(self, nworld)
        return self._made[nworld]

    def _step_worlds(self, number, qpos, *fields):
        nworld, model = len(qpos), self.model
        shapes = {"next_qpos": qpos.shape, "next_qvel": (nworld, model.nv), "next_warmstart": (nworld, model.nv)}
        shapes |= {"record": (nworld, number, model.nq), "overflow": (nworld,)}
        return tuple(_warp()[2](self._batch(nworld).handle, number, qpos, *fields, output_dims=shapes))

    def _sense_worlds(self, qpos, *fields):
        shape = {"sensordata": (len(qpos), self.model.nsensordata)}
        return tuple(_warp()[3](self._batch(len(qpos)).handle, qpos, *fields, output_dims=shape))


def _mapped(many):
    """A function of one world, which becomes `many` under jax.vmap, once or nested. many: a function of many worlds,
    whose arrays have a leading axis (nworld,)."""

    def spread(size, batched, fields):
        return [
            field if whole else jnp.broadcast_to(field, (size, *field.shape))
            for field, whole in zip(fields, batched, strict=True)
        ]

    worlds = jax.custom_batching.custom_vmap(many)

    @worlds.def_vmap
    def _(size, batched, *fields):
        fields = spread(size, batched, fields)
        found = worlds(*(field.reshape(-1, *field.shape[2:]) for field in fields))
        return tuple(one.reshape(size, -1, *one.shape[1:]) for one in found), (True,) * len(found)

    @jax.custom_batching.custom_vmap
    def single(*fields):
        return tuple(one[0] for one in worlds(*(field[None] for field in fields)))

    @single.def_vmap
    def _(size, batched, *fields):
        found = worlds(*spread(size, batched, fields))
        return found, (True,) * len(found)

    return single


class _Batch:
    """The arrays of `nworld` worlds on Warp's side, and the graphs of the kernels that work on them."""

    def __init__(self, engine, nworld):
        self._warp, self._mujoco, _, _ = _warp()
        self._full, self._lock = engine._model, threading.Lock()
        flags = self._full.opt.disableflags | int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        self._quiet = dataclasses.replace(self._full, opt=dataclasses.replace(self._full.opt, disableflags=flags))
        graphs = engine.config.graph and engine._device.is_cuda
        with self._warp.ScopedDevice(engine._device), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._data = self._mujoco.make_data(
                engine.model, nworld=nworld, naconmax=engine.contacts(nworld), njmax=engine.rows
            )
            self._step = self._captured(self._mujoco.step, self._quiet) if graphs else None
            self._forward = self._captured(self._mujoco.forward, self._full) if graphs else None
        self.handle = next(_handles)
        _batches[self.handle] = self

    def _captured(self, act, model):
        """The CUDA graph of the call act(model, data)."""
        act(model, self._data)  # loads the kernels
        self._warp.synchronize_device()
        from macid.engines.warp import no_collection

        relaxed = self._warp.CaptureMode.RELAXED
        with no_collection(), self._warp.ScopedCapture(capture_mode=relaxed) as capture:
            act(model, self._data)
        self._warp.synchronize_device()
        return capture.graph

    def _load(self, given):
        own = self._data.qpos, self._data.qvel, self._data.qacc_warmstart, self._data.ctrl
        for to, array in zip((*own, self._data.mocap_pos, self._data.mocap_quat), given, strict=True):
            self._warp.copy(to, array)

    def step(self, number, given, after):
        """Takes `number` steps from `given`, Warp's arrays; writes the result to `after`."""
        *motion, record, overflow = after
        with self._lock:  # on a CPU JAX may call from several threads
            self._load(given)
            self._data.overflow.zero_()
            for place in range(number):
                if self._step is None:
                    self._mujoco.step(self._quiet, self._data)
                else:
                    self._warp.capture_launch(self._step)
                self._warp.copy(record[:, place], self._data.qpos)
            own = self._data.qpos, self._data.qvel, self._data.qacc_warmstart, self._data.overflow
            for array, to in zip(own, (*motion, overflow), strict=True):
                self._warp.copy(to, array)

    def sense(self, given, sensordata):
        """Writes the readings of MuJoCo's sensors in the state `given`, Warp's arrays, to `sensordata`."""
        with self._lock:
            self._load(given)
            if self._forward is None:
                self._mujoco.forward(self._full, self._data)
            else:
                self._warp.capture_launch(self._forward)
            self._warp.copy(sensordata, self._data.sensordata)


# Bits of Warp's OverflowType that lose contacts or rows (a solver that stops at its limit loses nothing).
_ROWS = 1 << 0 | 1 << 1
_LOST = _ROWS | 1 << 2 | 1 << 3 | 1 << 4
