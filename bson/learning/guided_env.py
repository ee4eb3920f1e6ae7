"""The worlds in which guided robots learn (bson.guided): groups of native worlds, each in a drawn setting, for
stable-baselines3."""

from typing import Any

import gymnasium
import numpy as np

from bson import guided
from bson.agents.guide import MARGIN, Guide
from bson.episodes.session import Session
from bson.episodes.tracks import LocalTrack, make_track
from bson.interfaces.gym import ACTION_SPACE
from bson.learning.draw import Draw, training_seed
from bson.learning.vec_env import Worlds, summary
from bson.planners import Grid
from bson.task import TaskConfig
from macid.layout import NoFreeSpace

GROUP = 8  # worlds that share a setting
ROUND = 300  # control steps of a group in one setting
_MOST_PROGRESS = 0.3  # in a control step; a way's length jumps where another way becomes the shortest [m]
_HALF_BLIND = 0.5  # share of episodes in which people are told of only where the LIDAR sees them


class GuidedVecEnv(Worlds):
    """`num_envs` worlds, in groups of GROUP. A group's worlds share a setting, drawn anew every ROUND control steps:
    episodes that go on then are cut off. Observations (num_envs, bson.guided.SIZE) are what a guided robot with the map
    sees; in some episodes it is told of people as a robot without knowledge would be, only of those in the LIDAR's
    sight.

    The reward is the task's, but that a metre of the way counts, not one of the straight line. An ended episode's info
    has `episode`, as FeatureVecEnv's.
    """

    def __init__(self, num_envs: int, seed: int, draw: Draw | None, base: TaskConfig, nthread: int = 0):
        sizes = [min(GROUP, num_envs - first) for first in range(0, num_envs, GROUP)]
        track = make_track("local", "lidar2d")
        self._groups = [
            _Group(number, size, np.random.default_rng((seed, number)), draw, base, track, nthread)
            for number, size in enumerate(sizes)
        ]
        self.render_mode = None
        space = gymnasium.spaces.Box(-10.0, 10.0, (guided.SIZE,), np.float32)
        super().__init__(num_envs, space, ACTION_SPACE)

    def reset(self) -> np.ndarray:
        """Begins an episode in every world."""
        return np.concatenate([group.begin_round() for group in self._groups])

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """One control step; worlds whose episodes ended begin their next."""
        first, found = 0, []
        assert self._actions is not None
        for group in self._groups:
            found.append(group.step(self._actions[first : first + group.size]))
            first += group.size
        x, reward, done, infos = zip(*found, strict=True)
        return np.concatenate(x), np.concatenate(reward), np.concatenate(done), [one for each in infos for one in each]

    def close(self) -> None:
        """Frees all resources; closing twice does no harm."""
        for group in self._groups:
            group.close()


class _Group:
    """The worlds of one setting."""

    def __init__(self, number, size, rng, draw, base, track: LocalTrack, nthread):
        self.size, self._rng, self._draw, self._base, self._track = size, rng, draw, base, track
        self._nthread = nthread
        self._session: Any = None  # made by the first round
        self._all = np.arange(size)
        self._steps = number * ROUND // 4  # groups don't all change at once
        self._guides: list[Any] = [None] * size
        self._returns, self._length = np.zeros(size), np.zeros(size)
        self._blind = np.zeros(size, bool)

    def begin_round(self):
        """Draws a setting and begins its episodes; returns their observations (size, guided.SIZE)."""
        while True:
            config = self._draw.setting(self._rng, self._base) if self._draw else self._base
            if self._session is None:
                self._session = Session(config, self._track, self.size, nthread=self._nthread)
            elif self._session.config != config:
                self._session.configure(config)
            try:
                return self._begin(self._all)
            except NoFreeSpace:  # no room in this map for so many: another one
                if self._draw is None:
                    raise

    def _begin(self, ids):
        session = self._session
        observation = session.reset(ids, [training_seed(self._rng) for _ in ids])
        world, config = session.world, session.config
        clearance = config.robot.radius + MARGIN
        for index in ids:
            occupied = world.occupancy(index)
            grid = Grid(occupied, config.map_size / len(occupied), np.full(2, -config.map_size / 2))
            self._guides[index] = Guide(config, grid.inflated(clearance), world.goal[index])
        self._blind[ids] = self._rng.random(len(ids)) < _HALF_BLIND
        self._returns[ids] = 0.0
        return self._look(ids, observation)

    def _look(self, ids, observation):
        world, x = self._session.world, np.empty((len(ids), guided.SIZE), np.float32)
        for row, index in enumerate(ids):
            one = {name: value[row] for name, value in observation.items()}
            people = world.people[index, :, :2]
            x[row] = self._guides[index].see(one, world.pose[index], people, in_sight=bool(self._blind[index]))
            self._length[index] = self._guides[index].length
        return x

    def step(self, action):
        session, world = self._session, self._session.world
        before, collisions = self._length.copy(), world.collisions.copy()
        observation, _, terminated, truncated = session.step(self._all, action)
        x = self._look(self._all, observation)
        weights = session.config.reward
        progress = np.clip(before - self._length, -_MOST_PROGRESS, _MOST_PROGRESS)
        reward = weights.distance * progress + weights.goal * terminated
        reward -= weights.collision * (world.collisions > collisions)
        self._returns += reward
        self._steps += 1
        over = self._steps % ROUND == 0
        done = terminated | truncated | over
        infos: list[dict[str, Any]] = [{} for _ in self._all]
        if done.any():
            ended, told = np.flatnonzero(done), session.info(self._all)
            for index in ended:
                infos[index] = {"terminal_observation": x[index].copy(), "TimeLimit.truncated": not terminated[index]}
                if terminated[index] or truncated[index]:
                    row = {name: value[index] for name, value in told.items()}
                    infos[index]["episode"] = summary(row, self._returns[index], session.config.control_period)
            x[ended] = self.begin_round() if over else self._begin(ended)
        return x, reward.astype(np.float32), done, infos

    def close(self):
        if self._session is not None:
            self._session.close()
