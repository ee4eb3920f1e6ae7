"""Open scenes replayed: everybody is replaced by a model.

A person of the model comes where and when its real one came, with that one's velocity, and goes to where the real one
was last seen. Who walked together means to stay together. People who stood are moved as they stood. A scene is divided
into windows, the worlds of one batch: each begins a little before its time, with the people who were there then, and
counts the people who come in it.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.sparse import csgraph

from macid.human import measures
from macid.human.data import OPEN_PERIOD, Walks
from macid.human.stage import Body, Cast, Stage
from macid.layout import Layout
from macid.pedestrians import Controller

WINDOW = 90.0  # [s]
WARM_UP = 8.0  # before a window: people who were there go on from where they were [s]
LATE = 6.0  # how long after its real one was last seen a person may still walk [s]
LONGEST = 30.0  # played after a window for the people who came in it, at most [s]
_MARGIN = 10.0  # between the outermost place and the map's edge [m]


class Scene:
    """An open scene of P real people, each seen LEAST_SAMPLES times or more, every OPEN_PERIOD."""

    def __init__(self, walks: Walks):
        self.name = walks.name
        position = measures.strides(walks.position, walks.period)
        position = position[:, (~np.isnan(position[..., 0])).sum(axis=0) >= measures.LEAST_SAMPLES]
        low, high = np.nanmin(position, axis=(0, 1)), np.nanmax(position, axis=(0, 1))
        self.position = position - (low + high) / 2  # (T, P, 2) [m], around the origin
        self.reach = float((high - low).max() / 2)  # [m]
        seen = ~np.isnan(position[..., 0])
        self.first, self.last = seen.argmax(axis=0), len(seen) - 1 - seen[::-1].argmax(axis=0)
        self.velocity = measures.velocities(self.position, OPEN_PERIOD)  # (T, P, 2) [m/s]
        self.person = measures.people(self.position, OPEN_PERIOD)
        self.stands = ~self.person.walks
        self.companions = measures.companions(self.position, OPEN_PERIOD)  # (P, P)
        self.group = _groups(self.companions)  # (P,) int: the first one's index of those who walk together


class Window(NamedTuple):
    """A part of a scene; numbers of samples of the scene's."""

    scene: int  #: index of its scene
    start: int  #: where the play begins
    begin: int  #: where the window begins
    end: int  #: before which it ends
    stop: int  #: before which the play ends
    who: np.ndarray  #: (Q,) the scene's people who play
    counted: np.ndarray  #: (Q,) bool: come between begin and end, and do not stand


class Played(NamedTuple):
    """What came of the windows of all scenes; lists, an item a scene."""

    position: list[np.ndarray]  #: (T, P, 2) [m], at each instant as in the window that has it
    velocity: list[np.ndarray]  #: (T, P, 2) [m/s]
    walks: list[np.ndarray]  #: (T + late, P, 2) [m]: each person's whole walk, as in the window in which it came


def windows(scenes: list[Scene]) -> list[Window]:
    """The windows of all `scenes`."""
    found, warm = [], round(WARM_UP / OPEN_PERIOD)
    late, longest = round(LATE / OPEN_PERIOD), round(LONGEST / OPEN_PERIOD)
    for number, scene in enumerate(scenes):
        samples = len(scene.position)
        parts = max(1, round(samples * OPEN_PERIOD / WINDOW))
        edges = np.linspace(0, samples, parts + 1).round().astype(int)
        for begin, end in itertools.pairwise(edges):
            start = max(0, begin - warm)
            counted = (scene.first >= begin) & (scene.first < end) & ~scene.stands
            needed = int(scene.last[counted].max(initial=end - 1)) + 1 + late
            stop = max(int(end), min(needed, int(end) + longest))
            plays = (scene.last > start) & (scene.first < stop - 1)
            found.append(Window(number, start, int(begin), int(end), stop, np.flatnonzero(plays), counted[plays]))
    return found


def cast(scene: Scene, window: Window, speed: np.ndarray | None) -> Cast:
    """The people of a window. speed: (P,) everybody's preferred speed [m/s]; None: the model's own."""
    who, start = window.who, window.start
    comes = np.maximum(scene.first[who], start)
    stands = scene.stands[who]
    until = scene.last[who] - start
    leaves = until * OPEN_PERIOD + np.where(stands, 1e-3, LATE)
    walk = None
    if stands.any():
        walk = np.where(stands[None, :, None], scene.position[start : window.stop, who], np.nan)
    return Cast(
        (comes - start) * OPEN_PERIOD,
        leaves,
        scene.position[comes, who],
        np.where(stands[:, None], 0.0, scene.velocity[comes, who]),
        scene.position[scene.last[who], who],
        None if speed is None else speed[who],
        walk,
        scene.group[who],
    )


def _groups(companions):
    """For each person the index of the first one of its group: whoever is a companion of one of it."""
    _, label = csgraph.connected_components(companions, directed=False)
    _, first = np.unique(label, return_index=True)
    return first[label]


def play(
    scenes: list[Scene],
    controller: Controller,
    period: float,
    body: Body,
    rng: np.random.Generator,
    speeds: list[list[np.ndarray | None]],
    engine: str = "native",
    tell: Callable[[str], None] = lambda line: None,
) -> list[Played]:
    """`scenes` as the model `controller`, deciding every `period` [s], plays them: once for each of `speeds`, which has
    everybody's preferred speed [m/s], (P,) or None, of each scene. All are worlds of one batch, the first of `speeds`
    first; a controller may tell them apart by that. Raises UsageError where physics fails."""
    parts = windows(scenes)
    groups = _batches(parts)
    found = [{} for _ in speeds]
    size = 2 * (max(scene.reach for scene in scenes) + _MARGIN)
    for group in groups:
        casts = [cast(scenes[parts[i].scene], parts[i], each[parts[i].scene]) for each in speeds for i in group]
        duration = max((parts[i].stop - parts[i].start) * OPEN_PERIOD for i in group)
        tell(f"open scenes: {len(casts)} windows of {duration:.0f} s, {max(len(c.comes) for c in casts)} people")
        stage = Stage(Layout(size, np.empty((0, 5))), casts, duration, controller, period, body, rng, engine)
        played = stage.play(OPEN_PERIOD)
        for number, walks in enumerate(played):
            found[number // len(group)][group[number % len(group)]] = walks
    return [gather(scenes, parts, [each[number] for number in range(len(parts))]) for each in found]


def _batches(parts):
    """Indices of `parts`, those with many people apart from those with few: an engine has as many slots as its fullest
    world needs."""
    crowds = [len(part.who) / (part.stop - part.start) for part in parts]
    full = [i for i, crowd in enumerate(crowds) if crowd > max(crowds) / 2]
    rest = [i for i in range(len(parts)) if i not in full]
    return [group for group in (full, rest) if group]


def gather(scenes: list[Scene], parts: list[Window], walks: list[np.ndarray]) -> Played:
    """What was played in all windows `parts`, `walks` (T, Q, 2) [m], as Played."""
    played = Played([], [], [])
    late = round(LONGEST / OPEN_PERIOD)
    for scene in scenes:
        shape = scene.position.shape
        played.position.append(np.full(shape, np.nan))
        played.velocity.append(np.full(shape, np.nan))
        played.walks.append(np.full((shape[0] + late, *shape[1:]), np.nan))
    for part, own in zip(parts, walks, strict=True):
        own = own[: part.stop - part.start]
        rows = slice(part.begin - part.start, part.end - part.start)
        into = np.ix_(np.arange(part.begin, part.end), part.who)
        played.position[part.scene][into] = own[rows]
        played.velocity[part.scene][into] = measures.velocities(own, OPEN_PERIOD)[rows]
        counted = np.flatnonzero(part.counted)
        into = np.ix_(np.arange(part.start, part.start + len(own)), part.who[counted])
        played.walks[part.scene][into] = own[:, counted]
    return played


def as_they_were(scenes: list[Scene]) -> Played:
    """The real people, as Played."""
    parts = windows(scenes)
    walks = []
    for part in parts:
        scene = scenes[part.scene]
        own = np.full((part.stop - part.start, len(part.who), 2), np.nan)
        rows = scene.position[part.start : part.stop, part.who]
        own[: len(rows)] = rows
        walks.append(own)
    return gather(scenes, parts, walks)
