"""A live page: a world that is simulated and drawn as time goes by, and the controls that crowds and robots share.

Each page has a thread. It moves its world on in ticks, as fast as the clock, and draws the page 30 times a second,
places interpolated within a tick. What a person does on the page waits until the thread has a moment for it, between
two frames.
"""

import contextlib
import math
import queue
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import mujoco
import numpy as np

from macid import geometry
from macid.drawing.colours import GOAL_RGB
from macid.files import one_line
from macid.live.shapes import WORLD, Figures, Goal, Model
from macid.state import MAX_LCF

FPS = 30  # frames a second
_LAG = 0.1  # the most that a frame lasts: a world that is slower than the clock falls behind [s]
_TELL_EVERY = 0.25  # between readings [s]
_SETTLES = 0.4  # a slider that needs a new world has rested so long [s]
_TRAIL = 4.0  # of people's paths [s]
_CALM = 0.12  # the share of its lag that a camera behind somebody turns with each frame
_DOT = 0.12  # half a side of what marks people's goals [m]
_ASIDE = 0.2  # share of a map's side that its camera stands to the right, where the controls cover the picture
_SKY = (226, 235, 244)
NEAR = (0.0, -5.5, 3.2), (0.0, 1.5, 0.6)  # a camera that follows, and what it looks at, from whom it follows [m]
CAMERAS = ("behind", "beside", "map")  # what a camera follows: place and heading, the place, nothing


class LiveWorld(Protocol):
    """What a page shows. K people, nq coordinates of MuJoCo; world frame; metres, seconds, radians."""

    ended: str  #: why the episode is over; "" while it goes on

    @property
    def model(self) -> mujoco.MjModel:
        """As it looks; people come first in qpos, x, y, yaw each."""
        ...

    @property
    def boxes(self) -> np.ndarray:
        """(B, 5) of this episode."""
        ...

    @property
    def period(self) -> float:
        """Of a tick [s]."""
        ...

    @property
    def radius(self) -> float:
        """People's [m]."""
        ...

    @property
    def lcf(self) -> np.ndarray:
        """(K,) of people."""
        ...

    @property
    def time(self) -> float:
        """Since the reset [s]."""
        ...

    @property
    def seed(self) -> int:
        """The episode's."""
        ...

    def tick(self) -> np.ndarray:
        """Moves the world on by a tick: qpos (n + 1, nq) at equal intervals, the first as it was before."""
        ...

    def qpos(self) -> np.ndarray:
        """(nq,) now."""
        ...

    def here(self) -> np.ndarray:
        """(K,) bool: who is on the map."""
        ...

    def goals(self) -> np.ndarray:
        """(K, 2) where people head."""
        ...

    def colours(self) -> np.ndarray:
        """(K, 3) people's colours."""
        ...

    def set_lcf(self, lcf: float | np.ndarray, person: int | None = None) -> None:
        """Gives everybody the LCF `lcf`, a number or (K,); or the one `person`."""
        ...

    def draw_lcf(self) -> None:
        """Gives everybody the LCF that this episode drew."""
        ...

    def close(self) -> None:
        """Frees the world."""
        ...


class Page:
    """A page for the viser client `client`; a subclass makes its world and adds controls of its own.

    title: heads the controls. density: of people, a share of the paper's densest crowd. models, model: the pedestrian
    models to choose from, and the present one.
    """

    cameras = CAMERAS
    hint = ""  # on the keys

    def __init__(self, client: Any, title: str, models: list[str], model: str, density: float, seed: int):
        self.client, self.title = client, title
        self.models, self.model, self.density, self.seed = models, model, density, seed
        self.running, self.speed, self.clicked = True, 1.0, None
        self.keys: frozenset[str] = frozenset()
        self._by_hand: float | None = None  # everybody's LCF, where somebody has set it
        self._asked: queue.SimpleQueue = queue.SimpleQueue()
        self._gone = threading.Event()
        self._began = threading.Lock()
        self._thread: threading.Thread | None = None
        self._renew_at: float | None = None  # when a world of another setting is made
        self._stale = True  # whether the picture is older than the world
        self._built: mujoco.MjModel | None = None  # the model whose shapes are in the page
        self.world: Any = None

    # What a subclass gives.

    def make_world(self) -> LiveWorld:
        """The world of the page's present setting and `seed`, at its beginning; the former one may be used again."""
        raise NotImplementedError

    def readings(self) -> list[tuple[str, str]]:
        """(name, value) of what the page tells."""
        raise NotImplementedError

    def centre(self, qpos: np.ndarray) -> np.ndarray:
        """(3,) x, y, yaw that the camera follows."""
        return np.zeros(3)

    def add_controls(self) -> None:
        """Adds the subclass's own controls, above all others."""

    def add_pictures(self) -> None:
        """Adds what the subclass shows below the readings."""

    def begun(self) -> None:
        """Called as an episode begins, its picture built."""

    def ticked(self) -> None:
        """Called after each tick."""

    def drawn(self, qpos: np.ndarray) -> None:
        """Called with each picture of the world at `qpos` (nq,)."""

    def over(self) -> None:
        """Called once when the episode is over."""

    def closed(self) -> None:
        """Called in the page's thread as the page ends."""

    def next_seed(self) -> int:
        """The seed after this one."""
        return self.seed + 1

    # What the server calls, from its threads.

    def start(self) -> None:
        """As LivePage.start; a second call does nothing."""
        with self._began:
            if self._thread is None and not self._gone.is_set():
                self._thread = threading.Thread(target=self._run, daemon=True, name="live world")
                self._thread.start()

    def stop(self) -> None:
        """As LivePage.stop."""
        self._gone.set()
        with self._began:
            thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    def press(self, keys: frozenset[str]) -> None:
        """As LivePage.press."""
        self.keys = keys

    @property
    def ended(self) -> bool:
        """Whether the page is gone, its thread and its world with it."""
        return self._gone.is_set() and (self._thread is None or not self._thread.is_alive())

    def ask(self, what: Callable[[], object]) -> None:
        """Has `what` called in the page's thread, before its next frame."""
        self._asked.put(what)

    def tell(self, text: str) -> None:
        """Shows a line above the controls; an empty one takes it away."""
        self._told.content = text and f"> {text}"

    # The thread.

    def _run(self):
        try:
            self._build_controls()
            self._renew()
            self._loop()
        except Exception:
            if not self._gone.is_set():
                traceback.print_exc()
                with contextlib.suppress(Exception):
                    self.tell("**This page has failed.** The terminal says why. Load the page again.")
        finally:
            self.closed()
            if self.world is not None:
                self.world.close()
            self.world = None

    def _loop(self):
        last, told = time.monotonic(), -math.inf
        while not self._gone.is_set():
            while not self._asked.empty():
                with self.refusals():
                    self._asked.get()()
            now = time.monotonic()
            passed, last = min(now - last, _LAG), now
            if self._renew_at is not None and now >= self._renew_at:
                self._renew()
                last = time.monotonic()
            elif self.running:
                self._advance(passed * self.speed)
            if self._stale:
                self._draw()
            if now - told > _TELL_EVERY:
                told = now
                self._readings.content = _table(self.readings())
            self._gone.wait(max(0.0, last + 1 / FPS - time.monotonic()))

    @contextlib.contextmanager
    def refusals(self) -> Iterator[None]:
        """Shows an error of the user's on the page, instead of ending it."""
        try:
            yield
        except ValueError as error:
            self.tell(f"**{one_line(str(error))}**")

    def _advance(self, seconds):
        self._phase += seconds / self.world.period
        while self._phase >= 1 and self.running:
            self._tick()
            self._phase = self._phase - 1 if self.running else 1.0
        self._stale = True

    def _tick(self):
        """Moves the world on by a tick, and pauses where its episode is over."""
        self._path = self.world.tick()
        self._here = self.world.here()
        self._trail.append(self._people(self._path[-1])[:, :2])
        self.ticked()
        if self.world.ended:
            self.running = False
            self.over()

    def _people(self, qpos):
        """(K, 3) x, y, yaw."""
        return qpos[: 3 * len(self.world.lcf)].reshape(-1, 3)

    def _renew(self):
        """Begins an episode of the page's setting and seed."""
        self._renew_at = None
        self.tell("Preparing the world ...")
        before = self.world
        try:
            self.world = self.make_world()
        except ValueError as error:  # the setting before goes on
            self.tell(f"**{one_line(str(error))}**")
            if before is None:
                raise
            return
        if before is not None and before is not self.world:
            before.close()
        self.tell("")
        if self._by_hand is not None:
            self.world.set_lcf(self._by_hand)
        elif len(self.world.lcf):
            self._everyone.value = round(float(np.clip(self.world.lcf.mean(), -MAX_LCF, MAX_LCF)), 2)
        self._build()
        self.begun()

    def _build(self):
        """Builds the picture of an episode's beginning."""
        world, scene = self.world, self.client.scene
        self._seed_box.value = world.seed
        with self.client.atomic():
            if self._built is not world.model:
                if self._built is not None:
                    self._root.remove()
                self._built = world.model
                self._root = scene.add_frame(WORLD, show_axes=False)
                self._shapes = Model(scene, world.model)
                self._figures = Figures(scene, len(world.lcf), world.radius, self._clicked)
                self._goal = Goal(scene)
                self._lines, self._dots = {}, {}
                self._camera_changed(self._camera.value)
            self._shapes.still(world.boxes)
        self._path, self._here, self._phase = world.qpos()[None], world.here(), 0.0
        self._trail = [self._people(self._path[0])[:, :2]]
        self._heading = float(self.centre(self._path[0])[2])
        self._click(None)
        self.repaint()

    def _draw(self):
        self._stale = False
        world = self.world
        qpos = between(world.model, self._path, min(self._phase, 1.0))
        with self.client.atomic():
            self._shapes.move(qpos)
            self._figures.place(self._people(qpos), self._here)
            self._follow(qpos)
            self._draw_paths(qpos)
            self.drawn(qpos)

    def _follow(self, qpos):
        """Moves the world's node, so that what the camera follows stays in the page's middle."""
        x, y, yaw = self.centre(qpos)
        turn = 0.0
        if self._camera.value == "map":
            x = y = 0.0
        elif self._camera.value == "behind":  # a camera that turned as sharply as the robot would make giddy
            self._heading += _CALM * float(geometry.wrap_angle(yaw - self._heading))
            turn = math.pi / 2 - self._heading
        self._root.wxyz = geometry.yaw_quaternion(np.array(turn))
        self._root.position = (*-geometry.rotate(np.array([x, y]), np.array(turn)), 0.0)

    def _draw_paths(self, qpos):
        """People's last seconds, where they head, and the goal of the person clicked."""
        world, people = self.world, self._people(qpos)[:, :2]
        colours = world.colours()
        keep = round(_TRAIL / world.period)
        del self._trail[: -keep - 1]
        if self._paths.value and len(self._trail) > 1:
            trail = np.array([*self._trail[:-1:4], self._trail[-1]])  # (L, K, 2)
            ends = np.stack([trail[:-1], trail[1:]], axis=2).reshape(-1, 2, 2)
            near = geometry.norm(ends[:, 0] - ends[:, 1]) < 4.0  # nobody who left the map
            rgb = np.tile(0.75 * colours, (len(trail) - 1, 1))
            self.line("people", ends[near], rgb[near], 0.05)
        else:
            self.line("people", np.empty((0, 2, 2)), np.empty((0, 3)), 0.05)
        goals = world.goals()
        shown = self._here & bool(self._goals.value)
        self.dots("goals", np.column_stack([goals, np.full(len(goals), 0.05)])[shown], 0.75 * colours[shown], 2 * _DOT)
        if self.clicked is not None and self._here[self.clicked]:
            one = self.clicked
            self._goal.place(goals[one] if self.marks_goal else self.target())
            self.line("clicked", np.array([[people[one], goals[one]]]), np.array([GOAL_RGB]), 0.06)
        else:
            self._goal.place(self.target())
            self.line("clicked", np.empty((0, 2, 2)), np.empty((0, 3)), 0.06)

    marks_goal = True  # whether the flag marks the goal of the person clicked

    def target(self) -> np.ndarray | None:
        """(2,) the goal that the flag marks, where no person is clicked."""
        return None

    def line(self, name: str, ends: np.ndarray, colours: np.ndarray, width: float, height: float = 0.03) -> None:
        """Draws the lines `ends` (N, 2, 2) [m] on the ground, with `colours` (N, 3), in place of those of this name."""
        points = np.concatenate([ends, np.full((*ends.shape[:2], 1), height)], axis=-1).astype(np.float32)
        painted = np.rint(255 * np.repeat(colours[:, None], 2, axis=1)).astype(np.uint8)
        node = self._lines.get(name)
        if node is not None and node.points.shape == points.shape:
            node.points, node.colors = points, painted
            return
        if node is not None:
            node.remove()
        self._lines.pop(name, None)
        if len(points):
            self._lines[name] = self.client.scene.add_line_segments(
                f"{WORLD}/{name}_lines", points, painted, thickness=width
            )

    def dots(self, name: str, points: np.ndarray, colours: np.ndarray, size: float) -> None:
        """Draws dots at `points` (N, 3) [m], with `colours` (N, 3), in place of those of this name."""
        painted = np.rint(255 * colours).astype(np.uint8)
        node = self._dots.get(name)
        if node is not None and node.points.shape == points.shape:
            node.points, node.colors = points.astype(np.float32), painted
            return
        if node is not None:
            node.remove()
        self._dots.pop(name, None)
        if len(points):
            self._dots[name] = self.client.scene.add_point_cloud(
                f"{WORLD}/{name}_dots",
                points.astype(np.float32),
                painted,
                point_size=size,
                point_shape="circle",
                precision="float32",
                point_shading="flat",
            )

    def repaint(self) -> None:
        """Shows people's present colours."""
        self._figures.paint(self.world.colours())
        self._stale = True

    # The controls.

    def _build_controls(self):
        client, gui = self.client, self.client.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        gui.set_panel_label(self.title)
        client.scene.set_background_image(np.full((2, 2, 3), _SKY, np.uint8))
        self._told = gui.add_markdown("Preparing ...")
        self.add_controls()
        buttons = {"Pause": self.pause, "Step": self.step, "Reset": self.reset, "Next": self.next}
        gui.add_button_group("Episode", list(buttons)).on_click(lambda event: self.ask(buttons[event.target.value]))
        self._readings = gui.add_markdown("")
        self.add_pictures()
        with gui.add_folder("Time"):
            self._seed_box = gui.add_number("Seed", self.seed, min=0, max=2**31 - 1, step=1)
            self._on(self._seed_box, self._seed_changed)
            self.add_time_controls()
        with gui.add_folder("People"):
            self._everyone = gui.add_slider("LCF of all", -MAX_LCF, MAX_LCF, 0.05, 0.0)
            self._on(self._everyone, self.set_everybody)
            self._button("LCFs as drawn", self.as_drawn)
            self._who = gui.add_markdown("")
            self._one = gui.add_slider("LCF of one", -MAX_LCF, MAX_LCF, 0.05, 0.0, visible=False)
            self._on(self._one, self._set_one)
            self._density = gui.add_slider("Density", 0.0, 1.0, 0.01, self.density)
            self._on(self._density, self._set_density)
            self._model = gui.add_dropdown("Pedestrians", self._names(), initial_value=self.model)
            self._on(self._model, self._set_model)
        with gui.add_folder("View"):
            self._camera = gui.add_dropdown("Camera", self.cameras, initial_value=self.cameras[0])
            self._on(self._camera, self._camera_changed)
            self._paths = gui.add_checkbox("Paths", True)
            self._goals = gui.add_checkbox("Goals", True)
            for box in (self._paths, self._goals):
                self._on(box, lambda value: self._freshen())
            self.add_view_controls()
        if self.hint:
            gui.add_markdown(self.hint)

    def add_time_controls(self) -> None:
        """Adds the subclass's own controls of time."""

    def add_view_controls(self) -> None:
        """Adds the subclass's own controls of the view."""

    def _button(self, label, what):
        self.client.gui.add_button(label).on_click(lambda event: self.ask(what))

    def _on(self, control, what):
        """Has `what(value)` called in the page's thread when somebody moves the control; not when the page does."""
        control.on_update(lambda event: event.client is not None and self.ask(lambda: what(control.value)))

    def _freshen(self):
        self._stale = True

    def _camera_changed(self, chosen):
        camera = self.client.camera
        if chosen == "map":
            side = 2 * float(self.world.boxes[0, 2:4].max())
            aside = _ASIDE * side
            camera.position, camera.look_at = (aside, -0.6 * side, 0.8 * side), (aside, 0.0, 0.0)
        else:
            camera.position, camera.look_at = NEAR
        self._stale = True

    def pause(self) -> None:
        """Pauses, or goes on; after an episode's end begins the next one."""
        if self.world.ended:
            return self.next()
        self.running = not self.running
        return None

    def step(self) -> None:
        """Pauses, and moves the world on by one tick."""
        self.running = False
        if not self.world.ended:
            self._tick()
            self._phase, self._stale = 1.0, True

    def reset(self) -> None:
        """Begins the episode of the present seed again."""
        self.running = True
        self._renew()

    def next(self) -> None:
        """Begins the next seed's episode."""
        self.seed = self.next_seed()
        self.reset()

    def _seed_changed(self, seed):
        self.seed = int(seed)
        self.reset()

    def set_everybody(self, lcf: float) -> None:
        """Gives everybody the LCF `lcf`, after a reset too, until `as_drawn`."""
        self._by_hand = float(lcf)
        self.world.set_lcf(self._by_hand)
        self._show_one()
        self.repaint()

    def as_drawn(self) -> None:
        """Gives everybody the LCF that the episode drew for it."""
        self._by_hand = None
        self.world.draw_lcf()
        self._show_one()
        self.repaint()

    def _set_one(self, lcf):
        if self.clicked is not None:
            self.world.set_lcf(float(lcf), self.clicked)
            self.repaint()

    def _clicked(self, person):
        self.ask(lambda: self._click(person))

    def _click(self, person):
        """Chooses `person`, or nobody."""
        self.clicked = None if person == self.clicked else person
        self._show_one()
        self._stale = True

    def _show_one(self):
        one = self.clicked
        self._one.visible = one is not None
        if one is None:
            self._who.content = "Click a person for its own LCF."
        else:
            self._who.content = f"Person {one}:"
            self._one.value = round(float(np.clip(self.world.lcf[one], -MAX_LCF, MAX_LCF)), 2)

    def _set_density(self, density):
        self.density = float(density)
        self.renew_soon()

    def _set_model(self, model):
        self.model = model
        self.renew_soon()

    def _names(self):
        """The pedestrian models to choose from, the present one among them."""
        return self.models if self.model in self.models else [self.model, *self.models]

    def take(self, model: str, density: float) -> None:
        """Takes the pedestrian model and the density of another setting, and begins an episode of it soon."""
        self.model, self.density = model, density
        self._model.options, self._model.value, self._density.value = tuple(self._names()), model, density
        self.renew_soon()

    def renew_soon(self) -> None:
        """Begins an episode of the page's present setting once nobody has changed it for a moment."""
        self._renew_at = time.monotonic() + _SETTLES


def between(model: mujoco.MjModel, path: np.ndarray, share: float) -> np.ndarray:
    """qpos (nq,) at the `share` of the way along `path` (n + 1, nq), interpolated as MuJoCo's joints turn."""
    exact = share * (len(path) - 1)
    first = min(int(exact), len(path) - 1)
    if first == len(path) - 1 or exact == first:
        return path[first].astype(float)
    velocity, qpos = np.empty(model.nv), path[first].astype(float)
    mujoco.mj_differentiatePos(model, velocity, 1.0, qpos, path[first + 1].astype(float))
    mujoco.mj_integratePos(model, qpos, velocity, exact - first)
    return qpos


def lcf_reading(lcf: np.ndarray) -> tuple[str, str]:
    """The reading of people's LCFs (K,)."""
    if not len(lcf):
        return "LCF", "nobody"
    return "LCF: mean, least, most", f"{np.mean(lcf):.2f}, {np.min(lcf):.2f}, {np.max(lcf):.2f}"


def _table(rows):
    """(name, value) rows as Markdown."""
    lines = ["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)]
    return "\n".join(lines)
