"""MuJoCo's threaded batch simulator: the engine for CPUs."""

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np

from macid.engines.base import NO_OPTIONS, CrowdEngine, FlatState, NoOptions
from macid.geometry import Array
from macid.threads import physics_threads


class NativeEngine(CrowdEngine):
    """The engine is reached from jitted code by a callback. Worlds of a batch equal the same worlds run alone, bit for
    bit."""

    def __init__(self, model: mujoco.MjModel, number: int, boxes: Array, nworld: int, options: NoOptions = NO_OPTIONS):
        super().__init__(model, number, boxes, nworld)
        self._batch = mujoco.batch.Batch(model, nworld, physics_threads())
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._warmstart, self._ctrl = self._batch.bind("qacc_warmstart"), self._batch.bind("ctrl")

    def step(self, state: FlatState, command: Array, nstep: int = 1) -> FlatState:
        """As Engine.step."""

        def run(*fields):  # (..., nworld, 3 K): under vmap, one batch of worlds after the other
            after = tuple(np.empty(fields[0].shape, np.float32) for _ in state)
            for index in np.ndindex(fields[0].shape[:-2]):
                for bound, field in zip((*bounds, self._ctrl), fields, strict=True):
                    bound[:] = field[index]
                self._batch.step(nstep=nstep)
                for bound, field in zip(bounds, after, strict=True):
                    field[index] = bound
            return after

        bounds = self._qpos, self._qvel, self._warmstart
        shapes = tuple(jax.ShapeDtypeStruct(field.shape, jnp.float32) for field in state)
        ctrl = command.reshape(self.nworld, 3 * self.number)
        return FlatState(*jax.pure_callback(run, shapes, *state, ctrl, vmap_method="broadcast_all"))

    def _warned(self):
        told = []
        for warnings in np.asarray(self._batch.warning):
            number = int(warnings[:, 1].argmax())
            what = mujoco.mju_warningText(number, int(warnings[number, 0])).split(". ")[0]
            told.append(what if warnings[number, 1] else "")
        return told
