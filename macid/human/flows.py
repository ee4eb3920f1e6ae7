"""Flows: a model in the lab's corridors. An exit, one way at given densities, two ways.

The corridors lie along y, and x is from 0 to the width, as in the lab's files. People and models are measured alike.

| what | where | who |
|---|---|---|
| exit | corridors of 1.8 m (exit 1.2 m) and 3 m (exit 2 m), as the lab's | 80, 120 people before it, up to 60 s |
| one way | a ring of 8 m, 2 m wide | as many as the fundamental diagram's densities are, 8 s to settle, then 12 s |
| two ways | a corridor of 3.6 m, 8 m long | 18 and 36 a side, towards each other, up to 40 s |
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from macid.human import figures, measures
from macid.human.data import LAB_PERIOD, Bottleneck, TwoWays
from macid.human.stage import Body, Cast, Stage
from macid.layout import Layout
from macid.pedestrians import Controller

EXIT_PLACES = (Bottleneck(1.8, 1.2, -4.0, 4.0), Bottleneck(3.0, 2.0, -4.0, 4.0))
EXIT_PEOPLE = (80, 120)
START_DENSITY = 1.6  # before the exit [1/m2]
STARTS = 4.0  # until a crowd at rest walks [s]
LONGEST = 60.0  # [s]
CROSSING = 40.0  # of two ways [s]
DENSER = 1.6  # a side's density at the start, over what it is to be in the middle
RING, RING_WIDTH = 8.0, 2.0  # [m]
SETTLES, RUNS = 8.0, 12.0  # [s]
CORRIDOR = TwoWays(3.6, 4.0)
WALL = 0.3  # thickness [m]
BEYOND = 4.0  # how far beyond the exit, or the corridor's end, goals lie [m]
JITTER = 0.05  # of starts [m]
WALL_ROOM = 0.1  # between people and walls there [m]
_PUSHES = 150  # at most, until bodies have room


class Runs(NamedTuple):
    """What came of one model's flows: (T, P, 2) [m] of each run."""

    values: dict[str, float]
    curves: dict[str, Any]
    smoothness: np.ndarray  #: of all people who walk in a corridor, (N,)


def _apart(places, length):
    """Offsets (N, N, 2) [m] between `places` (N, 2) on a ring of `length` [m], and distances (N, N), infinite to
    itself."""
    offset = places[None] - places[:, None]
    offset[..., 1] -= length * np.round(offset[..., 1] / length)
    distance = np.linalg.norm(offset, axis=-1)
    np.fill_diagonal(distance, np.inf)
    return offset, distance


def lattice(number: int, width: float, length: float, radius: float) -> np.ndarray | None:
    """Places (number, 2) [m] in a corridor, x in (0, width), y in (0, length), which is a ring: rows along y, every
    other one shifted by half a step, of which the arrangement with the most room; then pushed apart until bodies of
    `radius` [m] have room. WALL_ROOM from walls, or less where there is no room else. None where there is none."""
    for gap in (WALL_ROOM, 0.0):
        low, high = radius + gap, width - radius - gap
        best, room = None, 0.0
        for rows in range(1, number + 1):
            across = (high - low) / (rows - 1) if rows > 1 else 0.0
            if high < low or (rows > 1 and across < radius / 2):
                break
            counts = [number // rows + (row < number % rows) for row in range(rows)]
            columns = [
                [(low + row * across if rows > 1 else width / 2, (step + 0.5 * (row % 2)) * length / count)]
                for row, count in enumerate(counts)
                for step in range(count)
            ]
            places = np.array(columns).reshape(number, 2)
            if (least := _apart(places, length)[1].min()) > room:
                best, room = places, least
        for _ in range(_PUSHES):
            if best is None or room >= 2 * radius:
                break
            offset, distance = _apart(best, length)
            push = np.maximum(2 * radius + 0.005 - distance, 0.0) / np.maximum(distance, 1e-9) / 2
            best = best - (push[..., None] * offset).sum(axis=1)
            best[:, 0] = np.clip(best[:, 0], low, high)
            room = _apart(best, length)[1].min()
        if best is not None and room >= 2 * radius - 0.01:
            return best
    return None


def jittered(rng: np.random.Generator, places: np.ndarray, radius: float, length: float) -> np.ndarray:
    """`places` (N, 2) [m] of a lattice on a ring of `length` [m], each moved a little, as far as there is room, and all
    turned along it."""
    free = min(JITTER, max(0.0, (_apart(places, length)[1].min() - 2 * radius) / 2 - 0.005))
    moved = places + rng.uniform(-free, free, places.shape) / math.sqrt(2)
    moved[:, 0] = np.clip(moved[:, 0], places[:, 0].min(), places[:, 0].max())
    moved[:, 1] = (moved[:, 1] + rng.uniform(0.0, length)) % length
    return moved


def crowded(number: int, width: float, length: float, radius: float, rng: np.random.Generator) -> np.ndarray:
    """`number` places (N, 2) [m] in a corridor, y from 0 to `length` [m], or to more where broad people need it."""
    while (places := lattice(number, width, length, radius)) is None:
        length *= 1.1
    return jittered(rng, places, radius, length)


def _wall(x0, y0, x1, y1):
    """The box between two corners."""
    return [(x0 + x1) / 2, (y0 + y1) / 2, abs(x1 - x0) / 2, abs(y1 - y0) / 2, 0.0]


def _sides(width, low, high):
    return [_wall(-WALL, low, 0.0, high), _wall(width, low, width + WALL, high)]


def exit_layout(place: Bottleneck, length: float) -> Layout:
    """A corridor from the exit on, `length` [m] long."""
    low, high, side = place.exit_y, place.exit_y + length, (place.width - place.exit) / 2
    walls = [
        *_sides(place.width, low, high),
        _wall(0.0, low - WALL, side, low),
        _wall(place.width - side, low - WALL, place.width, low),
    ]
    return Layout(2 * (max(abs(low), abs(high)) + BEYOND + 2.0), np.array(walls))


def exit_cast(place: Bottleneck, number: int, body: Body, rng: np.random.Generator, speed: Callable) -> Cast:
    """A crowd of `number` people at rest in a corridor before its exit. speed: as of `flows`."""
    places = crowded(number, place.width, number / (START_DENSITY * place.width), body.radius, rng)
    places = places + np.array([0.0, place.exit_y + body.radius + 0.2])
    room = max(0.0, place.exit / 2 - body.radius)
    middle = place.width / 2
    goals = np.stack([middle + np.clip(places[:, 0] - middle, -room, room), np.full(number, place.exit_y - BEYOND)], -1)
    return cast_of(places, goals, np.zeros((number, 2)), speed(number), LONGEST)


def ring_layout() -> Layout:
    """Two walls along y, from image to image of a ring."""
    return Layout(6 * RING, np.array(_sides(RING_WIDTH, -2 * RING, 2 * RING)))


def ring_cast(density: float, body: Body, rng: np.random.Generator, speed: Callable) -> Cast | None:
    """People at `density` [1/m2] on the ring, who all go one way, at first about as fast as people do; None where
    bodies have no room. Where one person more or less is easier to arrange, it is that many."""
    number = round(density * RING * RING_WIDTH)
    found = (lattice(many, RING_WIDTH, RING, body.radius) for many in (number, number + 1, number - 1))
    places = next((each for each in found if each is not None), None)
    if places is None:
        return None
    places = jittered(rng, places, body.radius, RING) - np.array([0.0, RING / 2])
    ahead = np.tile([0.0, -1.0], (len(places), 1))
    return cast_of(
        places, places + 10.0 * ahead, max(0.5, 1.7 - 0.5 * density) * ahead, speed(len(places)), SETTLES + RUNS
    )


def two_ways_layout() -> Layout:
    """The corridor of two ways, with room to stand behind both ends."""
    reach = CORRIDOR.half + 16.0
    return Layout(2 * (reach + 4.0), np.array(_sides(CORRIDOR.width, -reach, reach)))


def begin_density(side: int) -> float:
    """The density [1/m2] at which `side` people on each side begin: as a crowd draws out on its way, it is denser than
    half of what both are to be in the middle."""
    return DENSER * figures.SIDE_DENSITIES[figures.SIDES.index(side)] / 2


def two_ways_cast(
    side: int, density: float, body: Body, rng: np.random.Generator, speed: Callable, until: float = CROSSING
) -> Cast:
    """`side` people on each side, at rest, at `density` [1/m2], who start towards each other and stay for `until` [s].
    The first half of the cast goes towards greater y."""
    length = side / (density * CORRIDOR.width)
    places, goals = [], []
    for way in (1.0, -1.0):
        own = crowded(side, CORRIDOR.width, length, body.radius, rng)
        own[:, 1] = -way * (own[:, 1] + CORRIDOR.half / 2)
        places.append(own)
        goals.append(np.stack([own[:, 0], np.full(side, way * (CORRIDOR.half + BEYOND))], axis=-1))
    return cast_of(np.concatenate(places), np.concatenate(goals), np.zeros((2 * side, 2)), speed(2 * side), until)


def cast_of(
    places: np.ndarray, goals: np.ndarray, velocity: np.ndarray, speed: np.ndarray | None, until: float
) -> Cast:
    """People who are all there from the beginning, at `places` (N, 2) [m] with `velocity` (N, 2) [m/s], until
    `until` [s]."""
    number = len(places)
    return Cast(np.zeros(number), np.full(number, until), places, velocity, goals, speed)


def flows(
    controller: Controller,
    period: float,
    body: Body,
    seeds: list[int],
    speed: Callable[[np.random.Generator, int], np.ndarray | None] = lambda rng, number: None,
    engine: str = "native",
    tell: Callable[[str], None] = lambda line: None,
) -> list[Runs]:
    """The flows of a model, once for each of `seeds`: Runs.

    controller: deciding every `period` [s]; a batch has the first seed's worlds first, and a controller may tell them
    apart by that. speed: draws people's preferred speeds [m/s]; None: the model's own. Raises UsageError where physics
    fails."""
    drawn = [np.random.default_rng((seed, 0xF10)) for seed in seeds]

    def play(layout, make, ring=None, until=LONGEST):
        casts = [cast for rng in drawn for cast in make(rng, lambda number, rng=rng: speed(rng, number))]
        stage = Stage(
            layout, casts, until, controller, period, body, np.random.default_rng((*seeds, 0x1CF)), engine, ring
        )
        played = stage.play(LAB_PERIOD)
        each = len(casts) // len(seeds)
        return [played[number * each : (number + 1) * each] for number in range(len(seeds))]

    values, curves = [{} for _ in seeds], [{} for _ in seeds]
    smooth, before = [[] for _ in seeds], [[] for _ in seeds]
    for place, number in zip(EXIT_PLACES, EXIT_PEOPLE, strict=True):
        tell(f"exit of {place.exit:g} m: {number} people")
        layout = exit_layout(place, 2.0 * number / (START_DENSITY * place.width) + 2.0)
        crowd = functools.partial(exit_cast, place, number, body)
        for index, (walks,) in enumerate(play(layout, lambda rng, own, crowd=crowd: [crowd(rng, own)])):
            times = measures.crossing_times(walks, LAB_PERIOD, place.exit_y)
            values[index][f"exit{place.exit:g}"] = measures.flow(times, place.exit, number, LONGEST)
            going = walks[round(STARTS / LAB_PERIOD) :]
            before[index].append(measures.densities(going, LAB_PERIOD, figures.box(place.width)))
            smooth[index].append(measures.people(walks, LAB_PERIOD).smoothness)
    tell(f"one way: {', '.join(f'{rho:g}' for rho in measures.DENSITIES)} people/m2 on a ring")
    densities = [rho for rho in measures.DENSITIES if ring_cast(rho, body, np.random.default_rng(0), lambda n: None)]
    many = play(
        ring_layout(), lambda rng, own: [ring_cast(rho, body, rng, own) for rho in densities], RING, SETTLES + RUNS
    )
    for index, runs in enumerate(many):
        settled = [walks[round(SETTLES / LAB_PERIOD) :] for walks in runs]
        points = [measures.densities(walks, LAB_PERIOD, figures.box(RING_WIDTH)) for walks in settled]
        more, curves[index] = figures.diagram(points)
        values[index] |= more
    for side in figures.SIDES:
        tell(f"two ways: {side} a side")
    made = play(
        two_ways_layout(),
        lambda rng, own: [two_ways_cast(side, begin_density(side), body, rng, own) for side in figures.SIDES],
        until=CROSSING,
    )
    for index, runs in enumerate(made):
        for side, walks in zip(figures.SIDES, runs, strict=True):
            ways = np.repeat([1.0, -1.0], side)
            last = np.array([own[~np.isnan(own)][-1] for own in walks[..., 1].T])
            crossing = figures.two_ways(walks, LAB_PERIOD, CORRIDOR, ways)
            values[index][f"through{side}"] = 100.0 * float(np.mean(ways * last >= CORRIDOR.half))
            names = (f"two_speed{side}", f"lanes{side}", f"two_density{side}")
            values[index] |= dict(zip(names, crossing.values(), strict=True))
            smooth[index].append(measures.people(walks, LAB_PERIOD).smoothness)
    for index, points in enumerate(before):
        values[index] |= figures.before_exit(points)
    for index, parts in enumerate(smooth):
        values[index]["smoothness"] = measures.mean(np.concatenate(parts))
    return [Runs(v, c, np.concatenate(s)) for v, c, s in zip(values, curves, smooth, strict=True)]
