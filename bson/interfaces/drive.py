"""Driving: one world whose robot a person and an agent drive in turns, and what is kept of it."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from bson import robot
from bson.agents import AgentError, AgentFactory, Setting, act, made_for, reset_agent
from bson.episodes.record import Episode, Recorder
from bson.episodes.session import Session
from bson.episodes.tracks import LocalTrack
from bson.sensors import Lidar
from bson.task import TaskConfig
from macid.drawing.colours import lcf_colour

PERSON = "person"  # who drives, where no agent does
NAME = "human"  # the agent in results
_AHEAD, _BACK = ("KeyW", "ArrowUp"), ("KeyS", "ArrowDown")
_LEFT, _RIGHT = ("KeyA", "ArrowLeft"), ("KeyD", "ArrowRight")
STOP = "Space"


def action_of(keys: frozenset[str], share: float = 1.0) -> np.ndarray:
    """The action (2,) of the held `keys`, as browsers name them: `share` of the top speed ahead and of the top yaw rate
    counter-clockwise, in [-1, 1]."""
    if STOP in keys:
        return np.zeros(2)
    ahead, back, left, right = (bool(keys & {*names}) for names in (_AHEAD, _BACK, _LEFT, _RIGHT))
    return share * np.array([float(ahead) - back, float(left) - right])


@dataclasses.dataclass(frozen=True)
class Course:
    """What is to be driven: settings by name, and the seeds of their episodes; without seeds, all from `first` on."""

    settings: Mapping[str, TaskConfig]
    seeds: tuple[int, ...] = ()
    first: int = 0

    def after(self, seed: int | None, driven: frozenset[int] = frozenset()) -> int:
        """The seed after `seed` (None: the first one), one that was not `driven` yet where there is one."""
        if not self.seeds:
            following = self.first if seed is None else seed + 1
            while following in driven:
                following += 1
            return following
        place = -1 if seed not in self.seeds else self.seeds.index(seed)
        order = [*self.seeds[place + 1 :], *self.seeds[: place + 1]]
        return next((one for one in order if one not in driven), order[0])

    def why_not(self, name: str, config: TaskConfig, seed: int) -> str:
        """Why an episode of `config` and `seed` is none of the setting `name`; "" where it is one."""
        if config != self.settings[name]:
            return "its setting was changed on the page"
        if self.seeds and seed not in self.seeds:
            return "its seed is none of the suite's"
        return ""


class Drive:
    """A LiveWorld (macid.live.page): one world, its robot driven by `driver`, PERSON or the agent.

    config, track, seed: of the first episode. agent: the factory of the agent that drives where no person does, and its
    name. Raises AgentError where the agent refuses the setting, NoFreeSpace where the map has no room.

    action: what the person wants (2,), for the next control steps. drivers: who has driven in this episode. altered:
    what was done to the world that its setting doesn't say; "" if nothing. observations, actions: of each control step
    so far, and the present observation. trouble: why the agent gave up.
    """

    def __init__(
        self,
        config: TaskConfig,
        track: LocalTrack,
        seed: int,
        agent: AgentFactory | None = None,
        name: str = PERSON,
    ):
        self.track, self._session = track, Session(config, track, 1)
        self.action, self.driver, self._agent = np.zeros(2), PERSON, None
        self.begin(config, seed, agent, name)

    def begin(self, config: TaskConfig, seed: int, agent: AgentFactory | None = None, name: str = PERSON) -> None:
        """Begins the episode `seed` of `config`, driven by the agent, if it is given, or by the person."""
        session, made = self._session, self._made(agent, config)
        with session.setting(config):  # where the map has no room, the episode before goes on
            observation = session.reset([0], [seed])
        self.observations = [{key: value[0] for key, value in observation.items()}]
        self.actions: list[np.ndarray] = []
        self.drivers: set[str] = set()
        self.altered, self.ended, self.trouble = "", "", ""
        self._drawn = self.lcf.copy()
        self._recorder = Recorder(session, 0)
        self._data = mujoco.MjData(self.model)
        self._let(made, name)

    def hand_over(self, agent: AgentFactory | None, name: str = PERSON) -> None:
        """Lets `agent` drive from now on, or the person, where it is None. Raises AgentError."""
        self._let(self._made(agent, self.config), name)

    def _made(self, agent, config):
        return None if agent is None else made_for(agent, Setting.of(config, self.track))

    def _let(self, made, name):
        if made is not None:
            reset_agent(made, self.seed, name)
        self._agent, self.driver = made, PERSON if made is None else name

    def tick(self) -> np.ndarray:
        """As LiveWorld.tick: a control step."""
        before, action = self.qpos(), self.action
        if self._agent is not None:
            try:
                action = act(self._agent, self.observations[-1], self.driver)
            except AgentError as error:  # the person goes on
                self.trouble = str(error)
                self.hand_over(None)
        self.drivers.add(self.driver)
        self.actions.append(np.clip(np.asarray(action, float), -1.0, 1.0))
        observation, _, terminated, truncated = self._session.step([0], self.actions[-1][None])
        self.observations.append({key: value[0] for key, value in observation.items()})
        self._recorder.snap()
        if fault := self._world.fault[0]:
            self.ended = f"Physics failed: {fault}."
        elif terminated[0]:
            self.ended = "Arrived."
        elif truncated[0]:
            self.ended = "Out of time."
        return np.stack([before, self.qpos()])

    def episode(self) -> Episode:
        """The Episode so far."""
        return self._recorder.episode()

    @property
    def why_not_human(self) -> str:
        """Why the episode is none that a person drove in its setting; "" where it is one."""
        if self.drivers != {PERSON}:
            return f"{' and '.join(sorted(self.drivers)) or 'nobody'} drove it"
        return self.altered

    # What it is now; see LiveWorld.

    @property
    def _world(self):
        return self._session.world

    @property
    def config(self) -> TaskConfig:
        """The present setting."""
        return self._session.config

    @property
    def model(self) -> mujoco.MjModel:
        """As LiveWorld.model."""
        return self._world.scene

    @property
    def boxes(self) -> np.ndarray:
        """As LiveWorld.boxes."""
        return self._world.boxes[0]

    @property
    def period(self) -> float:
        """As LiveWorld.period."""
        return self.config.control_period

    @property
    def radius(self) -> float:
        """As LiveWorld.radius."""
        return self.config.person_radius

    @property
    def lcf(self) -> np.ndarray:
        """As LiveWorld.lcf."""
        return self._world.lcf[0]

    @property
    def time(self) -> float:
        """As LiveWorld.time."""
        return float(self._world.time[0])

    @property
    def seed(self) -> int:
        """As LiveWorld.seed."""
        return int(self._world.seed[0])

    def now(self, name: str) -> Any:
        """The present value of the quantity `name` of bson.simulation.data.QUANTITIES."""
        return getattr(self._world, name)[0]

    def qpos(self) -> np.ndarray:
        """As LiveWorld.qpos."""
        return self._world.qpos[0].copy()

    def here(self) -> np.ndarray:
        """As LiveWorld.here: everybody."""
        return np.ones(len(self.lcf), bool)

    def goals(self) -> np.ndarray:
        """As LiveWorld.goals: where people's ways end."""
        return self._world.destinations(0)

    def colours(self) -> np.ndarray:
        """As LiveWorld.colours: those of films."""
        return lcf_colour(self.lcf)

    def set_lcf(self, lcf: float | np.ndarray, person: int | None = None) -> None:
        """As LiveWorld.set_lcf."""
        self.lcf[slice(None) if person is None else person] = lcf
        self.altered = "LCFs were set by hand"

    def draw_lcf(self) -> None:
        """As LiveWorld.draw_lcf."""
        self.lcf[:] = self._drawn
        if not self.actions:
            self.altered = ""

    def pose(self, qpos: np.ndarray) -> np.ndarray:
        """The robot's x, y, yaw (3,) in `qpos` (nq,)."""
        first = 3 * len(self.lcf)
        return robot.planar_pose(qpos[None, first : first + 7])[0]

    def scan(self) -> np.ndarray:
        """The points (N, 3) [m] that the LIDARs' beams met last, world frame; NaN for a beam that met nothing."""
        self._data.qpos[:] = self._world.qpos[0]
        mujoco.mj_kinematics(self.model, self._data)
        clouds = [np.empty((0, 3))]
        for sensor in self.track.sensors:
            if isinstance(sensor, Lidar):
                site = self._data.site(f"robot/{sensor.key}_beams")
                reading = np.asarray(self.observations[-1][sensor.key], float)[..., None]
                met = np.where(reading < sensor.range_max, reading, np.nan) * sensor.directions
                clouds.append(site.xpos + met.reshape(-1, 3) @ site.xmat.reshape(3, 3).T)
        return np.concatenate(clouds)

    def close(self) -> None:
        """As LiveWorld.close."""
        self._session.close()
