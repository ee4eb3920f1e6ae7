"""Worlds of a scene, its pedestrians and the robot, many at once on one MuJoCo batch.

Every world has the same configuration and its own episode. What a world does depends only on its seed and its
commands, never on its neighbours in the batch, bit for bit: physics is stepped by MuJoCo's batch, which promises as
much, and pedestrians decide by one compiled program a world, since a vectorised one may round differently.

Worlds of any counts share a few compiled decisions: people and boxes are filled up to the next of a few sizes, with
people and boxes out of everybody's reach (`_decision`).
"""

import contextlib
import copy
import functools
import os

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np

from bson import robot
from bson.renderer import Renderer
from bson.task import TaskConfig, controller, spawn, stops, ways_checker
from macid import contacts, forks, geometry, layout, scene
from macid.documents import shown
from macid.maps import load_map
from macid.routing import occupancy_grid
from macid.state import CONTACT_GAP, GOAL_RADIUS, PHYSICS_STEP, RADIUS, CrowdState, parking_place

APPROACH = 0.05  # a robot slower than this towards whom it touches was run into [m/s]
MAP_RESOLUTION = 0.25  # of the occupancy map [m]
MAX_WORLDS = 65_536
_FAR = np.inf
_KINDS = ("person", "robot_on_person", "obstacle", "wall")  # of collisions
_CLOSING_SPEED = 10.0  # that no robot and person exceed [m/s]
_DIVERGED = 100.0  # a speed of a person or robot that only failed physics gives [m/s, rad/s]
_ABSENT = 1000.0  # how far off the map a robot stands that takes no part [m]
_ADDRESSES = {  # of joints, in what a warning of MuJoCo's counts
    mujoco.mjtWarning.mjWARN_BADQPOS: "jnt_qposadr",
    mujoco.mjtWarning.mjWARN_BADQVEL: "jnt_dofadr",
    mujoco.mjtWarning.mjWARN_BADQACC: "jnt_dofadr",
}
# Sizes to which a decision's people (with the robot) and boxes are filled up: the paper's counts are among them. No step
# leads over a power of two, at which the distance to a disc is rounded otherwise (macid.geometry.first_disc).
ROWS = (2, 4, 8, 16, 25, 32, 51, 64, 101, 128, 201, 256, 384, 512, 768, 1024, 1536, 2048)
BOXES = (4, 16, 44, 85, 128, 192, 256)
_BOX_STEP = 256  # of more boxes than that
_COLUMNS = (2, 1, 2, 1, 2, 1, 1)  # of a decision's rows: position, yaw, velocity, yaw rate, goal, lcf, model
_LISTS = ("layouts", "_routers", "_rngs", "_occupancy", "_unplanned")
_BOUND = {  # what the next step depends on: attributes of a World, and fields of MuJoCo's
    "_qpos": "qpos",
    "_qvel": "qvel",
    "_act": "act",
    "_ctrl": "ctrl",
    "_warmstart": "qacc_warmstart",
    "_time": "time",
    "_mocap_pos": "mocap_pos",
    "_mocap_quat": "mocap_quat",
}


def _rows(number):
    """The first of ROWS that `number` people and a robot fit in."""
    return next(rows for rows in ROWS if rows > number)


def _box_rows(number):
    """The first of BOXES, or multiple of _BOX_STEP, that `number` boxes fit in."""
    return next((rows for rows in BOXES if rows >= number), -(-number // _BOX_STEP) * _BOX_STEP)


@functools.lru_cache(8)
def _maze(size):
    """The example of a maze of side `size` [m] whose walls all stand."""
    return layout.maze_layout(np.random.default_rng(0), 1.0, size).boxes


def _boxes(config):
    """An example (B, 5) of the boxes that an episode of `config` has: their number and sizes are those of each."""
    if config.map is not None:
        return load_map(config.map).boxes
    boxes = _maze(config.map_size)
    return boxes[: 4 + round(config.obstacle_density * (len(boxes) - 4))]


def build_spec(config: TaskConfig, sensors, hidden=False):
    """The MjSpec of a world: pedestrians, boxes (movable: each episode has its own map), then the robot and sensors.
    hidden: whether no sensor sees the robot (bson.robot.hide_robot)."""
    spec = scene.base_spec(config.map_size)
    scene.add_people(spec, config.people)
    scene.add_boxes(spec, _boxes(config), movable=True)
    robot.add_robot(spec, robot.describe(config.robot), hidden=hidden)
    for sensor in sensors:
        sensor.mount(spec)
    if hidden:
        robot.hide_robot(spec)  # and what sensors have added to it
    return spec


def structure(config: TaskConfig):
    """What of `config` makes a world's model: worlds of one structure go from one setting to the other without a new
    one (World.configure)."""
    sizes = _boxes(config)[:, 2:4]
    return config.people, sizes.shape, sizes.tobytes(), config.map_size, config.robot, robot.describe(config.robot).digest


def build_model(config: TaskConfig, sensors):
    """The MjModel of a world as it looks, for films."""
    return build_spec(config, sensors).compile()


def _ways(layout, router, people, places, goals):
    """Waypoints (W, 2) [m] of each of `people` from its of `places` to its of `goals`, the goal last.

    They lead along the person's route, if the map has routes, and around obstacles, if there is a router. Raises
    NoFreeSpace."""
    ways = [stops(layout, *each) for each in zip(people, places, goals, strict=True)]
    if router is None or not ways:
        return ways
    starts = np.concatenate([[place, *way[:-1]] for place, way in zip(places, ways, strict=True)])
    legs = iter(router.paths(starts, np.concatenate(ways)))
    return [np.concatenate([next(legs) for _ in way]) for way in ways]


@functools.lru_cache(64)
def _decision(controllers, rows, boxes):
    """The decision of up to `rows` people among `boxes` boxes, by `controllers`, jitted: (rows, sum of _COLUMNS) and
    (boxes, 5) to (rows * 3,). The robot is one more disc, after the people; whoever fills the rows up comes last, out of
    everybody's reach. Worlds of all counts share a few of them: compiling takes longer than all else that makes a World.

    What fills up changes nothing of learned people's decisions, bit for bit. Of rules that add up forces, and of ORCA,
    it may change the last bit, as the compiler adds in another order: so all worlds of one count have the same rows.
    """

    def decide(packed, boxes):
        position, yaw, velocity, rate, goals, lcf, models = jnp.split(packed, np.cumsum(_COLUMNS)[:-1], axis=-1)
        state = CrowdState(position, yaw[:, 0], velocity, rate[:, 0], contacts.touching(position, boxes))
        commands = [controller(state, boxes, goals, lcf[:, 0]) for controller in controllers]
        command = commands[0]
        for number, other in enumerate(commands[1:], start=1):
            command = jnp.where(models == number, other, command)
        return command.ravel()

    return jax.jit(decide)


def check_worlds(name, number):
    """Raises ValueError for what is no number of worlds."""
    if not (isinstance(number, (int, np.integer)) and not isinstance(number, bool) and 1 <= number <= MAX_WORLDS):
        raise ValueError(f"{name} must be a whole number of at least 1, at most {MAX_WORLDS}, not {shown(number)}.")


class World:
    """`nworld` worlds. Arrays have a leading axis (nworld,); after `step(ids, ...)` the rows `ids`, in ascending
    order, are current.

    seed: of the episode. pose (3,) x, y, yaw [m, rad] and velocity (2,) v, w [m/s, rad/s] of the robot; goal (2,) [m];
    start_distance, distance: from start and from here to the goal [m]; travelled [m]; time [s]; steps: control steps;
    arrived: bool; nearest_person: surface to surface [m];
    people (K, 3) x, y, yaw; people_velocity (K, 2) [m/s]; people_goals (K, 2) [m]; lcf (K,), models (K,): which of the
    config's; and counts of physics steps (0.02 s) in which the robot touched anything (collisions), a person, an
    obstacle, an outer wall; and, of those with a person, in which it moved towards whom it touched at more than
    APPROACH (collisions_robot_on_person).
    fault: "", or what became infinite or not a number; such a world stays as it last was until its reset.
    """

    def __init__(self, config: TaskConfig, nworld=1, sensors=(), nthread=0, with_robot=True):
        """with_robot: False puts the robots where nobody sees or meets them: the same people among themselves.
        Raises ValueError for what doesn't fit together, macid.drawing.Unavailable for cameras without OpenGL."""
        check_worlds("nworld", nworld)
        self._made = nworld, tuple(sensors), nthread, with_robot
        self._away = 0.0 if with_robot else config.map_size + _ABSENT
        self._process = os.getpid()
        self.nworld, self.sensors = nworld, tuple(sensors)
        if len({sensor.key for sensor in self.sensors}) < len(self.sensors):
            raise ValueError(f"Two sensors share a key: {', '.join(sensor.key for sensor in self.sensors)}.")
        self.structure = structure(config)  #: of its model
        self.configure(config)
        self.model = model = build_spec(config, self.sensors, hidden=True).compile()  # as it moves and is sensed
        self.batch = mujoco.batch.Batch(model, nworld, nthread)
        for name, field in _BOUND.items():
            setattr(self, name, self.batch.bind(field))
        self._last_qpos = self._qpos.copy()  # as last sensed
        # Sensors are computed once a control step, not in each physics step.
        self._flags = self.batch.expand("opt.disableflags")
        self._sensors_on = int(model.opt.disableflags)
        self._sensors_off = self._sensors_on | int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        self._noise = [[None] * nworld for _ in self.sensors]  # their Generators; each episode has its own
        self.sensed = 0  # how often sensors were read

        k = config.people
        self._people = slice(0, 3 * k)
        self._robot_qpos, self._robot_qvel = slice(3 * k, 3 * k + 7), slice(3 * k, 3 * k + 6)
        self.robot = robot.describe(config.robot)
        self._robot_ctrl = robot.wheel_actuators(model, self.robot)
        self.layouts = [None] * nworld
        self._occupancy = [None] * nworld
        self.boxes = np.zeros((nworld, model.nmocap, 5))
        self._heading = np.zeros((nworld, k, 2))  # people_goals, once planned
        self._routes = [[] for _ in range(nworld)]  # for each person, the waypoints after that
        self._unplanned = [None] * nworld  # people's starts and goals, until their ways are needed
        self._routers, self._rngs = [None] * nworld, [None] * nworld
        self.seed = np.zeros(nworld, np.int64)
        self.lcf, self.models = np.zeros((nworld, k)), np.zeros((nworld, k), int)
        self.goal, self.pose, self.velocity = np.zeros((nworld, 2)), np.zeros((nworld, 3)), np.zeros((nworld, 2))
        for name in ("start_distance", "distance", "travelled", "time", "nearest_person"):
            setattr(self, name, np.zeros(nworld))
        for name in ("steps", "collisions", *(f"collisions_{kind}" for kind in _KINDS)):
            setattr(self, name, np.zeros(nworld, np.int64))
        self.arrived = np.zeros(nworld, bool)
        self.fault = np.full(nworld, "", object)
        self.readings = {
            sensor.key: np.zeros((nworld, *sensor.space.shape), sensor.space.dtype) for sensor in self.sensors
        }
        rows, boxes = _rows(k), _box_rows(model.nmocap)
        self._packed = np.zeros((nworld, rows, sum(_COLUMNS)), np.float32)  # for decisions
        self._packed_boxes = np.zeros((nworld, boxes, 5), np.float32)
        away = parking_place(np.arange(max(rows, boxes)))
        self._packed[:, :, :2] = self._packed[:, :, 6:8] = away[:rows]
        self._packed_boxes[:, :, :2], self._packed_boxes[:, :, 2:4] = -away[:boxes], 0.1
        self._journal = None  # what a failed step puts back, while there is a step
        try:
            self._readers = [sensor.bind(self) for sensor in self.sensors]
        except BaseException:
            self.close()
            raise

    def configure(self, config: TaskConfig):
        """Goes on in the setting `config`, which must have this world's structure; each world needs a reset then."""
        every = [sensor.every(config.control_period) for sensor in self.sensors]  # control steps
        controllers = tuple(controller(name, config.decision_period) for name in config.model_shares)
        self.config, self._every, self._controllers = config, every, controllers

    def __deepcopy__(self, memo):
        """Worlds of their own that go on from where these are, equally."""
        self._check_open()
        nworld, sensors, nthread, with_robot = self._made
        self._plan(range(nworld))
        made = World(self.config, nworld, sensors, nthread, with_robot)
        memo[id(self)] = made
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                getattr(made, name)[...] = value
        for name in ("_rngs", "_noise", "_routes"):
            setattr(made, name, copy.deepcopy(getattr(self, name), memo))
        for name in ("layouts", "_routers", "_occupancy"):  # never changed
            setattr(made, name, list(getattr(self, name)))
        for key, values in self.readings.items():
            made.readings[key][:] = values
        return made

    def close(self):
        """Frees the physics and what draws for cameras; closing twice does no harm. Nothing can be stepped then."""
        if "renderer" in vars(self):
            self.renderer.close()
        for name in (*_BOUND, "_flags", "batch", "renderer", "_readers", "readings", "_packed", "_packed_boxes", "_occupancy"):
            vars(self).pop(name, None)
        self.batch = None

    def _check_open(self):
        if self.batch is None:
            raise gymnasium.error.ClosedEnvironmentError("This environment is closed: make another one.")

    @functools.cached_property
    def scene(self):
        """The MjModel as it looks, for films."""
        return build_model(self.config, self.sensors)

    @contextlib.contextmanager
    def whole(self):
        """What happens within happens whole: where it raises, all worlds are put back as they were. They may be nested."""
        self._check_open()
        if self._journal is not None:
            yield
            return
        before = {name: array.copy() for name, array in vars(self).items() if isinstance(array, np.ndarray)}
        lists = {name: list(getattr(self, name)) for name in _LISTS}
        routes = [list(ways) for ways in self._routes]
        noise = [list(generators) for generators in self._noise]
        self._journal = {}
        try:
            yield
        except BaseException:
            for name, array in before.items():
                getattr(self, name)[...] = array
            for name, values in lists.items():
                setattr(self, name, values)
            self._routes, self._noise = routes, noise
            for generator, state in self._journal.values():
                generator.bit_generator.state = state
            raise
        finally:
            self._journal = None

    def _draws(self, generator):
        """Notes that `generator` is about to draw, for `whole`."""
        if self._journal is not None and id(generator) not in self._journal:
            self._journal[id(generator)] = generator, generator.bit_generator.state

    @functools.cached_property
    def renderer(self):
        """Draws what cameras see. Raises macid.drawing.Unavailable without OpenGL."""
        return Renderer(self.model)

    def begun(self, ids):
        """Whether all of the worlds `ids` have had a reset."""
        return all(self._rngs[index] is not None for index in ids)

    @property
    def people(self):
        """(nworld, K, 3) x, y, yaw [m, m, rad]."""
        return self._qpos[:, self._people].reshape(self.nworld, -1, 3)

    @property
    def people_velocity(self):
        """(nworld, K, 2) [m/s], world frame."""
        return self._qvel[:, self._people].reshape(self.nworld, -1, 3)[..., :2]

    @property
    def qpos(self):
        """(nworld, nq): the whole configuration, for films."""
        return self._qpos

    def occupancy(self, index):
        """The map of a world: whether something solid reaches each cell's centre, (rows, columns) bool; made once an
        episode. Cells have a side of MAP_RESOLUTION [m]; row 0 is the lowest, column 0 the leftmost."""
        if self._occupancy[index] is None:
            self._occupancy[index] = occupancy_grid(self.layouts[index], MAP_RESOLUTION, radius=0.0)
        return self._occupancy[index]

    @property
    def people_goals(self):
        """(nworld, K, 2) where each of the people heads now: the next waypoint, or the goal [m]."""
        self._plan(range(self.nworld))
        return self._heading

    def _plan(self, ids):
        """Finds the ways of the people of the worlds `ids` whose episodes have just begun.

        That takes longer than all else in a reset, so it waits until somebody walks or asks; on every map, spawn has
        seen to it that there are ways."""
        for index in ids:
            if self._unplanned[index] is not None:
                starts, goals = self._unplanned[index]
                ways = _ways(self.layouts[index], self._routers[index], range(len(starts)), starts, goals)
                self._heading[index] = np.reshape([way[0] for way in ways], (-1, 2))
                self._routes[index], self._unplanned[index] = [way[1:] for way in ways], None

    def destinations(self, index):
        """Where the people of a world go, at the end of their ways: (K, 2) [m]."""
        if self._unplanned[index] is not None:
            return self._unplanned[index][1].copy()
        ways = zip(self.people_goals[index], self._routes[index], strict=True)
        return np.reshape([route[-1] if len(route) else goal for goal, route in ways], (-1, 2))

    def reset(self, ids, seeds):
        """Begins a new episode in the worlds `ids`, each drawn from its seed. Raises NoFreeSpace before any change."""
        self._check_open()
        forks.refuse(self._process)
        ids = np.asarray(ids, dtype=int)
        rngs = [np.random.default_rng(int(seed)) for seed in seeds]
        drawn = [spawn(self.config, rng) for rng in rngs]
        with self.whole():
            self._begin(ids, seeds, rngs, drawn)

    def _begin(self, ids, seeds, rngs, drawn):
        """Begins the episodes that were drawn, a Spawn of each of the worlds `ids`."""
        self.batch.reset(ids, stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        k = self.config.people
        for index, seed, rng, s in zip(ids, seeds, rngs, drawn, strict=True):
            self.seed[index], self._rngs[index] = seed, rng
            self.layouts[index], self._routers[index], self._occupancy[index] = s.layout, s.router, None
            boxes = self.boxes[index] = s.layout.boxes
            self._mocap_pos[index, :, :2] = boxes[:, :2]
            self._mocap_quat[index] = geometry.yaw_quaternion(boxes[:, 4])
            self._qpos[index, self._people] = s.people.ravel()
            self._qpos[index, self._robot_qpos] = robot.spawn_qpos(*s.robot, self.config.robot)
            self._qpos[index, self._robot_qpos.start] += self._away
            self.goal[index], self.lcf[index], self.models[index] = s.goal, s.lcf, s.models
            self._packed[index, :k, 8], self._packed[index, :k, 9] = s.lcf, s.models
            self._packed_boxes[index, : len(boxes)] = boxes
            self._unplanned[index] = s.people[:, :2].copy(), s.people_goals
            self.start_distance[index] = np.hypot(*(s.goal - s.robot[:2]))
            for sensor, generators in zip(self.sensors, self._noise, strict=True):
                generators[index] = sensor.generator(int(seed)) if sensor.noise else None
        for counter in ("travelled", "time", "steps", "collisions"):
            getattr(self, counter)[ids] = 0
        for kind in _KINDS:
            getattr(self, f"collisions_{kind}")[ids] = 0
        self.fault[ids] = ""
        self._sense(ids)

    def step(self, ids, command):
        """One control step of the worlds `ids`: `command` (n, 2), v [m/s] and w [rad/s], held for the control period."""
        self._check_open()
        forks.refuse(self._process)
        with self.whole():
            self._step(ids, command)

    def _step(self, ids, command):
        self._plan(ids)
        sound = self.fault[ids] == ""
        ids, command = np.asarray(ids, dtype=int)[sound], np.asarray(command)[sound]
        self._ctrl[ids[:, None], self._robot_ctrl] = robot.wheel_speeds(command, self.robot)
        for _ in range(self.config.decisions):
            if not len(ids):  # physics failed everywhere
                return
            if self.config.people:
                self._command_people(ids)
            before = robot.planar_pose(self._qpos[ids, self._robot_qpos])
            record = self.batch.rollout(self.config.substeps, record=("qpos",), ids=ids)["qpos"]
            sound = self._check(ids)
            if not sound.all():
                ids, before, record = ids[sound], before[sound], record[sound]
            self._account(ids, before, record)
            self._advance_people(ids)
        self.steps[ids] += 1
        self.time[ids] = np.round(self.steps[ids] * self.config.control_period, 9)
        self._sense(ids)

    def _check(self, ids):
        """Whether physics went well in each of the worlds `ids`: (n,) bool; the others get their fault.

        MuJoCo puts a state that is not finite back to the model's default and goes on from there: only its count of
        warnings tells.
        """
        warnings, qvel = self.batch.warning[ids, :, 1], self._qvel[ids]
        speed = np.abs(np.concatenate([qvel[:, self._people], qvel[:, self._robot_qvel]], axis=-1))
        sound = ~warnings.any(axis=-1) & (speed <= _DIVERGED).all(axis=-1)
        for row in np.flatnonzero(~sound):
            if warnings[row].any():
                what = self._warned(ids[row], mujoco.mjtWarning(int(warnings[row].argmax())))
            else:
                fastest = int(speed[row].argmax())
                what = f"{self._joint('jnt_dofadr', fastest)} moves at {speed[row, fastest]:.0f} m/s or rad/s"
            self._fail(ids[row], what)
        return sound

    def _warned(self, index, warning):
        """What MuJoCo warned of in a world, in its words."""
        number = int(self.batch.warning[index, warning, 0])
        words = mujoco.mju_warningText(warning, number).split(". ")[0]
        if warning in _ADDRESSES:
            words += f", {self._joint(_ADDRESSES[warning], number)}"
        return words

    def _joint(self, addresses, number):
        """The name of the joint whose part of the model's `addresses` has `number`."""
        return self.model.joint(int(np.searchsorted(getattr(self.model, addresses), number, "right")) - 1).name

    def _fail(self, index, what):
        """Gives a world its fault, and its last finite configuration back, at rest."""
        self.fault[index] = what
        self._qpos[index], self._qvel[index] = self._last_qpos[index], 0.0

    def _command_people(self, ids):
        """Lets the people of the worlds `ids` decide. The calls overlap: JAX runs them while the next begins."""
        k = self.config.people
        qpos, qvel = self._qpos[ids], self._qvel[ids]
        packed = self._packed[ids]
        packed[:, :k, :3] = qpos[:, self._people].reshape(len(ids), k, 3)
        packed[:, :k, 3:6] = qvel[:, self._people].reshape(len(ids), k, 3)
        packed[:, :k, 6:8] = self._heading[ids]
        packed[:, k, :3] = robot.planar_pose(qpos[:, self._robot_qpos])
        packed[:, k, 3:5], packed[:, k, 5] = qvel[:, 3 * k : 3 * k + 2], qvel[:, 3 * k + 5]
        packed[:, k, 6:8] = packed[:, k, :2] + packed[:, k, 3:5]  # where it wants to go, as far as people can tell
        decide = _decision(self._controllers, packed.shape[1], self._packed_boxes.shape[1])
        commands = [decide(packed[row], self._packed_boxes[index]) for row, index in enumerate(ids)]
        for index, command in zip(ids, commands, strict=True):
            self._ctrl[index, self._people] = np.asarray(command)[: 3 * k]

    def _new_goals(self, index, who):
        """New goals, and ways to them, for the people `who` of a world, from where they stand.

        Who finds none (crowded into a corner of a small map) stays, and asks again at the next decision.
        """
        places, map_layout, router = self.people[index, who, :2], self.layouts[index], self._routers[index]
        try:
            if map_layout.routes:  # back to the other end
                ends = [map_layout.routes[person % len(map_layout.routes)][[0, -1]] for person in who]
                goals = [
                    pair[((pair - place) ** 2).sum(axis=-1).argmax()] for pair, place in zip(ends, places, strict=True)
                ]
            else:
                self._draws(self._rngs[index])
                region = map_layout.regions.get("people_goal")
                distance, joins = self.config.people_goal_distance, ways_checker(self.config, router)
                goals = layout.sample_goals(self._rngs[index], map_layout, places, distance, region=region, joins=joins)
            ways = _ways(map_layout, router, who, places, goals)
        except layout.NoFreeSpace:
            return
        for person, way in zip(who, ways, strict=True):
            self._heading[index, person], self._routes[index][person] = way[0], way[1:]

    def _advance_people(self, ids):
        """People at their waypoint go on to the next, people at their goal to a new one."""
        offset = self.people[ids, :, :2] - self._heading[ids]
        there = np.argwhere((offset**2).sum(axis=-1) <= GOAL_RADIUS**2)
        finished = {}
        for row, person in there:
            index = ids[row]
            route = self._routes[index][person]
            if len(route):
                self._heading[index, person], self._routes[index][person] = route[0], route[1:]
            else:
                finished.setdefault(index, []).append(person)
        for index, who in finished.items():
            self._new_goals(index, np.array(who))

    def _account(self, ids, before, qpos):
        """Adds the physics steps `qpos` (n, s, nq), after the pose `before` (n, 3), to way and collisions."""
        poses = robot.planar_pose(qpos[..., self._robot_qpos])
        way = np.diff(np.concatenate([before[:, None], poses], axis=1)[..., :2], axis=1)
        self.travelled[ids] += np.hypot(way[..., 0], way[..., 1]).sum(axis=-1)
        person, towards = np.zeros((2, *poses.shape[:2]), bool)
        near = np.flatnonzero(self.nearest_person[ids] <= _CLOSING_SPEED * self.config.control_period)
        if len(near):  # the others can't have met anybody since the last look
            touched = self._person_gaps(poses[near], qpos[near]) <= CONTACT_GAP
            person[near] = touched.any(axis=-1)
            offset = self._people_in(qpos[near]) - poses[near, :, None, :2]
            closing = (way[near, :, None] * offset).sum(axis=-1) > APPROACH * PHYSICS_STEP * geometry.norm(offset)
            towards[near] = (touched & closing).any(axis=-1)
        solid = self._box_contacts(ids, poses)
        wall, obstacle = solid[..., :4].any(axis=-1), solid[..., 4:].any(axis=-1)
        self.collisions[ids] += (person | wall | obstacle).sum(axis=-1)
        self.collisions_person[ids] += person.sum(axis=-1)
        self.collisions_robot_on_person[ids] += towards.sum(axis=-1)
        self.collisions_wall[ids] += wall.sum(axis=-1)
        self.collisions_obstacle[ids] += obstacle.sum(axis=-1)

    def _people_in(self, qpos):
        """Places (..., K, 2) [m] of the people in `qpos` (..., nq)."""
        return qpos[..., self._people].reshape(*qpos.shape[:-1], self.config.people, 3)[..., :2]

    def _person_gaps(self, poses, qpos):
        """Surface gaps [m] between the robot's footprint at `poses` (..., 3) and the people of `qpos` (..., nq): (..., K)."""
        box = robot.footprint(poses, self.config.robot)[..., None, None, :]
        return geometry.point_box_distance(self._people_in(qpos), box)[..., 0] - RADIUS

    def _box_contacts(self, ids, poses):
        """Whether the footprint at `poses` (n, s, 3) touches each box of the worlds `ids`: (n, s, B)."""
        box = robot.footprint(poses, self.config.robot)
        boxes = np.broadcast_to(self.boxes[ids][:, None], (*poses.shape[:2], *self.boxes.shape[1:]))
        reach = self.config.robot.radius + CONTACT_GAP
        close = geometry.point_box_distance(poses[..., :2], boxes) <= reach
        contacts = np.zeros(close.shape, bool)
        rows, steps, which = np.nonzero(close)
        if len(rows):
            gaps = geometry.box_box_gap(box[rows, steps], boxes[rows, steps, which][:, None])[:, 0]
            contacts[rows, steps, which] = gaps <= CONTACT_GAP
        return contacts

    def _sense(self, ids):
        """Makes poses, distances and sensor readings of the worlds `ids` current."""
        self._flags[ids] = self._sensors_on
        self.batch.forward(ids)
        self._flags[ids] = self._sensors_off
        qpos = self._last_qpos[ids] = self._qpos[ids]
        robot_qpos = qpos[:, self._robot_qpos]
        self.pose[ids] = robot.planar_pose(robot_qpos)
        self.velocity[ids] = robot.planar_velocity(robot_qpos, self._qvel[ids][:, self._robot_qvel])
        offset = self.goal[ids] - self.pose[ids, :2]
        self.distance[ids] = np.hypot(offset[:, 0], offset[:, 1])
        self.arrived[ids] = self.distance[ids] <= GOAL_RADIUS
        self.nearest_person[ids] = self._person_gaps(self.pose[ids], qpos).min(axis=-1, initial=_FAR)
        self.sensed += 1
        taken = []
        for sensor, every, read, noise in zip(self.sensors, self._every, self._readers, self._noise, strict=True):
            due = ids[self.steps[ids] % every == 0]
            if not len(due):
                continue
            readings = read(self, due)
            finite = np.isfinite(readings).reshape(len(due), -1).all(axis=-1)
            for index in due[~finite]:
                self._fail(index, f"the reading '{sensor.key}' is not finite")
            due, readings = due[finite], readings[finite]
            if sensor.noise:
                for row, index in enumerate(due):
                    self._draws(noise[index])
                    readings[row] = sensor.noisy(readings[row], noise[index])
            taken.append((sensor.key, due, readings))
        for key, due, readings in taken:  # once nothing can fail any more
            self.readings[key][due] = readings
