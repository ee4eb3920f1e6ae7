"""Failures of physics: values that became infinite or not a number, or impossible speeds."""

import numpy as np

from bson.simulation.engines.base import Engine
from bson.simulation.scene import joint_at

DIVERGED = 100.0  # only failed physics moves a person or robot this fast [m/s, rad/s]


def find_faults(engine: Engine, ids: np.ndarray, moving: int) -> dict[int, str]:
    """The failures of physics in the worlds `ids`: {index into ids: in words}.

    moving: the number of degrees of freedom of the people and of the robot without its wheels; they come first.
    """
    faults = engine.warnings(ids)
    speed = np.abs(engine.qvel[ids, :moving])
    for row in np.flatnonzero(~(speed <= DIVERGED).all(axis=-1)):
        if row not in faults:
            fastest = int(speed[row].argmax())
            name = joint_at(engine.model, "jnt_dofadr", fastest)
            faults[int(row)] = f"{name} moves at {speed[row, fastest]:.0f} m/s or rad/s"
    return faults
