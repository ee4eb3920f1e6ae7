"""Robots on driven wheels, left and right, that follow a commanded `(v, w)`, open loop: the Jackal, and any other that a
drive description and an MJCF or URDF model tell of.

A command is `(v, w)`: speed ahead [m/s] and yaw rate [rad/s], counter-clockwise. A pose is `(x, y, yaw)` in the world
frame, that of the robot's base: x ahead, y left, z up, its origin the middle of the footprint.

A description is a TOML file, `assets/robots/NAME.toml` or anybody's own:

| key | what |
|---|---|
| model | the MJCF (.xml) or URDF (.urdf) file, beside the description |
| base | the body (link) that carries the rest |
| spawn_height | of the base's frame above the ground when the robot stands still [m] |
| drive.kind | "differential", or "skid-steer", which needs `effective_track` |
| drive.left, .right | names of the hinges (continuous joints) of the driven wheels |
| drive.max_speed, .max_yaw_rate | limits of the command [m/s], [rad/s] |
| drive.wheel_radius, .track | of a driven wheel, and between left and right [m] |
| drive.rolling_radius, .effective_track | what they amount to in motion [m]; without: the above |
| drive.gain, .max_torque | velocity motors for the wheels [N m s/rad], [N m], instead of the model's |
| footprint.half_length, .half_width | of the box that counts in collisions [m] |
| footprint.bottom, .top | that box's height above the ground [m], unless the model has a geom `hull` of its own |
| mounts.NAME.position, .rpy | a place for a sensor in the base's frame [m], roll, pitch and yaw [rad] if it is turned |

Mounts are `lidar`, `lidar3d`, `camera`, `imu`, unless the model has sites of these names, and any others that a sensor's
`site` names. Wheels touch the floor only, and so does the rest of the model, sliding, as casters do; people and walls
touch the hull. Where the model has MuJoCo's defaults, contacts and armature are as the Jackal's (robots/jackal.xml).
"""

import dataclasses
import functools
import hashlib
import math
import pathlib
import tomllib
from xml.etree import ElementTree

import mujoco
import numpy as np

from macid import assets, geometry
from macid.scene import BIT_FLOOR, BIT_SOLID
from macid.state import PHYSICS_STEP

MOUNTS = ("lidar", "lidar3d", "camera", "imu")  # that every robot has
DRIVES = ("differential", "skid-steer")
MAX_SPEED = 5.0  # so that nobody is met between two looks (bson.world) [m/s]
MAX_RADIUS = 0.8  # so that a robot begins clear of obstacles (bson.task) [m]
_TYRE = {"friction": [0.8, 0.005, 0.0001], "solref": [0.15, 0.3], "solimp": [0.7, 0.7, 0.001, 0.5, 2.0]}
_HULL_CONTACT = (0, BIT_SOLID | BIT_FLOOR)  # contype, conaffinity
_HULL_FRICTION = [0.3, 0.005, 0.0001]
_UNSEEN = 3  # the group of shapes that films don't draw
_FRONT_FIELD = 42.0  # of the camera that films show, upright [deg]
_BACKWARDS_UP = (0.5, 0.5, -0.5, -0.5)  # from x ahead, z up to a MuJoCo camera's -z ahead, y up
_TABLES = {  # keys that a description must have, and those that it may
    "": ("model base spawn_height drive footprint", "mounts"),
    "drive": (
        "kind left right max_speed max_yaw_rate wheel_radius track",
        "rolling_radius effective_track gain max_torque",
    ),
    "footprint": ("half_length half_width", "bottom top"),
    "mounts": ("position", "rpy"),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class RobotConfig:
    """What a robot can do and how large it is; the rest is in the description `name`. Raises ValueError."""

    name: str  # of the description, or its file
    max_speed: float  # ahead and back [m/s]
    max_yaw_rate: float  # [rad/s]
    wheel_radius: float  # [m]
    rolling_radius: float  # of the loaded tyre [m]
    track: float  # between the left and the right wheels [m]
    effective_track: float  # that a robot without sideways slip would need to turn as this one does [m]
    half_length: float  # of the footprint [m]
    half_width: float  # [m]
    spawn_height: float  # of the base's frame above the ground when the robot stands still [m]

    def __post_init__(self):
        for field in dataclasses.fields(self)[1:]:
            value, on_ground = getattr(self, field.name), field.name == "spawn_height"
            if not (_positive(value) or on_ground and value == 0):
                domain = "at least 0" if on_ground else "above 0"
                raise ValueError(f"Robot '{self.name}': {field.name} must be a number {domain}, not {value!r}.")
        if self.max_speed > MAX_SPEED:
            raise ValueError(f"Robot '{self.name}': max_speed must be at most {MAX_SPEED} m/s, not {self.max_speed}.")
        if self.radius > MAX_RADIUS:
            raise ValueError(
                f"Robot '{self.name}': half_length and half_width make a circle of {self.radius:.2f} m around the "
                f"footprint; it must be at most {MAX_RADIUS} m."
            )

    @property
    def radius(self):
        """Of the circle around the footprint [m]."""
        return float(np.hypot(self.half_length, self.half_width))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Robot:
    """A description, read and checked."""

    config: RobotConfig
    model: pathlib.Path
    base: str
    left: tuple[str, ...]  # hinges of the wheels
    right: tuple[str, ...]
    motor: tuple[float, float] | None  # gain [N m s/rad], max_torque [N m]; None: the model's own
    height: tuple[float, float] | None  # bottom and top of the hull above the ground [m]; None: the model's own
    mounts: tuple  # of (name, position (3,) [m], quaternion (4,))
    digest: str  # of both files
    forwards: tuple[float, ...] = ()  # of each wheel: 1, or -1 where a positive turn of its hinge drives back

    @property
    def wheels(self):
        """The hinges of the wheels, in the order of `wheel_speeds`: the left ones first."""
        return self.left + self.right


def add_robot(spec: mujoco.MjSpec, robot, name="robot") -> None:
    """Attach the Robot to the world of `spec`, under a free joint `name`; its elements are called `name/...`.

    Joints and actuators of bodies that `spec` already has come before the robot's. Raises ValueError for a model that
    lacks what the description names.
    """
    model = _read_model(robot.model)
    base = model.body(robot.base)
    if base is None:
        raise ValueError(f"there is no body '{robot.base}'. Its bodies are {_names(model.bodies[1:])}.")
    joints = {joint.name: joint for joint in base.find_all("joint")}
    for wheel in robot.wheels:
        if wheel not in joints:
            raise ValueError(
                f"there is no joint '{wheel}' on '{robot.base}'. Its joints are {_names(joints.values())}."
            )
    for key in model.keys:
        model.delete(key)
    for part in ("option", "visual", "stat", "memory"):  # the scene's rule; MuJoCo would warn that they do
        setattr(model, part, getattr(spec, part))
    for joint in base.joints:
        if joint.type != mujoco.mjtJoint.mjJNT_FREE:
            raise ValueError(f"the base '{robot.base}' has the joint '{joint.name}', but must be free.")
        model.delete(joint)
    _add_motors(model, robot, joints)
    _set_contacts(robot, base, joints)
    _add_mounts(model, robot, base)
    attached = spec.worldbody.add_frame().attach_body(base, f"{name}/", "")
    attached.add_freejoint(name=name)
    _fit_hull(spec, attached, robot, name)


def hide_robot(spec, name="robot"):
    """Takes from `spec` what of the robot can only be seen, and hides the rest of it from rays and cameras: no sensor
    sees the robot that carries it. Motion stays what it was, bit for bit."""
    for geom in spec.joint(name).parent.find_all("geom"):
        weightless = geom.mass == 0 or geom.parent.explicitinertial
        if weightless and not _collides(geom):
            spec.delete(geom)
        else:
            geom.rgba[3], geom.material = 0.0, ""


def _collides(geom):
    return geom.contype or geom.conaffinity


def _names(elements):
    return ", ".join(element.name for element in elements if element.name) or "none"


def _read_model(file):
    """The MjSpec of an MJCF or URDF file. Raises ValueError.

    Unless a URDF says otherwise, its visuals are kept, and of its meshes' names only the last part counts.
    """
    try:
        if file.suffix != ".urdf":
            return mujoco.MjSpec.from_file(str(file))
        tree = ElementTree.fromstring(file.read_bytes())
        ours = tree if tree.tag == "mujoco" else tree.find("mujoco")
        ours = ElementTree.SubElement(tree, "mujoco") if ours is None else ours
        compiler = ours.find("compiler")
        compiler = ElementTree.SubElement(ours, "compiler") if compiler is None else compiler
        compiler.attrib = {"discardvisual": "false", "strippath": "true", **compiler.attrib}
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(tree, encoding="unicode"))
        spec.modelfiledir = str(file.parent)
        for body in spec.bodies:
            if any(not _collides(geom) for geom in body.geoms):  # the link has visuals
                for geom in filter(_collides, body.geoms):
                    geom.group = _UNSEEN
        return spec
    except (ValueError, ElementTree.ParseError) as error:
        raise ValueError(f"MuJoCo can't read '{file.name}': {error}") from None


def _add_motors(model, robot, joints):
    """A velocity actuator for each wheel, with the description's gain, unless that leaves it to the model."""
    for wheel in robot.wheels:
        own = [motor for motor in model.actuators if motor.target == wheel]
        if robot.motor is None:
            if len(own) != 1 or not _is_velocity_motor(own[0]):
                raise ValueError(f"wheel '{wheel}' needs one velocity actuator: give drive.gain and drive.max_torque.")
            continue
        for motor in own:
            model.delete(motor)
        gain, limit = robot.motor
        motor = model.add_actuator(name=wheel, target=wheel, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_velocity(kv=gain)
        motor.forcelimited, motor.forcerange = True, [-limit, limit]
        if joints[wheel].armature == 0:
            joints[wheel].armature = gain * PHYSICS_STEP / 2


def _is_velocity_motor(motor):
    return (
        motor.biastype == mujoco.mjtBias.mjBIAS_AFFINE
        and motor.gear[0] == 1
        and motor.gainprm[0] == -motor.biasprm[2] > 0 == motor.biasprm[1]
    )


def _set_contacts(robot, base, joints):
    """Says what of the robot touches what."""
    plain = mujoco.MjSpec().worldbody.add_geom()
    wheels = {joints[wheel].parent.name for wheel in robot.wheels}
    for geom in filter(_collides, base.find_all("geom")):
        if geom.name == "hull":
            geom.contype, geom.conaffinity = _HULL_CONTACT
            continue
        geom.contype, geom.conaffinity, geom.priority = 0, BIT_FLOOR, 1
        for key, value in _TYRE.items():
            if np.array_equal(getattr(geom, key), getattr(plain, key)):
                if key == "friction" and geom.parent.name not in wheels:
                    geom.condim = 1  # a caster
                else:
                    setattr(geom, key, value)


def _fit_hull(spec, base, robot, name):
    """Makes the hull as large as the footprint; adds it to the attached body `base`, if the model has none."""
    hull, config = spec.geom(f"{name}/hull"), robot.config
    if hull is None:
        if robot.height is None:
            raise ValueError("the model has no geom 'hull': give footprint.bottom and footprint.top.")
        bottom, top = np.array(robot.height) - config.spawn_height
        hull = base.add_geom(
            spec.default,  # not the model's
            name=f"{name}/hull",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[0.0, 0.0, (bottom + top) / 2],
            size=[0.0, 0.0, (top - bottom) / 2],
            rgba=[0, 0, 0, 0],
            group=_UNSEEN,
            mass=0.0,
            contype=_HULL_CONTACT[0],
            conaffinity=_HULL_CONTACT[1],
            priority=1,
            friction=_HULL_FRICTION,
        )
    elif robot.height is not None or hull.type != mujoco.mjtGeom.mjGEOM_BOX:
        raise ValueError("the model's geom 'hull' must be a box, and then footprint has no bottom and top.")
    hull.size = [config.half_length, config.half_width, hull.size[2]]


def _add_mounts(model, robot, base):
    """The sites that sensors look for, the IMU's two sensors, and the camera that films show."""
    for name, position, quaternion in robot.mounts:
        base.add_site(name=name, pos=position, quat=quaternion, group=4)
    for name in MOUNTS:
        if model.site(name) is None:
            raise ValueError(f"there is no place for the sensor '{name}': give mounts.{name}.position.")
    for site in model.sites:
        if site.alt.type != mujoco.mjtOrientation.mjORIENTATION_QUAT:  # sensors read the quaternion
            compiler = model.compiler
            site.quat = model.resolve_orientation(
                degree=compiler.degree, sequence=compiler.eulerseq, orientation=site.alt
            )
            site.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    imu = {"accelerometer": mujoco.mjtSensor.mjSENS_ACCELEROMETER, "gyro": mujoco.mjtSensor.mjSENS_GYRO}
    for kind, number in imu.items():
        if model.sensor(f"imu_{kind}") is None:
            model.add_sensor(name=f"imu_{kind}", type=number, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="imu")
    if model.camera("front") is None:
        site, turned = model.site("camera"), np.empty(4)
        mujoco.mju_mulQuat(turned, site.quat, _BACKWARDS_UP)
        site.parent.add_camera(name="front", pos=site.pos, quat=turned, fovy=_FRONT_FIELD)


def robot_names():
    """Names of the descriptions in assets/robots, sorted."""
    return assets.names("robots", ".toml")


def load_robot(name):
    """The Robot of a description: a name of `robot_names()`, or a .toml file.

    Raises ValueError, naming the valid choices, or what is wrong in the description or its model.
    """
    path = pathlib.Path(name)
    if path.suffix != ".toml":
        if name not in robot_names():
            raise ValueError(f"Unknown robot '{name}'. Choose one of {', '.join(robot_names())}, or a .toml file.")
        path = assets.path("robots", f"{name}.toml")
    if not path.is_file():
        raise ValueError(f"There is no robot file '{name}'.")
    fields = _fields(path.resolve(), path.stat().st_mtime_ns)
    model = path.parent / fields["model"]
    if not model.is_file():
        raise ValueError(f"{name}: there is no model file '{model}'.")
    return _load(str(name), path.resolve(), path.stat().st_mtime_ns, model.stat().st_mtime_ns)


def robot_config(value):
    """The RobotConfig that `value` stands for: itself, a description's name or file, or a dict of numbers to be changed of
    the description `name` (of the Jackal's without). Raises ValueError."""
    names = [field.name for field in dataclasses.fields(RobotConfig)]
    if isinstance(value, RobotConfig):
        load_robot(value.name)
        return value
    if isinstance(value, (str, pathlib.Path)):
        return load_robot(str(value)).config
    if isinstance(value, dict) and set(value) <= set(names) and isinstance(value.get("name", ""), str):
        return dataclasses.replace(load_robot(value.get("name", "jackal")).config, **value)
    raise ValueError(
        f"robot must be one of {', '.join(robot_names())}, a .toml file, or a dict of {', '.join(names)}, not {value!r}."
    )


def describe(config):
    """The Robot whose description `config` names, with the numbers of `config`."""
    return dataclasses.replace(load_robot(config.name), config=config)


def _positive(value):
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value < math.inf


def _triple(value):
    return (
        isinstance(value, list)
        and len(value) == 3
        and all(isinstance(one, (int, float)) and not isinstance(one, bool) and math.isfinite(one) for one in value)
    )


@functools.lru_cache(16)
def _fields(path, _changed):
    """The content of a description, with all of its keys checked."""
    with path.open("rb") as f:
        try:
            fields = tomllib.load(f)
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"{path} is not TOML: {error}.") from None
    mounts = fields.get("mounts", {})
    if not isinstance(mounts, dict):
        raise ValueError(f"{path}: mounts must be a table of places for sensors.")
    tables = [("", fields), *((name, fields.get(name)) for name in ("drive", "footprint"))]
    for name, table in [*tables, *(("mounts", mount) for mount in mounts.values())]:
        needed, optional = (keys.split() for keys in _TABLES[name])
        where = f"[{name}] has" if name else "a robot has"
        if not isinstance(table, dict):
            raise ValueError(f"{path}: {where} {', '.join(needed)}; this is missing or no table.")
        if missing := [key for key in needed if key not in table]:
            raise ValueError(f"{path}: missing '{missing[0]}': {where} {', '.join(needed)}.")
        if unknown := sorted(set(table) - {*needed, *optional}):
            raise ValueError(f"{path}: unknown key '{unknown[0]}': {where} {', '.join(needed + optional)}.")
    _check_values(path, fields)
    return fields


def _check_values(path, fields):
    """Raises ValueError for a value of a description that is outside its domain."""
    drive, footprint = fields["drive"], fields["footprint"]
    for key in ("model", "base"):
        if not isinstance(fields[key], str):
            raise ValueError(f"{path}: {key} must be a name, not {fields[key]!r}.")
    if drive["kind"] not in DRIVES:
        raise ValueError(f"{path}: drive.kind must be one of {', '.join(DRIVES)}, not {drive['kind']!r}.")
    if drive["kind"] == "skid-steer" and "effective_track" not in drive:
        raise ValueError(f"{path}: a skid-steered robot needs drive.effective_track, which its wheels' slip decides.")
    for key in ("left", "right"):
        if not (isinstance(drive[key], list) and drive[key] and all(isinstance(one, str) for one in drive[key])):
            raise ValueError(f"{path}: drive.{key} must be a list of joints' names, not {drive[key]!r}.")
    for table, first, second in ((drive, "gain", "max_torque"), (footprint, "bottom", "top")):
        if (first in table) != (second in table):
            raise ValueError(f"{path}: give both of {first} and {second}, or neither.")
    for key in ("gain", "max_torque"):
        if key in drive and not _positive(drive[key]):
            raise ValueError(f"{path}: drive.{key} must be a number above 0, not {drive[key]!r}.")
    if "top" in footprint and not (
        _positive(footprint["bottom"]) and _positive(footprint["top"]) and footprint["bottom"] < footprint["top"]
    ):
        raise ValueError(f"{path}: footprint.bottom and .top must be heights above 0 in rising order.")
    for name, mount in fields.get("mounts", {}).items():
        for key in ("position", "rpy"):
            if not _triple(mount.get(key, [0, 0, 0])):
                raise ValueError(f"{path}: mounts.{name}.{key} must be three numbers, not {mount[key]!r}.")


@functools.lru_cache(16)
def _load(name, path, changed, _model_changed):
    """The Robot of a description, checked by building it."""
    fields = _fields(path, changed)
    drive, footprint, model = fields["drive"], fields["footprint"], path.parent / fields["model"]
    config = RobotConfig(
        name=name,
        **{key: drive[key] for key in ("max_speed", "max_yaw_rate", "wheel_radius", "track")},
        rolling_radius=drive.get("rolling_radius", drive["wheel_radius"]),
        effective_track=drive.get("effective_track", drive["track"]),
        half_length=footprint["half_length"],
        half_width=footprint["half_width"],
        spawn_height=fields["spawn_height"],
    )
    robot = Robot(
        config=config,
        model=model,
        base=fields["base"],
        left=tuple(drive["left"]),
        right=tuple(drive["right"]),
        motor=(drive["gain"], drive["max_torque"]) if "gain" in drive else None,
        height=(footprint["bottom"], footprint["top"]) if "top" in footprint else None,
        mounts=tuple(
            (mount, tuple(place["position"]), _quaternion(place.get("rpy", [0, 0, 0])))
            for mount, place in fields.get("mounts", {}).items()
        ),
        digest=hashlib.sha256(path.read_bytes() + model.read_bytes()).hexdigest()[:12],
    )
    try:
        return dataclasses.replace(robot, forwards=_forwards(robot))
    except ValueError as error:
        raise ValueError(f"Robot '{name}': {' '.join(str(error).split())}") from None


def _quaternion(rpy):
    """(4,) of roll, pitch and yaw [rad] about fixed axes, as URDF has them."""
    quaternion = np.empty(4)
    mujoco.mju_euler2Quat(quaternion, rpy[::-1], "zyx")
    return tuple(quaternion)


def _forwards(robot):
    """1 or -1 for each wheel: whether a positive turn of its hinge drives ahead. Raises ValueError for a robot that can't
    be built, or whose wheels are not left and right on axles across it."""
    spec = mujoco.MjSpec()
    add_robot(spec, robot)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:7] = 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
    mujoco.mj_kinematics(model, data)
    forwards = []
    for wheel in robot.wheels:
        joint = model.joint(f"robot/{wheel}")
        if joint.type[0] != mujoco.mjtJoint.mjJNT_HINGE or model.jnt_limited[joint.id]:
            raise ValueError(f"joint '{wheel}' is no free-running hinge (URDF: continuous), as a wheel's must be.")
        across, left = data.xaxis[joint.id, 1], data.xanchor[joint.id, 1] > 0
        if abs(across) < 0.99:
            raise ValueError(f"the axle of wheel '{wheel}' does not lie across the robot, along y.")
        if left != (wheel in robot.left):
            raise ValueError(f"wheel '{wheel}' is on the {'left' if left else 'right'}, y being left.")
        forwards.append(float(np.sign(across)))
    return tuple(forwards)


JACKAL = load_robot("jackal")


def wheel_speeds(command, robot=JACKAL):
    """Speeds (..., W) [rad/s] of the Robot's hinges, ordered as its `wheels`, for `command` (..., 2): (v [m/s], w
    [rad/s]), clipped."""
    config = robot.config
    limit = np.array([config.max_speed, config.max_yaw_rate])
    speed, yaw_rate = np.moveaxis(np.clip(command, -limit, limit), -1, 0)
    difference = yaw_rate * config.effective_track / 2
    left, right = speed - difference, speed + difference
    sides = [left] * len(robot.left) + [right] * len(robot.right)
    return np.stack(sides, axis=-1) / config.rolling_radius * robot.forwards


def wheel_actuators(model, robot=JACKAL, name="robot"):
    """Which entries (W,) of the MjModel's ctrl are the Robot's wheels, ordered as its `wheels`."""
    hinges = [model.joint(f"{name}/{wheel}").id for wheel in robot.wheels]
    return np.array([np.flatnonzero(model.actuator_trnid[:, 0] == hinge)[0] for hinge in hinges])


def planar_pose(qpos):
    """Pose (..., 3), world frame [m, m, rad], of a free joint's `qpos` (..., 7)."""
    qpos = np.asarray(qpos)
    w, x, y, z = qpos[..., 3], qpos[..., 4], qpos[..., 5], qpos[..., 6]
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    return np.stack([qpos[..., 0], qpos[..., 1], yaw], axis=-1)


def planar_velocity(qpos, qvel):
    """Speed ahead [m/s] and yaw rate [rad/s] (..., 2) of a free joint's `qpos` (..., 7) and `qvel` (..., 6).

    MuJoCo gives a free joint's linear velocity in the world frame and its angular velocity in the body frame.
    """
    qvel = np.asarray(qvel)
    yaw = planar_pose(qpos)[..., 2]
    ahead = np.cos(yaw) * qvel[..., 0] + np.sin(yaw) * qvel[..., 1]
    return np.stack([ahead, qvel[..., 5]], axis=-1)


def spawn_qpos(x, y, yaw, config=JACKAL.config):
    """`qpos` (..., 7) of a robot that stands on the ground at `x`, `y` [m] (...), `yaw` [rad] (...)."""
    x, y, yaw = np.broadcast_arrays(x, y, yaw)
    place = np.stack([x, y, np.full(yaw.shape, config.spawn_height)], axis=-1)
    return np.concatenate([place, geometry.yaw_quaternion(np.asarray(yaw, dtype=float))], axis=-1)


def footprint(pose, config=JACKAL.config):
    """Box rows (..., 5), as in `macid.geometry`, that a robot at `pose` (..., 3) covers."""
    pose = np.asarray(pose)
    half_x, half_y = np.full(pose.shape[:-1], config.half_length), np.full(pose.shape[:-1], config.half_width)
    return np.stack([pose[..., 0], pose[..., 1], half_x, half_y, pose[..., 2]], axis=-1)
