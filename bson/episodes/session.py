"""Episodes on worlds: actions in; observations, rewards and ends out. All interfaces and evaluations build on the
Session."""

import contextlib
import ctypes
from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

import gymnasium
import numpy as np

from bson.episodes.tracks import LocalTrack
from bson.simulation.data import INFO
from bson.simulation.engines.base import MakeEngine
from bson.simulation.engines.native import NativeEngine
from bson.simulation.scene import structure
from bson.simulation.world import World, check_worlds
from bson.task import TaskConfig
from macid.reward import individual_reward

Ids: TypeAlias = Sequence[int] | np.ndarray  #: numbers of worlds, in ascending order
KEPT = 4  # how many worlds of different structures a Session keeps
_GIVE_BACK_EVERY = 8  # replaced worlds between two returns of memory: memory that was returned costs time to get again


def _give_back():
    """Gives pages of freed memory back to the system, where the C library can (glibc).

    Otherwise the physics of many sizes, tens of megabytes each, would be scattered over more and more of the heap."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (OSError, TypeError, AttributeError):  # another C library
        return
    trim(0)


def closed() -> Exception:
    """The error of an environment that was closed."""
    return gymnasium.error.ClosedEnvironmentError("This environment is closed: make another one.")


class Session:
    """`nworld` worlds of one configuration and track, each in its own episode."""

    def __init__(
        self,
        config: TaskConfig,
        track: LocalTrack,
        nworld: int = 1,
        seeds: Sequence[Any] | None = None,
        nthread: int = 0,
        engine: MakeEngine = NativeEngine,
    ):
        """seeds: one for each world (default: fresh ones); they begin the streams from which later episodes' seeds
        come. engine: makes the engine that moves the worlds (bson.simulation.engines)."""
        check_worlds("nworld", nworld)
        self.track, self.nworld, self._nthread, self._engine = track, nworld, nthread, engine
        self._worlds: Any = {}  # {structure: World}; None once closed
        self._replaced = 0
        self.configure(config)
        self._streams: list[Any] = [None] * nworld
        self.reseed(range(nworld), seeds if seeds is not None else [None] * nworld)

    @property
    def world(self) -> World:
        """The World of the present setting. Raises gymnasium.error.ClosedEnvironmentError once closed."""
        if self._world is None:
            raise closed()
        return self._world

    def configure(self, config: TaskConfig) -> None:
        """Changes the setting of all worlds; after it they need a reset. The last models are kept: the most recent of
        another structure (bson.simulation.scene.structure) takes the place of the oldest."""
        if self._worlds is None:
            raise closed()
        key = structure(config)
        world = self._worlds.pop(key, None)
        if world is None:
            if len(self._worlds) >= KEPT:
                self._worlds.pop(next(iter(self._worlds)))
                self._replaced += 1
                if self._replaced % _GIVE_BACK_EVERY == 0:
                    _give_back()
            world = World(config, self.nworld, self.track.sensors, self._nthread, engine=self._engine)
        elif world.config != config:
            world.configure(config)
        self._worlds[key] = world
        self.config, self._world = config, world

    @contextlib.contextmanager
    def setting(self, config: TaskConfig) -> Iterator[None]:
        """`configure` for a `with`. If an error is raised within, the setting and the seeds' streams are put back, and
        episodes go on."""
        before, streams = self.config, list(self._streams)
        self.configure(config)
        try:
            with self.whole():
                yield
        except BaseException:
            self.configure(before)
            self._streams = streams
            raise

    def close(self) -> None:
        """Frees the worlds; closing twice does no harm."""
        worlds = list((self._worlds or {}).values())
        self._worlds = self._world = None
        for world in worlds:
            world.close()
        _give_back()

    @contextlib.contextmanager
    def whole(self) -> Iterator[None]:
        """Within the `with` everything happens, or nothing: if an error is raised, the worlds (see World.whole) and the
        seeds' streams are put back."""
        states = [stream.bit_generator.state for stream in self._streams]
        try:
            with self.world.whole():
                yield
        except BaseException:
            for stream, state in zip(self._streams, states, strict=True):
                stream.bit_generator.state = state
            raise

    def reseed(self, ids: Ids, seeds: Sequence[Any]) -> None:
        """Begins the seed streams of the worlds `ids` anew, from `seeds`."""
        for index, seed in zip(ids, seeds, strict=True):
            self._streams[index] = np.random.default_rng(None if seed is None else (0x50C1A1, seed))

    def next_seeds(self, ids: Ids) -> list[int]:
        """The seeds of the next episodes of the worlds `ids`, from their streams."""
        return [int(self._streams[index].integers(2**31)) for index in ids]

    def reset(self, ids: Ids, seeds: Sequence[Any]) -> dict[str, np.ndarray]:
        """A new episode in each of the worlds `ids`, from its seed; returns their observations."""
        self.world.reset(ids, seeds)
        return self.observe(ids)

    def observe(self, ids: Ids) -> dict[str, np.ndarray]:
        """Observations of the worlds `ids`: a dict of arrays with a leading axis (len(ids),)."""
        return self.track.observe(self.world, np.asarray(ids))

    def step(self, ids: Ids, action: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray]:
        """One control step of the worlds `ids` under `action` (n, 2) in [-1, 1]: shares of the top speed and yaw rate.

        Returns observations, reward (n,), terminated (n,), truncated (n,). The reward is eq. 5's: the distance is the
        metres that the goal came closer in this step, a collision any contact during it. A world whose physics failed
        (its `fault` in the info) is truncated, and its observation is the last good one.
        """
        world, config = self.world, self.config
        if not world.begun(ids):
            raise gymnasium.error.ResetNeeded("Call reset before step.")
        limit = np.array([world.robot.config.max_speed, world.robot.config.max_yaw_rate])
        distance, collisions = world.distance[ids].copy(), world.collisions[ids].copy()
        world.step(ids, np.clip(action, -1.0, 1.0) * limit)
        failed = world.fault[ids] != ""
        arrived = world.arrived[ids] & ~failed
        collided = world.collisions[ids] > collisions
        reward = individual_reward(distance - world.distance[ids], arrived, collided, config.reward)
        return self.observe(ids), reward, arrived, failed | (world.steps[ids] >= config.horizon) & ~arrived

    def info(self, ids: Ids) -> dict[str, np.ndarray]:
        """The quantities that the metrics need, of the worlds `ids`: a dict of arrays (len(ids), ...), copies; see
        bson.simulation.data."""
        return {name: np.array(getattr(self.world, name)[ids]) for name in INFO}
