"""What is measured of walking people, real ones and models' alike: pure NumPy.

Walks are positions (T, K, 2) [m] on a grid of times, NaN where somebody is not there (`macid.human.data.Walks`). Each
measure stands on its own; there is no single score. Two people collide where their centres come within CENTRES of each
other, whatever the radius of a model's bodies: all are judged by one ruler.
"""

import warnings
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

STRIDE = 0.4  # speeds are means over it: the time between samples of the open scenes [s]
LEAST_SAMPLES = 3  # a person who is seen less often is not measured
STANDS = 0.3  # people whose mean speed is below it stand [m/s]
CENTRES = 0.4  # the centres' distance at which two discs collide [m]
TAUS = (0.5, 1.0, 2.0)  # the times to collision whose E is told [s]
TAU_SHARE = 0.2  # E(tau) is of times to collision within this share of tau
TAU_EDGES = np.concatenate(
    [np.arange(0.2, 1.0, 0.2), np.arange(1.0, 3.0, 0.25), np.arange(3.0, 8.01, 0.5)]
)  # E's curve
TAU_FAR = (4.0, 8.0)  # where g is 1 [s]
SOON = 2.0  # [s]
CLOSE = (0.7, 0.4)  # [m]
SHIFTS = 10  # other times that each instant is paired with
COMPANION_DISTANCE, COMPANION_SHARE = 1.5, 0.7  # within it [m], for this share of the time that both are there
COMPANION_TIME, COMPANION_SPEED = 1.6, 0.6  # least time [s], and greatest mean difference of velocities [m/s]
DENSITIES = (0.8, 1.2, 1.6, 2.0, 2.4)  # the middles of the fundamental diagram's bins [1/m2]
DENSITY_HALF = 0.2  # half the width of these bins [1/m2]
LANE_REACH = 0.375  # sideways [m]


class Box(NamedTuple):
    """Where a density is measured: x and y between two bounds [m]."""

    x: tuple[float, float]
    y: tuple[float, float]

    @property
    def area(self) -> float:
        """[m2]"""
        return (self.x[1] - self.x[0]) * (self.y[1] - self.y[0])

    def holds(self, position: np.ndarray) -> np.ndarray:
        """Whether each of `position` (..., 2) lies in it: (...); where there is nobody, it does not."""
        x, y = position[..., 0], position[..., 1]
        return (x >= self.x[0]) & (x < self.x[1]) & (y >= self.y[0]) & (y < self.y[1])


def strides(position: np.ndarray, period: float) -> np.ndarray:
    """Every STRIDE's position: `position` (T, K, 2) on a grid of `period` [s], thinned to one of STRIDE."""
    step = round(STRIDE / period)
    if abs(step * period - STRIDE) > 1e-6 or step < 1:
        raise ValueError(f"the grid's period must divide {STRIDE} s, not be {period:g} s")
    return position[::step]


def velocities(position: np.ndarray, period: float) -> np.ndarray:
    """Everybody's mean velocity over the STRIDE that begins at each instant: (T, K, 2) [m/s]; in a person's last
    STRIDE, over the one that ends then. NaN where somebody is not there for a STRIDE."""
    step = round(STRIDE / period)
    ahead = np.full(position.shape, np.nan)
    ahead[:-step] = (position[step:] - position[:-step]) / STRIDE
    behind = np.full(position.shape, np.nan)
    behind[step:] = ahead[:-step]
    return np.where(np.isnan(ahead), behind, ahead)


class Person(NamedTuple):
    """How each of K people walks; NaN of people who are seen less than LEAST_SAMPLES times."""

    speed: np.ndarray  #: mean [m/s]
    within: np.ndarray  #: standard deviation of a person's own speeds [m/s]
    straightness: np.ndarray  #: displacement / path
    smoothness: np.ndarray  #: mean change of speed from STRIDE to STRIDE, without its sign, a second [m/s2]
    walks: np.ndarray  #: bool: faster than STANDS


def people(position: np.ndarray, period: float) -> Person:
    """How each person walks, from positions (T, K, 2) [m] on a grid of `period` [s].

    A person's STRIDEs begin when it comes: its own first sample, not the grid's."""
    rows = []
    for who in range(position.shape[1]):
        own = position[:, who]
        own = strides(own[~np.isnan(own[:, 0])], period)
        if len(own) < LEAST_SAMPLES:
            rows.append([np.nan] * 4)
            continue
        ways = np.linalg.norm(np.diff(own, axis=0), axis=-1)
        speed, path = ways / STRIDE, ways.sum()
        straight = np.linalg.norm(own[-1] - own[0]) / path if path > 0 else np.nan
        rows.append([speed.mean(), speed.std(), straight, np.abs(np.diff(speed)).mean() / STRIDE])
    speed, within, straightness, smoothness = np.array(rows).reshape(-1, 4).T
    return Person(speed, within, straightness, smoothness, speed > STANDS)


def time_to_collision(apart: np.ndarray, velocity: np.ndarray, centres: float = CENTRES) -> np.ndarray:
    """After how long two discs touch that keep their velocities: (...) [s], infinite where they never do, and where
    they overlap. apart, velocity: of the one, from the other (..., 2) [m, m/s]. centres: their distance then [m]."""
    a, b = (velocity**2).sum(axis=-1), (apart * velocity).sum(axis=-1)
    c = (apart**2).sum(axis=-1) - centres**2
    root = b**2 - a * c
    meets = (c > 0) & (b < 0) & (root >= 0)
    return np.where(meets, (-b - np.sqrt(np.where(meets, root, 0.0))) / np.where(meets, a, 1.0), np.inf)


def companions(position: np.ndarray, period: float) -> np.ndarray:
    """Who walks with whom: (K, K) bool, symmetric, from positions (T, K, 2) [m].

    Companions are within COMPANION_DISTANCE of each other for COMPANION_SHARE of the time that both are there, which is
    COMPANION_TIME or more, with velocities that differ by less than COMPANION_SPEED in the mean."""
    velocity = velocities(position, period)
    there, number = ~np.isnan(position[..., 0]), position.shape[1]
    found = np.zeros((number, number), bool)
    for who in range(number):
        times = there[:, who]
        others = np.flatnonzero(there[times].any(axis=0))
        others = others[others > who]
        both = there[times][:, others]
        distance = np.linalg.norm(position[times][:, others] - position[times, who][:, None], axis=-1)
        differs = np.linalg.norm(velocity[times][:, others] - velocity[times, who][:, None], axis=-1)
        shared = both.sum(axis=0)
        near = (np.where(both, distance, np.inf) < COMPANION_DISTANCE).sum(axis=0)
        known = ~np.isnan(differs)
        mean = np.where(known, differs, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        long = shared * period >= COMPANION_TIME - 1e-9
        found[who, others] = long & (near >= COMPANION_SHARE * shared) & (mean < COMPANION_SPEED)
    return found | found.T


class Meetings(NamedTuple):
    """What pairs of people do in one scene: sums, so that scenes are added up (`added`)."""

    together: np.ndarray  #: pairs of strangers who are there together, by time to collision: TAU_EDGES' bins, TAUS, FAR
    apart: np.ndarray  #: pairs from different times, in the same bins; of SHIFTS such times in the mean
    time: float  #: instants x people
    soon: float  #: of these, on a collision course with a stranger within SOON
    close: np.ndarray  #: of these, with somebody's centre within each of CLOSE

    @classmethod
    def added(cls, several: Iterable["Meetings"]) -> "Meetings":
        """All of them together."""
        return cls(*(np.sum(parts, axis=0) for parts in zip(*several, strict=True)))

    @property
    def soon_share(self) -> float:
        """The share of person-time on a collision course with a stranger within SOON."""
        return self.soon / self.time if self.time else np.nan

    @property
    def close_shares(self) -> np.ndarray:
        """The shares of person-time with somebody's centre within each of CLOSE."""
        return self.close / self.time if self.time else np.full(len(CLOSE), np.nan)

    def anticipation(self) -> np.ndarray:
        """E at TAUS. E = -ln g, g being the density of strangers' times to collision over that of pairs who don't see
        each other (Karamouzas, Skinner, Guy: Universal power law governing pedestrian interactions, PRL 2014), 1 at
        TAU_FAR. NaN where nobody was to meet then; infinite where of people who are together nobody was."""
        return self._energy()[len(TAU_EDGES) - 1 : -1]

    def curve(self) -> tuple[np.ndarray, np.ndarray]:
        """(the middles of TAU_EDGES [s], E there)."""
        return (TAU_EDGES[1:] + TAU_EDGES[:-1]) / 2, self._energy()[: len(TAU_EDGES) - 1]

    def _energy(self):
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = self.together / self.apart
            return -np.log(ratio / ratio[-1])


_LOW = np.array([*TAU_EDGES[:-1], *((1 - TAU_SHARE) * tau for tau in TAUS), TAU_FAR[0]])
_HIGH = np.array([*TAU_EDGES[1:], *((1 + TAU_SHARE) * tau for tau in TAUS), TAU_FAR[1]])


def _counted(times):
    """How many of `times` (...) [s] lie in each bin of Meetings."""
    times = np.sort(times[times < _HIGH.max()])
    return (np.searchsorted(times, _HIGH) - np.searchsorted(times, _LOW)).astype(float)


def meetings(position: np.ndarray, velocity: np.ndarray, known: np.ndarray) -> Meetings:
    """Pairs of people in one scene, from everybody's positions and velocities (T, K, 2) [m, m/s] every STRIDE, NaN
    where somebody is not there. known: (K, K) bool, pairs who are no strangers. A pair counts from both
    sides.

    Strangers who overlap are on a collision course, too, but have no time to collision."""
    there = [np.flatnonzero(row) for row in ~np.isnan(position[..., 0] + velocity[..., 0])]
    instants = len(there)
    together, soon, people_time, close = np.zeros(len(_LOW)), 0.0, 0.0, np.zeros(len(CLOSE))
    for at, who in enumerate(there):
        if not len(who):
            continue
        place, speed = position[at, who], velocity[at, who]
        offset = place[None] - place[:, None]
        times = time_to_collision(offset, speed[None] - speed[:, None])
        friends, distance = known[np.ix_(who, who)], np.linalg.norm(offset, axis=-1)
        np.fill_diagonal(distance, np.inf)
        times[friends] = np.inf
        together += _counted(times)
        soon += ((times < SOON) | ((distance < CENTRES) & ~friends)).any(axis=1).sum()
        close += [(distance.min(axis=1) < bound).sum() for bound in CLOSE]
        people_time += len(who)
    apart = np.zeros(len(_LOW))
    for shift in range(1, SHIFTS + 1):
        by = instants * shift // (SHIFTS + 1)
        for at, who in enumerate(there):
            then = (at + by) % instants
            other = there[then]
            if len(who) and len(other):
                times = time_to_collision(
                    position[then, other][None] - position[at, who][:, None],
                    velocity[then, other][None] - velocity[at, who][:, None],
                )
                times[who[:, None] == other] = np.inf
                apart += _counted(times)
    return Meetings(together, apart / SHIFTS, people_time, soon, close)


def densities(position: np.ndarray, period: float, box: Box) -> tuple[np.ndarray, np.ndarray]:
    """The fundamental diagram's points, an instant each in which somebody is in `box`: (density [1/m2], mean speed of
    the people in it [m/s]), both (N,)."""
    speed = np.linalg.norm(velocities(position, period), axis=-1)
    inside = box.holds(position) & ~np.isnan(speed)
    number = inside.sum(axis=1)
    some = number > 0
    mean = np.where(inside, speed, 0.0).sum(axis=1)[some] / number[some]
    return number[some] / box.area, mean


def binned(density: np.ndarray, speed: np.ndarray) -> list[float]:
    """The mean of `speed` in DENSITIES' bins; NaN where there is none."""
    bins = [np.abs(density - middle) <= DENSITY_HALF + 1e-9 for middle in DENSITIES]
    return [float(speed[chosen].mean()) if chosen.any() else float("nan") for chosen in bins]


def crossing_times(position: np.ndarray, period: float, y: float, way: int = -1) -> np.ndarray:
    """When people first cross the line at `y` [m], towards smaller y (way -1) or greater (1): sorted (N,) [s], each
    interpolated between samples."""
    along = way * (position[..., 1] - y)
    before, after = along[:-1], along[1:]
    crosses = (before < 0) & (after >= 0)
    someone = crosses.any(axis=0)
    at = crosses.argmax(axis=0)[someone]
    b, a = before[at, np.flatnonzero(someone)], after[at, np.flatnonzero(someone)]
    return np.sort((at - b / (a - b)) * period)


def flow(times: np.ndarray, width: float, crowd: int, until: float) -> float:
    """Persons/m/s through an exit of `width` [m] by their `times` (N,) [s], sorted, from when 10% of the `crowd` have
    gone until 80% have: neither the first, who find it free, nor the last, who find no queue.

    Of a crowd of whom fewer have gone when its time is over, it is `until` then [s]; of one of whom fewer than 10%
    have, from the beginning."""
    first, last = round(0.1 * crowd), round(0.8 * crowd)
    if len(times) > last:
        return float((last - first) / (times[last] - times[first]) / width)
    if len(times) > first:
        return float((len(times) - 1 - first) / (until - times[first]) / width)
    return float(len(times) / until / width)


def lane_order(position: np.ndarray, towards: np.ndarray) -> float:
    """How well two ways keep apart: the mean over people and instants of ((same - opposite) / (same + opposite))^2 of
    the people whose x lies within LANE_REACH of a person's own, itself included (Nowak and Schadschneider, Phys. Rev. E
    2012). position: (T, K, 2) [m], of those within the corridor, NaN elsewhere. towards: (K,) 1 or -1.

    1 with lanes; where n people of either way stand there at random, 1 / n. A person who has nobody beside it does not
    count; NaN where nobody has."""
    found = []
    for row in position:
        who = np.flatnonzero(~np.isnan(row[:, 0]))
        beside = np.abs(row[who, None, 0] - row[None, who, 0]) < LANE_REACH
        number = beside.sum(axis=1)
        some = number > 1
        found.append(((beside * towards[who]).sum(axis=1)[some] / number[some]) ** 2)
    found = np.concatenate(found) if found else np.array([])
    return float(found.mean()) if len(found) else float("nan")


def displacement_errors(model: np.ndarray, real: np.ndarray) -> tuple[float, float]:
    """(ADE, FDE) [m]: how far each person of `model` (T, K, 2) is from its place in `real` (T, K, 2), in the mean over
    all instants in which the real one is there, and at the last of these. Means over people.

    Who has arrived, and so left `model`, counts as standing where it was last."""
    ade, fde = [], []
    for who in range(real.shape[1]):
        times = np.flatnonzero(~np.isnan(real[:, who, 0]))
        if len(times) < LEAST_SAMPLES:
            continue
        own = held(model[:, who])[times]
        error = np.linalg.norm(own - real[times, who], axis=-1)
        if np.isnan(error).any():
            error = error[~np.isnan(error)]
        if len(error):
            ade.append(error.mean())
            fde.append(error[-1])
    return (float(np.mean(ade)), float(np.mean(fde))) if ade else (float("nan"), float("nan"))


def held(walk: np.ndarray) -> np.ndarray:
    """`walk` (T, 2) with every NaN after a place replaced by the last place before it."""
    known = np.where(np.isnan(walk[:, 0]), 0, np.arange(len(walk)))
    return walk[np.maximum.accumulate(known)]


def wasserstein(a: np.ndarray, b: np.ndarray) -> float:
    """The first Wasserstein distance of two samples (N,), (M,): how far one's values lie from the other's, in their
    unit. NaN where either is empty."""
    from scipy.stats import wasserstein_distance

    a, b = a[~np.isnan(a)], b[~np.isnan(b)]
    return float(wasserstein_distance(a, b)) if len(a) and len(b) else float("nan")


def mean(values: np.ndarray) -> float:
    """Of those that are not NaN; NaN where there is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return float(np.nanmean(values))


def deviation(values: np.ndarray) -> float:
    """The standard deviation of those that are not NaN; NaN where there is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return float(np.nanstd(values))
