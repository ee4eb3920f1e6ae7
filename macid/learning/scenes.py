"""Where `macid-human` learns: small scenes, sparse and crowded, in which people go round loops of gates.

A scene's people never stop: each follows its loop, a closed row of gates, and goes on to the next gate when it is
through one. So densities stay as they were drawn, for as long as an episode lasts.

| scene | what | people | persons/m2 |
|---|---|---|---|
| open | a square, goals drawn | 10 to 48 | 0.04 to 0.19 |
| crossing | two corridors of 4 m that cross | 8 to 40 | 0.07 to 0.34 |
| two-ways | a corridor of 3.2 m, half the people each way | 10 to 64 | 0.2 to 1.1 |
| ring | a corridor of 2 m in a square ring, everybody the same way | 10 to 120 | 0.2 to 2.2 |
| exits | two rooms with two doors, 0.9 and 1.5 m: through one, back through the other | 10 to 64 | 0.1 to 0.8 |
| bottleneck | a corridor of 4 m that narrows to 1.6 m, both ways | 6 to 40 | 0.1 to 0.5 |
| boxes | a square with nine boxes; goals behind them, of which nobody tells the way | 8 to 30 | 0.03 to 0.12 |

A gate is a row (x, y, direction x, direction y, half width) [m]. A person heads for the point of the gate that lies
nearest, half a metre beyond it, and is through when it has crossed the gate's line. A gate of half width 0 is a place,
reached within 0.5 m.
"""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np

from macid.geometry import Array, norm, point_box_distance
from macid.layout import Layout, NoFreeSpace, clearance
from macid.routing import Router
from macid.state import GOAL_RADIUS

BEYOND = 0.5  # a gate's goal lies behind its line [m]
_SHOULDER = 0.25  # people keep it from a gate's ends [m]
_TRIES = 2000
_CELL = 0.5  # side of a cell that knows the ways [m]
_BODY = 0.2  # radius of a person for whom the ways are [m]
_NEAR_PLACE = 1.5  # of a place: goals of companions lie beside it [m]


@dataclasses.dataclass(frozen=True)
class Scene:
    """A scene's map and loops. number: people at most. loops: (L, G, 5) gates. starts: for each loop and gate the box
    (x, y, half x, half y) in which people begin who head for it: (L, G, 4). places: (P, 2) [m], from which goals are
    drawn; None: anywhere on the map."""

    name: str
    layout: Layout
    number: int
    fewest: int
    loops: np.ndarray
    starts: np.ndarray
    places: np.ndarray | None = None

    @functools.cached_property
    def ways(self) -> np.ndarray:
        """Unit vectors along a shortest way to each of the places, from each of the map's cells of _CELL: (P, N, N, 2),
        a row for each y; 0 where it leads straight there. Where nobody can stand, they are those of the nearest cell
        where one can."""
        places = np.empty((0, 2)) if self.places is None else self.places
        axis = np.arange(_CELL / 2, self.layout.size, _CELL) - self.layout.size / 2
        cells = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        along = np.zeros((len(places), *cells.shape))
        free = np.flatnonzero(clearance(cells, self.layout.boxes) > _BODY)
        nearest = free[norm(cells[:, None] - cells[free]).argmin(axis=-1)] if len(places) else free
        router = Router(self.layout, _BODY + 0.15)  # ways with some room
        for number, place in enumerate(places):
            found = router.paths(cells[free], np.tile(place, (len(free), 1)))
            for cell, way in zip(free, found, strict=True):
                beyond = norm(way - cells[cell]) > _CELL
                corner = int(beyond.argmax()) if beyond.any() else len(way) - 1
                if corner < len(way) - 1:
                    step = way[corner] - cells[cell]
                    along[number, cell] = step / norm(step)
            along[number] = along[number, nearest]
        return along.reshape(len(places), len(axis), len(axis), 2)


class Drawn(NamedTuple):
    """The beginnings of `N` crowds of a scene."""

    position: np.ndarray  #: (N, K, 2) [m]
    gates: np.ndarray  #: (N, K, G, 5), each person's loop
    first: np.ndarray  #: (N, K) int: the gate for which it heads
    group: np.ndarray  #: (N, K) int: the number of its companions; its own where it walks alone


def _wall(x0, x1, y0, y1):
    return [(x0 + x1) / 2, (y0 + y1) / 2, (x1 - x0) / 2, (y1 - y0) / 2, 0.0]


def _region(x0, x1, y0, y1):
    return _wall(x0, x1, y0, y1)[:4]


def _open():
    size = 16.0
    half = size / 2 - 0.5
    place = [0.0, 0.0, 1.0, 0.0, 0.0]
    loops = np.tile(np.array(place), (1, 12, 1))  # placed anew for each person
    starts = np.tile(np.array(_region(-half, half, -half, half)), (1, 12, 1))
    return Scene("open", Layout(size, np.zeros((0, 5)), name="open"), 48, 10, loops, starts)


def _crossing():
    far, half = 11.0, 2.0
    corner = [_wall(a, b, c, d) for a, b in ((half, far), (-far, -half)) for c, d in ((half, far), (-far, -half))]
    end = far - 1.5
    right, left = [end, 0, 1, 0, half], [-end, 0, -1, 0, half]
    up, down = [0, end, 0, 1, half], [0, -end, 0, -1, half]
    along, across = _region(-end, end, -half, half), _region(-half, half, -end, end)
    return Scene(
        "crossing",
        Layout(2 * far, np.array(corner), name="crossing"),
        40,
        8,
        np.array([[right, left], [up, down]], dtype=float),
        np.array([[along, along], [across, across]], dtype=float),
    )


def _two_ways():
    far, half = 10.0, 1.6
    walls = [_wall(-far, far, half, half + 0.3), _wall(-far, far, -half - 0.3, -half)]
    end = far - 1.2
    loop = [[end, 0, 1, 0, half], [-end, 0, -1, 0, half]]
    along = _region(-end, end, -half, half)
    return Scene(
        "two-ways",
        Layout(2 * far, np.array(walls), name="two-ways"),
        64,
        10,
        np.array([loop], dtype=float),
        np.array([[along, along]], dtype=float),
    )


def _ring():
    outer, inner = 4.75, 2.75
    middle, half = (outer + inner) / 2, (outer - inner) / 2
    block = _wall(-inner, inner, -inner, inner)
    gates = [
        [inner, -middle, 1, 0, half],  # along the lower side, then counter-clockwise
        [middle, inner, 0, 1, half],
        [-inner, middle, -1, 0, half],
        [-middle, -inner, 0, -1, half],
    ]
    starts = [
        _region(-inner, inner, -outer, -inner),
        _region(inner, outer, -outer, inner),
        _region(-inner, outer, inner, outer),
        _region(-outer, -inner, -inner, outer),
    ]
    return Scene(
        "ring",
        Layout(2 * outer, np.array([block]), name="ring"),
        120,
        10,
        np.array([gates], dtype=float),
        np.array([starts], dtype=float),
    )


def _exits():
    half, thick = 5.0, 0.2
    there, back = (2.0, 0.45), (-2.0, 0.75)  # each door's middle and half width
    walls = [
        _wall(-thick, thick, there[0] + there[1], half),
        _wall(-thick, thick, back[0] + back[1], there[0] - there[1]),
        _wall(-thick, thick, -half, back[0] - back[1]),
    ]
    gates = [[thick, there[0], 1, 0, there[1]], [-thick, back[0], -1, 0, back[1]]]
    starts = [_region(-half, -thick, -half, half), _region(thick, half, -half, half)]
    return Scene(
        "exits",
        Layout(2 * half, np.array(walls), name="exits"),
        64,
        10,
        np.array([gates], dtype=float),
        np.array([starts], dtype=float),
    )


def _bottleneck():
    far, half, door, thick = 9.0, 2.0, 0.8, 0.5
    walls = [
        _wall(-far, far, half, half + 0.3),
        _wall(-far, far, -half - 0.3, -half),
        _wall(-thick, thick, door, half),
        _wall(-thick, thick, -half, -door),
    ]
    end = far - 1.2
    gates = [[thick, 0, 1, 0, door], [end, 0, 1, 0, half], [-thick, 0, -1, 0, door], [-end, 0, -1, 0, half]]
    left, right = _region(-end, -thick, -half, half), _region(thick, end, -half, half)
    return Scene(
        "bottleneck",
        Layout(2 * far, np.array(walls), name="bottleneck"),
        40,
        6,
        np.array([gates], dtype=float),
        np.array([[left, right, right, left]], dtype=float),
    )


def _boxes():
    half = 8.0
    rows = [
        [-4.5, 4.0, 1.2, 0.8, 0.3],
        [0.5, 4.8, 0.6, 0.6, 0.8],
        [5.0, 3.5, 0.8, 1.6, 0.0],
        [-5.0, -1.0, 0.7, 1.3, 0.5],
        [-0.5, 0.0, 1.5, 0.5, -0.4],
        [4.2, -1.5, 0.5, 0.5, 0.0],
        [-3.5, -5.0, 1.6, 0.4, 0.0],
        [1.5, -4.8, 1.0, 1.0, 0.6],
        [5.5, -5.5, 0.6, 0.9, -0.3],
    ]
    layout = Layout(2 * half, np.array(rows), name="boxes")
    axis = np.arange(-half + 1.0, half, 1.0)
    places = []
    for place in np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2):
        apart = norm(place - np.array(places)).min() if places else np.inf
        if apart >= 2 * _NEAR_PLACE and clearance(place, layout.boxes) >= 0.8:
            places.append(place)
    loops = np.tile(np.array([0.0, 0.0, 1.0, 0.0, 0.0]), (1, 12, 1))
    starts = np.tile(np.array(_region(-half, half, -half, half)), (1, 12, 1))
    return Scene("boxes", layout, 30, 8, loops, starts, np.array(places))


_ALL = (_open(), _crossing(), _two_ways(), _ring(), _exits(), _bottleneck(), _boxes())
SCENES = {scene.name: scene for scene in _ALL}


def lonely_place(index: Array) -> np.ndarray:
    """Where the person in slot `index` (any shape) walks alone, out of everybody's sight and off the map: (..., 2)
    [m]."""
    index = np.asarray(index, dtype=float)
    return np.stack([200.0 + 60.0 * index, np.full_like(index, 200.0)], axis=-1)


def draw(scene: Scene, rng: np.random.Generator, crowds: int, radius: float, companions: float = 0.0) -> Drawn:
    """The beginnings of `crowds` crowds of `scene`, from the Generator `rng`, of people of `radius` [m].

    How many people a crowd has is drawn evenly from the scene's `fewest` to its `number`; the rest walk alone, off the
    map, in the open. companions: the share of people who walk in pairs and threes. Raises NoFreeSpace.
    """
    drawn = [_draw_one(scene, rng, radius, companions) for _ in range(crowds)]
    return Drawn(*(np.stack(field) for field in zip(*drawn, strict=True)))


def _draw_one(scene, rng, radius, companions):
    number = int(rng.integers(scene.fewest, scene.number + 1))
    loops, gates = scene.loops.shape[:2]
    group = _groups(rng, number, companions)
    loop_of, first_of = rng.integers(loops, size=number), _weighted(rng, scene, number)
    position, taken = np.zeros((number, 2)), np.empty((0, 2))
    boxes = scene.layout.boxes
    for person in range(number):
        lead = group[person]
        loop, first = loop_of[lead], first_of[lead]
        x, y, half_x, half_y = scene.starts[loop, first]
        for attempt in range(_TRIES):
            if lead != person and attempt < _TRIES // 2:
                angle = rng.uniform(-np.pi, np.pi)
                spot = position[lead] + rng.uniform(0.55, 0.9) * np.array([np.cos(angle), np.sin(angle)])
            else:
                spot = rng.uniform([x - half_x, y - half_y], [x + half_x, y + half_y])
            if point_box_distance(spot[None], boxes[None]).min() < radius + 0.02:
                continue
            if np.abs(spot).max() > scene.layout.size / 2 - radius:
                continue
            if len(taken) and norm(taken - spot).min() < 2 * radius + 0.02:
                continue
            break
        else:
            raise NoFreeSpace(f"Scene '{scene.name}' has no room for {number} people of {radius} m.")
        position[person] = spot
        taken = np.concatenate([taken, spot[None]])
    loops_of = scene.loops[loop_of[group]].copy()
    anywhere = not scene.loops[..., 4].any()  # its gates are places, drawn for each person
    if anywhere:
        half = scene.layout.size / 2 - 0.7

        def somewhere(shape):
            if scene.places is None:
                return rng.uniform(-half, half, (*shape, 2))
            return scene.places[rng.integers(len(scene.places), size=shape)]

        targets = somewhere((number, gates))
        for step in range(gates):  # each goal at least 6 m from the one before
            before = position if step == 0 else targets[:, step - 1]
            for _ in range(_TRIES):
                near = norm(targets[:, step] - before) < 6.0
                if not near.any():
                    break
                targets[near, step] = somewhere((int(near.sum()),))
        beside = position - position[group]  # companions' goals lie side by side, as they stand
        targets = np.clip(targets[group] + beside[:, None], -half, half)
        loops_of[:, :, :2] = targets
    first = np.where(anywhere, 0, first_of[group])
    alone = scene.number - number
    if alone:
        slots = np.arange(number, scene.number)
        home = lonely_place(slots)
        angle = rng.uniform(-np.pi, np.pi, (alone, gates))
        away = rng.uniform(4.0, 20.0, (alone, gates))[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        rows = np.zeros((alone, gates, 5))
        rows[..., :2], rows[..., 2] = home[:, None] + away, 1.0
        position = np.concatenate([position, home])
        loops_of = np.concatenate([loops_of, rows])
        first = np.concatenate([first, np.zeros(alone, int)])
        group = np.concatenate([group, slots])
    return position, loops_of, first.astype(np.int32), group.astype(np.int32)


def _weighted(rng, scene, number):
    """The first gate of `number` people, drawn by the areas in which they begin."""
    area = 4 * scene.starts[0, :, 2] * scene.starts[0, :, 3]
    return rng.choice(len(area), size=number, p=area / area.sum())


def _groups(rng, number, companions):
    """The number of each person's group, which is that of the group's first person: (number,)."""
    group = np.arange(number)
    person = 0
    while person < number:
        size = 1
        if rng.random() < companions / 2.2:  # a group has 2.2 people on average: four pairs to each three
            size = 3 if rng.random() < 0.2 else 2
        group[person : person + size] = person
        person += size
    return group


def goal(gate: Array, position: Array, half_body: float = _SHOULDER) -> Array:
    """The point (..., 2) [m] for which people at `position` (..., 2) head, whose gate is `gate` (..., 5)."""
    xp = position.__array_namespace__()
    centre, direction, half = gate[..., :2], gate[..., 2:4], gate[..., 4]
    aside = xp.stack([-direction[..., 1], direction[..., 0]], axis=-1)
    lateral = xp.sum((position - centre) * aside, axis=-1)
    room = xp.maximum(half - half_body, xp.zeros_like(half))
    lateral = xp.minimum(xp.maximum(lateral, -room), room)
    beyond = xp.where(half > 0, BEYOND, 0.0)
    return centre + lateral[..., None] * aside + beyond[..., None] * direction


def ahead(ways: Array, places: Array, gate: Array, position: Array, goals: Array) -> Array:
    """Unit vectors (..., 2) along the ways of people at `position` (..., 2) [m] to `goals` (..., 2), points of their
    `gate` (..., 5): as a Scene's `ways` (P, N, N, 2) to `places` (P, 2) lead, and straight where there is none."""
    xp = position.__array_namespace__()
    step = goals - position
    straight = step / xp.maximum(norm(step), 1e-6)[..., None]
    if not len(places):
        return straight
    away = norm(gate[..., None, :2] - places)
    cells = ways.shape[1]
    column, row = (xp.floor(position[..., axis] / _CELL + cells / 2).astype(int) for axis in (0, 1))
    known = (column >= 0) & (column < cells) & (row >= 0) & (row < cells) & (away.min(axis=-1) < _NEAR_PLACE)
    way = ways[away.argmin(axis=-1), row.clip(0, cells - 1), column.clip(0, cells - 1)]
    return xp.where((known & (norm(way) > 0.5))[..., None], way, straight)


def passed(gate: Array, position: Array) -> Array:
    """Whether people at `position` (..., 2) are through their `gate` (..., 5): (...) bool."""
    xp = position.__array_namespace__()
    offset = position - gate[..., :2]
    along = xp.sum(offset * gate[..., 2:4], axis=-1)
    return xp.where(gate[..., 4] > 0, along > 0, norm(offset) <= GOAL_RADIUS)
