"""What the LCF does to people: how much a crowd touches, and who gives way, in the open and in a corridor.

| what | where | who |
|---|---|---|
| touch | a square of 12 m; a corridor of 3.6 m | 24 people who cross the square; 12 on each side of the corridor |
| giving way | the same | two people who meet head-on, a little aside; the other one's LCF is 0 |

Everybody's LCF, or the one person's, is each of LCFS in turn, with the same starts and speeds. A person's sidestep is
how far it leaves its straight line at most, and who gives way more has the greater share of both people's sidesteps.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from macid import metrics
from macid.human import figures
from macid.human.data import LAB_PERIOD
from macid.human.flows import CORRIDOR, cast_of, two_ways_cast, two_ways_layout
from macid.human.stage import Body, Cast, Stage
from macid.layout import Layout
from macid.pedestrians import Controller
from macid.state import CONTACT_GAP

LCFS = (-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5)
WHERE = ("open", "corridor")
SQUARE = 12.0  # side [m]
CROWD = 24
CROWDS, PAIRS = 8, 16  # of each seed and LCF
LONGEST = 25.0  # [s]
DENSITY = 1.0  # of each side in the corridor, at the start [1/m2]
_FAR = 5.0  # of two people who meet from the middle, at the start [m]
_ASIDE = 0.25  # of their lines, at most [m]


def touch_share(walks: np.ndarray, radius: float) -> float:
    """The share of person-time of `walks` (T, P, 2) [m] in which somebody, of `radius` [m], touches another person."""
    distance = np.linalg.norm(walks[:, :, None] - walks[:, None], axis=-1)
    distance[:, np.arange(walks.shape[1]), np.arange(walks.shape[1])] = np.inf
    there = ~np.isnan(walks[..., 0])
    near = (np.nan_to_num(distance, nan=np.inf) <= 2 * radius + CONTACT_GAP).any(axis=-1)
    return float((near & there).sum() / max(1, there.sum()))


def sidesteps(walks: np.ndarray) -> np.ndarray:
    """How far each of `walks` (T, P, 2) [m] leaves the straight line on which it began, which leads along the y-axis:
    (P,) [m]."""
    return np.nanmax(np.abs(walks[..., 0] - walks[0, :, 0]), axis=0)


def crowd_cast(where: str, body: Body, rng: np.random.Generator, speed: Callable) -> Cast:
    """A crowd whose people cross a square, or a corridor's two ways."""
    if where == "corridor":
        return two_ways_cast(CROWD // 2, DENSITY, body, rng, speed, LONGEST)
    angles = (np.arange(CROWD) + rng.uniform(-0.2, 0.2, CROWD)) * (2 * np.pi / CROWD)
    places = SQUARE / 2 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    goals = -places + rng.uniform(-1.0, 1.0, places.shape)
    return cast_of(places, goals, np.zeros_like(places), speed(CROWD), LONGEST)


def pair_cast(where: str, rng: np.random.Generator) -> Cast:
    """Two people who want 1.34 m/s and meet head-on, on lines along y that are a little aside from each other."""
    middle = CORRIDOR.width / 2 if where == "corridor" else 0.0
    aside = rng.uniform(-_ASIDE, _ASIDE)
    places = np.array([[middle, -_FAR], [middle + aside, _FAR]])
    return cast_of(places, places * [1.0, -2.0], np.zeros_like(places), np.full(2, 1.34), LONGEST)


def knob(
    controller: Controller,
    period: float,
    body: Body,
    seeds: list[int],
    speed: Callable[[np.random.Generator, int], np.ndarray | None] = lambda rng, number: None,
    engine: str = "native",
    tell: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """What the LCF does, for each of `seeds`: a dict with

    - `lcf`, LCFS;
    - `touch`, {where: for each seed the shares of time [%] in which people touch, one for each LCF};
    - `way`, {where: for each seed the shares of both people's sidesteps that are the person's with this LCF};
    - `touch_rank` and `way_rank`, {where: for each seed Spearman's rank correlation with the LCF, or None}.

    Arguments and errors as of macid.human.flows.flows; `body.lcf` is not used.
    """
    found = {"lcf": list(LCFS), "touch": {}, "way": {}, "touch_rank": {}, "way_rank": {}}
    for where in WHERE:
        tell(f"the LCF's knob: {where}")
        layout = two_ways_layout() if where == "corridor" else Layout(4 * SQUARE, np.zeros((0, 5)))

        def play(make, lcfs, each, layout=layout, where=where):
            casts = []
            for seed in seeds:  # the same crowds for every LCF
                rng = np.random.default_rng((seed, 0x10B, WHERE.index(where)))
                drawn = [make(rng) for _ in range(each)]
                casts += [cast._replace(lcf=lcfs(lcf)) for lcf in LCFS for cast in drawn]
            stage = Stage(layout, casts, LONGEST, controller, period, body, np.random.default_rng(0), engine)
            played = stage.play(LAB_PERIOD)
            rows = [played[start : start + each] for start in range(0, len(played), each)]
            return [rows[start : start + len(LCFS)] for start in range(0, len(rows), len(LCFS))]

        def crowd(rng, where=where):
            return crowd_cast(where, body, rng, lambda number: speed(rng, number))

        crowds = play(crowd, lambda lcf: np.full(CROWD, lcf), CROWDS)
        pairs = play(lambda rng, where=where: pair_cast(where, rng), lambda lcf: np.array([lcf, 0.0]), PAIRS)
        touch = [
            [100.0 * float(np.mean([touch_share(walks, body.radius) for walks in runs])) for runs in seed]
            for seed in crowds
        ]
        way = [[_own_share(runs) for runs in seed] for seed in pairs]
        for name, rows in (("touch", touch), ("way", way)):
            found[name][where] = [[figures.rounded(value) for value in row] for row in rows]
            found[f"{name}_rank"][where] = [figures.rounded(metrics.rank_correlation(row)) for row in rows]
    return found


def _own_share(runs):
    """The first person's share of both people's sidesteps, over several pairs; NaN where nobody steps aside."""
    own, other = np.sum([sidesteps(walks) for walks in runs], axis=0)
    return float(own / (own + other)) if own + other > 0 else float("nan")
