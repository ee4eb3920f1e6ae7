"""Physics that failed: what became infinite or not a number, or moves as nothing does."""

import numpy as np

from bson.simulation.engines.base import Engine
from bson.simulation.scene import joint_at

DIVERGED = 100.0  # a speed of a person or robot that only failed physics gives [m/s, rad/s]


def find_faults(engine: Engine, ids: np.ndarray, moving: int) -> dict[int, str]:
    """What went wrong in which of the worlds `ids`: {place in ids: in words}.

    moving: how many degrees of freedom, the first ones, are people's and the robot's own, without its wheels.
    """
    faults = engine.warnings(ids)
    speed = np.abs(engine.qvel[ids, :moving])
    for row in np.flatnonzero(~(speed <= DIVERGED).all(axis=-1)):
        if row not in faults:
            fastest = int(speed[row].argmax())
            name = joint_at(engine.model, "jnt_dofadr", fastest)
            faults[int(row)] = f"{name} moves at {speed[row, fastest]:.0f} m/s or rad/s"
    return faults
