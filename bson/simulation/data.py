"""The quantities of a world, named once.

A World has each row of QUANTITIES as an array with a leading axis (nworld,). The `info` of environments, the record
that a Recorder keeps of each control step, and the fields of an Episode come from these rows.
"""

from typing import NamedTuple

import numpy as np

MAP_RESOLUTION = 0.25  # of the occupancy map [m]


class Quantity(NamedTuple):
    """A row of QUANTITIES."""

    name: str  # the World's attribute, and the key in `info`
    shape: tuple[int | str, ...]  # of one world's value; K: number of people, B: of boxes, nq: of MuJoCo's coordinates
    kind: type  # int, float, bool or str
    unit: str  # "-" for a plain number
    frame: str  # "world" or "robot"; "" for a quantity without a frame
    what: str
    info: bool = False  # whether environments give it as `info`
    each: str | None = None  # its name in an Episode that keeps it after the reset and each control step: (T + 1, ...)
    last: str | None = None  # its name in an Episode that keeps its value at the end
    held: bool = True  # whether the World has an array of its own for it; physics or people hold the others

    def shaped(self, *before: str) -> str:
        """The shape as text, with the sizes `before` in front; "" for a single number."""
        sides = [*before, *map(str, self.shape)]
        return f"({', '.join(sides)}{',' * (len(sides) == 1)})" if sides else ""

    def measured(self) -> str:
        """Frame and unit, as text."""
        return ", ".join(filter(None, (self.frame, self.unit)))

    def empty(self, nworld: int, **sizes: int) -> np.ndarray:
        """Zeros (no text) for `nworld` worlds; sizes: the numbers for the letters in `shape`."""
        shape = (nworld, *(sizes[side] if isinstance(side, str) else side for side in self.shape))
        return np.full(shape, "", object) if self.kind is str else np.zeros(shape, self.kind)


# fmt: off
QUANTITIES = (
    Quantity("seed", (), int, "-", "", "seed of the episode", info=True, last="seed"),
    Quantity("time", (), float, "s", "", "since the reset", info=True, last="duration"),
    Quantity("pose", (3,), float, "m, m, rad", "world", "the robot's x, y, yaw", info=True, each="pose"),
    Quantity("goal", (2,), float, "m", "world", "position of the robot's goal", info=True, last="goal"),
    Quantity("start_distance", (), float, "m", "", "d_i: from the start to the goal, as the crow flies",
             info=True, last="start_distance"),
    Quantity("distance", (), float, "m", "", "d_f: from here to the goal, as the crow flies",
             info=True, last="final_distance"),
    Quantity("travelled", (), float, "m", "", "way driven", info=True, last="travelled"),
    Quantity("collisions", (), int, "steps of 0.02 s", "", "steps in which the robot touched anything",
             info=True, each="collisions_so_far", last="collisions"),
    Quantity("collisions_person", (), int, "steps of 0.02 s", "", "steps in which it touched a person",
             info=True, last="collisions_person"),
    Quantity("collisions_robot_on_person", (), int, "steps of 0.02 s", "",
             "of those: it moved towards the person at more than 0.05 m/s",
             info=True, last="collisions_robot_on_person"),
    Quantity("collisions_obstacle", (), int, "steps of 0.02 s", "", "steps in which it touched an obstacle",
             info=True, last="collisions_obstacle"),
    Quantity("collisions_wall", (), int, "steps of 0.02 s", "", "steps in which it touched an outer wall",
             info=True, last="collisions_wall"),
    Quantity("nearest_person", (), float, "m", "", "to the nearest person, surface to surface; infinity without any",
             info=True, each="nearest_person"),
    Quantity("arrived", (), bool, "-", "", "whether the robot is at its goal", info=True, last="arrived"),
    Quantity("fault", (), str, "-", "",
             "empty, or what of the physics became infinite or not a number; such a world stays as it was",
             info=True, last="fault"),
    Quantity("steps", (), int, "-", "", "control steps since the reset"),
    Quantity("velocity", (2,), float, "m/s, rad/s", "robot", "its speed ahead and yaw rate", each="velocity"),
    Quantity("lcf", ("K",), float, "-", "", "each person's local coordination factor; may be changed at any time",
             last="lcf"),
    Quantity("models", ("K",), int, "-", "", "which of the config's pedestrian models each person is"),
    Quantity("boxes", ("B", 5), float, "m, m, m, m, rad", "world",
             "outer walls (the first four) and obstacles: x, y, half lengths, yaw", last="boxes"),
    Quantity("people", ("K", 3), float, "m, m, rad", "world", "each person's x, y, yaw", each="people", held=False),
    Quantity("people_velocity", ("K", 2), float, "m/s", "world", "each person's velocity",
             each="people_velocity", held=False),
    Quantity("people_goals", ("K", 2), float, "m", "world", "where each person heads: the next waypoint, or the goal",
             held=False),
    Quantity("qpos", ("nq",), float, "m, rad", "world", "MuJoCo's configuration, for films", each="qpos", held=False),
)
# fmt: on

INFO = tuple(quantity.name for quantity in QUANTITIES if quantity.info)
