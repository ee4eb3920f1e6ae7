"""Episodes drawn on the host for worlds on a device: a ring of them there, refilled in the background.

An episode is drawn by `bson.task.spawn` from its seed, as everywhere else. The native world draws a new goal when a
person has arrived at the last one. Here these goals are drawn beforehand, from the same stream after the spawn. So each
goal is drawn around the last goal, and not around the place, up to GOAL_RADIUS away, at which the person arrives. A
person at the end of its ways walks them back.

Episodes may have settings of their own, as far as worlds of one structure can have them: other LCFs and distances to
goals, fewer people and fewer obstacles. Those who are missing stand far off the map, out of everybody's sight.
"""

import concurrent.futures
import itertools
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from bson import robot
from bson.simulation.data import MAP_RESOLUTION
from bson.simulation.people import beside_companions, find_ways, next_goals
from bson.simulation.scene import structure
from bson.task import TaskConfig, spawn
from macid import layout, start
from macid.documents import shown
from macid.routing import occupancy_grid
from macid.state import PAPER_TRAITS, Traits

GOALS = 8  # of each person, where ways are straight
ROUTED_GOALS = 3  # where ways lead around obstacles, which the host takes far longer to find
ROUTED_WAYPOINTS = 32
_BLOCK = 64  # episodes that a worker draws at once
_TRIED = 50  # settings of an episode that are tried, where there is no room for it
_AWAY, _APART = 1000.0, 50.0  # where who is missing stands, and how far from each other [m]


def check_number(name: str, value: Any, least: int) -> None:
    """Raises ValueError unless `value` is None, for as many as are needed, or a whole number of at least `least`."""
    if value is not None and not (isinstance(value, int) and not isinstance(value, bool) and value >= least):
        raise ValueError(f"{name} must be None or a whole number of at least {least}, not {shown(value)}.")


class Drawn(NamedTuple):
    """How an episode begins: NumPy or JAX arrays, with a leading axis where there are many."""

    seed: Any  #: (2,) uint32, the lower half first
    boxes: Any  #: (B, 5)
    robot: Any  #: (7,) of the robot's free joint
    goal: Any  #: (2,) [m]
    start_distance: Any  #: () [m]
    people: Any  #: (K, 3) x, y, yaw
    lcf: Any  #: (K,)
    models: Any  #: (K,) int32
    ways: Any  #: (K, W, 2) waypoints [m], goal after goal
    turns: Any  #: (K,) int32: number of waypoints
    map: Any  #: (cells, cells) uint8, see bson.episodes.tracks; (0, 0) unless asked for
    traits: Traits = PAPER_TRAITS  #: of people, (K,) each


def _itineraries(config, drawn, rng):
    """Waypoints (K, W, 2) [m] of the people of a Spawn, and how many each has (K,)."""
    count, routed = config.people, drawn.router is not None or bool(drawn.layout.routes)
    goals, most = (ROUTED_GOALS, ROUTED_WAYPOINTS) if routed else (GOALS, GOALS)
    chains = [[] for _ in range(count)]
    places, ends = drawn.people[:, :2], drawn.people_goals
    for number in range(goals if count else 0):
        if number:
            try:
                goals_then = next_goals(config, drawn.layout, drawn.router, range(count), ends, rng)
                goals_then = beside_companions(config, drawn.layout, drawn.traits.group, ends, goals_then)
                places, ends = ends, goals_then
            except layout.NoFreeSpace:  # then the person goes back from there
                break
        for chain, way in zip(chains, find_ways(drawn.layout, drawn.router, range(count), places, ends), strict=True):
            chain.extend(way)
    ways, turns = np.zeros((count, most, 2), np.float32), np.zeros(count, np.int32)
    for person, chain in enumerate(chains):
        turns[person] = min(len(chain), most)
        ways[person, : turns[person]] = chain[:most]
    return ways, turns


def draw(config: TaskConfig, seed: int, with_map: bool = False) -> Drawn:
    """The episode `seed` of `config`: Drawn, of NumPy arrays. Raises NoFreeSpace."""
    rng = np.random.default_rng(int(seed))
    drawn = spawn(config, rng)
    ways, turns = _itineraries(config, drawn, rng)
    x, y, yaw = drawn.robot
    grid = occupancy_grid(drawn.layout, MAP_RESOLUTION, radius=0.0) if with_map else np.zeros((0, 0))
    return Drawn(
        np.array([seed & 0xFFFFFFFF, seed >> 32], np.uint32),
        drawn.layout.boxes.astype(np.float32),
        robot.spawn_qpos(x, y, yaw, config.robot).astype(np.float32),
        drawn.goal.astype(np.float32),
        np.float32(np.hypot(*(drawn.goal - drawn.robot[:2]))),
        drawn.people.astype(np.float32),
        drawn.lcf.astype(np.float32),
        drawn.models.astype(np.int32),
        ways,
        turns,
        grid.astype(np.uint8),
        drawn.traits,
    )


def _away(number, side):
    """Places (number, 2) [m] far off the map; side: 1 or -1, of people and of obstacles."""
    return np.stack([_AWAY + _APART * np.arange(number), np.full(number, side * _AWAY)], axis=-1).astype(np.float32)


def filled(drawn: Drawn, config: TaskConfig) -> Drawn:
    """The episode `drawn` for a world of `config`, which has at least as many people and obstacles."""
    missing = config.people - len(drawn.people)
    people = np.pad(drawn.people, ((0, missing), (0, 0)))
    people[len(drawn.people) :, :2] = _away(missing, 1)
    walls = structure(config)[2][0] - len(drawn.boxes)
    boxes = np.concatenate([drawn.boxes, np.zeros((walls, 5), np.float32)])
    boxes[len(drawn.boxes) :, :2] = _away(walls, -1)
    boxes[len(drawn.boxes) :, 2:4] = 0.1
    most = max(drawn.ways.shape[1], ROUTED_WAYPOINTS if len(boxes) > 4 else GOALS)
    ways = np.pad(drawn.ways, ((0, missing), (0, most - drawn.ways.shape[1]), (0, 0)))
    ways[len(drawn.people) :, 0] = people[len(drawn.people) :, :2]
    return drawn._replace(
        boxes=boxes,
        people=people,
        lcf=np.pad(drawn.lcf, (0, missing)),
        models=np.pad(drawn.models, (0, missing)),
        ways=ways,
        turns=np.pad(drawn.turns, (0, missing), constant_values=1),
    )


def _one(config, seed, with_map, settings):
    if settings is None:
        return draw(config, seed, with_map)
    failure = None
    for setting in itertools.islice(settings(seed), _TRIED):
        try:
            return filled(draw(setting, seed, with_map), config)
        except layout.NoFreeSpace as error:
            failure = error
    assert failure is not None
    raise failure


def draw_all(config: TaskConfig, seeds: Sequence[int], with_map: bool = False, settings: Any = None) -> Drawn:
    """The episodes `seeds` of `config`: Drawn, with a leading axis (len(seeds),). settings: settings(seed) gives the
    settings of the episode, the next one where the last has no room; None: all have `config`. Raises NoFreeSpace."""
    *fields, traits = zip(*(_one(config, seed, with_map, settings) for seed in seeds), strict=True)
    each = zip(*traits, strict=True)
    together = Traits(*(None if one[0] is None else np.stack(one) for one in each))
    return Drawn._make([*map(np.stack, fields), together])


class _Worker:
    """Another process that draws episodes, so that this one's interpreter is free."""

    def __init__(self):
        command = [sys.executable, "-c", "from bson.simulation.pool import serve; serve()"]
        environment = {**os.environ, "JAX_PLATFORMS": "cpu"}  # a worker needs no accelerator
        with start.quiet_children():  # it ends when this process ends or closes it
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
        assert self._process.stdin and self._process.stdout
        self._asked, self._answered, self._lock = self._process.stdin, self._process.stdout, threading.Lock()

    def __call__(self, *arguments):
        with self._lock:
            pickle.dump(arguments, self._asked)
            self._asked.flush()
            answer = pickle.load(self._answered)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def close(self):
        self._asked.close()
        self._process.wait()
        self._answered.close()


def serve() -> None:
    """The program of a worker process: draws the episodes asked for on its standard input, until that ends."""
    output, sys.stdout = sys.stdout.buffer, sys.stderr
    while True:
        try:
            arguments = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        try:
            answer = draw_all(*arguments)
        except Exception as error:
            answer = error
        pickle.dump(answer, output)
        output.flush()


class Pool:
    """A ring of `size` episodes on the device, with the seeds `seed`, `seed + 1`, ...; no seed comes twice.

    `episodes` (Drawn, leading axis (size,)) holds the ring's episodes. A caller takes the slots in order around the
    ring. Before it takes up to `number` more, it calls `ensure(number)`, which waits only where the host has not drawn
    them yet; afterwards it calls `used` with the number taken. workers: number of processes that draw; 0: a thread
    draws. settings: see draw_all; it can be pickled.
    """

    def __init__(
        self,
        config: TaskConfig,
        size: int,
        seed: int = 0,
        with_map: bool = False,
        workers: int = 0,
        settings: Any = None,
    ):
        import jax

        self.size, self.workers, self.settings = size, workers, settings
        self.config, self._with_map = config, with_map
        self._next_seed = int(seed)
        block = max(1, min(_BLOCK, size // 4))
        while size % block:
            block -= 1
        self._block = block
        self.begun = self.drawn = 0  #: episodes taken from the ring, and put into it
        self.waited = 0.0  #: time spent waiting for episodes, after the first ones [s]
        self._workers = [_Worker() for _ in range(workers)]
        self._threads = concurrent.futures.ThreadPoolExecutor(max(1, workers), "bson-pool")
        self._pending = []
        self._ask()
        first = self._pending[0].result()
        self.episodes = jax.tree.map(lambda x: jax.numpy.zeros((size, *x.shape[1:]), x.dtype), Drawn(*first))
        self._put = jax.jit(
            lambda ring, block, at: jax.tree.map(
                lambda ring, block: jax.lax.dynamic_update_slice_in_dim(ring, block, at, 0), ring, block
            ),
            donate_argnums=0,
        )

    def _ask(self):
        """Asks for blocks of episodes: as many as have room in the ring, and two more for each worker."""
        ahead = max(2, 2 * len(self._workers)) + (self.size - (self.drawn - self.begun)) // self._block
        while len(self._pending) < ahead:
            seeds = range(self._next_seed, self._next_seed + self._block)
            self._next_seed += self._block
            number = self._next_seed // self._block
            task: Callable[..., Any] = self._workers[number % len(self._workers)] if self._workers else draw_all
            self._pending.append(self._threads.submit(task, self.config, seeds, self._with_map, self.settings))

    def used(self, number: int) -> None:
        """Notes that `number` more episodes have begun."""
        self.begun += int(number)

    def ensure(self, number: int) -> None:
        """Waits until the ring has at least `number` episodes that have not begun. Raises NoFreeSpace."""
        if number > self.size - self._block + 1:
            raise ValueError(f"A pool of {self.size} episodes can't have {number} ready: give it a larger size.")
        begin, short = time.perf_counter(), self.drawn - self.begun < number and self.begun > 0
        while self._pending and self.drawn - self.begun <= self.size - self._block:
            if not (self._pending[0].done() or self.drawn - self.begun < number):
                break
            block = self._pending.pop(0).result()
            self.episodes = self._put(self.episodes, block, self.drawn % self.size)
            self.drawn += self._block
            self._ask()
        if short:
            self.waited += time.perf_counter() - begin
        self._ask()

    def close(self) -> None:
        """Stops drawing episodes; closing twice does no harm."""
        self._threads.shutdown(wait=True, cancel_futures=True)
        for worker in self._workers:
            worker.close()
        self._workers = []
