"""MJX, MuJoCo in JAX: the engine for accelerators without Warp, and for several devices at once."""

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from macid.engines.base import NO_OPTIONS, CrowdEngine, NoOptions
from macid.geometry import Array


class MjxEngine(CrowdEngine):
    """Its state is one `mjx.Data` with a leading axis of worlds."""

    shards = stacks = True

    def __init__(self, model: mujoco.MjModel, number: int, boxes: Array, nworld: int, options: NoOptions = NO_OPTIONS):
        super().__init__(model, number, boxes, nworld)
        self._model = mjx.put_model(model, impl="jax")

    def init(self, position: Array, yaw: Array) -> mjx.Data:
        """As Engine.init."""

        def one(qpos):
            data = mjx.make_data(self.model, impl="jax").replace(qpos=qpos)
            return mjx.forward(self._model, data)

        example = mjx.make_data(self.model, impl="jax")
        data = jax.vmap(one)(self._pack(position, yaw))
        # A step's output must have its input's types, or every second call would compile anew.
        return jax.tree.map(lambda x, like: jnp.asarray(x, jnp.asarray(like).dtype), data, example)

    def step(self, state: mjx.Data, command: Array, nstep: int = 1) -> mjx.Data:
        """As Engine.step."""
        ctrl = command.reshape(self.nworld, 3 * self.number)
        gain = self._model.actuator_gainprm[:, 0]
        limit = jnp.where(self._model.actuator_forcelimited, self._model.actuator_forcerange[:, 1], jnp.inf)

        def one(data, ctrl):
            # The implicit integrators damp by an actuator's velocity gain. MuJoCo's don't where the actuator is at its
            # limit, MJX's always do. So that the engines agree, an actuator at its limit is a constant force here.
            force = gain * (ctrl - data.qvel)
            at_limit = jnp.abs(force) >= limit
            ctrl = jnp.where(at_limit, jnp.clip(force, -limit, limit) / gain, ctrl)
            bias = jnp.where(at_limit[:, None], 0.0, self._model.actuator_biasprm)
            return mjx.step(self._model.replace(actuator_biasprm=bias), data.replace(ctrl=ctrl))

        for _ in range(nstep):
            stepped = jax.vmap(one)(state, ctrl)
            state = jax.tree.map(lambda x, like: x.astype(like.dtype), stepped, state)
        return state

    def _replace(self, state, **fields):
        return state.replace(**fields)
