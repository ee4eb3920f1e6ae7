"""`macid live`: a crowd alone, whose knob can be turned while it walks."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from macid import metrics
from macid.crowd import Crowd, CrowdConfig, snapshot
from macid.drawing.colours import lcf_colour
from macid.evaluate import level_name, level_seed, table_lcf, usual_period
from macid.layout import NoFreeSpace, load_level, person_count, sample_goals
from macid.live.page import Page, lcf_reading
from macid.pedestrians import is_learned, make_controller, model_names
from macid.watch import RULE_RGB

TICK = 0.1  # [s], or one decision where that lasts longer


@dataclasses.dataclass(frozen=True)
class CrowdSetting:
    """What a live crowd is: the names of a pedestrian model and a level; how many people (None: the level's own); their
    range of LCFs and the time between decisions [s] (None: as Table II has them); and whether a person who arrives
    walks on to a new goal, or leaves, as in evaluations."""

    pedestrian: str = "macid"
    level: int | str = 2
    people: int | None = None
    lcf: tuple[float, float] | None = None
    period: float | None = None
    stay: bool = True

    @property
    def number(self) -> int:
        """The number of people."""
        return load_level(self.level).people if self.people is None else self.people

    @property
    def config(self) -> CrowdConfig:
        """The crowd's configuration. Raises ValueError."""
        period = usual_period(self.pedestrian) if self.period is None else self.period
        low, high = table_lcf(self.pedestrian) if self.lcf is None else self.lcf
        return CrowdConfig(number=self.number, period=period, duration=max(20.0, period), lcf=(low, high))


class LiveCrowd:
    """A LiveWorld: the crowd of `setting`, begun from `seed`.

    With everybody leaving at its goal, and nobody touching the knob, it is the episode of `macid evaluate --episodes 1
    --seed SEED`.
    """

    def __init__(self, setting: CrowdSetting, seed: int):
        self.setting, config = setting, setting.config
        self._controller = make_controller(setting.pedestrian, config.period)
        self.layout = load_level(setting.level)
        self._crowd = Crowd(self.layout, config)
        self.model, self.boxes = self._crowd.model, np.asarray(self._crowd.boxes, float)
        self._decisions = max(1, round(TICK / config.period))
        self.period, self.radius = self._decisions * config.period, config.person.radius
        self.reset(seed)
        self._crowd.rollout(self._episode, self._controller, self._decisions, snapshot)  # compiled now, not in a tick

    def reset(self, seed: int) -> None:
        """Begins the episode of `seed`. Raises NoFreeSpace."""
        self.seed, self.time, self.ended = seed, 0.0, ""
        self._rng = np.random.default_rng((seed, *level_seed(self.setting.level)))
        self._episode = self._crowd.reset(self._rng)
        self._drawn = np.asarray(self._episode.lcf)[0].astype(float)
        self.lcf = self._drawn.copy()
        self.reached = 0  # goals, by everybody together
        self._read()

    def _read(self):
        state = self._crowd.read(self._episode)
        self._position, self._yaw = np.asarray(state.position)[0], np.asarray(state.yaw)[0]
        self._contact = np.asarray(state.contact)[0]

    def tick(self) -> np.ndarray:
        """As LiveWorld.tick."""
        crowd, before = self._crowd, self.here()
        self._episode, moments = crowd.rollout(self._episode, self._controller, self._decisions, snapshot)
        if what := crowd.engine.faults(self._episode.physics)[0]:
            self.ended = f"Physics failed: {what}."
        self._read()
        last = np.asarray(self._episode.walking)
        position, yaw, walking = (
            np.concatenate([np.asarray(each)[:, 0], end])
            for each, end in zip(moments[:3], (self._position[None], self._yaw[None], last), strict=True)
        )
        for step in range(1, len(position)):  # who has left in between is drawn where it left
            gone = ~walking[step]
            position[step, gone], yaw[step, gone] = position[step - 1, gone], yaw[step - 1, gone]
        self.time = round(self.time + self.period, 9)
        arrived = np.flatnonzero(before & ~last[0])
        self.reached += len(arrived)
        if self.setting.stay and len(arrived):
            self._walk_on(arrived, position[-1])
        elif not self.here().any() and not self.ended:
            self.ended = "Everybody has arrived."
        return np.concatenate([position, yaw[..., None]], axis=-1).reshape(len(position), -1)

    def _walk_on(self, who, places):
        """Puts the people `who`, who left the map at their goals, back to `places` (K, 2), with new goals."""
        try:
            new = sample_goals(
                self._rng, self.layout, places[who], self._crowd.config.goal_distance, radius=self.radius
            )
        except NoFreeSpace:  # pressed into a corner without a goal in reach: they have left
            return
        back = np.zeros((1, len(places)), bool)
        back[0, who] = True
        goals = self._goals()
        goals[who] = new
        there = jnp.asarray(places, jnp.float32)
        self._episode = self._episode._replace(
            physics=self._crowd.engine.place(self._episode.physics, jnp.asarray(back), there),
            walking=self._episode.walking | back,
            goals=jnp.asarray(goals[None]),
        )
        self._read()

    def qpos(self) -> np.ndarray:
        """As LiveWorld.qpos."""
        return np.column_stack([self._position, self._yaw]).ravel()

    def here(self) -> np.ndarray:
        """As LiveWorld.here."""
        return np.asarray(self._episode.walking)[0]

    def _goals(self):
        return np.array(self._episode.goals[0])

    def goals(self) -> np.ndarray:
        """As LiveWorld.goals."""
        return self._goals()

    @property
    def touching(self) -> int:
        """How many people are in contact."""
        return int((self._contact & self.here()).sum())

    @property
    def collisions(self) -> np.ndarray:
        """(K,) steps of 0.02 s in contact so far."""
        return np.asarray(self._episode.collisions)[0]

    def colours(self) -> np.ndarray:
        """As LiveWorld.colours; rules have no use for LCFs, and their people have one colour."""
        learned = is_learned(self.setting.pedestrian)
        return lcf_colour(self.lcf) if learned else np.tile(RULE_RGB, (len(self.lcf), 1))

    def set_lcf(self, lcf: float | np.ndarray, person: int | None = None) -> None:
        """As LiveWorld.set_lcf."""
        self.lcf[slice(None) if person is None else person] = lcf
        self._episode = self._episode._replace(lcf=jnp.asarray(self.lcf[None], jnp.float32))

    def draw_lcf(self) -> None:
        """As LiveWorld.draw_lcf."""
        self.set_lcf(self._drawn)

    def close(self) -> None:
        """As LiveWorld.close: there is nothing to free."""


class CrowdPage(Page):
    """The page of `macid live`, whose first crowd is `setting`, begun from `seed`."""

    cameras = ("map", "behind", "beside")

    def __init__(self, client: Any, setting: CrowdSetting, seed: int):
        self.setting = setting
        size = load_level(setting.level).size
        density = min(1.0, round(setting.number / max(1, person_count(1.0, size)), 2))
        self._given = density  # the density that stands for the setting's own number
        title = f"macid live: {level_name(setting.level)}"
        super().__init__(client, title, model_names(), setting.pedestrian, density, seed)

    def make_world(self) -> LiveCrowd:
        """As Page.make_world."""
        people = self.setting.people
        if self.density != self._given:
            people = max(1, person_count(self.density, load_level(self.setting.level).size))
            self._given = self.density
        self.setting = dataclasses.replace(self.setting, pedestrian=self.model, people=people)
        if self.world is not None and self.world.setting == self.setting:
            self.world.reset(self.seed)
            return self.world
        return LiveCrowd(self.setting, self.seed)

    def add_time_controls(self) -> None:
        """As Page.add_time_controls."""
        self._on(self.client.gui.add_slider("Speed", 0.25, 4.0, 0.25, 1.0), self._set_speed)

    def add_controls(self) -> None:
        """As Page.add_controls."""
        self._on(self.client.gui.add_checkbox("Walk on after a goal", self.setting.stay), self._set_stay)

    def _set_speed(self, speed):
        self.speed = float(speed)

    def _set_stay(self, stay):
        self.setting = self.world.setting = dataclasses.replace(self.setting, stay=bool(stay))

    def centre(self, qpos: np.ndarray) -> np.ndarray:
        """As Page.centre: the person clicked, or else the first one there."""
        here = np.flatnonzero(self._here)
        who = self.clicked if self.clicked is not None and self._here[self.clicked] else here[0] if len(here) else 0
        return self._people(qpos)[who]

    def over(self) -> None:
        """As Page.over."""
        self.tell(self.world.ended)

    def readings(self) -> list[tuple[str, str]]:
        """As Page.readings."""
        world = self.world
        return [
            ("Time", f"{world.time:.1f} s"),
            ("On the map", f"{int(world.here().sum())} of {len(world.lcf)}"),
            ("Goals reached", f"{world.reached}"),
            ("In contact", f"{world.touching}"),
            ("Collision steps a person (CP)", f"{metrics.collision_penalty(world.collisions):.1f}"),
            lcf_reading(world.lcf),
        ]
