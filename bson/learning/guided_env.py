"""The worlds in which guided and recurrent robots learn (bson.guided): groups of native worlds, each in a drawn
setting, for stable-baselines3 and bson.learning.recurrent_ppo."""

from typing import Any

import gymnasium
import numpy as np

from bson import recurrent
from bson.agents.contract import Setting
from bson.agents.guide import MARGIN, Guide
from bson.agents.learned import Pupil
from bson.agents.ways import Ways
from bson.episodes.session import Session
from bson.episodes.tracks import LocalTrack, make_track
from bson.interfaces.gym import ACTION_SPACE
from bson.learning.dagger import common_track
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
    sight. With a `pupil`, an agent's class, they are what it sees, (num_envs, bson.recurrent.size(pupil.eye)).

    The reward is the task's, but that a metre of the way counts, not one of the straight line. An ended episode's info
    has `episode`, as FeatureVecEnv's. After `seed`, a reset begins the environment anew, as if made with that seed.
    """

    def __init__(
        self,
        num_envs: int,
        seed: int,
        draw: Draw | None,
        base: TaskConfig,
        nthread: int = 0,
        pupil: type[Pupil] | None = None,
    ):
        sizes = [min(GROUP, num_envs - first) for first in range(0, num_envs, GROUP)]
        track = common_track(pupil, pupil) if pupil else make_track("local", "lidar2d")
        self._groups = [
            _Group(number, size, np.random.default_rng((seed, number)), draw, base, track, nthread, pupil)
            for number, size in enumerate(sizes)
        ]
        self.render_mode = None
        space = gymnasium.spaces.Box(-10.0, 10.0, (recurrent.size(pupil.eye if pupil else "people"),), np.float32)
        super().__init__(num_envs, space, ACTION_SPACE)

    def seed(self, seed: int | None = None) -> Any:
        """The seed of the next reset."""
        self._seeds = [seed] * self.num_envs
        return self._seeds

    def reset(self) -> np.ndarray:
        """Begins an episode in every world."""
        if (seed := self._seeds[0]) is not None:
            for number, group in enumerate(self._groups):
                group.reseed(np.random.default_rng((seed, number)))
            self._reset_seeds()
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

    def __init__(self, number, size, rng, draw, base, track: LocalTrack, nthread, pupil=None):
        self.size, self._draw, self._base, self._track = size, draw, base, track
        self._nthread, self._pupil, self._number = nthread, pupil, number
        self._session: Any = None  # made by the first round
        self._all = np.arange(size)
        self.reseed(rng)
        self._guides: list[Any] = [None] * size
        self._sights: list[Any] = [None] * size  # of pupils
        self._returns, self._length = np.zeros(size), np.zeros(size)
        self._blind = np.zeros(size, bool)

    def reseed(self, rng):
        """Begins the group anew, but for `begin_round`."""
        self._rng = rng
        self._steps = self._number * ROUND // 4  # groups don't all change at once

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
        clearance, setting = config.robot.radius + MARGIN, Setting.of(config, self._track)
        for index in ids:
            occupied = world.occupancy(index)
            grid = Grid(occupied, config.map_size / len(occupied), np.full(2, -config.map_size / 2))
            guide = _Way if self._pupil else Guide
            self._guides[index] = guide(setting, grid.inflated(clearance), world.goal[index])
            if self._pupil:
                self._sights[index] = self._pupil.sight(setting)
        self._blind[ids] = self._rng.random(len(ids)) < _HALF_BLIND
        self._returns[ids] = 0.0
        return self._look(ids, observation)

    def _look(self, ids, observation):
        world, rows = self._session.world, []
        for row, index in enumerate(ids):
            one = {name: value[row] for name, value in observation.items()}
            people = world.people[index, :, :2]
            seen = self._guides[index].see(one, world.pose[index], people, in_sight=bool(self._blind[index]))
            self._length[index] = self._guides[index].length
            if self._pupil:
                vector, picture = self._pupil.look(self._sights[index], one)
                seen = vector if picture is None else np.append(vector, picture.ravel())
            rows.append(seen)
        return np.array(rows, np.float32)

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


class _Way:
    """A Guide that knows the way's length alone."""

    def __init__(self, setting, grid, goal):
        self._ways, self.length = Ways(grid, goal), 0.0

    def see(self, observation, pose, people, in_sight=False):
        """Nothing; the length is noted."""
        self.length = self._ways.ahead(pose[:2])[2]
