"""One world of the benchmark as pure functions in JAX, which jax.vmap turns into many: the work of
`bson.simulation.world.World`, by the same rules, on a device.

Call `begin`, then `sense`, to begin an episode; then `advance` and `sense` for each control step.
"""

import zlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bson import robot, sensors
from bson.simulation import contacts, pictures, rays
from bson.simulation.engines.warp import Motion, WarpEngine
from bson.simulation.faults import DIVERGED
from bson.simulation.people import with_others
from bson.simulation.pool import Drawn
from bson.simulation.scene import build_spec
from bson.task import TaskConfig, controller
from macid import contacts as crowd_contacts
from macid import geometry
from macid.files import UsageError
from macid.state import CONTACT_GAP, GOAL_RADIUS, RADIUS, CrowdState

COLLISIONS = ("collisions", *contacts.COUNTERS)


class State(NamedTuple):
    """The state of a world; fields without a comment are as in `bson.simulation.world.World`."""

    drawn: Drawn  #: the episode's beginning
    motion: Motion
    stage: Any  #: (K,) int32: number of waypoints that each person has reached
    key: Any  #: random key of the sensors' noise
    steps: Any  #: int32
    travelled: Any
    counts: Any  #: (5,) int32, in the order of COLLISIONS
    fault: Any  #: bool: physics failed; the world stays as it was
    overflow: Any  #: int32: not 0 where contacts had no room (WarpEngine.explain); the episode is then worthless
    pose: Any
    velocity: Any
    distance: Any
    arrived: Any
    nearest_person: Any
    readings: dict


def _chosen(condition, one, other):
    """`one` where `condition` () holds, else `other`: trees of arrays."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), one, other)


class BatchedWorld:
    """The functions of a world of `config` with the sensors `mounted`, for `nworld` worlds that are stepped together
    under jax.vmap.

    Raises ValueError for arguments that don't fit together, UsageError without MJX-Warp.
    """

    def __init__(self, config: TaskConfig, mounted: Any = (), nworld: int = 1, engine: Any = None):
        self.config, self.sensors, self.nworld = config, tuple(mounted), nworld
        check_sensors(self.sensors)
        spec = build_spec(config, self.sensors, hidden=True)
        self.engine = WarpEngine(spec, config.people, engine)
        self.model = model = self.engine.model
        self.robot = robot.describe(config.robot)
        self._wheels = robot.wheel_actuators(model, self.robot)
        self._limit = np.array([config.robot.max_speed, config.robot.max_yaw_rate], np.float32)
        self._controllers = [controller(name, config.decision_period) for name in config.model_shares]
        self._every = [sensor.every(config.control_period) for sensor in self.sensors]
        self._readers = [_bind(model, sensor, config) for sensor in self.sensors]
        self._forward = any(isinstance(sensor, sensors.Imu) for sensor in self.sensors)

    @property
    def _k(self):
        return self.config.people

    def begin(self, drawn: Any, key: Any = None) -> Any:
        """The State, not yet sensed, of the episode `drawn`. key: of noise; None: a key from the episode's seed."""
        k, model = self._k, self.model
        qpos = jnp.concatenate([drawn.people.ravel(), drawn.robot, jnp.asarray(model.qpos0[3 * k + 7 :], jnp.float32)])
        if key is None:
            key = jax.random.key(0)
        key = jax.random.fold_in(jax.random.fold_in(key, drawn.seed[0]), drawn.seed[1])
        zero, none = jnp.float32(0), jnp.int32(0)
        readings = {sensor.key: jnp.zeros(sensor.space.shape, sensor.space.dtype) for sensor in self.sensors}
        return State(
            drawn,
            self.engine.rest(qpos),
            jnp.zeros(k, jnp.int32),
            jax.random.key_data(key),
            none,
            zero,
            jnp.zeros(len(COLLISIONS), jnp.int32),
            jnp.bool_(False),
            none,
            jnp.zeros(3, jnp.float32),
            jnp.zeros(2, jnp.float32),
            zero,
            jnp.bool_(False),
            zero,
            readings,
        )

    def advance(self, state: Any, action: Any) -> Any:
        """The State, not yet sensed, after a control step under `action` (2,) in [-1, 1]. An action that is not finite
        is a fault."""
        command = jnp.clip(jnp.asarray(action, jnp.float32), -1.0, 1.0) * self._limit
        wheels = robot.wheel_speeds(command, self.robot)
        ctrl = state.motion.ctrl.at[self._wheels].set(wheels.astype(jnp.float32))
        after = state._replace(motion=state.motion._replace(ctrl=ctrl))
        with jax.default_matmul_precision("float32"):
            for _ in range(self.config.decisions):
                after = self._decide_and_move(after)
        after = after._replace(steps=state.steps + 1)
        speed = jnp.abs(after.motion.qvel[: 3 * self._k + 6])
        sound = jnp.isfinite(after.motion.qpos).all() & (speed <= DIVERGED).all() & ~state.fault
        sound &= jnp.isfinite(jnp.asarray(action)).all()
        still = state.motion._replace(qvel=jnp.zeros_like(state.motion.qvel))
        failed = state._replace(motion=still, fault=jnp.bool_(True), overflow=after.overflow)
        return _chosen(sound, after, failed)

    def headings(self, state: Any) -> Any:
        """The point (K, 2) [m] for which each person heads now: the next waypoint, or the goal."""
        last = jnp.maximum(state.drawn.turns - 1, 1)
        index = state.stage % (2 * last)  # a person walks its waypoints to and fro
        index = jnp.minimum(jnp.where(index > last, 2 * last - index, index), state.drawn.turns - 1)
        return jnp.take_along_axis(state.drawn.ways, index[:, None, None], axis=1)[:, 0]

    def _people(self, qpos):
        """Places (..., K, 2) [m] of the people in `qpos` (..., nq)."""
        return qpos[..., : 3 * self._k].reshape(*qpos.shape[:-1], self._k, 3)[..., :2]

    def _robot(self, qpos):
        """The robot's part (..., 7) of `qpos` (..., nq)."""
        return qpos[..., 3 * self._k : 3 * self._k + 7]

    def _commands(self, state):
        """The people's decisions (3 K,): world velocities [m/s] and yaw rates [rad/s]."""
        k, motion, boxes = self._k, state.motion, state.drawn.boxes
        pose, rate = motion.qpos[: 3 * k].reshape(k, 3), motion.qvel[: 3 * k].reshape(k, 3)
        body = robot.planar_pose(self._robot(motion.qpos))
        speed = motion.qvel[3 * k : 3 * k + 6]
        position = jnp.concatenate([pose[:, :2], body[None, :2]])
        traits = with_others(state.drawn.traits, k + 1)
        radius = RADIUS if traits.radius is None else traits.radius
        crowd = CrowdState(
            position,
            jnp.append(pose[:, 2], body[2]),
            jnp.concatenate([rate[:, :2], speed[None, :2]]),
            jnp.append(rate[:, 2], speed[5]),
            crowd_contacts.touching(position, boxes, radius),
            traits,
        )
        # The robot is one more disc. People assume that it wants to go on as it moves.
        goals = jnp.concatenate([self.headings(state), body[None, :2] + speed[None, :2]])
        lcf = jnp.append(state.drawn.lcf, 0.0)
        command, *others = (decide(crowd, boxes, goals, lcf)[:k] for decide in self._controllers)
        for number, other in enumerate(others, start=1):
            command = jnp.where((state.drawn.models == number)[:, None], other, command)
        return command.ravel()

    def _decide_and_move(self, state):
        k, motion = self._k, state.motion
        if k:
            ctrl = motion.ctrl.at[: 3 * k].set(self._commands(state).astype(jnp.float32))
            motion = motion._replace(ctrl=ctrl)
        before = robot.planar_pose(self._robot(motion.qpos))
        motion, record, overflow = self.engine.step(motion, state.drawn.boxes, self.config.substeps)
        way, counts = self._account(before, record, state.drawn.boxes)
        state = state._replace(
            motion=motion,
            travelled=state.travelled + way,
            counts=state.counts + counts,
            overflow=state.overflow | overflow,
        )
        offset = self._people(motion.qpos) - self.headings(state)
        reached = (offset**2).sum(axis=-1) <= GOAL_RADIUS**2
        return state._replace(stage=state.stage + reached)

    def _account(self, before, qpos, boxes):
        """The way driven [m] and the steps in contact (5,) in the physics steps `qpos` (s, nq), which follow the pose
        `before` (3,)."""
        poses = robot.planar_pose(self._robot(qpos))
        way = jnp.diff(jnp.concatenate([before[None], poses]), axis=0)[:, :2]
        config = self.config
        person, towards = contacts.touches_people(poses, way, self._people(qpos), config.robot, config.person_radius)
        everywhere = jnp.broadcast_to(boxes, (poses.shape[0], *boxes.shape))
        solid = geometry.box_box_gap(robot.footprint(poses, self.config.robot), everywhere) <= CONTACT_GAP
        wall, obstacle = solid[:, :4].any(axis=-1), solid[:, 4:].any(axis=-1)
        counts = jnp.stack([person | wall | obstacle, person, towards, obstacle, wall]).sum(axis=-1)
        return geometry.norm(way).sum(), counts.astype(jnp.int32)

    def sense(self, state: Any) -> Any:
        """`state` with poses, distances and sensor readings made current."""
        motion, drawn, k = state.motion, state.drawn, self._k
        body, speed = self._robot(motion.qpos), motion.qvel[3 * k : 3 * k + 6]
        pose = robot.planar_pose(body)
        offset = drawn.goal - pose[:2]
        distance = jnp.sqrt((offset**2).sum())
        readings = dict(state.readings)
        data = self.engine.sensordata(motion, drawn.boxes) if self._forward else None
        radius = self.config.person_radius
        solids = rays.Solids(self._people(motion.qpos), drawn.boxes, self.config.map_size / 2 + 1.0, radius)
        gaps = contacts.person_gaps(pose, solids.people, self.config.robot, radius)
        keys = jax.random.wrap_key_data(state.key)
        seen = {}  # pictures that cameras share
        for number, (sensor, every, read) in enumerate(zip(self.sensors, self._every, self._readers, strict=True)):
            reading = read(body, solids, data, seen)
            if sensor.noise:
                stream = jax.random.fold_in(keys, zlib.crc32(sensor.key.encode()) + number)
                reading = _noisy(sensor, reading, jax.random.fold_in(stream, state.steps))
            if every > 1:
                reading = jnp.where(state.steps % every == 0, reading, readings[sensor.key])
            readings[sensor.key] = reading
        sensed = state._replace(
            pose=pose,
            velocity=robot.planar_velocity(body, speed),
            distance=distance,
            arrived=distance <= GOAL_RADIUS,
            nearest_person=gaps.min(axis=-1, initial=jnp.inf),
            readings=readings,
        )
        # A world whose physics failed keeps its last readings.
        return _chosen(state.fault, state, sensed)


def _rotation(quaternion):
    """The rotation (3, 3) of a unit quaternion (4,)."""
    w, x, y, z = quaternion
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _turned(rotation, vectors):
    """`vectors` (..., 3) turned by `rotation` (3, 3), in full precision."""
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return jnp.stack([rotation[row, 0] * x + rotation[row, 1] * y + rotation[row, 2] * z for row in range(3)], axis=-1)


def _mounted(model, body, place, quaternion, base="robot"):
    """The pose of a thing fixed to `body`, in the frame of the robot's body `base`: place (3,), rotation (3, 3).

    Raises ValueError where a joint lies between."""
    base = int(model.joint(base).bodyid[0])
    turn, place = np.empty(9), np.array(place, dtype=float)
    mujoco.mju_quat2Mat(turn, quaternion)
    turn = turn.reshape(3, 3)
    while body != base:
        if body == 0 or model.body_jntnum[body]:
            raise ValueError("The engine 'warp' has sensors only on the body that carries the robot.")
        frame = np.empty(9)
        mujoco.mju_quat2Mat(frame, model.body_quat[body])
        frame = frame.reshape(3, 3)
        place, turn = model.body_pos[body] + frame @ place, frame @ turn
        body = model.body_parentid[body]
    return place, turn


def check_sensors(mounted: Any) -> None:
    """Raises UsageError where one of the sensors `mounted` is none of those that are formulas here."""
    for sensor in mounted:
        if not isinstance(sensor, (sensors.Imu, sensors.Lidar, sensors.RgbCamera, sensors.DepthCamera)):
            raise UsageError(
                f"The engine 'warp' has no {type(sensor).__name__}: it has Imu, Lidar2D, Lidar3D, RgbCamera, "
                "DepthCamera."
            )


def _bind(model, sensor, config):
    """The reading function of `sensor`: read(the robot's free joint (7,), rays.Solids, sensordata, the dict of
    pictures) -> reading."""
    if isinstance(sensor, sensors.Imu):
        columns = np.concatenate(
            [model.sensor(f"robot/imu_{kind}").adr[0] + np.arange(3) for kind in ("accelerometer", "gyro")]
        )
        return lambda body, solids, data, seen: jnp.clip(data[columns], -sensor.limit, sensor.limit)
    if isinstance(sensor, sensors.Lidar):
        site = model.site(f"robot/{sensor.key}_beams").id
        place, turn = _mounted(model, model.site_bodyid[site], model.site_pos[site], model.site_quat[site])
        directions = jnp.asarray(sensor.directions @ turn.T, jnp.float32)
        place = jnp.asarray(place, jnp.float32)

        def read(body, solids, data, seen):
            rotation = _rotation(body[3:])
            distance = rays.first(body[:3] + _turned(rotation, place), _turned(rotation, directions), solids)
            return jnp.clip(distance, sensor.range_min, sensor.range_max)

        return read
    check_sensors([sensor])
    return _bind_camera(model, sensor)


def _bind_camera(model, sensor):
    """As _bind, for a camera. Cameras with the same picture share it in the dict of pictures."""
    camera = model.camera(f"robot/{sensor.key}").id
    place, turn = _mounted(model, model.cam_bodyid[camera], model.cam_pos[camera], model.cam_quat[camera])
    turn = turn @ sensors.LOOK.T
    directions, ahead = jnp.asarray(sensor.directions @ turn.T, jnp.float32), jnp.asarray(turn[:, 0], jnp.float32)
    view = sensor.size, sensor.field, tuple(place), tuple(turn.ravel())
    place, pixel = jnp.asarray(place, jnp.float32), 1 / sensor.focal[1]
    coloured = isinstance(sensor, sensors.RgbCamera)

    def read(body, solids, data, seen):
        if view not in seen:
            rotation = _rotation(body[3:])
            eye, towards = body[:3] + _turned(rotation, place), _turned(rotation, directions)
            seen[view] = pictures.look(eye, towards, _turned(rotation, ahead), solids, pixel)
        colours, depth = seen[view]
        return colours if coloured else jnp.clip(depth, sensor.range_min, sensor.range_max)

    return read


def _noisy(sensor, reading, key):
    """`reading` with noise of the same distribution as from `sensor.noisy`."""
    if isinstance(sensor, sensors.RgbCamera):
        error = jax.random.normal(key, (*reading.shape[:2], 1)) * (255 * sensor.noise * sensor.sigma)
        return jnp.clip(jnp.rint(reading + error), 0, 255).astype(jnp.uint8)
    error = jax.random.normal(key, reading.shape)
    if isinstance(sensor, sensors.Imu):
        sigma = np.repeat([sensor.sigma_force, sensor.sigma_rate], 3) * sensor.noise
        return jnp.clip(reading + error * sigma, -sensor.limit, sensor.limit).astype(jnp.float32)
    growth = reading**2 if isinstance(sensor, sensors.DepthCamera) else 1.0
    noisy = jnp.clip(reading + error * (sensor.noise * sensor.sigma) * growth, sensor.range_min, sensor.range_max)
    return jnp.where(reading < sensor.range_max, noisy, reading).astype(jnp.float32)
