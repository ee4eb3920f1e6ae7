"""A world's quantities as ROS 2 messages, at the reset and after each control step.

Nothing here asks who carries the messages on, a bag (bson.interfaces.bag) or the wire (bson.interfaces.ros): a Carrier
makes them. Units are SI (REP 103). Frames are as in REP 105: `map` is the world's frame, `odom` coincides with it, as
the robot's odometry is exact, and `base_link` is the frame of the robot's body. Each sensor has a frame of its own; of
cameras, `camera_link` has x ahead, and the optical frames have z ahead, x right, y down. Stamps are simulated time:
seconds since the reset, plus the Reporter's `start`.

A sensor whose key is its class's default has the topics and frame of the table below; for any other key they begin with
the key (`/key/scan`, frame `key_laser`), so that a robot may carry two scanners.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import mujoco
import numpy as np

from bson.episodes.tracks import MAP_RESOLUTION
from bson.sensors import DepthCamera, Imu, Lidar, Lidar2D, Mounted, RgbCamera, Sensor
from bson.simulation.data import QUANTITIES
from macid.drawing.colours import lcf_colour
from macid.geometry import yaw_quaternion
from macid.state import HEIGHT

MAP, ODOM, BASE = "map", "odom", "base_link"
EXACT = 1e-9  # variance of what is exact; 0 would mean an unknown variance
UNMEASURED = 1e6  # variance of the parts of a twist that are not measured
COUNTERS = tuple(each.name for each in QUANTITIES if each.name.startswith("collisions"))
PROGRESS = ("time", "start_distance", "distance", "travelled", "nearest_person", "arrived")
PERSON = ("x", "y", "z", "vx", "vy", "yaw", "lcf")  # fields of a point of /people/states; x, y, z are float32
_CYLINDER, _TEXT, _DELETE_ALL = 3, 9, 3  # of visualization_msgs/msg/Marker: types and an action
_TEXT_SIZE, _TEXT_GAP = 0.3, 0.25  # of a person's text, and from its head [m]
_FLOAT32, _FLOAT64 = 7, 8  # of sensor_msgs/msg/PointField
_OCCUPIED = 100  # of nav_msgs/msg/OccupancyGrid
_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # from x ahead, z up to z ahead, y down
_MUJOCO_TO_OPTICAL = np.diag([1.0, -1.0, -1.0])


class Topic(NamedTuple):
    """A topic: its name, its messages' type, and its quality of service: always reliable, the last `depth` messages
    kept; latched: whether late subscribers get them (transient local)."""

    name: str
    kind: str
    what: str
    depth: int = 10
    latched: bool = False


def _table(*rows):
    return {row.name: row for row in rows}


#: The topics without the sensors', by name.
TOPICS = _table(
    Topic("/clock", "rosgraph_msgs/msg/Clock", "simulated time"),
    Topic("/tf", "tf2_msgs/msg/TFMessage", "odom to base_link", depth=100),
    Topic("/tf_static", "tf2_msgs/msg/TFMessage", "map to odom, base_link to each sensor", depth=1, latched=True),
    Topic("/odom", "nav_msgs/msg/Odometry", "pose in odom, speed ahead and yaw rate in base_link"),
    Topic("/map", "nav_msgs/msg/OccupancyGrid", "100 where something solid is, else 0", depth=1, latched=True),
    Topic("/goal_pose", "geometry_msgs/msg/PoseStamped", "the robot's goal", depth=1, latched=True),
    Topic("/people/markers", "visualization_msgs/msg/MarkerArray", "cylinders, coloured by the LCF, and it as a text"),
    Topic("/people/poses", "geometry_msgs/msg/PoseArray", "where people stand and look"),
    Topic("/people/states", "sensor_msgs/msg/PointCloud2", f"people as points: {', '.join(PERSON)}"),
    Topic("/collisions", "std_msgs/msg/Int64MultiArray", f"steps of 0.02 s so far: {', '.join(COUNTERS)}"),
    Topic("/episode", "std_msgs/msg/Float64MultiArray", f"the episode so far: {', '.join(PROGRESS)}"),
)
COMMANDS = {  #: the topic of commands, by whether they are stamped
    True: Topic("/cmd_vel", "geometry_msgs/msg/TwistStamped", "the command: speed ahead, yaw rate; in base_link"),
    False: Topic("/cmd_vel", "geometry_msgs/msg/Twist", "the command: speed ahead, yaw rate"),
}
#: {a sensor's class: (its topics, its frame)}
SENSED: Mapping[type, tuple[tuple[Topic, ...], str]] = {
    Imu: ((Topic("/imu/data", "sensor_msgs/msg/Imu", "specific force, angular velocity, orientation"),), "imu_link"),
    Lidar2D: ((Topic("/scan", "sensor_msgs/msg/LaserScan", "distances; infinity where nothing is met"),), "laser"),
    Lidar: ((Topic("/points", "sensor_msgs/msg/PointCloud2", "what was met; not a number elsewhere"),), "velodyne"),
    RgbCamera: (
        (
            Topic("/camera/image_raw", "sensor_msgs/msg/Image", "rgb8", depth=5),
            Topic("/camera/camera_info", "sensor_msgs/msg/CameraInfo", "of /camera/image_raw", depth=5),
        ),
        "camera_color_optical_frame",
    ),
    DepthCamera: (
        (
            Topic("/camera/depth/image_raw", "sensor_msgs/msg/Image", "32FC1 [m]; infinity beyond the range", depth=5),
            Topic("/camera/depth/camera_info", "sensor_msgs/msg/CameraInfo", "of /camera/depth/image_raw", depth=5),
        ),
        "camera_depth_optical_frame",
    ),
}


class Carrier(Protocol):
    """Makes messages for a bag or for the wire. Both kinds have the attributes that the message's definition names."""

    def new(self, kind: str) -> Any:
        """A message of `kind`, such as "sensor_msgs/msg/LaserScan", all of whose numbers are 0."""
        ...

    def numbers(self, values: np.ndarray) -> Any:
        """The array `values`, of the message's own type of numbers, as messages keep sequences of numbers."""
        ...


class Said(NamedTuple):
    """A message on its way. It is changed and given out again in the next control step: write or send it at once."""

    topic: Topic
    stamp: int  #: [ns]
    message: Any


def nanoseconds(seconds: float) -> int:
    """`seconds` as the nearest whole number of nanoseconds."""
    return round(seconds * 1e9)


def of_sensor(sensor: Sensor) -> tuple[tuple[Topic, ...], str]:
    """The topics of a sensor, and its frame; no topic and "" for a sensor for which ROS has no message here."""
    for kind, (topics, frame) in SENSED.items():
        if isinstance(sensor, kind):
            if sensor.key == type(sensor).__dataclass_fields__["key"].default:
                return topics, frame
            named = [topic._replace(name=f"/{sensor.key}/{topic.name.rsplit('/', 1)[1]}") for topic in topics]
            return tuple(named), f"{sensor.key}_{frame}"
    return (), ""


def topics(sensors: Sequence[Sensor], stamped: bool = True) -> dict[str, Topic]:
    """All topics, by name. stamped: whether commands are TwistStamped, not Twist."""
    sensed = _table(*(topic for sensor in sensors for topic in of_sensor(sensor)[0]))
    return {**TOPICS, COMMANDS[stamped].name: COMMANDS[stamped], **sensed}


def unknown(sensors: Sequence[Sensor]) -> list[str]:
    """The keys of the sensors for which there is no message."""
    return [sensor.key for sensor in sensors if not of_sensor(sensor)[0]]


def _quaternion(rotation):
    """(w, x, y, z) of a rotation (3, 3)."""
    found = np.empty(4)
    mujoco.mju_mat2Quat(found, np.ascontiguousarray(rotation, float).ravel())
    return found


def mounts(model: mujoco.MjModel, sensors: Sequence[Sensor], robot: str = "robot") -> list[tuple[str, str, Any, Any]]:
    """(parent frame, frame, place (3,) [m], rotation (3, 3)) of each sensor's frame, and of `camera_link`."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    body = model.jnt_bodyid[model.joint(robot).id]
    base, turned = data.xpos[body], data.xmat[body].reshape(3, 3)
    found, camera = [], None
    for sensor in sensors:
        topics, frame = of_sensor(sensor)
        if not topics:
            continue
        if isinstance(sensor, Mounted) and not isinstance(sensor, Lidar):
            seen = data.cam(f"{robot}/{sensor.key}")
            place, rotation = seen.xpos, seen.xmat.reshape(3, 3) @ _MUJOCO_TO_OPTICAL
        else:
            seen = data.site(f"{robot}/{sensor.key}_beams" if isinstance(sensor, Lidar) else f"{robot}/imu")
            place, rotation = seen.xpos, seen.xmat.reshape(3, 3)
        place, rotation = turned.T @ (place - base), turned.T @ rotation
        if frame.startswith("camera_"):
            if camera is None:
                camera = place, rotation @ _OPTICAL.T
                found.append((BASE, "camera_link", *camera))
            found.append(("camera_link", frame, camera[1].T @ (place - camera[0]), camera[1].T @ rotation))
        else:
            found.append((BASE, frame, place, rotation))
    return found


def _fill(vector, values):
    vector.x, vector.y, vector.z = map(float, values)


def _turn(quaternion, wxyz):
    quaternion.w, quaternion.x, quaternion.y, quaternion.z = map(float, wxyz)


def _diagonal(*variances):
    return np.diag(np.array(variances, float)).ravel()


class Reporter:
    """Tells the episode of one world in messages: `begin()` after its reset, `step()` after each control step. The
    frames that stay, the map and the goal are told at the beginning only."""

    def __init__(
        self,
        carrier: Carrier,
        world: Any,
        index: int = 0,
        stamped: bool = True,
        start: float = 0.0,
        without: Collection[str] = (),
    ):
        """world: a bson.simulation.world.World. stamped: whether commands are TwistStamped. start: the stamp of the
        reset [s]. without: the types of messages that the carrier can't make; their topics are left out."""
        self._carrier, self._world, self._index, self._start = carrier, world, index, start
        self._sensors, self._command, self._without = world.sensors, COMMANDS[stamped], without
        self.topics = {name: one for name, one in topics(world.sensors, stamped).items() if one.kind not in without}
        self._kept: dict[str, Any] = {}
        self._beams: dict[str, np.ndarray] = {}
        self._told = 0  # the stamp of the last state [ns]
        self._make_people(world.config.people)

    @property
    def now(self) -> int:
        """The stamp of the present state [ns]."""
        return nanoseconds(self._start + float(self._world.time[self._index]))

    def _message(self, topic, frame=None, key=""):
        """The message of `topic`, and whether it is new; its header, if it has `frame`, has the present stamp."""
        name = topic.name + key
        new = name not in self._kept
        if new:
            self._kept[name] = self._carrier.new(topic.kind)
        message = self._kept[name]
        if frame is not None:
            self._stamp(message.header, frame)
        return message, new

    def _stamp(self, header, frame):
        self._time(header.stamp, self.now)
        header.frame_id = frame

    def _time(self, stamp, now):
        stamp.sec, stamp.nanosec = divmod(now, 1_000_000_000)

    def begin(self) -> Iterator[Said]:
        """The messages of the reset."""
        now = self.now
        yield Said(TOPICS["/clock"], now, self._clock(now))
        if TOPICS["/tf"].kind not in self._without:
            yield Said(TOPICS["/tf_static"], now, self._statics())
        yield Said(TOPICS["/map"], now, self._map())
        goal, _ = self._message(TOPICS["/goal_pose"], MAP)
        _fill(goal.pose.position, (*self._world.goal[self._index], 0.0))
        _turn(goal.pose.orientation, (1.0, 0.0, 0.0, 0.0))
        yield Said(TOPICS["/goal_pose"], now, goal)
        if TOPICS["/people/markers"].kind not in self._without:
            markers, _ = self._message(TOPICS["/people/markers"], key="/none")
            none = self._carrier.new("visualization_msgs/msg/Marker")
            self._stamp(none.header, MAP)
            none.action, markers.markers = _DELETE_ALL, [none]
            yield Said(TOPICS["/people/markers"], now, markers)
        yield from self._state(now)

    def step(self, action: np.ndarray | None = None) -> Iterator[Said]:
        """The messages of a control step. action (2,) in [-1, 1]: that of this step; the command that it stands for
        comes first, with the stamp of the state in which it was given. None: no command is told."""
        now = self.now
        if action is not None:
            yield Said(self._command, self._told, self._commanded(action))
        yield Said(TOPICS["/clock"], now, self._clock(now))
        yield from self._state(now)

    def _commanded(self, action):
        message, _ = self._message(self._command)
        twist = message
        if self._command is COMMANDS[True]:
            self._time(message.header.stamp, self._told)
            message.header.frame_id, twist = BASE, message.twist
        config = self._world.config.robot
        speed, yaw_rate = np.clip(action, -1.0, 1.0) * np.array([config.max_speed, config.max_yaw_rate])
        twist.linear.x, twist.angular.z = float(speed), float(yaw_rate)
        return message

    def _state(self, now):
        self._told = now
        world, index = self._world, self._index
        place, wxyz = self._base()
        if TOPICS["/tf"].kind not in self._without:
            yield Said(TOPICS["/tf"], now, self._transforms("/tf", [(ODOM, BASE, place, wxyz)]))
        odometry, new = self._message(TOPICS["/odom"], ODOM)
        if new:
            odometry.child_frame_id = BASE
            odometry.pose.covariance = _diagonal(*[EXACT] * 6)
            odometry.twist.covariance = _diagonal(EXACT, *[UNMEASURED] * 4, EXACT)
        _fill(odometry.pose.pose.position, place)
        _turn(odometry.pose.pose.orientation, wxyz)
        odometry.twist.twist.linear.x, odometry.twist.twist.angular.z = map(float, world.velocity[index])
        yield Said(TOPICS["/odom"], now, odometry)
        for sensor in self._sensors:
            if world.steps[index] % sensor.every(world.config.control_period) == 0:
                yield from self._sensed(sensor, np.asarray(world.readings[sensor.key][index]), wxyz, now)
        yield from self._people(now)
        yield Said(TOPICS["/collisions"], now, self._row("/collisions", COUNTERS, np.int64))
        yield Said(TOPICS["/episode"], now, self._row("/episode", PROGRESS, np.float64))

    def _base(self):
        """Place (3,) and orientation (4,), w first, of the robot's body."""
        k = 3 * self._world.config.people
        qpos = self._world.qpos[self._index, k : k + 7]
        return qpos[:3], qpos[3:]

    def _clock(self, now):
        message, _ = self._message(TOPICS["/clock"])
        self._time(message.clock, now)
        return message

    def _row(self, topic, names, kind):
        message, new = self._message(TOPICS[topic])
        if new:
            side = self._carrier.new("std_msgs/msg/MultiArrayDimension")
            side.label, side.size, side.stride = ",".join(names), len(names), len(names)
            message.layout.dim = [side]
        values = [getattr(self._world, name)[self._index] for name in names]
        message.data = self._carrier.numbers(np.array(values, kind))
        return message

    def _transforms(self, topic, frames):
        """A TFMessage of `frames`: (parent, child, place (3,), orientation (4,), w first)."""
        message, new = self._message(TOPICS[topic])
        if new:
            message.transforms = [self._carrier.new("geometry_msgs/msg/TransformStamped") for _ in frames]
        for transform, (parent, child, place, wxyz) in zip(message.transforms, frames, strict=True):
            self._stamp(transform.header, parent)
            transform.child_frame_id = child
            _fill(transform.transform.translation, place)
            _turn(transform.transform.rotation, wxyz)
        return message

    def _statics(self):
        still = (MAP, ODOM, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        frames = [
            (parent, child, place, _quaternion(rotation))
            for parent, child, place, rotation in mounts(self._world.model, self._sensors)
        ]
        return self._transforms("/tf_static", [still, *frames])

    def _map(self):
        message, _ = self._message(TOPICS["/map"], MAP)
        occupied = self._world.occupancy(self._index)
        message.info.map_load_time = message.header.stamp
        message.info.resolution = MAP_RESOLUTION
        message.info.height, message.info.width = occupied.shape
        half = self._world.config.map_size / 2
        _fill(message.info.origin.position, (-half, -half, 0.0))
        _turn(message.info.origin.orientation, (1.0, 0.0, 0.0, 0.0))
        message.data = self._carrier.numbers((_OCCUPIED * occupied).astype(np.int8).ravel())
        return message

    def _sensed(self, sensor, reading, wxyz, now):
        """The messages of one sensor's `reading`."""
        topics, frame = of_sensor(sensor)
        if not topics:
            return
        message, new = self._message(topics[0], frame)
        if isinstance(sensor, Imu):
            if new:
                message.orientation_covariance = _diagonal(*[EXACT] * 3)
                for name, sigma in (("angular_velocity", "sigma_rate"), ("linear_acceleration", "sigma_force")):
                    variance = max((sensor.noise * getattr(sensor, sigma)) ** 2, EXACT)
                    setattr(message, f"{name}_covariance", _diagonal(*[variance] * 3))
            _fill(message.linear_acceleration, reading[:3])
            _fill(message.angular_velocity, reading[3:])
            _turn(message.orientation, wxyz)
        elif isinstance(sensor, Lidar2D):
            if new:
                message.angle_min, message.angle_max = -sensor.field / 2, sensor.field / 2
                message.angle_increment = sensor.field / (sensor.beams - 1)
                message.scan_time = sensor.every(self._world.config.control_period) * self._world.config.control_period
                message.range_min, message.range_max = float(sensor.range_min), float(sensor.range_max)
            far = reading >= np.float32(sensor.range_max)
            message.ranges = self._carrier.numbers(np.where(far, np.float32(np.inf), reading))
        elif isinstance(sensor, Lidar):
            points = (reading[..., None] * self._directions(sensor)).astype(np.float32)
            points[reading >= np.float32(sensor.range_max)] = np.nan
            self._cloud(message, points.reshape(-1, points.shape[-2], 3), ("x", "y", "z"), new)
        else:
            depth = isinstance(sensor, DepthCamera)
            if depth:
                far = reading >= np.float32(sensor.range_max)
                reading = np.where(far, np.float32(np.inf), reading)
            message.height, message.width = reading.shape[:2]
            message.encoding, message.step = ("32FC1" if depth else "rgb8"), reading[0].nbytes
            message.data = self._carrier.numbers(np.frombuffer(reading.tobytes(), np.uint8))
            yield Said(topics[0], now, message)
            yield Said(topics[1], now, self._camera_info(topics[1], frame, sensor))
            return
        yield Said(topics[0], now, message)

    def _directions(self, sensor):
        if sensor.key not in self._beams:
            self._beams[sensor.key] = sensor.directions
        return self._beams[sensor.key]

    def _camera_info(self, topic, frame, sensor):
        message, new = self._message(topic, frame)
        if new:
            message.width, message.height = sensor.size
            (fx, fy), (cx, cy) = sensor.focal, ((side - 1) / 2 for side in sensor.size)  # pixel 0's middle is at 0
            message.distortion_model, message.d = "plumb_bob", self._carrier.numbers(np.zeros(5))
            message.k, message.r = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1], float), np.eye(3).ravel()
            message.p = np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0], float)
        return message

    def _cloud(self, message, points, names, new):
        """Fills a PointCloud2 with `points` (H, W), a structured array, or (H, W, 3) float32."""
        kind = points.dtype if points.dtype.names else np.dtype([(name, np.float32) for name in names])
        if new:
            fields, offset = [], 0
            for name in names:
                field = self._carrier.new("sensor_msgs/msg/PointField")
                field.name, field.offset, field.count = name, offset, 1
                field.datatype = _FLOAT32 if kind[name] == np.float32 else _FLOAT64
                fields.append(field)
                offset += kind[name].itemsize
            message.fields, message.point_step = fields, kind.itemsize
        message.height, message.width = points.shape[:2]
        message.row_step = message.width * kind.itemsize
        message.is_dense = not bool(np.isnan(points["x"] if points.dtype.names else points).any())
        message.data = self._carrier.numbers(np.frombuffer(points.tobytes(), np.uint8))

    def _make_people(self, number):
        """Makes the messages of `number` people; only what changes is written at each step."""
        poses, _ = self._message(TOPICS["/people/poses"])
        poses.poses = [self._carrier.new("geometry_msgs/msg/Pose") for _ in range(number)]
        self._bodies: list[Any] = []
        self._texts: list[Any] = []
        if TOPICS["/people/markers"].kind in self._without:
            return
        markers, _ = self._message(TOPICS["/people/markers"])
        made = [self._carrier.new("visualization_msgs/msg/Marker") for _ in range(2 * number)]
        width = 2 * self._world.config.person_radius
        for person, (body, text) in enumerate(zip(made[:number], made[number:], strict=True)):
            for marker, name, kind in ((body, "people", _CYLINDER), (text, "lcf", _TEXT)):
                marker.header.frame_id, marker.ns, marker.id, marker.type = MAP, name, person, kind
                marker.pose.orientation.w = 1.0
            _fill(body.scale, (width, width, HEIGHT))
            body.pose.position.z, text.pose.position.z = HEIGHT / 2, HEIGHT + _TEXT_GAP
            text.scale.z = _TEXT_SIZE
            body.color.a = text.color.a = 1.0
        markers.markers = made
        self._bodies, self._texts = made[:number], made[number:]

    def _people(self, now):
        world, index = self._world, self._index
        people, velocity, lcf = world.people[index], world.people_velocity[index], world.lcf[index]
        poses, _ = self._message(TOPICS["/people/poses"], MAP)
        places, turned, seconds = people[:, :2].tolist(), yaw_quaternion(people[:, 2]), divmod(now, 1_000_000_000)
        for (x, y), (w, _, _, z), pose in zip(places, turned.tolist(), poses.poses, strict=True):
            pose.position.x, pose.position.y, pose.orientation.w, pose.orientation.z = x, y, w, z
        for (x, y), temper, body, text in zip(places, lcf.tolist(), self._bodies, self._texts, strict=False):
            for marker in (body, text):
                stamp, place = marker.header.stamp, marker.pose.position
                stamp.sec, stamp.nanosec = seconds
                place.x, place.y = x, y
            told = f"{temper:+.2f}"
            if body.text != told:
                body.text = text.text = told
                for marker in (body, text):
                    colour = marker.color
                    colour.r, colour.g, colour.b = map(float, lcf_colour(temper)[:3])
        if TOPICS["/people/markers"].kind not in self._without:
            yield Said(TOPICS["/people/markers"], now, self._message(TOPICS["/people/markers"])[0])
        yield Said(TOPICS["/people/poses"], now, poses)
        states, new = self._message(TOPICS["/people/states"], MAP)
        points = np.zeros((1, len(people)), [(n, np.float32 if n in "xyz" else np.float64) for n in PERSON])
        points["x"], points["y"], points["yaw"] = people.T
        points["vx"], points["vy"], points["lcf"] = *velocity.T, lcf
        self._cloud(states, points, PERSON, new)
        yield Said(TOPICS["/people/states"], now, states)
