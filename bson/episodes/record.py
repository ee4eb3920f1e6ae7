"""Episodes as they are kept, and the recorder that keeps them. bson.simulation.data.QUANTITIES says what is kept of a
world."""

import dataclasses
import functools
from typing import TYPE_CHECKING

import numpy as np

from bson.episodes.effects import find_effects
from bson.simulation.data import QUANTITIES
from macid.state import RADIUS

if TYPE_CHECKING:  # these modules load MuJoCo, which comparing results does without
    from bson.episodes.session import Session
    from macid.layout import Layout

_EACH = {quantity.each: quantity for quantity in QUANTITIES if quantity.each}  # {name in an Episode: Quantity}
_LAST = {quantity.last: quantity for quantity in QUANTITIES if quantity.last}


def _fields():
    """The fields of an Episode that come from a world: (name, type), and the default "" for a text."""
    for name, quantity in _LAST.items():
        kind = np.ndarray if quantity.shape else quantity.kind
        yield (name, kind, "") if kind is str else (name, kind)
    for name in _EACH:
        yield name, np.ndarray


_Kept = dataclasses.make_dataclass("_Kept", _fields(), namespace={"__module__": __name__}, frozen=True, kw_only=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Episode(_Kept):
    """One episode of one robot. World frame; metres, seconds, radians. T control steps, K people, B boxes.

    Beside the quantities of its world:

    - shortest: way from the start to the goal around the walls; straight where the router finds none
    - timed_out: the horizon came first
    - period: of control
    - robot_radius: of the circle around its footprint
    - person_radius: everybody's
    - people_goals: (K, 2) where people go first
    - people_alone: (T + 1, K, 3) the same people without the robot, if that was played
    - actions: (T, 2) the agent's, as it gave them, if the recorder was told

    An episode with a fault is not scored.
    """

    shortest: float
    timed_out: bool
    period: float
    robot_radius: float
    people_goals: np.ndarray | None = None
    people_alone: np.ndarray | None = None
    person_radius: float = RADIUS
    actions: np.ndarray | None = None

    @functools.cached_property
    def effects(self) -> dict[str, np.ndarray]:
        """What the robot did to each of the people: see bson.episodes.effects.find_effects; {} without a pair."""
        return find_effects(self)


def _described(kept, *before):
    """A line for each of the fields that come from a world, for people to read."""
    for name, each in kept.items():
        shape, unit = each.shaped(*before), "" if each.unit == "-" else f" [{each.measured()}]"
        yield f"    - {name}: {shape}{' ' if shape else ''}{each.what}{unit}\n"


Episode.__doc__ = (
    f"{Episode.__doc__}\n    Of its world at the end:\n\n{''.join(_described(_LAST))}\n"
    f"    Of its world after the reset and each control step:\n\n{''.join(_described(_EACH, 'T + 1'))}"
)


class Recorder:
    """Records the episode of one world of a session, from its reset on. Call `snap()` after the reset and after each
    step."""

    def __init__(self, session: "Session", index: int):
        self._world, self._index = session.world, index
        self._rows = {name: [] for name in _EACH}
        self._people_goals = self._world.destinations(index)
        self._actions = []
        self.snap()

    def snap(self, action: np.ndarray | None = None) -> None:
        """Appends the world's present state, and the `action` (2,) of the control step that led there."""
        if action is not None:
            self._actions.append(np.array(action, dtype=float))
        for name, rows in self._rows.items():
            rows.append(np.array(getattr(self._world, _EACH[name].name)[self._index]))

    def episode(self) -> Episode:
        """The Episode so far."""
        world, index = self._world, self._index
        last = {name: getattr(world, quantity.name)[index] for name, quantity in _LAST.items()}
        return Episode(
            **{name: value.copy() if _LAST[name].shape else _LAST[name].kind(value) for name, value in last.items()},
            **{name: np.array(rows) for name, rows in self._rows.items()},
            shortest=self._shortest(),
            timed_out=bool(world.steps[index] >= world.config.horizon and not world.arrived[index]),
            period=world.config.control_period,
            robot_radius=world.config.robot.radius,
            people_goals=self._people_goals,
            actions=np.array(self._actions) if self._actions else None,
            person_radius=world.config.person_radius,
        )

    def _shortest(self):
        world, index = self._world, self._index
        start, radius = self._rows["pose"][0][:2], world.config.robot.radius
        return shortest_way(world.layouts[index], start, world.goal[index], radius)


def shortest_way(layout: "Layout", start: np.ndarray, goal: np.ndarray, radius: float) -> float:
    """Length [m] of the router's shortest way on `layout` from `start` to `goal` (2,) for a robot of `radius` [m], or
    of the straight way where it finds none."""
    from macid.routing import Router  # here, as metrics, which import this module, do without the router

    try:
        way = Router(layout, radius).path(start, goal)
    except ValueError:  # a passage may be wider than the robot and narrower than a grid can tell
        way = goal[None]
    return float(np.hypot(*np.diff(np.vstack([start, way]), axis=0).T).sum())
