"""One step, two engines: MuJoCo's threaded batch simulator, and MJX for accelerators.

Both are functional, `step(state, command) -> state`, can sit in the same jitted `lax.scan`, and are read as the same
`CrowdState`; nothing behind this file asks which engine runs.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np

from macid import geometry
from macid.state import CONTACT_GAP, RADIUS, CrowdState
from macid.threads import physics_threads

ENGINES = ("native", "mjx")
DIVERGED = 100.0  # a speed that only failed physics gives [m/s, rad/s]
_UNROLLED = 50  # physics steps of a decision up to which XLA compiles each; a loop's sums may differ in the last bit


def repeat(step, carried, number):
    """`carried = step(carried)`, `number` times, in jitted code: written out for usual periods, else a loop, which takes no
    longer to compile however many steps it has."""
    if number > _UNROLLED:
        return jax.lax.fori_loop(0, number, lambda _, carried: step(carried), carried)
    for _ in range(number):
        carried = step(carried)
    return carried


def touching(position, boxes):
    """Whether each person of `position` (..., K, 2) is within CONTACT_GAP of a person or of `boxes` (..., B, 5): (..., K).

    A collision is this geometric test on both engines, so that scores don't depend on solver details.
    """
    xp = position.__array_namespace__()
    people = xp.any(touching_people(position), axis=-1)
    to_boxes = geometry.point_box_distance(position, boxes[..., None, :, :])
    return people | xp.any(to_boxes <= RADIUS + CONTACT_GAP, axis=-1)


def touching_people(position):
    """Who touches whom of `position` (..., K, 2): (..., K, K), nobody oneself."""
    return geometry.pairs_within(position, 2 * RADIUS + CONTACT_GAP)


def read_crowd(qpos, qvel, number, boxes):
    """The CrowdState of the first `number` pedestrians in `qpos` (..., nq) and `qvel` (..., nv), among `boxes` (..., B, 5)."""
    pose = qpos[..., : 3 * number].reshape(*qpos.shape[:-1], number, 3)
    rate = qvel[..., : 3 * number].reshape(*qvel.shape[:-1], number, 3)
    position = pose[..., :2]
    return CrowdState(position, pose[..., 2], rate[..., :2], rate[..., 2], touching(position, boxes))


class NativeState(NamedTuple):
    """The part of MuJoCo's state that a crowd's next step depends on, one row a world."""

    qpos: Any  #: (nworld, 3 K)
    qvel: Any  #: (nworld, 3 K)
    qacc_warmstart: Any  #: (nworld, 3 K)


class _Engine:
    """What both engines share: the model, sizes, and reading."""

    def __init__(self, model, number, boxes, nworld):
        self.model, self.number, self.nworld = model, number, nworld
        self.boxes = jnp.asarray(boxes, jnp.float32)

    def _pack(self, position, yaw):
        pose = jnp.concatenate([jnp.asarray(position), jnp.asarray(yaw)[..., None]], axis=-1)
        return pose.reshape(self.nworld, 3 * self.number).astype(jnp.float32)

    def read(self, state):
        """The CrowdState, leading axes (nworld, K)."""
        return read_crowd(state.qpos, state.qvel, self.number, self.boxes)

    def faults(self, state):
        """What of the physics failed in each world: "" where nothing did. `state`: the last one.

        Of the native engine all that it has simulated counts: MuJoCo puts a state that is not finite back to the model's
        default, takes a command that is none for 0, and goes on from there; only its count of warnings tells.
        """
        speed = np.abs(np.asarray(state.qvel)).max(axis=-1, initial=0.0)
        finite = np.isfinite(np.asarray(state.qpos)).all(axis=-1)
        return [
            warned or ("" if good and fast <= DIVERGED else f"somebody moves at {fast:.0f} m/s or rad/s")
            for warned, good, fast in zip(self._warned(), finite, speed, strict=True)
        ]

    def _warned(self):
        """What MuJoCo warned of in each world, in its words."""
        return [""] * self.nworld

    def place(self, state, who, position):
        """The state with the people `who` (nworld, K) bool put at rest at `position` (nworld, K, 2) [m]."""
        shape = (self.nworld, self.number, 3)
        pose = state.qpos.reshape(shape)
        moved = jnp.concatenate([jnp.broadcast_to(position, (*shape[:2], 2)), pose[..., 2:]], axis=-1)
        qpos = jnp.where(who[..., None], moved, pose).reshape(state.qpos.shape)
        still = jnp.where(jnp.repeat(who, 3, axis=-1), 0.0, 1.0)
        return self._replace(
            state,
            qpos=qpos.astype(jnp.float32),
            qvel=state.qvel * still,
            qacc_warmstart=state.qacc_warmstart * still,
        )


class NativePhysics(_Engine):
    """`nworld` worlds of `number` pedestrians on MuJoCo's batch simulator, reached from jitted code by a callback."""

    def __init__(self, model, number, boxes, nworld, nthread=0):
        super().__init__(model, number, boxes, nworld)
        self._batch = mujoco.batch.Batch(model, nworld, nthread or physics_threads())
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._warmstart, self._ctrl = self._batch.bind("qacc_warmstart"), self._batch.bind("ctrl")

    def init(self, position, yaw):
        """The state with everybody at rest at `position` (nworld, K, 2) [m], `yaw` (nworld, K) [rad]."""
        qpos = self._pack(position, yaw)
        return NativeState(qpos, jnp.zeros_like(qpos), jnp.zeros_like(qpos))

    def step(self, state, command, nstep=1):
        """The state after `nstep` physics steps under `command` (nworld, K, 3): world velocity [m/s], yaw rate [rad/s]."""

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
        return NativeState(*jax.pure_callback(run, shapes, *state, ctrl, vmap_method="broadcast_all"))

    def _warned(self):
        told = []
        for warnings in np.asarray(self._batch.warning):
            number = int(warnings[:, 1].argmax())
            what = mujoco.mju_warningText(number, int(warnings[number, 0])).split(". ")[0]
            told.append(what if warnings[number, 1] else "")
        return told

    def _replace(self, state, **fields):
        return state._replace(**fields)


class MjxPhysics(_Engine):
    """The same on MJX: one `mjx.Data` with a leading world axis."""

    def __init__(self, model, number, boxes, nworld):
        super().__init__(model, number, boxes, nworld)
        from mujoco import mjx

        self._mjx = mjx
        self._model = mjx.put_model(model)

    def init(self, position, yaw):
        """As NativePhysics.init."""
        mjx = self._mjx

        def one(qpos):
            data = mjx.make_data(self.model).replace(qpos=qpos)
            return mjx.forward(self._model, data)

        example = mjx.make_data(self.model)
        data = jax.vmap(one)(self._pack(position, yaw))
        # A step's output must have its input's types, or every second call would compile anew.
        return jax.tree.map(lambda x, like: jnp.asarray(x, jnp.asarray(like).dtype), data, example)

    def step(self, state, command, nstep=1):
        """As NativePhysics.step."""
        ctrl = command.reshape(self.nworld, 3 * self.number)
        gain = self._model.actuator_gainprm[:, 0]
        limit = jnp.where(self._model.actuator_forcelimited, self._model.actuator_forcerange[:, 1], jnp.inf)

        def one(data, ctrl):
            # The implicit integrators damp by an actuator's velocity gain, MuJoCo's not where the actuator is at its
            # limit, MJX's everywhere: so that the engines agree, an actuator at its limit is a constant force here.
            force = gain * (ctrl - data.qvel)
            at_limit = jnp.abs(force) >= limit
            ctrl = jnp.where(at_limit, jnp.clip(force, -limit, limit) / gain, ctrl)
            bias = jnp.where(at_limit[:, None], 0.0, self._model.actuator_biasprm)
            return self._mjx.step(self._model.replace(actuator_biasprm=bias), data.replace(ctrl=ctrl))

        for _ in range(nstep):
            stepped = jax.vmap(one)(state, ctrl)
            state = jax.tree.map(lambda x, like: x.astype(like.dtype), stepped, state)
        return state

    def _replace(self, state, **fields):
        return state.replace(**fields)


def make_physics(engine, model, number, boxes, nworld):
    """The engine named `engine` ('native' or 'mjx') for `nworld` worlds of `model`, whose crowd has `number` people."""
    if engine == "native":
        return NativePhysics(model, number, boxes, nworld)
    if engine == "mjx":
        return MjxPhysics(model, number, boxes, nworld)
    raise ValueError(f"Unknown engine '{engine}'. Choose one of {', '.join(ENGINES)}.")
