"""`bson live`: the page in which a person drives the robot, or an agent does and the person takes over."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from bson.agents import AgentFactory, agent_names, check_settings, load_agent
from bson.episodes.film import PATH_RGB, Eye
from bson.episodes.tracks import make_track
from bson.interfaces.drive import PERSON, Course, Drive, action_of
from macid.drawing.gl import Unavailable
from macid.layout import person_count
from macid.live.page import Page, lcf_reading
from macid.pedestrians import model_names

_BEAM_RGB = (0.86, 0.10, 0.10)
_WAY_STEP = 0.3  # between the points of the robot's way [m]
_BELOW = -1000.0  # height of a beam's point that met nothing [m]
_KEYS = "**W A S D** or the arrows drive, also where an agent does: you take over. **Space** stops."


@dataclasses.dataclass(frozen=True)
class DriveSetting:
    """What is driven in a page: the course and the name of its setting; the agent that begins, PERSON for none; the
    track and the sensors, as make_track takes them (None: what the agent wants); whether a trained agent may drive
    elsewhere than where it was trained."""

    course: Course
    name: str
    agent: Any = PERSON
    called: str = PERSON
    track: str | None = None
    sensor: Any = None
    untrained: bool = False


class DrivePage(Page):
    """The page of `bson live`.

    score(drive): (name, value) of the score so far. keep(drive, setting): what is told of an episode that is over; it
    keeps those that count. driven(setting): the seeds of the episodes that were kept before.
    """

    hint = _KEYS
    marks_goal = False

    def __init__(
        self,
        client: Any,
        setting: DriveSetting,
        score: Callable[[Drive], list[tuple[str, str]]],
        keep: Callable[[Drive, str], str],
        driven: Callable[[str], frozenset[int]],
    ):
        self.setting, self._score, self._keep, self._driven = setting, score, keep, driven
        self._name = setting.name
        self._base = self._own_of(setting.name)
        self._driver, self._factory = PERSON, None
        self._share, self._eye, self._blind = 1.0, None, ""
        self._seen_model: Any = None  # the model that the eye draws
        seed = setting.course.after(None, driven(setting.name))
        super().__init__(client, "bson live", model_names(), *self._base, seed)
        self._choose(setting.called)

    # The world.

    def _choose(self, name):
        """Takes the agent `name` for the driver; PERSON: nobody but the person. Raises AgentError."""
        agent = self.setting.agent if name == self.setting.called else name
        self._factory = None if name == PERSON else load_agent(agent, self.setting.untrained)
        self._driver = name

    def _track(self):
        """The track and sensors that the driver wants, as make_track takes them."""
        factory: AgentFactory | None = self._factory
        track = self.setting.track or (factory.track if factory else "local")
        return track, self.setting.sensor or (factory.sensor if factory else "lidar2d")

    def _own_of(self, name):
        """The pedestrian model and the density of the setting of this name, as the page's controls show them."""
        config = self.setting.course.settings[name]
        model = config.pedestrian_model if isinstance(config.pedestrian_model, str) else "as the setting mixes them"
        return model, round(min(1.0, config.people / max(1, person_count(1.0, config.map_size))), 2)

    def _config(self):
        """The TaskConfig of the page's present setting."""
        config, (model, density) = self.setting.course.settings[self._name], self._base
        if self.density != density:
            config = config.replace(pedestrian_density=self.density)
        if self.model != model:
            config = config.replace(pedestrian_model=self.model)
        return config

    def make_world(self) -> Drive:
        """As Page.make_world."""
        config, wanted = self._config(), self._track()
        if self.world is not None and self._made == wanted:
            self.world.begin(config, self.seed, self._factory, self._driver)
            return self.world
        made = Drive(config, make_track(*wanted), self.seed, self._factory, self._driver)
        self._made = wanted
        return made

    def begun(self) -> None:
        """As Page.begun."""
        self._way = [self.world.pose(self._path[0])[:2]]
        self.world.action = np.zeros(2)
        if self._eye is not None and self._seen_model is not self.world.model:
            self._eye.close()
            self._eye = None
        if self._eye is None and not self._blind:
            try:
                self._eye = Eye(self.world.model)
            except Unavailable as error:  # the page works without this picture
                self._blind = str(error)
                self.tell(f"No picture of the robot's camera: {error}")
        self._seen_model = self.world.model
        self._look()

    def _tick(self):
        world = self.world
        if self.keys and world.driver != PERSON:
            self._take_over()
        world.action = action_of(self.keys, self._share)
        super()._tick()

    def _take_over(self):
        self._choose(PERSON)
        self.world.hand_over(None)
        self._who_drives.value = PERSON

    def ticked(self) -> None:
        """As Page.ticked."""
        world, place = self.world, self.world.pose(self._path[-1])[:2]
        if world.trouble:
            self.tell(f"**{world.trouble}** You drive.")
            world.trouble = ""
            self._take_over()
        if np.hypot(*(place - self._way[-1])) >= _WAY_STEP:
            self._way.append(place)
        self._look()

    def _look(self):
        """What the robot senses now: the LIDAR's points, the camera's picture."""
        world = self.world
        points = world.scan() if self._beams.value else np.empty((0, 3))
        missed = np.isnan(points).any(axis=-1)
        points[missed] = [0, 0, _BELOW]
        self.dots("lidar", points, np.tile(_BEAM_RGB, (len(points), 1)), 0.06)
        if self._eye is not None and self._picture.visible:
            people = world.now("people")
            self._picture.image = self._eye.picture(
                world.qpos(), world.boxes, people, world.colours(), world.now("goal"), world.radius
            )

    def drawn(self, qpos: np.ndarray) -> None:
        """As Page.drawn: the robot's way so far."""
        if self._paths.value:
            way = np.array([*self._way, self.world.pose(qpos)[:2]])
            ends = np.stack([way[:-1], way[1:]], axis=1)
        else:
            ends = np.empty((0, 2, 2))
        self.line("robot", ends, np.tile(PATH_RGB, (len(ends), 1)), 0.07)

    def centre(self, qpos: np.ndarray) -> np.ndarray:
        """As Page.centre: the robot."""
        return self.world.pose(qpos)

    def target(self) -> np.ndarray:
        """As Page.target: the robot's goal."""
        return self.world.now("goal")

    def over(self) -> None:
        """As Page.over: keeps an episode that counts."""
        told = f"**{self.world.ended}** "
        try:
            told += self._keep(self.world, self._name)
        except ValueError as error:
            told += f"Not kept: {error}"
        self.tell(f"{told} 'Next' begins another episode.")

    def next_seed(self) -> int:
        """As Page.next_seed: the next one of the course that was not driven yet."""
        return self.setting.course.after(self.seed, self._driven(self._name))

    def readings(self) -> list[tuple[str, str]]:
        """As Page.readings."""
        world = self.world
        nearest = float(world.now("nearest_person"))
        return [
            ("Time", f"{world.time:.1f} of {world.period * world.config.horizon:.0f} s"),
            ("Drives", world.driver),
            ("Speed", f"{round(float(world.now('velocity')[0]), 2) + 0.0:.2f} m/s"),
            ("Way driven", f"{float(world.now('travelled')):.2f} m"),
            ("To the goal", f"{float(world.now('distance')):.1f} m"),
            ("Nearest person", f"{max(nearest, 0.0):.2f} m" if np.isfinite(nearest) else "-"),
            ("In collision", f"{int(world.now('collisions'))} steps"),
            *self._score(world),
            lcf_reading(world.lcf),
            ("Counts", self._counts()),
        ]

    def _counts(self):
        """Whether the episode so far will be kept, for the table."""
        why = self.setting.course.why_not(self._name, self.world.config, self.world.seed)
        if not why and self.world.actions:
            why = self.world.why_not_human
        return f"no: {why}" if why else "yes"

    # The controls.

    def add_controls(self) -> None:
        """As Page.add_controls."""
        gui = self.client.gui
        names = [PERSON, *agent_names()]
        if self.setting.called not in names:
            names.append(self.setting.called)
        self._who_drives = gui.add_dropdown("Who drives", names, initial_value=self._driver)
        self._on(self._who_drives, self._set_driver)
        self._on(gui.add_slider("Your top speed", 0.1, 1.0, 0.05, 1.0, hint="a share of the robot's"), self._set_share)
        if len(self.setting.course.settings) > 1:
            settings = list(self.setting.course.settings)
            self._on(gui.add_dropdown("Setting", settings, initial_value=self._name), self._set_setting)

    def add_pictures(self) -> None:
        """As Page.add_pictures."""
        width, height = Eye.size_seen
        blank = np.zeros((height, width, 3), np.uint8)
        self._picture = self.client.gui.add_image(blank, label="Robot's camera", format="jpeg")

    def add_view_controls(self) -> None:
        """As Page.add_view_controls."""
        self._beams = self.client.gui.add_checkbox("LIDAR points", True)
        self._on(self._beams, lambda value: self._look())
        camera = self.client.gui.add_checkbox("Robot's camera", True)
        self._on(camera, self._show_camera)

    def _show_camera(self, shown):
        self._picture.visible = bool(shown)
        self._look()

    def _set_driver(self, name):
        before = self._driver
        try:
            self._choose(name)
            if self._factory is None or self._track() == self._made:
                self.world.hand_over(self._factory, name)
            else:  # it wants to see something else: the episode begins again
                check_settings(self._factory, [self._config()], make_track(*self._track()))
                self._renew()
        except ValueError:
            self._choose(before)
            self._who_drives.value = before
            raise

    def _set_share(self, share):
        self._share = float(share)

    def _set_setting(self, name):
        self._name, self._base = name, self._own_of(name)
        self.take(*self._base)

    def step(self) -> None:
        """As Page.step; a drive step by step is no drive."""
        if not self.world.ended:
            self.world.altered = "it was driven step by step"
        super().step()

    def closed(self) -> None:
        """As Page.closed."""
        if self._eye is not None:
            self._eye.close()
