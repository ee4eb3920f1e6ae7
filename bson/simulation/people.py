"""The people of many worlds: their ways and their decisions.

A compiled program decides for the pedestrians of one world at a time, since a vectorised program may round differently:
what a pedestrian does depends on nothing in any other world, bit for bit. Worlds of any counts share a few compiled
decisions: people and boxes are filled up to the next of a few sizes, with people and boxes out of everybody's reach
(`decision`).
"""

import copy
import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bson.task import Spawn, TaskConfig, controller, stops, ways_checker
from macid import contacts, layout
from macid.layout import Layout
from macid.state import GOAL_RADIUS, MAX_SPEED, PAPER_TRAITS, RADIUS, CrowdState, Traits, parking_place
from macid.traits import shared_goals

# Sizes to which a decision's people (with the robot) and boxes are filled up; the paper's counts are among them. No
# size rounds up over a power of two, where the distance to a disc is rounded otherwise (macid.geometry.first_disc).
ROWS = (2, 4, 8, 16, 25, 32, 51, 64, 101, 128, 201, 256, 384, 512, 768, 1024, 1536, 2048)
BOXES = (4, 16, 44, 85, 128, 192, 256)
_BOX_STEP = 256  # sizes beyond these are multiples of it
_COLUMNS = (2, 1, 2, 1, 2, 1, 1)  # of a decision's array: position, yaw, velocity, yaw rate, goal, lcf, model


def rows_for(number: int) -> int:
    """The least of ROWS that has room for `number` people and a robot."""
    return next(rows for rows in ROWS if rows > number)


def _box_rows(number):
    """The least of BOXES, or else the least multiple of _BOX_STEP, that has room for `number` boxes."""
    return next((rows for rows in BOXES if rows >= number), -(-number // _BOX_STEP) * _BOX_STEP)


def find_ways(layout: Layout, router: Any, people: Any, places: np.ndarray, goals: np.ndarray) -> list[np.ndarray]:
    """Waypoints (W, 2) [m] of each of `people` from its row of `places` to its row of `goals`, the goal last.

    The waypoints lead along the person's route, if the map has routes, and around obstacles, if there is a router.
    Raises NoFreeSpace."""
    ways = [stops(layout, *each) for each in zip(people, places, goals, strict=True)]
    if router is None or not ways:
        return ways
    starts = np.concatenate([[place, *way[:-1]] for place, way in zip(places, ways, strict=True)])
    legs = iter(router.paths(starts, np.concatenate(ways)))
    return [np.concatenate([next(legs) for _ in way]) for way in ways]


def next_goals(
    config: TaskConfig,
    map_layout: Layout,
    router: Any,
    who: Sequence[int] | np.ndarray,
    places: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """New goals (N, 2) [m] of the people `who` (N,), who are at their goals, at `places` (N, 2).

    On a route a person goes back to the other end; elsewhere goals are drawn from the Generator `rng`. Raises
    NoFreeSpace."""
    if map_layout.routes:
        ends = [map_layout.routes[person % len(map_layout.routes)][[0, -1]] for person in who]
        far = [((pair - place) ** 2).sum(axis=-1).argmax() for pair, place in zip(ends, places, strict=True)]
        return np.reshape([pair[which] for pair, which in zip(ends, far, strict=True)], (-1, 2))
    region = map_layout.regions.get("people_goal")
    distance, joins = config.people_goal_distance, ways_checker(config, router)
    radius = config.person_radius
    return layout.sample_goals(rng, map_layout, places, distance, region=region, joins=joins, radius=radius)


def beside_companions(
    config: TaskConfig, map_layout: Layout, group: np.ndarray | None, places: np.ndarray, goals: np.ndarray
) -> np.ndarray:
    """`goals` (K, 2) [m] of people at `places` (K, 2), those of companions beside the goal of their `group`'s first
    person; on a route it is the same goal."""
    if group is None:
        return goals
    return shared_goals(map_layout, group, places, goals, config.person_radius, same=bool(map_layout.routes))


def given_traits(traits: Traits) -> tuple[str, ...]:
    """The names of the Traits that are not the paper's."""
    return tuple(name for name, value in zip(Traits._fields, traits, strict=True) if value is not None)


def with_others(traits: Traits, rows: int) -> Traits:
    """The Traits (K,) of people, NumPy or JAX, filled up to `rows`: with the robot, which people take for a disc of
    RADIUS, and with discs that are out of everybody's reach."""
    others = Traits(np.full(rows, RADIUS), np.ones(rows), np.full(rows, MAX_SPEED), np.arange(rows))

    def filled(value, other):
        if value is None:
            return None
        xp = value.__array_namespace__()
        return xp.concatenate([value, xp.asarray(other[value.shape[0] :], dtype=value.dtype)])

    return Traits(*(filled(*pair) for pair in zip(traits, others, strict=True)))


@functools.lru_cache(64)
def decision(controllers: tuple, rows: int, boxes: int, given: tuple[str, ...] = ()) -> Callable:
    """The decision of up to `rows` people among `boxes` boxes, by `controllers`, jitted: (rows, sum of _COLUMNS, and a
    column for each of the Traits `given`) and (boxes, 5) to (rows * 3,). The robot is one more disc, after the people;
    the discs that fill the rows up come last, out of everybody's reach. Worlds with any counts share a few decisions,
    as compiling one takes longer than all other work of making a World.

    Filling up changes nothing in learned people's decisions, bit for bit. With rules that add up forces, and with ORCA,
    it may change the last bit, as the compiler adds in another order. So all worlds with one count have the same number
    of rows.
    """

    def decide(packed, boxes):
        columns = jnp.split(packed, np.cumsum([*_COLUMNS, *(1 for _ in given)])[:-1], axis=-1)
        position, yaw, velocity, rate, goals, lcf, models, *own = columns
        traits = Traits(**{name: column[:, 0] for name, column in zip(given, own, strict=True)})
        if traits.group is not None:
            traits = traits._replace(group=traits.group.astype(jnp.int32))
        radius = RADIUS if traits.radius is None else traits.radius
        touching = contacts.touching(position, boxes, radius)
        state = CrowdState(position, yaw[:, 0], velocity, rate[:, 0], touching, traits)
        commands = [controller(state, boxes, goals, lcf[:, 0]) for controller in controllers]
        command = commands[0]
        for number, other in enumerate(commands[1:], start=1):
            command = jnp.where(models == number, other, command)
        return command.ravel()

    return jax.jit(decide)


class People:
    """`number` people in each of `nworld` worlds, among `boxes` boxes.

    heading (nworld, K, 2): the next waypoint, or the goal [m], once planned. layouts: each world's map.
    """

    def __init__(self, nworld: int, number: int, boxes: int):
        self.heading = np.zeros((nworld, number, 2))
        self.layouts: list[Any] = [None] * nworld
        self._routers: list[Any] = [None] * nworld
        self._rngs: list[Any] = [None] * nworld
        self._routes: list[list] = [[] for _ in range(nworld)]  # for each person, the waypoints after `heading`
        self._unplanned: list[Any] = [None] * nworld  # people's starts and goals, until their ways are needed
        self._traits: list[Traits] = [PAPER_TRAITS] * nworld
        rows, box_rows = rows_for(number), _box_rows(boxes)
        away = parking_place(np.arange(max(rows, box_rows)))
        self._rows = np.zeros((rows, sum(_COLUMNS)), np.float32)  # of a decision, while nobody is there
        self._rows[:, :2] = self._rows[:, 6:8] = away[:rows]
        self._boxes = np.zeros((nworld, box_rows, 5), np.float32)
        self._boxes[:, :, :2], self._boxes[:, :, 2:4] = -away[:box_rows], 0.1

    def configure(self, config: TaskConfig) -> None:
        """Goes on in the setting `config`, which has the same numbers of people and boxes."""
        self._controllers = tuple(controller(name, config.decision_period) for name in config.model_shares)
        self._config = config

    def begin(self, index: int, drawn: Spawn, rng: np.random.Generator) -> None:
        """Begins the episode `drawn` in world `index`; later goals are drawn from `rng`."""
        self.layouts[index], self._routers[index], self._rngs[index] = drawn.layout, drawn.router, rng
        self._boxes[index, : len(drawn.layout.boxes)] = drawn.layout.boxes
        self._unplanned[index] = drawn.people[:, :2].copy(), drawn.people_goals
        self._traits[index] = drawn.traits

    def traits(self, index: int) -> Traits:
        """The Traits (K,) of a world's people."""
        return self._traits[index]

    def begun(self, index: int) -> bool:
        """Whether world `index` has had an episode."""
        return self._rngs[index] is not None

    def plan(self, ids: Iterable[int]) -> None:
        """Finds the ways of the people of the worlds `ids` whose episodes have just begun.

        The search takes longer than all other work of a reset, so it waits until somebody walks or asks. It can't fail,
        as spawn has checked on every map that there are ways."""
        for index in ids:
            if self._unplanned[index] is not None:
                starts, goals = self._unplanned[index]
                ways = find_ways(self.layouts[index], self._routers[index], range(len(starts)), starts, goals)
                self.heading[index] = np.reshape([way[0] for way in ways], (-1, 2))
                self._routes[index], self._unplanned[index] = [way[1:] for way in ways], None

    def destinations(self, index: int) -> np.ndarray:
        """The ends (K, 2) [m] of the ways of a world's people."""
        if self._unplanned[index] is not None:
            return self._unplanned[index][1].copy()
        ways = zip(self.heading[index], self._routes[index], strict=True)
        return np.reshape([route[-1] if len(route) else goal for goal, route in ways], (-1, 2))

    def decide(
        self,
        ids: np.ndarray,
        pose: np.ndarray,
        rate: np.ndarray,
        robot_pose: np.ndarray,
        robot_rate: np.ndarray,
        lcf: np.ndarray,
        models: np.ndarray,
    ) -> list[np.ndarray]:
        """The decisions of the people of the worlds `ids`: for each world (3 K,), world-frame velocities [m/s] and yaw
        rates [rad/s].

        pose, rate (n, K, 3): x, y, yaw and their rates; robot_pose, robot_rate (n, 3): the robot's; lcf, models (n, K).
        The calls overlap: JAX computes one while the next begins.
        """
        k = self.heading.shape[1]
        packed = np.repeat(self._rows[None], len(ids), axis=0)
        packed[:, :k, :3], packed[:, :k, 3:6] = pose, rate
        packed[:, :k, 6:8], packed[:, :k, 8], packed[:, :k, 9] = self.heading[ids], lcf, models
        packed[:, k, :3], packed[:, k, 3:6] = robot_pose, robot_rate
        packed[:, k, 6:8] = packed[:, k, :2] + packed[:, k, 3:5]  # people assume that it wants to go on as it moves
        given = given_traits(self._traits[ids[0]]) if len(ids) else ()
        if given:
            own = [with_others(self._traits[index], packed.shape[1]) for index in ids]
            columns = [np.stack([getattr(each, name) for name in given], axis=-1) for each in own]
            packed = np.concatenate([packed, np.asarray(columns, np.float32)], axis=-1)
        decide = decision(self._controllers, packed.shape[1], self._boxes.shape[1], given)
        commands = [decide(packed[row], self._boxes[index]) for row, index in enumerate(ids)]
        return [np.asarray(command)[: 3 * k] for command in commands]

    def advance(self, ids: np.ndarray, places: np.ndarray, draws: Callable) -> None:
        """Lets people of the worlds `ids`, now at `places` (n, K, 2), go on from a waypoint that they reached to the
        next one, and from their goal to a new one. draws(rng): called before a goal is drawn from the Generator
        `rng`."""
        offset = places - self.heading[ids]
        there = np.argwhere((offset**2).sum(axis=-1) <= GOAL_RADIUS**2)
        finished = {}
        for row, person in there:
            index = ids[row]
            route = self._routes[index][person]
            if len(route):
                self.heading[index, person], self._routes[index][person] = route[0], route[1:]
            else:
                finished.setdefault(row, []).append(person)
        for row, who in finished.items():
            self._new_goals(ids[row], np.array(who), places[row], draws)

    def _new_goals(self, index, who, places, draws):
        """New goals, and ways to them, for the people `who` of a world, all of which are at `places` (K, 2). Companions
        get theirs as soon as one of them has arrived.

        A person for whom no goal is found (crowded into a corner of a small map) stays, and asks again at the next
        decision.
        """
        map_layout, router, group = self.layouts[index], self._routers[index], self._traits[index].group
        try:
            if not map_layout.routes:
                draws(self._rngs[index])
            asking = who if group is None else np.unique(group[who])
            goals = next_goals(self._config, map_layout, router, asking, places[asking], self._rngs[index])
            if group is not None:
                every = np.zeros_like(places)
                every[asking], who = goals, np.flatnonzero(np.isin(group, asking))
                goals = beside_companions(self._config, map_layout, group, places, every)[who]
            ways = find_ways(map_layout, router, who, places[who], goals)
        except layout.NoFreeSpace:
            return
        for person, way in zip(who, ways, strict=True):
            self.heading[index, person], self._routes[index][person] = way[0], way[1:]

    def own_generators(self, memo: dict) -> None:
        """Goes on with copies of its Generators (memo: copy.deepcopy's), so that no other People object draws from
        them."""
        self._rngs = copy.deepcopy(self._rngs, memo)

    def save(self) -> dict:
        """The whole state on which the next calls depend, for `restore`, except the Generators'."""
        lists = {name: list(getattr(self, name)) for name in ("layouts", "_routers", "_rngs", "_unplanned", "_traits")}
        arrays = {name: getattr(self, name).copy() for name in ("heading", "_boxes")}
        return {**lists, **arrays, "_routes": [list(ways) for ways in self._routes]}

    def restore(self, saved: dict) -> None:
        """Goes back to a state from `save`, of this or another People object with the same numbers of people and
        worlds."""
        for name, value in saved.items():
            getattr(self, name)[:] = value
