"""The shapes that stand for a person and for a goal."""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from macid.state import GOAL_RADIUS, HEIGHT, RADIUS


class Part(NamedTuple):
    """A shape of what stands for a person or a goal."""

    kind: mujoco.mjtGeom
    size: tuple[float, float, float]  #: as MuJoCo's geoms have it [m]
    place: tuple[float, float, float]  #: of its middle: ahead of the axis, to the left, above the ground [m]
    shade: float = 1.0  #: the colour is this share of the whole's; 0: dark, as a visor
    alpha: float = 1.0
    glow: float = 0.0

    def colour(self, rgb: ArrayLike) -> np.ndarray:
        """The part's colour (..., 3), where the whole has the colour `rgb` (..., 3)."""
        return np.broadcast_to(_VISOR_RGB, np.shape(rgb)) if self.shade == 0 else self.shade * np.asarray(rgb)


_VISOR_RGB = (0.1, 0.1, 0.12)
_BOX, _BALL, _TUBE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_ELLIPSOID, mujoco.mjtGeom.mjGEOM_CYLINDER
_WAIST, _HEAD, _VISOR = 1.16, 0.19, 0.13  # height; radius of the head, and how far ahead of its middle eyes are [m]
FIGURE_PARTS = 4  # shapes in a person's figure


def figure(radius: float = RADIUS) -> tuple[Part, ...]:
    """A person inside its cylinder of `radius` [m]: body and head, and a visor where it faces."""
    slim = (1.0 + radius / RADIUS) / 2  # heads differ less than shoulders do
    head, visor = _HEAD * slim, _VISOR * slim
    return (
        Part(_TUBE, (radius, _WAIST / 2, 0), (0, 0, _WAIST / 2), glow=0.15),
        Part(_BALL, (radius, radius, 0.15), (0, 0, _WAIST), glow=0.15),
        Part(_BALL, (head, head, 0.22), (0, 0, HEIGHT - 0.22), shade=0.85, glow=0.15),
        Part(_BOX, (0.10 * slim, visor, 0.045), (visor, 0, HEIGHT - 0.2), shade=0.0),
    )


#: A goal: pole, flag, a disc as large as the goal is, and a translucent column.
GOAL = (
    Part(_TUBE, (0.035, 0.9, 0), (0, 0, 2.1), glow=0.4),
    Part(_BOX, (0.34, 0.012, 0.22), (0.34, 0, 2.78), glow=0.4),
    Part(_TUBE, (GOAL_RADIUS, 0.008, 0), (0, 0, 0.012), alpha=0.75, glow=0.4),
    Part(_TUBE, (GOAL_RADIUS, 1.25, 0), (0, 0, 1.25), alpha=0.22, glow=0.5),
)
