"""The robot's worlds in MJX-Warp: MuJoCo's physics of many worlds at once on a GPU, and on a CPU for tests.

All here is one world's, and pure: jax.vmap makes it many, and MJX-Warp then steps them together. A step agrees with
MuJoCo's own to a tolerance, not bit for bit, and on a GPU two runs agree no better than that.
"""

import dataclasses
import logging
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from macid.files import UsageError

SOLVERS = {"newton": mujoco.mjtSolver.mjSOL_NEWTON, "cg": mujoco.mjtSolver.mjSOL_CG}
_SENSORS_OFF = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)


@dataclasses.dataclass(frozen=True)
class WarpConfig:
    """What the engine may take: limits of the solver, and room for contacts.

    contacts: of all worlds together, per world, beside 64; people and a robot in a crowd have a dozen. rows: of one
    world's constraints, per person, beside 64. Too few of either is an error where a world needs more, and the error
    tells which.
    """

    solver: str = "newton"
    iterations: int = 8
    ls_iterations: int = 16
    contacts: float = 16.0
    rows: float = 6.0
    graph_mode: str | None = None  # of Warp's calls: JAX, WARP, WARP_STAGED, WARP_STAGED_EX, NONE; None: MJX's choice

    def __post_init__(self):
        if self.solver not in SOLVERS:
            raise ValueError(f"solver must be one of {', '.join(SOLVERS)}, not {self.solver!r}.")


class Motion(NamedTuple):
    """The part of MuJoCo's state that a world's next step depends on."""

    qpos: Any  #: (nq,)
    qvel: Any  #: (nv,)
    warmstart: Any  #: (nv,)
    ctrl: Any  #: (nu,)


def _import_warp():
    """Warp, without its greeting. Raises UsageError where it is not installed."""
    try:
        import warp
    except ImportError:
        raise UsageError("The engine 'warp' needs warp-lang: pip install 'bson[warp]'.") from None
    warp.config.log_level = logging.ERROR  # no greeting, and no line for each kernel that is compiled
    return warp


class WarpEngine:
    """Physics of the worlds of one MjSpec, of which `nworld` are stepped at once under jax.vmap.

    model: the MjModel, with the solver's limits of `config`. people: how many pedestrians come first in it.
    """

    def __init__(self, spec, people, nworld=1, config=None):
        warp = _import_warp()
        from mujoco import mjx  # tells, where it is imported without Warp, that there is none

        self._mjx = mjx
        self.config, self.nworld, self.people = config or WarpConfig(), nworld, people
        config = self.config
        spec.option.iterations, spec.option.ls_iterations = config.iterations, config.ls_iterations
        spec.option.solver = SOLVERS[config.solver]
        self.model = model = spec.compile()
        if model.na:
            raise ValueError("The engine 'warp' has no motors with a state of their own (dyntype).")
        mode = {"graph_mode": getattr(warp.JaxCallableGraphMode, config.graph_mode)} if config.graph_mode else {}
        put = mjx.put_model(model, impl="warp", **mode)
        put = put.tree_replace({"opt._impl.warn_overflow": 0})  # told by `overflow` instead
        self._model = put
        self._quiet = put.tree_replace({"opt.disableflags": put.opt.disableflags | _SENSORS_OFF})
        self.contacts = 64 + int(np.ceil(config.contacts * nworld))
        self.rows = 64 + int(np.ceil(config.rows * people))
        self._data = mjx.make_data(model, impl="warp", naconmax=self.contacts, njmax=self.rows)
        self._height = jnp.asarray(self._data.mocap_pos[:, 2])

    def rest(self, qpos):
        """The Motion of a world at rest in the configuration `qpos` (nq,)."""
        nv, nu = self.model.nv, self.model.nu
        return Motion(qpos, jnp.zeros(nv, jnp.float32), jnp.zeros(nv, jnp.float32), jnp.zeros(nu, jnp.float32))

    def _load(self, motion, boxes):
        """MJX's Data of a world in `motion` among `boxes` (B, 5)."""
        half = boxes[:, 4] / 2
        zero = jnp.zeros_like(half)
        return self._data.replace(
            qpos=motion.qpos,
            qvel=motion.qvel,
            qacc_warmstart=motion.warmstart,
            ctrl=motion.ctrl,
            mocap_pos=jnp.concatenate([boxes[:, :2], self._height[:, None]], axis=-1),
            mocap_quat=jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], axis=-1),
        )

    def step(self, motion, boxes, number):
        """`number` physics steps: the Motion after them, the configuration after each (number, nq), and `overflow`.

        overflow: 0, or the bits of what found no room (Warp's OverflowType); `explain` puts them into words.
        """

        def one(data, _):
            data = self._mjx.step(self._quiet, data)
            return data, data.qpos

        data, record = jax.lax.scan(one, self._load(motion, boxes), None, length=number)
        after = Motion(data.qpos, data.qvel, data.qacc_warmstart, motion.ctrl)
        return after, record, data._impl.overflow & _LOST

    def sensordata(self, motion, boxes):
        """What MuJoCo's own sensors (IMU) read: (nsensordata,)."""
        return self._mjx.forward(self._model, self._load(motion, boxes)).sensordata

    def explain(self, overflow):
        """The bits `overflow` of a step in one sentence."""
        told = []
        if overflow & _ROWS:
            told.append(
                f"a world needs more than {self.rows} constraint rows: raise WarpConfig.rows ({self.config.rows:g})"
            )
        if overflow & ~_ROWS:
            told.append(
                f"the {self.nworld} worlds need more than {self.contacts} contacts: raise WarpConfig.contacts "
                f"({self.config.contacts:g})"
            )
        return "Physics ran out of room: " + "; ".join(told) + "."


# Of Warp's OverflowType: what loses contacts or rows (a solver that stops at its limit loses nothing).
_ROWS = 1 << 0 | 1 << 1
_LOST = _ROWS | 1 << 2 | 1 << 3 | 1 << 4
