"""People's figures and models', by the same code: one flat table of values, and what plots are made of.

People's figures are made from their files by `macid human data DIR --figures OUT`, and shipped (assets/human): means,
histograms and binned means, no walk of anybody.
"""

import json
from typing import Any, NamedTuple

import numpy as np

from macid import assets
from macid.human import measures
from macid.human.data import OPEN_PERIOD, Bottleneck, TwoWays, Walks
from macid.human.replay import Played, Scene, as_they_were

SPEED_EDGES = np.round(np.arange(0.0, 2.61, 0.1), 1)  # of histograms [m/s]
LAB_BOX = 2.0  # length of the box in which densities are measured [m]
MOST_POINTS = 400  # of a fundamental diagram's plot
EXITS = (1.2, 2.0)  # widths [m]
SIDES = (18, 36)  # people on each side
SIDE_DENSITIES = (0.9, 1.4)  # of both ways together in the middle, as these come to among people [1/m2]


class Measure(NamedTuple):
    """One line of the table."""

    key: str
    title: str
    unit: str
    digits: int
    group: str  #: "open", "one way", "exit", "two ways" or "lab"


MEASURES = (
    Measure("speed", "speed, mean of people's means", "m/s", 2, "open"),
    Measure("speed_sd", "its SD between people", "m/s", 2, "open"),
    Measure("within", "SD within a person", "m/s", 2, "open"),
    *(Measure(f"E{tau:g}", f"anticipation E({tau:g} s)", "", 2, "open") for tau in measures.TAUS),
    Measure("soon", f"share of time with a collision with a stranger within {measures.SOON:g} s", "%", 1, "open"),
    *(
        Measure(f"close{near:g}", f"share of time within {near:g} m of somebody", "%", 1, "open")
        for near in measures.CLOSE
    ),
    Measure("straightness", "displacement / path", "", 3, "open"),
    Measure("ADE", "mean distance from the real person", "m", 2, "open"),
    Measure("FDE", "distance where the real person was last seen", "m", 2, "open"),
    Measure("W", "Wasserstein distance of the people's speeds", "m/s", 3, "open"),
    Measure("smoothness", "mean change of speed", "m/s2", 2, "lab"),
    *(Measure(f"v{rho:g}", f"speed at {rho:g} people/m2", "m/s", 2, "one way") for rho in measures.DENSITIES),
    *(Measure(f"exit{width:g}", f"flow through an exit of {width:g} m", "1/m/s", 2, "exit") for width in EXITS),
    *(
        Measure(f"{key}{side}", f"{title}, {side} a side", unit, digits, "two ways")
        for side in SIDES
        for key, title, unit, digits in (
            ("through", "two ways: share that gets through", "%", 0),
            ("two_speed", "two ways: speed", "m/s", 2),
            ("lanes", "two ways: order of lanes", "", 2),
            ("two_density", "two ways: density", "1/m2", 2),
        )
    ),
)


def rounded(value: float, digits: int = 4) -> float | None:
    """`value` for JSON: None for what is no number."""
    return round(float(value), digits) if np.isfinite(value) else None


def open_figures(
    scenes: list[Scene], played: Played, part: slice | None = None, real: Played | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """(values, curves) of `scenes` as `played`. part: a part of each scene's samples, as a share of it, of which alone
    they are. real: what as_they_were(scenes) gives, where it is at hand."""
    real = as_they_were(scenes) if real is None else real
    people, errors, weights, meetings, speeds = [], [], [], [], []
    for number, scene in enumerate(scenes):
        position, velocity = played.position[number], played.velocity[number]
        counted = ~scene.stands
        if part is not None:
            low, high = (round(end * len(position)) for end in (part.start, part.stop))
            position, velocity = position[low:high], velocity[low:high]
            counted &= (scene.first >= low) & (scene.first < high)
        walks, known = played.walks[number][:, counted], real.walks[number][:, counted]
        people.append(measures.people(walks, OPEN_PERIOD))
        speeds.append(measures.people(known, OPEN_PERIOD).speed)
        errors.append(measures.displacement_errors(walks, known))
        weights.append(counted.sum())
        meetings.append(measures.meetings(position, velocity, scene.companions))
    speed, within, straightness = (np.concatenate([person[i] for person in people]) for i in range(3))
    all_of_them = measures.Meetings.added(meetings)
    energy, (middles, curve) = all_of_them.anticipation(), all_of_them.curve()
    ade, fde = np.average(errors, axis=0, weights=weights)
    histogram = np.histogram(np.clip(speed[~np.isnan(speed)], 0.0, SPEED_EDGES[-1] - 1e-6), SPEED_EDGES)[0]
    values = {
        "speed": measures.mean(speed),
        "speed_sd": measures.deviation(speed),
        "within": measures.mean(within),
        **{f"E{tau:g}": each for tau, each in zip(measures.TAUS, energy, strict=True)},
        "soon": 100 * all_of_them.soon_share,
        **{f"close{d:g}": 100 * each for d, each in zip(measures.CLOSE, all_of_them.close_shares, strict=True)},
        "straightness": measures.mean(straightness),
        "ADE": ade,
        "FDE": fde,
        "W": measures.wasserstein(speed, np.concatenate(speeds)),
    }
    curves = {
        "E": [[rounded(tau), rounded(each)] for tau, each in zip(middles, curve, strict=True)],
        "speeds": {"edges": SPEED_EDGES.tolist(), "share": (histogram / max(1, histogram.sum())).round(4).tolist()},
    }
    return values, curves


def box(width: float) -> measures.Box:
    """The box of a corridor of `width` [m] with x from 0, and y around 0."""
    return measures.Box((0.0, width), (-LAB_BOX / 2, LAB_BOX / 2))


def diagram(points: list[tuple[np.ndarray, np.ndarray]]) -> tuple[dict[str, Any], dict[str, Any]]:
    """(values, curves) of the fundamental diagram whose points, as of measures.densities, are several runs'."""
    density, speed = (np.concatenate(parts) for parts in zip(*points, strict=True))
    binned = measures.binned(density, speed)
    values = {f"v{rho:g}": each for rho, each in zip(measures.DENSITIES, binned, strict=True)}
    # For the plot: the mean speed of each density, which are multiples of one over the box's area.
    steps = np.round(density / 0.1).astype(int)
    rows = [[step / 10, rounded(speed[steps == step].mean()), int((steps == step).sum())] for step in np.unique(steps)]
    return values, {"diagram": rows}


class Crossing(NamedTuple):
    """What two ways do at the instants when both are in the middle box."""

    density: np.ndarray  #: (N,) [1/m2]
    speed: np.ndarray  #: (N,) mean of the people in the box [m/s]
    lanes: np.ndarray  #: (N,) measures.lane_order of all in the corridor

    def values(self, chosen: np.ndarray | None = None) -> tuple[float, float, float]:
        """(speed, lanes, density), means over the instants `chosen` (N,) bool."""
        chosen = np.ones(len(self.density), bool) if chosen is None else chosen
        number = self.density[chosen]
        speed = float(np.average(self.speed[chosen], weights=number)) if chosen.any() else float("nan")
        return speed, measures.mean(self.lanes[chosen]), measures.mean(number)


def two_ways(position: np.ndarray, period: float, place: TwoWays, towards: np.ndarray) -> Crossing:
    """What people (T, K, 2) [m] do who walk both ways, `towards` (K,) 1 or -1 along y."""
    velocity = measures.velocities(position, period)
    speed = np.linalg.norm(velocity, axis=-1)
    inside = box(place.width).holds(position) & ~np.isnan(speed)
    both = np.flatnonzero((inside & (towards > 0)).any(axis=1) & (inside & (towards < 0)).any(axis=1))
    corridor = np.where((np.abs(position[..., 1]) < place.half)[..., None], position, np.nan)
    number = inside[both].sum(axis=1)
    return Crossing(
        number / box(place.width).area,
        np.where(inside, speed, 0.0)[both].sum(axis=1) / number,
        np.array([measures.lane_order(corridor[at][None], towards) for at in both]),
    )


def towards(position: np.ndarray) -> np.ndarray:
    """1 for each person whose y grows on the whole, -1 for the others: (K,)."""
    found = np.empty(position.shape[1])
    for who in range(position.shape[1]):
        own = position[~np.isnan(position[:, who, 0]), who, 1]
        found[who] = 1.0 if own[-1] >= own[0] else -1.0
    return found


def lab_figures(walks: list[Walks], part: tuple[float, float] = (0.0, 1.0)) -> tuple[dict[str, Any], dict[str, Any]]:
    """(values, curves) of files of the lab's. part: of each the share of its time of which alone they are.

    What the two ways do is told at the densities that SIDES come to, SIDE_DENSITIES."""
    values, points, smooth, curves, crowds, through, exits = {}, [], [], {}, [], [], []
    for walk in walks:
        low, high = (round(share * len(walk.position)) for share in part)
        position, place = walk.position[low:high], walk.source.place if walk.source else None
        position = position[:, ~np.isnan(position[..., 0]).all(axis=0)]
        smooth.append(measures.people(position, walk.period).smoothness)
        if isinstance(place, Bottleneck):
            points.append(measures.densities(position, walk.period, box(place.width)))
            if place.exit < place.width:
                times = measures.crossing_times(walk.position, walk.period, place.exit_y)
                first, last = (0.1 + 0.7 * share for share in part)  # as of measures.flow
                times = times[round(first * len(times)) : round(last * len(times)) + 1]
                flow = (len(times) - 1) / (times[-1] - times[0]) / place.exit
                values[f"exit{place.exit:g}"] = flow
                exits.append([place.exit, rounded(flow)])
        elif place is not None:
            crowds.append(two_ways(position, walk.period, place, towards(position)))
            ends = [own[~np.isnan(own)][[0, -1]] for own in walk.position[..., 1].T]
            through += [abs(end[1] - end[0]) >= 2 * place.half for end in ends]
    values["smoothness"] = measures.mean(np.concatenate(smooth)) if smooth else float("nan")
    if points:
        more, curves = diagram(points)
        values |= more
    if crowds:
        crossing = Crossing(*(np.concatenate(parts) for parts in zip(*crowds, strict=True)))
        for side, density in zip(SIDES, SIDE_DENSITIES, strict=True):
            found = crossing.values(np.abs(crossing.density - density) <= measures.DENSITY_HALF)
            values[f"through{side}"] = 100.0 * float(np.mean(through))
            values |= dict(zip((f"two_speed{side}", f"lanes{side}", f"two_density{side}"), found, strict=True))
    return values, {**curves, "exits": exits}


def people(walks: list[Walks]) -> dict[str, Any]:
    """Real people's figures: a document {"measures": {key: {"people", "halves"}}, "curves", "files", "scenes"}.

    halves: of the first and of the second half of each recording; how far they lie apart is the least difference that
    means anything."""
    opens = [Scene(walk) for walk in walks if walk.scene == "open"]
    labs = [walk for walk in walks if walk.scene != "open"]
    found, halves, curves = {}, [{}, {}], {}
    ends = [(0.0, 0.5), (0.5, 1.0)]
    if opens:
        real = as_they_were(opens)
        found, curves = open_figures(opens, real, real=real)
        halves = [open_figures(opens, real, slice(*end), real)[0] for end in ends]
    if labs:
        more, lines = lab_figures(labs)
        found, curves = found | more, curves | lines
        halves = [half | lab_figures(labs, end)[0] for half, end in zip(halves, ends, strict=True)]
    if len(halves) == 2 and opens:
        speeds = [np.concatenate([s.person.speed[_half(s, end)] for s in opens]) for end in ends]
        found["W"], halves[0]["W"], halves[1]["W"] = 0.0, 0.0, measures.wasserstein(*speeds)
    rows = {}
    for measure in MEASURES:
        if measure.key in found:
            both = [rounded(half.get(measure.key, float("nan"))) for half in halves]
            rows[measure.key] = {"people": rounded(found[measure.key]), "halves": both}
    return {
        "measures": rows,
        "curves": curves,
        "companions": {s.name: rounded(s.companions.any(axis=0).mean()) for s in opens},
        "files": [
            {"name": w.name, "source": w.source.source, "licence": w.source.licence} if w.source else {"name": w.name}
            for w in walks
        ],
    }


def _half(scene, end):
    low, high = (round(share * len(scene.position)) for share in end)
    return ~scene.stands & (scene.first >= low) & (scene.first < high)


def shipped() -> dict[str, Any]:
    """People's figures that ship with the project, as of `people`."""
    return json.loads(assets.path("human", "people.json").read_text())
