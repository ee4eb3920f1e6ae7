"""The interface of an engine, and the code that engines share."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from macid import contacts
from macid.files import UsageError
from macid.geometry import Array
from macid.state import RADIUS, CrowdState, Traits

T = TypeVar("T")
DIVERGED = 100.0  # only failed physics gives such a speed [m/s, rad/s]
_UNROLLED = 50  # up to this many physics steps a decision, XLA compiles each; a loop's sums may differ in the last bit


class Engine(Protocol):
    """`nworld` worlds of a crowd of `number` people. Its state is a tree of arrays with a leading axis
    (nworld,)."""

    number: int
    nworld: int
    boxes: Any  #: (B, 5), the same in all worlds
    shards: bool  #: whether the worlds can lie on several of JAX's devices
    stacks: bool  #: whether batches under vmap, such as several seeds, are stepped at once, not one by one

    def init(self, position: Array, yaw: Array) -> Any:
        """The state with everybody at rest at `position` (nworld, K, 2) [m], `yaw` (nworld, K) [rad]. Jittable."""
        ...

    def step(self, state: Any, command: Array, nstep: int = 1) -> Any:
        """The state after `nstep` physics steps under `command` (nworld, K, 3): world velocity [m/s], yaw rate [rad/s].
        Jittable, and mappable over a leading axis of both."""
        ...

    def read(self, state: Any) -> CrowdState:
        """The crowds of a state, leading axes (nworld, K). Jittable."""
        ...

    def place(
        self, state: Any, who: Array, position: Array, velocity: Array | None = None, yaw: Array | None = None
    ) -> Any:
        """The state with the people `who` (nworld, K) bool put at `position` (nworld, K, 2) [m]. Jittable.

        velocity: (nworld, K, 2) [m/s], world frame, with which they come (default: at rest). yaw: (nworld, K) [rad]
        (default: as it is)."""
        ...

    def faults(self, state: Any) -> list[str]:
        """The failures of physics in each world: "" where nothing failed. state: the last state. Raises as `check`."""
        ...

    def check(self) -> None:
        """Raises EngineOverflow where the engine had too little room for what it has simulated so far.

        Call it after the simulation has ended: jitted code can't raise."""
        ...


class EngineOverflow(UsageError):
    """An engine had too little room for contacts: its results are wrong. The text names the option to raise."""


@dataclasses.dataclass(frozen=True)
class NoOptions:
    """The options of an engine without options."""


NO_OPTIONS = NoOptions()


class FlatState(NamedTuple):
    """The part of MuJoCo's state that a crowd's next step depends on, one row a world."""

    qpos: Any  #: (nworld, 3 K)
    qvel: Any  #: (nworld, 3 K)
    qacc_warmstart: Any  #: (nworld, 3 K)


class CrowdEngine:
    """The base of engines: the model, sizes, and reading.

    radius: everybody's [m], as the model has it; None where it is the paper's.
    """

    shards = stacks = False
    options = NoOptions  # the dataclass of the options after the engine's name

    def __init__(self, model: mujoco.MjModel, number: int, boxes: Array, nworld: int):
        self.model, self.number, self.nworld = model, number, nworld
        self.boxes = jnp.asarray(boxes, jnp.float32)
        radius = float(model.geom("person0/proxy").size[0]) if number else RADIUS
        self.radius = None if radius == RADIUS else radius

    def _pack(self, position, yaw):
        pose = jnp.concatenate([jnp.asarray(position), jnp.asarray(yaw)[..., None]], axis=-1)
        return pose.reshape(self.nworld, 3 * self.number).astype(jnp.float32)

    def init(self, position: Array, yaw: Array) -> Any:
        """As Engine.init, for engines whose state is a FlatState."""
        qpos = self._pack(position, yaw)
        return FlatState(qpos, jnp.zeros_like(qpos), jnp.zeros_like(qpos))

    def read(self, state: Any) -> CrowdState:
        """As Engine.read."""
        return read_crowd(state.qpos, state.qvel, self.number, self.boxes, self.radius)

    def faults(self, state: Any) -> list[str]:
        """As Engine.faults.

        The native engine reports the failures of everything that it has simulated. MuJoCo puts a state that is not
        finite back to the model's default, takes a command that is not a number for 0, and goes on from there; only its
        count of warnings tells.
        """
        speed = np.abs(np.asarray(state.qvel)).max(axis=-1, initial=0.0)
        finite = np.asarray(np.isfinite(np.asarray(state.qpos)).all(axis=-1))
        self.check()
        return [
            warned or ("" if good and fast <= DIVERGED else f"somebody moves at {fast:.0f} m/s or rad/s")
            for warned, good, fast in zip(self._warned(), finite, speed, strict=True)
        ]

    def check(self) -> None:
        """As Engine.check: this engine finds room as it goes."""

    def _warned(self) -> list[str]:
        """MuJoCo's warnings in each world, in its words."""
        return [""] * self.nworld

    def place(
        self, state: Any, who: Array, position: Array, velocity: Array | None = None, yaw: Array | None = None
    ) -> Any:
        """As Engine.place."""
        shape = (self.nworld, self.number, 3)
        pose = state.qpos.reshape(shape)
        facing = pose[..., 2:] if yaw is None else jnp.broadcast_to(yaw, shape[:2])[..., None]
        moved = jnp.concatenate([jnp.broadcast_to(position, (*shape[:2], 2)), facing], axis=-1)
        qpos = jnp.where(who[..., None], moved, pose).reshape(state.qpos.shape)
        still = jnp.where(jnp.repeat(who, 3, axis=-1), 0.0, 1.0)
        qvel = state.qvel * still
        if velocity is not None:
            coming = jnp.where(who[..., None], jnp.broadcast_to(velocity, (*shape[:2], 2)), 0.0)
            coming = jnp.concatenate([coming, jnp.zeros((*shape[:2], 1))], axis=-1)
            qvel = (qvel + coming.reshape(qvel.shape)).astype(jnp.float32)
        return self._replace(
            state,
            qpos=qpos.astype(jnp.float32),
            qvel=qvel,
            qacc_warmstart=state.qacc_warmstart * still,
        )

    def _replace(self, state, **fields) -> Any:
        return state._replace(**fields)


def read_crowd(qpos: Array, qvel: Array, number: int, boxes: Array, radius: float | None = None) -> CrowdState:
    """The CrowdState of the first `number` people of `qpos` (..., nq), `qvel` (..., nv) among `boxes` (..., B, 5).
    radius: everybody's [m]; None: the paper's."""
    pose = qpos[..., : 3 * number].reshape(*qpos.shape[:-1], number, 3)
    rate = qvel[..., : 3 * number].reshape(*qvel.shape[:-1], number, 3)
    position = pose[..., :2]
    touching = contacts.touching(position, boxes, RADIUS if radius is None else radius)
    traits = Traits() if radius is None else Traits(radius=jnp.full(position.shape[:-1], radius, jnp.float32))
    return CrowdState(position, pose[..., 2], rate[..., :2], rate[..., 2], touching, traits)


def repeat(step: Callable[[T], T], carried: T, number: int) -> T:
    """`carried = step(carried)`, `number` times, in jitted code: written out for usual periods, else a loop, whose
    compilation takes no longer for more steps."""
    if number > _UNROLLED:
        return jax.lax.fori_loop(0, number, lambda _, carried: step(carried), carried)
    for _ in range(number):
        carried = step(carried)
    return carried
