"""MuJoCo Warp: the engine for NVIDIA GPUs. It runs on a CPU as well, for tests.

MJX's own way there, `mjx.put_model(model, impl="warp")`, hands 168 fields of all worlds from XLA to the kernels and
back at every step, and allocates each anew. Here Warp keeps them, and only the state and the command pass at a step.

The kernels of a step are captured once, as a graph, when an engine is made, and not at XLA's first call. Within XLA's
callback Python may collect garbage, and JAX may then free memory. This is forbidden while a CUDA graph is captured, and
made the process hang. A graph is many times as fast as its kernels one by one. On a GPU equal seeds agree to a
tolerance, not bit for bit: contacts are counted in any order.
"""

import contextlib
import copy
import dataclasses
import gc
import itertools
import warnings
import weakref
from collections.abc import Iterator

import jax
import mujoco
import numpy as np
import warp as wp
from mujoco.mjx.third_party import mujoco_warp
from mujoco.mjx.third_party.mujoco_warp._src.types import OverflowType

from macid.engines.base import CrowdEngine, EngineOverflow, FlatState
from macid.geometry import Array
from macid.state import parking_place

wp.config.log_level = wp.LOG_ERROR  # else Warp prints lines on itself and on each kernel that it compiles
_ROWS = 4  # rows of a contact's constraints: condim 3 in a pyramid
_CONTACTS = OverflowType.BROADPHASE | OverflowType.NARROWPHASE | OverflowType.CCD
_OVERFLOWS = _CONTACTS | OverflowType.NEFC | OverflowType.NJMAX_NNZ
MOST_NEWTON = 100  # up to this many people "auto" chooses newton
ITERATIONS = {"newton": 8, "cg": 32}
_SOLVERS = {"newton": mujoco.mjtSolver.mjSOL_NEWTON, "cg": mujoco.mjtSolver.mjSOL_CG}


@dataclasses.dataclass(frozen=True)
class WarpOptions:
    """How MuJoCo Warp simulates; an engine's name may give them: `warp:contacts=4,solver=cg`."""

    contacts: int = 2  #: room per person: for contacts in all worlds together, for these contacts' rows in each world
    solver: str = "auto"  #: newton: few exact iterations; cg: more, cheaper ones; auto: newton up to MOST_NEWTON people
    iterations: int = 0  #: of the solver, at most; 0: the solver's number in ITERATIONS
    line_search: int = 16  #: iterations of its line search, at most
    until_done: bool = True  #: the solver stops when all worlds are done (a loop in the graph), not after `iterations`
    graph: str = "engine"  #: when a step's graph is captured: with the engine, at XLA's first "call" (GPU), or "none"

    def __post_init__(self):
        for name, least in (("contacts", 1), ("iterations", 0), ("line_search", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, not {getattr(self, name)}.")
        if self.graph not in ("engine", "call", "none"):
            raise ValueError(f"graph must be engine, call or none, not '{self.graph}'.")
        if self.solver not in ("auto", *_SOLVERS):
            raise ValueError(f"solver must be one of auto, {', '.join(_SOLVERS)}, not '{self.solver}'.")

    def solving(self, number: int) -> tuple[str, int]:
        """(solver, iterations at most) for a crowd of `number` people."""
        solver = ("newton" if number <= MOST_NEWTON else "cg") if self.solver == "auto" else self.solver
        return solver, self.iterations or ITERATIONS[solver]


class WarpEngine(CrowdEngine):
    """Worlds on JAX's first device. Under vmap, as over several seeds, the worlds of all are stepped at once."""

    stacks = True
    options = WarpOptions

    def __init__(
        self, model: mujoco.MjModel, number: int, boxes: Array, nworld: int, options: WarpOptions = WarpOptions()
    ):
        super().__init__(model, number, boxes, nworld)
        self.chosen = options
        self._device = wp.device_from_jax(jax.devices()[0])
        own = copy.copy(model)
        solver, own.opt.iterations = options.solving(number)
        own.opt.solver, own.opt.jacobian = _SOLVERS[solver], mujoco.mjtJacobian.mjJAC_SPARSE
        own.opt.ls_iterations = options.line_search
        with wp.ScopedDevice(self._device), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # walls have no friction of their own, see macid.scene.add_boxes
            self._model = mujoco_warp.put_model(own)
        self._model.opt.graph_conditional = options.until_done
        self._model.opt.warn_overflow = 0  # `check` reports it
        self._mujoco, self._batches = own, {}
        self._call = _captured_call if options.graph == "call" and self._device.is_cuda else _call
        self._step = jax.custom_batching.custom_vmap(self._step_worlds)
        self._step.def_vmap(self._step_stacked)
        self._batch(nworld)

    def step(self, state: FlatState, command: Array, nstep: int = 1) -> FlatState:
        """As Engine.step."""
        ctrl = command.reshape(state.qpos.shape)
        for _ in range(nstep):
            state = FlatState(*self._step(*state, ctrl))
        return state

    def check(self) -> None:
        """As Engine.check."""
        for batch in self._batches.values():
            batch.check()

    def _batch(self, nworld):
        if nworld not in self._batches:
            self._batches[nworld] = _Batch(self._mujoco, self._model, self._device, nworld, self.number, self.chosen)
        return self._batches[nworld]

    def _step_worlds(self, qpos, qvel, warmstart, ctrl):
        return tuple(self._call(self._batch(len(qpos)).handle, qpos, qvel, warmstart, ctrl, output_dims=qpos.shape))

    def _step_stacked(self, size, batched, *fields):
        """A step under vmap: the worlds of all stacks become one batch."""
        whole = [
            field if is_so else jax.numpy.broadcast_to(field, (size, *field.shape))
            for field, is_so in zip(fields, batched, strict=True)
        ]
        stepped = self._step(*(field.reshape(-1, field.shape[-1]) for field in whole))
        return tuple(field.reshape(whole[0].shape) for field in stepped), (True,) * len(stepped)


class _Batch:
    """The arrays of `nworld` worlds on Warp's side, and the graph of their step."""

    def __init__(self, mujoco_model, model, device, nworld, number, options):
        self._model, self._options, self._number = model, options, number
        with wp.ScopedDevice(device):
            self.data = mujoco_warp.make_data(
                mujoco_model,
                nworld=nworld,
                naconmax=options.contacts * number * nworld,
                njmax=_ROWS * options.contacts * number,
            )
            self._graph = self._capture() if options.graph == "engine" else None
        self.handle = next(_handles)
        _batches[self.handle] = self

    def _capture(self):
        """The graph of a step."""
        places = np.pad(parking_place(np.arange(self._number)), ((0, 0), (0, 1))).ravel()
        self.data.qpos.assign(np.tile(places, (self.data.nworld, 1)).astype(np.float32))
        mujoco_warp.step(self._model, self.data)  # loads the kernels
        wp.synchronize_device()
        # Relaxed, so that CUDA calls of another thread don't break the capture.
        with no_collection(), wp.ScopedCapture(capture_mode=wp.CaptureMode.RELAXED) as capture:
            mujoco_warp.step(self._model, self.data)
        wp.capture_launch(capture.graph)  # gets the graph ready here, too
        self.data.overflow.zero_()
        wp.synchronize_device()
        return capture.graph

    def step(self, given, stepped):
        """Steps from `given`, (qpos, qvel, qacc_warmstart, ctrl), and writes the result to `stepped`, (qpos, qvel,
        qacc_warmstart); all are Warp's arrays (nworld, 3 K)."""
        data = self.data
        for own, array in zip((data.qpos, data.qvel, data.qacc_warmstart, data.ctrl), given, strict=True):
            wp.copy(own, array)
        if self._graph is None:
            mujoco_warp.step(self._model, data)
        else:
            wp.capture_launch(self._graph)
        for array, own in zip(stepped, (data.qpos, data.qvel, data.qacc_warmstart), strict=True):
            wp.copy(array, own)

    def check(self):
        """Raises EngineOverflow if a step so far had too little room."""
        what = int(np.bitwise_or.reduce(self.data.overflow.numpy()))
        if what & _OVERFLOWS:
            kind = "contacts" if what & _CONTACTS else "rows of constraints"
            self.data.overflow.zero_()
            raise EngineOverflow(
                f"The engine 'warp' had too little room for {kind}: {self._options.contacts} contacts a person of "
                f"{self._number}. Raise its option: --engine warp:contacts={2 * self._options.contacts}"
            )


@contextlib.contextmanager
def no_collection() -> Iterator[None]:
    """Keeps Python's collector from freeing anything within the `with`."""
    gc.collect()
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


_handles = itertools.count()
_batches = weakref.WeakValueDictionary()  # by handle, weakly: programs that JAX compiled must not keep worlds alive


def _step_batch(
    handle: int,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    warmstart: wp.array2d[float],
    ctrl: wp.array2d[float],
    next_qpos: wp.array2d[float],
    next_qvel: wp.array2d[float],
    next_warmstart: wp.array2d[float],
):
    _batches[handle].step((qpos, qvel, warmstart, ctrl), (next_qpos, next_qvel, next_warmstart))


_call, _captured_call = (
    wp.jax_callable(_step_batch, num_outputs=3, graph_mode=mode, vmap_method=None)
    for mode in (wp.JaxCallableGraphMode.NONE, wp.JaxCallableGraphMode.WARP)
)
