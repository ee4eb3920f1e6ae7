"""Any pedestrian model on a layout where people come and go in the middle of the play.

Each world has its own cast. Everybody comes at its time and place, with its velocity, and leaves at its goal or when
its time is over. A slot of the engine's serves one person after the other; whoever is not there stands far away.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from macid import scene
from macid.engines import make_engine
from macid.files import UsageError
from macid.geometry import Array, norm
from macid.layout import Layout
from macid.pedestrians import Controller
from macid.state import GOAL_RADIUS, MAX_SPEED, RADIUS, CrowdState, parking_place, physics_steps

STEP = 0.4  # between the places of Cast.walk [s]
_NOBODY = -1
_SAMPLE = 0.1  # the longest time between kept places [s]


class Cast(NamedTuple):
    """The P people of one world."""

    comes: np.ndarray  #: (P,) [s]
    leaves: np.ndarray  #: (P,) [s]: at the latest, having arrived or not
    place: np.ndarray  #: (P, 2) [m], where they come
    velocity: np.ndarray  #: (P, 2) [m/s], with which they come
    goal: np.ndarray  #: (P, 2) [m]
    speed: np.ndarray | None = None  #: (P,) preferred [m/s]; None: the model's own
    walk: np.ndarray | None = None  #: (T, P, 2) [m], every STEP: of people who are moved along it; NaN: by the model
    group: np.ndarray | None = None  #: (P,) int, as in macid.state.Traits; None: everybody walks alone
    lcf: np.ndarray | None = None  #: (P,); None: drawn from the Body's range


@dataclasses.dataclass(frozen=True)
class Body:
    """What people are like whom a model moves."""

    radius: float = RADIUS  # [m]
    max_speed: float = MAX_SPEED  # [m/s]
    lcf: tuple[float, float] = (0.67, 1.33)  # the range from which each draws


class _Timed(NamedTuple):
    """What happens as each decision begins; leading axes (decisions, nworld)."""

    comes: Any  #: (..., K) int: the person who comes into each slot, or _NOBODY
    ends: Any  #: (..., K) bool: whose time is over
    number: Any  #: (...) int: of the decision


class Stage:
    """The worlds of `casts` on `layout`, as one batch, for `duration` [s].

    controller: deciding every `period` [s], a multiple of the physics step. ring: the y-axis is a ring of this length
    [m]. People beyond its end go on at its beginning, everybody sees, and touches, the nearest image of everybody, and
    goals move along with people.
    """

    def __init__(
        self,
        layout: Layout,
        casts: list[Cast],
        duration: float,
        controller: Controller,
        period: float,
        body: Body,
        rng: np.random.Generator,
        engine: str = "native",
        ring: float | None = None,
    ):
        self.casts, self.period, self.body, self.ring, self._controller = casts, period, body, ring, controller
        self.duration, self._substeps = duration, physics_steps(period)
        self._steps = int(np.ceil(duration / period - 1e-9)) + 1
        self._keep = max(1, int(_SAMPLE / period + 1e-9))  # decisions between kept places
        self._steps += -self._steps % self._keep
        self.people = max(len(cast.comes) for cast in casts)
        self._timed = self._schedule()
        self.number = self._timed.comes.shape[-1]
        self.bodies = 2 * self.number if ring else self.number
        model = scene.crowd_spec(layout, self.bodies, scene.PersonConfig(radius=body.radius)).compile()
        self.engine = make_engine(engine, model, self.bodies, layout.boxes, len(casts))
        self._place, self._velocity, self._goal = (self._stacked(name, 2) for name in ("place", "velocity", "goal"))
        self._walk = self._walks()
        self._group = None if casts[0].group is None else self._stacked("group").astype(int)
        self._speed = None if casts[0].speed is None else self._stacked("speed")
        drawn = jnp.asarray(rng.uniform(*body.lcf, (len(casts), self.people)), jnp.float32)
        self._lcf = drawn if casts[0].lcf is None else self._stacked("lcf")
        self._away = jnp.asarray(parking_place(np.arange(self.bodies)), jnp.float32)

    def play(self, sample: float) -> list[np.ndarray]:
        """Where everybody is every `sample` [s]: of each world, positions (T, P, 2) [m], NaN where somebody is not
        there. Raises UsageError where physics fails."""
        (state, *_), (position, who) = jax.jit(self._run)(self._timed)
        if faults := [what for what in self.engine.faults(state) if what]:
            raise UsageError(f"Physics failed: {faults[0]}.")
        position, who = np.asarray(position), np.asarray(who)
        return [self._of_people(cast, position[:, w], who[:, w], sample) for w, cast in enumerate(self.casts)]

    def _stacked(self, name, *width):
        """The field `name` of all casts: (nworld, people, *width)."""
        found = np.zeros((len(self.casts), self.people, *width), np.float32)
        for world, cast in enumerate(self.casts):
            found[world, : len(cast.comes)] = getattr(cast, name)
        return jnp.asarray(found)

    def _schedule(self):
        """Who comes and goes in which slot, a _Timed: a slot is free for the next one once its person's time is
        over."""
        spans = [
            (
                np.clip(np.ceil(cast.comes / self.period - 1e-6), 0, self._steps - 1).astype(int),
                np.clip(np.ceil(cast.leaves / self.period - 1e-6), 1, self._steps).astype(int),
            )
            for cast in self.casts
        ]
        slots = [_slots(first, last) for first, last in spans]
        shape = (self._steps, len(self.casts), max(int(slot.max(initial=0)) + 1 for slot in slots))
        comes, ends = np.full(shape, _NOBODY, np.int16), np.zeros(shape, bool)
        for world, ((first, last), slot) in enumerate(zip(spans, slots, strict=True)):
            comes[first, world, slot] = np.arange(len(slot))
            gone = last < self._steps
            ends[last[gone], world, slot[gone]] = True
        return _Timed(comes, ends, np.arange(self._steps, dtype=np.int32))

    def _walks(self):
        """Cast.walk of all (T, nworld, people, 2) [m]; None where nobody is moved along one."""
        walks = [cast.walk for cast in self.casts]
        if all(walk is None for walk in walks):
            return None
        longest = max(len(walk) for walk in walks if walk is not None) + 1
        found = np.full((longest, len(walks), self.people, 2), np.nan, np.float32)
        for world, walk in enumerate(walks):
            if walk is not None:
                found[: len(walk), world, : walk.shape[1]] = walk
        return jnp.asarray(found)

    def _run(self, timed):
        worlds = len(self.casts)
        start = self.engine.init(
            jnp.broadcast_to(self._away, (worlds, self.bodies, 2)), jnp.zeros((worlds, self.bodies))
        )
        nobody = jnp.full((worlds, self.number), _NOBODY), jnp.zeros((worlds, self.number), bool)

        def kept(carried, timed):
            carried, seen = jax.lax.scan(self._decide, carried, timed)
            return carried, jax.tree.map(lambda each: each[0], seen)

        timed = jax.tree.map(lambda each: each.reshape(-1, self._keep, *each.shape[1:]), timed)
        return jax.lax.scan(kept, (start, *nobody), timed)

    def _decide(self, carried, timed):
        """One decision: (physics, who has each slot, who of them is there) after it, and what is kept of its
        beginning."""
        state, who, there = carried
        new = timed.comes >= 0
        who, there = jnp.where(new, timed.comes, who), new | (there & ~timed.ends)
        each, own = jnp.arange(len(self.casts))[:, None], jnp.maximum(who, 0)
        start, goal, entry = self._place[each, own], self._goal[each, own], self._velocity[each, own]
        led = jnp.zeros_like(there)
        where, moved = jnp.where(new[..., None], start, self._away[: self.number]), new | timed.ends
        if self._walk is not None:
            walk = _along(self._walk, timed.number * (self.period / STEP))[each, own]
            led = there & ~jnp.isnan(walk[..., 0])
            where, moved = jnp.where(led[..., None], walk, where), moved | led
        towards = jnp.where(norm(entry)[..., None] > 1e-3, entry, goal - start)
        yaw = jnp.arctan2(towards[..., 1], towards[..., 0])
        if self.ring:
            state, goal = self._turned(state, new, moved, there, where, entry, yaw, goal - start)
        else:
            still = jnp.where(new[..., None], entry, 0.0)
            yaw = jnp.where(new, yaw, self.engine.read(state).yaw)
            state = self.engine.place(state, moved, where, still, yaw)
        now = self._wishing(self.engine.read(state), own, there)
        command = self._controller(now, self.engine.boxes, goal, self._both(self._lcf[each, own]))
        command = jnp.where((there & ~led)[..., None], command[:, : self.number], 0.0)
        state = self.engine.step(state, self._both(command), self._substeps)
        after = self.engine.read(state).position[:, : self.number]
        if not self.ring:
            arrived = there & ~led & (norm(goal - after) <= GOAL_RADIUS)
            state, gone = self.engine.place(state, arrived, self._away), arrived
        else:
            gone = jnp.zeros_like(there)
        place = jnp.where(there[..., None], now.position[:, : self.number], jnp.nan)
        return (state, who, there & ~gone), (place, own)

    def _both(self, values):
        """`values` (nworld, number, ...) of people, and of their images on a ring."""
        return jnp.concatenate([values, values], axis=1) if self.ring else values

    def _wishing(self, state: CrowdState, own: Array, there: Array) -> CrowdState:
        """`state` with the wishes of the people `own` (nworld, number), where somebody is `there`."""
        shape = state.position.shape[:-1]
        each = jnp.arange(len(self.casts))[:, None]
        most = None if self.body.max_speed == MAX_SPEED else jnp.full(shape, self.body.max_speed, jnp.float32)
        wanted = None if self._speed is None else self._both(self._speed[each, own])
        traits = state.traits._replace(preferred_speed=wanted, max_speed=most)
        if self._group is not None:
            nobody = -1 - jnp.arange(self.number)  # in an empty slot, who is nobody's companion
            traits = traits._replace(group=self._both(jnp.where(there, self._group[each, own], nobody)))
        return state._replace(traits=traits)

    def _turned(self, state, new, moved, there, where, entry, yaw, ahead):
        """(physics, goals of people and images) on a ring, once everybody is on it and images are where they belong."""
        round_ = jnp.asarray([0.0, self.ring])
        now = self.engine.read(state)
        here = now.position[:, : self.number]
        turns = jnp.where(there & ~moved, jnp.round(here[..., 1] / self.ring), 0.0)
        here = jnp.where(moved[..., None], where, here - turns[..., None] * round_)
        image = here - jnp.where(here[..., 1:] >= 0, 1.0, -1.0) * round_
        image = jnp.where(there[..., None], image, self._away[self.number :])
        speed = jnp.where(new[..., None], entry, now.velocity[:, : self.number])
        yaw = jnp.where(new, yaw, now.yaw[:, : self.number])
        state = self.engine.place(
            state,
            jnp.concatenate([moved | (turns != 0), jnp.ones_like(there)], axis=1),
            jnp.concatenate([here, image], axis=1),
            self._both(speed),
            self._both(yaw),
        )
        return state, jnp.concatenate([here + ahead, image + ahead], axis=1)

    def _of_people(self, cast, position, who, sample):
        """Positions (T, P, 2) every `sample` [s], of those (N, K, 2) of slots with the people `who` (N, K)."""
        kept = np.full((len(position), len(cast.comes), 2), np.nan)
        there = ~np.isnan(position[..., 0])
        row, slot = np.nonzero(there)
        kept[row, who[row, slot]] = position[row, slot]
        times = np.arange(len(kept)) * self._keep * self.period
        return sampled(kept, times, np.arange(int(self.duration / sample + 1e-6) + 1) * sample)


def sampled(walks: np.ndarray, times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """`walks` (T, P, 2), known at `times` (T,), evenly spaced, at the times `wanted` (N,): (N, P, 2), interpolated
    between two known places; NaN where one of them is missing."""
    step = (times[-1] - times[0]) / max(1, len(times) - 1) or 1.0
    exact = (wanted - times[0]) / step
    before = np.clip(np.floor(exact + 1e-4).astype(int), 0, len(times) - 1)
    share = np.clip(exact - before, 0.0, 1.0)
    share = np.where(share < 1e-3, 0.0, share)[:, None, None]
    after = np.minimum(before + 1, len(times) - 1)
    found = np.where(share > 0, walks[before] * (1 - share) + walks[after] * share, walks[before])
    found[exact > len(times) - 1 + 1e-3] = np.nan
    return found


def _along(walk, exact):
    """Places of `walk` (T, nworld, people, 2) [m] at the step `exact`, not always a whole number; NaN where there is
    none."""
    before = jnp.minimum(jnp.floor(exact + 1e-4).astype(int), len(walk) - 1)
    after = jnp.minimum(before + 1, len(walk) - 1)
    share = exact - before
    return jnp.where(share > 1e-3, walk[before] * (1.0 - share) + walk[after] * share, walk[before])


def _slots(first, last):
    """A slot for each person, who needs it from decision `first` to `last` (P,): as few as possible."""
    free_from, slot = [], np.zeros(len(first), int)
    for who in np.argsort(first, kind="stable"):
        ready = [number for number, time in enumerate(free_from) if time <= first[who]]
        slot[who] = ready[0] if ready else len(free_from)
        if not ready:
            free_from.append(0)
        free_from[slot[who]] = max(last[who], first[who] + 1)
    return slot
