"""People's wishes, drawn: the speeds at which they want to walk, and who walks with whom.

Everything here is drawn after an episode's starts and goals, so that these stay what they are without it.
"""

import math
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from macid import geometry
from macid.documents import is_number, shown
from macid.layout import Layout, clearance
from macid.routing import lines_are_free
from macid.state import MAX_SPEED, RADIUS, TOP_SPEED, Traits

PreferredSpeed: TypeAlias = float | tuple[float, float] | str | None
HUMAN = "human"  # the preferred speeds of people in the street
# Mean and standard deviation [m/s]. The mean is Weidmann's (Transporttechnik der Fussgaenger, 1993); people in the open
# scenes of macid.human differ by more than his 0.26: their mean speeds have a standard deviation of 0.41.
HUMAN_SPEED = (1.34, 0.36)
HUMAN_RANGE = (0.4, 2.0)  # to which the distribution is cut [m/s]
LEAST_SPEED = 0.1  # [m/s]
APART = (0.6, 0.8)  # between the centres of companions at the start [m]
THREES = 0.25  # share of threes among groups, the rest are twos; about as counted by James, Am. Sociol. Rev. 18, 1953
_ROOM = 0.1  # between a companion's place and all but its group [m]
_SIDES = [math.radians(angle) for angle in (90, -90, 60, -60, 120, -120, 30, -30, 150, -150, 0, 180)]


def check_preferred_speed(value: Any, name: str = "preferred_speed") -> PreferredSpeed:
    """`value` as a preferred speed: None, a number, a range (least, most) [m/s] or HUMAN. Raises ValueError."""
    if value is None or (isinstance(value, str) and value == HUMAN):
        return value
    try:
        pair = (value, value) if is_number(value) else tuple(value)
    except TypeError:
        pair = ()
    if len(pair) != 2 or not all(is_number(each, LEAST_SPEED, TOP_SPEED) for each in pair) or pair[0] > pair[1]:
        raise ValueError(
            f"{name} must be a number or a range (least, most) from {LEAST_SPEED:g} to {TOP_SPEED:g} m/s, '{HUMAN}', "
            f"or None for each model's own, not {shown(value)}."
        )
    return float(value) if is_number(value) else (float(pair[0]), float(pair[1]))


def check_max_speed(value: Any, name: str = "max_speed") -> None:
    """Raises ValueError unless `value` [m/s] is a maximum speed that people may have."""
    if not is_number(value, LEAST_SPEED, TOP_SPEED):
        raise ValueError(f"{name} must be a number from {LEAST_SPEED:g} to {TOP_SPEED:g} m/s, not {shown(value)}.")


def check_companions(value: Any, name: str = "companions") -> None:
    """Raises ValueError unless `value` is a share of people who walk in groups, or None."""
    if value is not None and not is_number(value, 0.0, 1.0):
        raise ValueError(f"{name} must be a share from 0 to 1, or None, not {shown(value)}.")


def draw_preferred_speed(rng: np.random.Generator, preferred: PreferredSpeed, number: int) -> np.ndarray | None:
    """Everybody's preferred speed (number,) [m/s], drawn from the numpy Generator `rng`; None for None, where nothing
    is drawn. HUMAN: the normal distribution of HUMAN_SPEED within HUMAN_RANGE."""
    if preferred is None:
        return None
    if isinstance(preferred, str):
        mean, deviation = HUMAN_SPEED
        least, most = special.ndtr((np.array(HUMAN_RANGE) - mean) / deviation)
        return mean + deviation * special.ndtri(rng.uniform(least, most, number))
    if isinstance(preferred, tuple):
        return rng.uniform(preferred[0], preferred[1], number)
    return np.full(number, preferred)


def draw_groups(
    rng: np.random.Generator, number: int, share: float, kinds: np.ndarray | None = None
) -> list[np.ndarray]:
    """Groups of two and three among `number` people, of whom the share `share` walks in groups as far as the numbers
    allow: the people's indices, of each group. kinds: (number,) int; people of different kinds do not walk together.
    """
    order = rng.permutation(number)
    kinds = np.zeros(number, int) if kinds is None else kinds
    groups = []
    for kind in np.unique(kinds):
        waiting = order[kinds[order] == kind]
        waiting = waiting[: round(share * len(waiting))]
        while len(waiting) > 1:
            size = 3 if rng.random() < THREES else 2
            size = {3: 3, 4: 2}.get(len(waiting), min(size, len(waiting)))  # nobody is left over
            groups.append(waiting[:size])
            waiting = waiting[size:]
    return groups


def beside(
    leader: np.ndarray,
    ahead: float,
    apart: float,
    side: int,
    layout: Layout,
    taken: np.ndarray,
    radius: float = RADIUS,
) -> np.ndarray | None:
    """The place (2,) [m] of a person who walks with a `leader` (2,) whose way leads along the angle `ahead` [rad]:
    `apart` [m] from it, abreast on the side `side` (1: left, -1: right) if there is room, else elsewhere around it;
    None where there is none. taken: (N, 2) places of others."""
    places = leader + apart * geometry.heading(ahead + side * np.array(_SIDES))
    free = (np.abs(places) <= layout.size / 2 - radius).all(axis=-1)
    free &= clearance(places, layout.boxes) >= radius + _ROOM / 2
    if len(taken):
        free &= (np.linalg.norm(places[:, None] - taken, axis=-1) >= 2 * radius + _ROOM).all(axis=-1)
    for place in places[free]:
        if lines_are_free(leader, place[None], layout.boxes, radius)[0]:
            return place
    return None


def gather(
    rng: np.random.Generator,
    layout: Layout,
    starts: np.ndarray,
    goals: np.ndarray,
    share: float,
    radius: float = RADIUS,
    kinds: np.ndarray | None = None,
    taken: ArrayLike = (),
    keep_off: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lets the share `share` of people who start at `starts` and go to `goals`, (K, 2) [m], walk in groups: (starts,
    goals, group), the group (K,) being the index of its first person, each person's own where it walks alone.

    A group starts abreast around its first person, and its goals lie side by side; where there is no room for that, all
    go to the first person's goal. A person without a free place beside its group stays where it is and walks alone.
    kinds: as of `draw_groups`; people of one kind keep goals that all of them have. taken, keep_off: as of
    macid.layout.sample_people. All draws are from the numpy Generator `rng`.
    """
    starts, goals, group = starts.copy(), goals.copy(), np.arange(len(starts))
    taken = np.reshape(np.asarray(taken, dtype=float), (-1, 2))
    for first, *others in draw_groups(rng, len(starts), share, kinds):
        ahead = math.atan2(*(goals[first] - starts[first])[::-1])
        left = 1 if rng.random() < 0.5 else -1
        for side, person in zip((left, -left), others, strict=False):
            apart = max(rng.uniform(*APART), 2 * radius + _ROOM / 2)
            rest = np.delete(starts, [first, person], axis=0)
            place = beside(starts[first], ahead, apart, side, layout, rest, radius)
            if place is None or (len(taken) and geometry.norm(taken - place).min() < 2 * radius + keep_off):
                continue
            starts[person], group[person] = place, first
            goals[person] = goals[first]
            if kinds is None:
                goals[person] = goal_beside(goals[first], ahead, apart, side, layout, radius)
    return starts, goals, group


def goal_beside(
    goal: np.ndarray, ahead: float, apart: float, side: int, layout: Layout, radius: float = RADIUS
) -> np.ndarray:
    """The goal (2,) [m] of a person who walks with another one to its `goal` (2,): beside it, as `beside` has it, or
    the same one where there is no room."""
    found = beside(goal, ahead, apart, side, layout, np.empty((0, 2)), radius)
    return goal if found is None else found


def shared_goals(
    layout: Layout, group: np.ndarray, places: np.ndarray, goals: np.ndarray, radius: float = RADIUS, same: bool = False
) -> np.ndarray:
    """`goals` (K, 2) [m] of people at `places` (K, 2), with everybody's goal beside that of the first person of its
    `group` (K,); with `same`, it is that goal."""
    goals, sides = goals.copy(), {}
    for person in np.flatnonzero(group != np.arange(len(group))):
        first = group[person]
        if same:
            goals[person] = goals[first]
            continue
        sides[first] = -sides.get(first, -1)
        ahead = math.atan2(*(goals[first] - places[first])[::-1])
        apart = max(sum(APART) / 2, 2 * radius + _ROOM / 2)
        goals[person] = goal_beside(goals[first], ahead, apart, sides[first], layout, radius)
    return goals


def make_traits(
    radius: float = RADIUS,
    preferred_speed: np.ndarray | None = None,
    max_speed: float = MAX_SPEED,
    group: np.ndarray | None = None,
    number: int = 0,
) -> Traits:
    """The Traits of `number` people, with None for what is as the paper has it. People of one `group` (number,) want
    to walk at one speed, that of its first person."""
    if preferred_speed is not None and group is not None:
        preferred_speed = preferred_speed[group]
    return Traits(
        None if radius == RADIUS else np.full(number, radius, np.float32),
        None if preferred_speed is None else np.asarray(preferred_speed, np.float32),
        None if max_speed == MAX_SPEED else np.full(number, max_speed, np.float32),
        None if group is None else np.asarray(group, np.int32),
    )
