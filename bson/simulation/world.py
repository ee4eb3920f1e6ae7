"""Worlds of a scene, its people and the robot, many at once on one engine.

Every world has the same configuration and its own episode. A world's course depends only on its seed and its commands,
never on its neighbours in the batch; bit for bit where the engine promises it.
"""

import contextlib
import functools
import os
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from bson import robot
from bson.sensors import Sensor
from bson.simulation import contacts
from bson.simulation.data import MAP_RESOLUTION, QUANTITIES
from bson.simulation.engines.base import MakeEngine
from bson.simulation.engines.native import NativeEngine
from bson.simulation.faults import find_faults
from bson.simulation.people import People
from bson.simulation.scene import build_model, build_spec, structure
from bson.simulation.senses import Senses
from bson.task import Spawn, TaskConfig, spawn
from macid import forks, geometry
from macid.documents import shown
from macid.routing import occupancy_grid
from macid.state import GOAL_RADIUS, Traits

MAX_WORLDS = 65_536
_FAR = np.inf
_CLOSING_SPEED = 10.0  # at most, of a robot and a person [m/s]
_ABSENT = 1000.0  # distance off the map at which absent robots stand [m]


def check_worlds(name: str, number: int) -> None:
    """Raises ValueError unless `number` is a number of worlds."""
    if not (isinstance(number, (int, np.integer)) and not isinstance(number, bool) and 1 <= number <= MAX_WORLDS):
        raise ValueError(f"{name} must be a whole number of at least 1, at most {MAX_WORLDS}, not {shown(number)}.")


def _finite(name, value, shape):
    """`value` as an array, or None. Raises ValueError for anything but finite numbers of `shape`."""
    if value is None:
        return None
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite numbers of shape {shape}, not {shown(value)}.")
    return array


class World:
    """`nworld` worlds. Each quantity of bson.simulation.data.QUANTITIES is an attribute, an array with a leading axis
    (nworld,). After `step(ids, ...)` the rows `ids`, in ascending order, are current.

    engine: makes the engine that moves the worlds (bson.simulation.engines).
    """

    seed: np.ndarray
    time: np.ndarray
    pose: np.ndarray
    goal: np.ndarray
    start_distance: np.ndarray
    distance: np.ndarray
    travelled: np.ndarray
    collisions: np.ndarray
    nearest_person: np.ndarray
    arrived: np.ndarray
    fault: np.ndarray
    steps: np.ndarray
    velocity: np.ndarray
    lcf: np.ndarray
    models: np.ndarray
    boxes: np.ndarray

    def __init__(
        self,
        config: TaskConfig,
        nworld: int = 1,
        sensors: Sequence[Sensor] = (),
        nthread: int = 0,
        with_robot: bool = True,
        engine: MakeEngine = NativeEngine,
    ):
        """with_robot: False puts the robots where nobody sees or meets them, so that the same people walk among
        themselves. Raises ValueError for arguments that don't fit together, macid.drawing.gl.Unavailable for cameras
        without OpenGL."""
        check_worlds("nworld", nworld)
        self._made = nworld, tuple(sensors), nthread, with_robot, engine
        self._away = 0.0 if with_robot else config.map_size + _ABSENT
        self._process = os.getpid()
        self.nworld, self.sensors = nworld, tuple(sensors)
        self._senses = Senses(sensors, nworld)
        self.structure = structure(config)  #: the structure of its model
        self.model = model = build_spec(config, self.sensors, hidden=True).compile()  # as it moves and is sensed
        self.robot = robot.describe(config.robot)
        self._crowd = People(nworld, config.people, model.nmocap)
        self.configure(config)
        self.engine = engine(model, nworld, nthread)
        k = config.people
        self._people = slice(0, 3 * k)
        self._robot_qpos, self._robot_qvel = slice(3 * k, 3 * k + 7), slice(3 * k, 3 * k + 6)
        self._robot_ctrl = robot.wheel_actuators(model, self.robot)
        self._last_qpos = self.engine.qpos.copy()  # at the last sensing
        self._occupancy: list[Any] = [None] * nworld
        for quantity in QUANTITIES:
            if quantity.held:
                setattr(self, quantity.name, quantity.empty(nworld, K=k, B=model.nmocap))
        self._journal: dict | None = None  # states that a failed step puts back, while a step runs
        try:
            self._senses.bind(self)
        except BaseException:
            self.close()
            raise

    def configure(self, config: TaskConfig) -> None:
        """Goes on in the setting `config`, which must have the worlds' structure; after it each world needs a reset."""
        self._senses.configure(config.control_period)
        self._crowd.configure(config)
        self.config = config

    def __deepcopy__(self, memo):
        """An independent copy of the worlds, which goes on from the present state equally."""
        self._check_open()
        self._crowd.plan(range(self.nworld))
        made = World(self.config, *self._made)
        memo[id(self)] = made
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                getattr(made, name)[...] = value
        made.engine.restore(self.engine.save())
        made._crowd.restore(self._crowd.save())
        made._crowd.own_generators(memo)
        made._senses.follow(self._senses, memo)
        made._occupancy = list(self._occupancy)
        return made

    def close(self) -> None:
        """Frees the physics and the cameras' renderer; closing twice does no harm. After it no world can be stepped."""
        if "engine" in vars(self):
            self.engine.close()
        for name in ("engine", "_senses", "_crowd", "_occupancy"):
            vars(self).pop(name, None)

    def _check_open(self):
        if "engine" not in vars(self):
            raise gymnasium.error.ClosedEnvironmentError("This environment is closed: make another one.")

    @functools.cached_property
    def scene(self) -> mujoco.MjModel:
        """The MjModel as it looks, for films."""
        return build_model(self.config, self.sensors)

    @contextlib.contextmanager
    def whole(self) -> Iterator[None]:
        """Within the `with` everything happens, or nothing: if an error is raised, all worlds are put back as they
        were. It can be nested."""
        self._check_open()
        if self._journal is not None:
            yield
            return
        before = {name: array.copy() for name, array in vars(self).items() if isinstance(array, np.ndarray)}
        parts: list[tuple[Any, Any]] = [(part, part.save()) for part in (self.engine, self._crowd, self._senses)]
        occupancy = list(self._occupancy)
        self._journal = {}
        try:
            yield
        except BaseException:
            for name, array in before.items():
                getattr(self, name)[...] = array
            for part, saved in parts:
                part.restore(saved)
            self._occupancy = occupancy
            for generator, drawn in self._journal.values():
                generator.bit_generator.state = drawn
            raise
        finally:
            self._journal = None

    def _draws(self, generator):
        """Notes that `generator` is about to draw, for `whole`."""
        if self._journal is not None and id(generator) not in self._journal:
            self._journal[id(generator)] = generator, generator.bit_generator.state

    def begun(self, ids: Iterable[int]) -> bool:
        """Whether all of the worlds `ids` have had a reset."""
        return all(self._crowd.begun(index) for index in ids)

    @property
    def readings(self) -> dict[str, np.ndarray]:
        """{a sensor's key: its last readings (nworld, ...)}."""
        return self._senses.readings

    @property
    def layouts(self) -> list:
        """The Layout of each world's map, None before its first reset."""
        return self._crowd.layouts

    @property
    def people(self) -> np.ndarray:
        """(nworld, K, 3): see QUANTITIES."""
        return self.engine.qpos[:, self._people].reshape(self.nworld, -1, 3)

    @property
    def people_velocity(self) -> np.ndarray:
        """(nworld, K, 2): see QUANTITIES."""
        return self.engine.qvel[:, self._people].reshape(self.nworld, -1, 3)[..., :2]

    @property
    def people_goals(self) -> np.ndarray:
        """(nworld, K, 2): see QUANTITIES."""
        self._crowd.plan(range(self.nworld))
        return self._crowd.heading

    @property
    def qpos(self) -> np.ndarray:
        """(nworld, nq): see QUANTITIES."""
        return self.engine.qpos

    def destinations(self, index: int) -> np.ndarray:
        """The ends (K, 2) [m] of the ways of a world's people."""
        return self._crowd.destinations(index)

    def traits(self, index: int) -> Traits:
        """The Traits (K,) of a world's people, None where they are the paper's."""
        return self._crowd.traits(index)

    def occupancy(self, index: int) -> np.ndarray:
        """The map of a world: whether something solid reaches each cell's centre, (rows, columns) bool; made once an
        episode. Cells have a side of MAP_RESOLUTION [m]; row 0 is the lowest, column 0 the leftmost."""
        if self._occupancy[index] is None:
            self._occupancy[index] = occupancy_grid(self.layouts[index], MAP_RESOLUTION, radius=0.0)
        return self._occupancy[index]

    def reset(self, ids: ArrayLike, seeds: Sequence[int]) -> None:
        """Begins a new episode in the worlds `ids`, each drawn from its seed. Raises NoFreeSpace before any change."""
        self._check_open()
        forks.refuse(self._process)
        ids = np.asarray(ids, dtype=int)
        rngs = [np.random.default_rng(int(seed)) for seed in seeds]
        drawn = [spawn(self.config, rng) for rng in rngs]
        with self.whole():
            self._begin(ids, seeds, rngs, drawn)

    def _begin(self, ids, seeds, rngs, drawn: list[Spawn]):
        """Begins the episodes `drawn`, one Spawn for each of the worlds `ids`."""
        engine = self.engine
        engine.reset(ids)
        for index, seed, rng, s in zip(ids, seeds, rngs, drawn, strict=True):
            self.seed[index], self._occupancy[index] = seed, None
            self._crowd.begin(index, s, rng)
            boxes = self.boxes[index] = s.layout.boxes
            engine.mocap_pos[index, :, :2] = boxes[:, :2]
            engine.mocap_quat[index] = geometry.yaw_quaternion(boxes[:, 4])
            engine.qpos[index, self._people] = s.people.ravel()
            engine.qpos[index, self._robot_qpos] = self._standing(s.robot)
            self.goal[index], self.lcf[index], self.models[index] = s.goal, s.lcf, s.models
            self.start_distance[index] = np.hypot(*(s.goal - s.robot[:2]))
            self._senses.begin(index, int(seed))
        for counter in ("travelled", "time", "steps", "collisions", *contacts.COUNTERS):
            getattr(self, counter)[ids] = 0
        self.fault[ids] = ""
        self._sense(ids)

    def _standing(self, pose):
        """The robot's part of qpos (..., 7) at `pose` (..., 3), or off the map for a robot that takes no part."""
        x, y, yaw = np.moveaxis(np.asarray(pose, dtype=float), -1, 0)
        qpos = robot.spawn_qpos(x, y, yaw, self.robot.config)
        qpos[..., 0] += self._away
        return qpos

    def place(
        self,
        ids: ArrayLike,
        *,
        pose: ArrayLike | None = None,
        people: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
        people_velocity: ArrayLike | None = None,
    ) -> None:
        """Moves the robots and people of the worlds `ids`; their episodes go on from there.

        pose (n, 3) of the robot, people (n, K, 3): x, y, yaw [m, m, rad], world frame; without a place they stay.
        velocity (n, 2) of the robot: ahead [m/s], yaw rate [rad/s]; people_velocity (n, K, 2) [m/s], world frame;
        without a velocity they are at rest. No way or contact is counted for the move; sensors read the new state.
        Raises ValueError for other shapes and for values that are not finite, gymnasium.error.ResetNeeded before a
        world's first reset.
        """
        self._check_open()
        ids = np.asarray(ids, dtype=int)
        if not self.begun(ids):
            raise gymnasium.error.ResetNeeded("Call reset before place.")
        n, k, engine = len(ids), self.config.people, self.engine
        pose, people = _finite("pose", pose, (n, 3)), _finite("people", people, (n, k, 3))
        velocity = _finite("velocity", velocity, (n, 2))
        people_velocity = _finite("people_velocity", people_velocity, (n, k, 2))
        with self.whole():
            if pose is not None:
                engine.qpos[ids, self._robot_qpos] = self._standing(pose)
            if people is not None:
                engine.qpos[ids, self._people] = people.reshape(n, 3 * k)
            engine.qvel[ids] = 0.0
            if velocity is not None:
                speed, yaw_rate = velocity.T
                yaw = robot.planar_pose(engine.qpos[ids, self._robot_qpos])[:, 2]
                moving = np.zeros((n, 6))
                moving[:, 0], moving[:, 1], moving[:, 5] = speed * np.cos(yaw), speed * np.sin(yaw), yaw_rate
                engine.qvel[ids, self._robot_qvel] = moving
                wheels = robot.wheel_dofs(self.model, self.robot)
                engine.qvel[ids[:, None], wheels] = robot.wheel_speeds(velocity, self.robot)
            if people_velocity is not None:
                rates = np.concatenate([people_velocity, np.zeros((n, k, 1))], axis=-1)
                engine.qvel[ids, self._people] = rates.reshape(n, 3 * k)
            self._sense(ids)

    def step(self, ids: ArrayLike, command: ArrayLike) -> None:
        """One control step of the worlds `ids`: `command` (n, 2), v [m/s] and w [rad/s], held for its period."""
        self._check_open()
        forks.refuse(self._process)
        with self.whole():
            self._step(ids, command)

    def _step(self, ids, command):
        self._crowd.plan(ids)
        engine = self.engine
        sound = self.fault[ids] == ""
        ids, command = np.asarray(ids, dtype=int)[sound], np.asarray(command)[sound]
        engine.ctrl[ids[:, None], self._robot_ctrl] = robot.wheel_speeds(command, self.robot)
        for _ in range(self.config.decisions):
            if not len(ids):  # physics failed in all of them
                return
            if self.config.people:
                self._command_people(ids)
            before = robot.planar_pose(engine.qpos[ids, self._robot_qpos])
            record = engine.step(ids, self.config.substeps)
            if faults := find_faults(engine, ids, self._robot_qvel.stop):
                for row, what in faults.items():
                    self._fail(ids[row], what)
                sound = np.delete(np.arange(len(ids)), list(faults))
                ids, before, record = ids[sound], before[sound], record[sound]
            self._account(ids, before, record)
            self._crowd.advance(ids, self.people[ids, :, :2], self._draws)
        self.steps[ids] += 1
        self.time[ids] = np.round(self.steps[ids] * self.config.control_period, 9)
        self._sense(ids)

    def _fail(self, index, what):
        """Gives a world its fault, and its last finite configuration back, at rest."""
        self.fault[index] = what
        self.engine.qpos[index], self.engine.qvel[index] = self._last_qpos[index], 0.0

    def _command_people(self, ids):
        """Gives the people of the worlds `ids` their next commands."""
        k = self.config.people
        qpos, qvel = self.engine.qpos[ids], self.engine.qvel[ids]
        commands = self._crowd.decide(
            ids,
            qpos[:, self._people].reshape(len(ids), k, 3),
            qvel[:, self._people].reshape(len(ids), k, 3),
            robot.planar_pose(qpos[:, self._robot_qpos]),
            qvel[:, self._robot_qvel][:, [0, 1, 5]],
            self.lcf[ids],
            self.models[ids],
        )
        for index, command in zip(ids, commands, strict=True):
            self.engine.ctrl[index, self._people] = command

    def _account(self, ids, before, qpos):
        """Adds the physics steps `qpos` (n, s, nq), which follow the pose `before` (n, 3), to way and collisions."""
        config = self.robot.config
        poses = robot.planar_pose(qpos[..., self._robot_qpos])
        way = np.diff(np.concatenate([before[:, None], poses], axis=1)[..., :2], axis=1)
        self.travelled[ids] += np.hypot(way[..., 0], way[..., 1]).sum(axis=-1)
        person, towards = np.zeros((2, *poses.shape[:2]), bool)
        near = np.flatnonzero(self.nearest_person[ids] <= _CLOSING_SPEED * self.config.control_period)
        if len(near):  # the other robots can't have met anybody since the last look
            person[near], towards[near] = contacts.touches_people(
                poses[near], way[near], self._places(qpos[near]), config, self.config.person_radius
            )
        solid = contacts.touches_boxes(poses, self.boxes[ids], config)
        wall, obstacle = solid[..., :4].any(axis=-1), solid[..., 4:].any(axis=-1)
        self.collisions[ids] += (person | wall | obstacle).sum(axis=-1)
        for counter, touched in zip(contacts.COUNTERS, (person, towards, obstacle, wall), strict=True):
            getattr(self, counter)[ids] += touched.sum(axis=-1)

    def _places(self, qpos):
        """Places (..., K, 2) [m] of the people in `qpos` (..., nq)."""
        return qpos[..., self._people].reshape(*qpos.shape[:-1], self.config.people, 3)[..., :2]

    def _sense(self, ids):
        """Makes poses, distances and sensor readings of the worlds `ids` current."""
        self.engine.forward(ids)
        qpos = self._last_qpos[ids] = self.engine.qpos[ids]
        robot_qpos = qpos[:, self._robot_qpos]
        self.pose[ids] = robot.planar_pose(robot_qpos)
        self.velocity[ids] = robot.planar_velocity(robot_qpos, self.engine.qvel[ids][:, self._robot_qvel])
        offset = self.goal[ids] - self.pose[ids, :2]
        self.distance[ids] = np.hypot(offset[:, 0], offset[:, 1])
        self.arrived[ids] = self.distance[ids] <= GOAL_RADIUS
        places, radius = self._places(qpos), self.config.person_radius
        gaps = contacts.person_gaps(self.pose[ids], places, self.robot.config, radius)
        self.nearest_person[ids] = gaps.min(axis=-1, initial=_FAR)
        self._senses.read(self, ids, self._fail, self._draws)
