"""Robots on driven wheels, left and right, that follow a commanded `(v, w)`, open loop: the Jackal, and any other robot
with a drive description and an MJCF or URDF model.

A command is `(v, w)`: speed ahead [m/s] and yaw rate [rad/s], counter-clockwise. A pose is `(x, y, yaw)` of the robot's
base in the world frame. The base's frame has x ahead, y left, z up, and its origin in the middle of the footprint.

A description is a TOML file, `assets/robots/NAME.toml` or the user's own file:

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

Mounts are `lidar`, `lidar3d`, `camera`, `imu`, unless the model has sites of these names, and any others that a
sensor's `site` names. Numbers outside the range of such robots are refused, in the description and in the model as
MuJoCo compiles it (masses, inertias, shapes). Wheels touch the floor only. The rest of the model touches the floor only
as well, and slides, as casters do. People and walls touch the hull. Where the model has MuJoCo's defaults, contacts and
armature are as the Jackal's (robots/jackal.xml).
"""

import dataclasses
import functools
import hashlib
import math
import pathlib
from typing import Annotated, Any, Literal
from xml.etree import ElementTree

import msgspec
import mujoco
import numpy as np
from msgspec import Meta

from macid import assets, geometry
from macid.documents import check_readable, read_bytes, read_document, shown, shown_path
from macid.files import UsageError
from macid.geometry import Array
from macid.registry import Kind
from macid.scene import BIT_FLOOR, BIT_SOLID, base_spec
from macid.state import PHYSICS_STEP

MOUNTS = ("lidar", "lidar3d", "camera", "imu")  # every robot has these
MAX_SPEED = 5.0  # at most, so that nobody is met between two looks (bson.simulation.world) [m/s]
MAX_RADIUS = 0.8  # at most, so that a robot begins clear of obstacles (bson.task) [m]
_TYRE = {"friction": [0.8, 0.005, 0.0001], "solref": [0.15, 0.3], "solimp": [0.7, 0.7, 0.001, 0.5, 2.0]}
_HULL_CONTACT = (0, BIT_SOLID | BIT_FLOOR)  # contype, conaffinity
_HULL_FRICTION = [0.3, 0.005, 0.0001]
_UNSEEN = 3  # the group of shapes that films don't draw
_FRONT_FIELD = 42.0  # of the camera in films, upright [deg]
_BACKWARDS_UP = (0.5, 0.5, -0.5, -0.5)  # from x ahead, z up to a MuJoCo camera's -z ahead, y up
_BOUNDS = {  # of a RobotConfig's numbers: least, most, unit
    "max_speed": (0.01, MAX_SPEED, "m/s"),
    "max_yaw_rate": (0.01, 20.0, "rad/s"),
    "wheel_radius": (0.005, MAX_RADIUS, "m"),
    "rolling_radius": (0.005, MAX_RADIUS, "m"),
    "track": (0.02, 2 * MAX_RADIUS, "m"),
    "effective_track": (0.02, 10.0, "m"),
    "half_length": (0.02, MAX_RADIUS, "m"),
    "half_width": (0.02, MAX_RADIUS, "m"),
    "spawn_height": (0.0, 2.0, "m"),
}
_MASS = (0.1, 1000.0)  # of a robot [kg]
_GYRATION = (0.0005, 2.0)  # radius of gyration of a body about any of its axes [m]
_SIZE = (0.001, 2.0)  # radius of a shape that touches the floor [m]
_MODEL_BYTES = 1 << 24
_MOST_ASSET = 1 << 28  # of a mesh or texture of a model [bytes]
_MOST_INCLUDES = 16  # levels of includes inside each other
_ASSET_FOLDERS = ("assetdir", "meshdir", "texturedir")  # of an MJCF's <compiler>
_MOST_COPIES = 4096  # of an element of a model, or sides of a texture [pixels]


def _domain(name):
    least, most, unit = _BOUNDS[name]
    return f"a number above 0, from {least:g} to {most:g} {unit}" if least else f"a number from 0 to {most:g} {unit}"


def _whole(name):
    """The bounds of a field of whole numbers, which stays whole."""
    least, most, _ = _BOUNDS[name]
    return Meta(description=_domain(name), ge=math.ceil(least), le=math.floor(most))


def _real(name):
    least, most, _ = _BOUNDS[name]
    return Meta(description=_domain(name), ge=least, le=most)


_Name = Annotated[str, Meta(min_length=1, max_length=1000, description="a name")]
_Wheels = Annotated[list[_Name], Meta(min_length=1, max_length=32, description="a list of joints' names")]
_Gain = Annotated[float, Meta(ge=1e-3, le=1e4, description="a number above 0, from 0.001 to 10000")]
_Height = Annotated[float, Meta(ge=1e-3, le=3.0, description="a height above the ground, from 0.001 to 3 m")]
_Triple = Annotated[
    list[Annotated[float, Meta(ge=-10.0, le=10.0)]],
    Meta(min_length=3, max_length=3, description="three numbers from -10 to 10"),
]


class _Drive(msgspec.Struct, forbid_unknown_fields=True):
    kind: Literal["differential", "skid-steer"]
    left: _Wheels
    right: _Wheels
    max_speed: Annotated[int, _whole("max_speed")] | Annotated[float, _real("max_speed")]
    max_yaw_rate: Annotated[int, _whole("max_yaw_rate")] | Annotated[float, _real("max_yaw_rate")]
    wheel_radius: Annotated[int, _whole("wheel_radius")] | Annotated[float, _real("wheel_radius")]
    track: Annotated[int, _whole("track")] | Annotated[float, _real("track")]
    rolling_radius: Annotated[int, _whole("rolling_radius")] | Annotated[float, _real("rolling_radius")] | None = None
    effective_track: Annotated[int, _whole("effective_track")] | Annotated[float, _real("effective_track")] | None = (
        None
    )
    gain: _Gain | None = None
    max_torque: _Gain | None = None


class _Footprint(msgspec.Struct, forbid_unknown_fields=True):
    half_length: Annotated[int, _whole("half_length")] | Annotated[float, _real("half_length")]
    half_width: Annotated[int, _whole("half_width")] | Annotated[float, _real("half_width")]
    bottom: _Height | None = None
    top: _Height | None = None


class _Mount(msgspec.Struct, forbid_unknown_fields=True):
    position: _Triple
    rpy: _Triple = msgspec.field(default_factory=lambda: [0.0, 0.0, 0.0])


class _Description(msgspec.Struct, forbid_unknown_fields=True):
    """The keys of a robot's file."""

    model: _Name
    base: _Name
    spawn_height: Annotated[int, _whole("spawn_height")] | Annotated[float, _real("spawn_height")]
    drive: _Drive
    footprint: _Footprint
    mounts: Annotated[dict[_Name, _Mount], Meta(max_length=100)] = {}


@dataclasses.dataclass(frozen=True, kw_only=True)
class RobotConfig:
    """A robot's abilities and sizes; the rest is in the description `name`. Raises ValueError."""

    name: str  # the description's name, or its file
    max_speed: float  # ahead and back [m/s]
    max_yaw_rate: float  # [rad/s]
    wheel_radius: float  # [m]
    rolling_radius: float  # of the loaded tyre [m]
    track: float  # between the left and the right wheels [m]
    effective_track: float  # the track with which a robot without sideways slip would turn as this one does [m]
    half_length: float  # of the footprint [m]
    half_width: float  # [m]
    spawn_height: float  # of the base's frame above the ground when the robot stands still [m]

    def __post_init__(self):
        for name, (least, most, _) in _BOUNDS.items():
            value = getattr(self, name)
            real = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not (real and least <= value <= most):
                raise ValueError(f"Robot {shown_path(self.name)}: {name} must be {_domain(name)}, not {shown(value)}.")
        if self.radius > MAX_RADIUS:
            raise ValueError(
                f"Robot {shown_path(self.name)}: half_length and half_width make a circle of {self.radius:.2f} m "
                f"around the footprint; it must be at most {MAX_RADIUS} m."
            )

    @property
    def radius(self) -> float:
        """The radius of the circle around the footprint [m]."""
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
    mounts: tuple  # (name, position (3,) [m], quaternion (4,)) of each
    digest: str  # a hash of both files
    forwards: tuple[float, ...] = ()  # of each wheel: 1, or -1 where a positive turn of its hinge drives back

    @property
    def wheels(self) -> tuple[str, ...]:
        """The hinges of the wheels, in the order of `wheel_speeds`: the left ones first."""
        return self.left + self.right


def add_robot(spec: mujoco.MjSpec, robot: "Robot", name: str = "robot", hidden: bool = False) -> None:
    """Attach the Robot to the world of `spec`, under a free joint `name`; its elements get names `name/...`.

    Joints and actuators that `spec` already has come before the robot's. hidden: whether sensors don't see the robot,
    see `hide_robot`. Raises ValueError for a model that lacks what the description names.
    """
    model = _prepared(robot, hidden).copy()
    for part in ("option", "visual", "stat", "memory"):  # the scene's hold; MuJoCo would warn that they do
        setattr(model, part, getattr(spec, part))
    attached = spec.worldbody.add_frame().attach_body(model.body(robot.base), f"{name}/", "")
    attached.add_freejoint(name=name)
    _fit_hull(spec, attached, robot, name)


@functools.lru_cache(8)  # reading a model takes as long as compiling it
def _prepared(robot, hidden):
    """The MjSpec of the Robot alone, ready to be attached. Raises ValueError."""
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
    for joint in base.joints:
        if joint.type != mujoco.mjtJoint.mjJNT_FREE:
            raise ValueError(f"the base '{robot.base}' has the joint '{joint.name}', but must be free.")
        model.delete(joint)
    _add_motors(model, robot, joints)
    _set_contacts(robot, base, joints)
    _add_mounts(model, robot, base)
    if hidden:
        _hide(model, base)
    return model


def hide_robot(spec: mujoco.MjSpec, name: str = "robot") -> None:
    """Removes from `spec` the robot's visual-only parts, and hides its other parts from rays and cameras: no sensor
    sees the robot that carries it. Motion stays what it was, bit for bit."""
    _hide(spec, spec.joint(name).parent)


def _hide(spec, base):
    for geom in base.find_all("geom"):
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
    """A velocity actuator for each wheel, with the description's gain, unless the description leaves the motors to the
    model."""
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
    """Sets which of the robot's shapes touch the floor, people and walls."""
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
            spec.default,  # not the model's own default
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
    """Adds the sites that sensors look for, the IMU's two sensors, and the camera for films."""
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
    for kind, sensor in imu.items():
        if model.sensor(f"imu_{kind}") is None:
            model.add_sensor(name=f"imu_{kind}", type=sensor, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="imu")
    if model.camera("front") is None:
        site, turned = model.site("camera"), np.empty(4)
        mujoco.mju_mulQuat(turned, site.quat, _BACKWARDS_UP)
        site.parent.add_camera(name="front", pos=site.pos, quat=turned, fovy=_FRONT_FIELD)


def robot_names() -> list[str]:
    """Names of the descriptions in assets/robots, sorted."""
    return assets.names("robots", ".toml")


def load_robot(name: str) -> "Robot":
    """The Robot of a description: a name of `robot_names()`, or a .toml file.

    Raises UsageError, naming the valid choices, or the fault in the description or its model.
    """
    cure = _CURES.get(pathlib.Path(name).suffix.lower(), "")
    if cure and name not in robot_names():
        raise UsageError(f"{ROBOTS.unknown(name)}{cure}")
    return ROBOTS.load(name)


def _read_robot(name):
    """The Robot of a description, a shipped one or a file."""
    path = pathlib.Path(name)
    if path.suffix != ".toml":
        path = assets.path("robots", f"{name}.toml")
    try:
        if not path.is_file():
            raise UsageError(f"There is no robot file {shown_path(name)}.")
        path = path.resolve()
        changed = path.stat().st_mtime_ns, path.stat().st_size
        model = _model(path, _fields(path, changed))
        return _load(str(name), path, changed, (model.stat().st_mtime_ns, model.stat().st_size))
    except OSError as error:
        raise UsageError(f"Can't read the robot {shown_path(name)}: {error.strerror}.") from None


ROBOTS: Kind["Robot"] = Kind("robot", shipped=robot_names, read=_read_robot, files=(".toml",))
_EXPAND = (
    " Expand it first: `xacro FILE.urdf.xacro > FILE.urdf`, and let a .toml description name FILE.urdf as its model."
)
_CURES = {
    ".xacro": _EXPAND,
    **dict.fromkeys((".urdf", ".xml"), " A model needs a .toml description beside it (docs: bson.robot)."),
    ".dae": " A mesh is part of a model, an MJCF or URDF file, and that needs a .toml description (docs: bson.robot).",
}


def _model(path, fields):
    """The model's file that the description in `path` names. Raises UsageError."""
    model = path.parent / fields.model
    where = f"robot {shown_path(path)}, key 'model'"
    if model.suffix.lower() == ".xacro":
        raise UsageError(f"{where}: MuJoCo can't read xacro, {shown_path(fields.model)}.{_EXPAND}")
    if model.suffix.lower() not in (".xml", ".urdf"):
        raise UsageError(f"{where}: it must be an MJCF (.xml) or URDF (.urdf) file, not {shown_path(fields.model)}.")
    if "\0" in fields.model or not model.is_file():
        raise UsageError(f"{where}: there is no model file {shown_path(model)}.")
    try:
        str(model).encode()
    except UnicodeEncodeError:
        raise UsageError(f"{where}: MuJoCo opens files with UTF-8 names only, not {shown_path(model)}.") from None
    return model


def robot_config(value: Any) -> RobotConfig:
    """The RobotConfig that `value` stands for: itself, a description's name or file, or a dict of changed numbers, for
    the description `name` in it (without: the Jackal's). Raises ValueError."""
    names = [field.name for field in dataclasses.fields(RobotConfig)]
    if isinstance(value, RobotConfig):
        load_robot(value.name)
        return value
    if isinstance(value, (str, pathlib.Path)):
        return load_robot(str(value)).config
    if isinstance(value, dict) and set(value) <= set(names) and isinstance(value.get("name", ""), str):
        return dataclasses.replace(load_robot(value.get("name", "jackal")).config, **value)
    raise ValueError(
        f"robot must be one of {', '.join(robot_names())}, a .toml file, or a dict of {', '.join(names)}, not "
        f"{shown(value)}."
    )


def describe(config: RobotConfig) -> Robot:
    """The Robot whose description `config` names, with the numbers of `config`."""
    return dataclasses.replace(load_robot(config.name), config=config)


@functools.lru_cache(16)
def _fields(path, _changed):
    """The content of a description (_Description), checked."""
    fields = read_document(path, _Description, "robot")
    where, drive, footprint = f"robot {shown_path(path)}", fields.drive, fields.footprint
    if drive.kind == "skid-steer" and drive.effective_track is None:
        raise UsageError(f"{where}: a skid-steered robot needs drive.effective_track, which its wheels' slip decides.")
    for table, first, second in ((drive, "gain", "max_torque"), (footprint, "bottom", "top")):
        if (getattr(table, first) is None) != (getattr(table, second) is None):
            raise UsageError(f"{where}: give both of {first} and {second}, or neither.")
    bottom, top = footprint.bottom, footprint.top
    if bottom is not None and top is not None and not bottom < top:
        raise UsageError(
            f"{where}: footprint.bottom and .top must be heights above 0 in rising order, not {footprint.bottom:g} and "
            f"{footprint.top:g}."
        )
    return fields


@functools.lru_cache(16)
def _load(name, path, changed, _model_changed):
    """The Robot of a description, checked by building it."""
    fields = _fields(path, changed)
    drive, footprint, model = fields.drive, fields.footprint, path.parent / fields.model
    config = RobotConfig(
        name=name,
        **{key: getattr(drive, key) for key in ("max_speed", "max_yaw_rate", "wheel_radius", "track")},
        rolling_radius=drive.wheel_radius if drive.rolling_radius is None else drive.rolling_radius,
        effective_track=drive.track if drive.effective_track is None else drive.effective_track,
        half_length=footprint.half_length,
        half_width=footprint.half_width,
        spawn_height=fields.spawn_height,
    )
    content = read_bytes(model, "robot model", _MODEL_BYTES)
    robot = Robot(
        config=config,
        model=model,
        base=fields.base,
        left=tuple(drive.left),
        right=tuple(drive.right),
        motor=None if drive.gain is None or drive.max_torque is None else (drive.gain, drive.max_torque),
        height=None if footprint.bottom is None or footprint.top is None else (footprint.bottom, footprint.top),
        mounts=tuple((mount, tuple(place.position), _quaternion(place.rpy)) for mount, place in fields.mounts.items()),
        digest=hashlib.sha256(path.read_bytes() + content).hexdigest()[:12],
    )
    try:
        _refuse_odd_models(content, model.parent)
        return dataclasses.replace(robot, forwards=_forwards(robot))
    except (ValueError, RecursionError) as error:
        problem = " ".join(str(error).split()).encode("ascii", "backslashreplace").decode()[:600]
        raise UsageError(f"Robot {shown_path(name)}: {problem}") from None


def _refuse_odd_models(content, folder, depth=0):
    """Raises ValueError for a model (bytes) in `folder`, or a file that it includes, that needs a reader or more room
    than MuJoCo has."""
    if depth > _MOST_INCLUDES:
        raise ValueError(f"its <include>s are nested more than {_MOST_INCLUDES} deep.")
    if b"<xacro:" in content:
        raise ValueError(f"the model has xacro's macros, which MuJoCo can't read.{_EXPAND}")
    try:
        tree = ElementTree.fromstring(content)
    except (ElementTree.ParseError, ValueError):  # MuJoCo's own message is better
        return
    places = {"", *(value for each in tree.iter("compiler") for key in _ASSET_FOLDERS if (value := each.get(key)))}
    copies = 1.0
    for element in tree.iter():
        mesh = element.get("filename") or element.get("file") or ""
        named = {mesh, mesh.replace("\\", "/").rpartition("/")[2]} - {""}  # names in a URDF lose their folders
        for file in [folder / place / name for place in sorted(places) for name in sorted(named)]:
            if element.tag == "include" and file.exists():
                _refuse_odd_models(read_bytes(file, "included model", _MODEL_BYTES), folder, depth + 1)
            elif file.exists():
                check_readable(file, f"<{element.tag}>", _MOST_ASSET)
        if mesh.lower().endswith(".dae"):
            raise ValueError(
                f"MuJoCo can't read the mesh {shown_path(mesh)}: convert it to .obj or .stl (Blender and MeshLab do), "
                "and name that in the model."
            )
        for key in ("width", "height", "nrow", "ncol", "count"):
            for word in (element.get(key) or "").split()[:3]:
                if word.isdigit() and int(word[:9]) > _MOST_COPIES:
                    raise ValueError(f"<{element.tag} {key}=...> is at most {_MOST_COPIES}, not {shown(word)}.")
                if word.isdigit() and key == "count":
                    copies *= max(1, int(word))
    if copies > 10 * _MOST_COPIES:
        raise ValueError(f"the model repeats elements {copies:.3g} times; {10 * _MOST_COPIES} are possible.")


def _quaternion(rpy):
    """(4,) of roll, pitch and yaw [rad] about fixed axes, as URDF has them."""
    quaternion = np.empty(4)
    mujoco.mju_euler2Quat(quaternion, rpy[::-1], "zyx")
    return tuple(quaternion)


def _forwards(robot):
    """For each wheel 1 where a positive turn of its hinge drives ahead, -1 where it drives back. Raises ValueError for
    a robot that can't be built, or whose wheels are not left and right on axles across it."""
    spec = base_spec(20.0)
    add_robot(spec, robot)
    model = spec.compile()
    _refuse_odd_bodies(model)
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


def _refuse_odd_bodies(model):
    """Raises ValueError where the bodies of a compiled model, a robot alone in its world, are outside the range of real
    robots."""
    total = float(model.body_mass.sum())
    if not _MASS[0] <= total <= _MASS[1]:
        raise ValueError(f"its mass is {total:g} kg; it must be from {_MASS[0]:g} to {_MASS[1]:g} kg.")
    for index in range(1, model.nbody):
        body, mass = model.body(index).name.removeprefix("robot/"), model.body_mass[index]
        if mass == 0:  # a body that it carries has a mass, or MuJoCo would have refused it
            continue
        gyration = np.sqrt(model.body_inertia[index] / mass)
        if not ((gyration >= _GYRATION[0]) & (gyration <= _GYRATION[1])).all():
            inertia = ", ".join(f"{one:.3g}" for one in model.body_inertia[index])
            raise ValueError(
                f"body '{body}' of {mass:.3g} kg has the inertia {inertia} kg m2; its radii of gyration must be from "
                f"{_GYRATION[0]:g} to {_GYRATION[1]:g} m."
            )
        if not (np.abs(model.body_pos[index]) <= 10.0).all():
            raise ValueError(f"body '{body}' is more than 10 m from what carries it.")
    for index in np.flatnonzero(model.geom_contype | model.geom_conaffinity):
        body, radius = model.geom_bodyid[index], model.geom_rbound[index]
        if body and not _SIZE[0] <= radius <= _SIZE[1]:
            body = model.body(body).name.removeprefix("robot/")
            raise ValueError(
                f"body '{body}' touches with a shape of radius {radius:.3g} m; it must be from {_SIZE[0]:g} to "
                f"{_SIZE[1]:g} m."
            )
    for what in ("dof_damping", "dof_armature", "dof_frictionloss", "jnt_stiffness", "actuator_gainprm"):
        most = np.abs(getattr(model, what)).max(initial=0.0)
        if not most <= 1e6:
            raise ValueError(f"its {what} must be numbers of at most 1e6, not {most:.3g}.")


def __getattr__(name):
    """JACKAL, the Robot with which others are compared. It is read when it is first asked for, as reading compiles
    it."""
    if name != "JACKAL":
        raise AttributeError(f"module 'bson.robot' has no attribute '{name}'")
    return load_robot("jackal")


@functools.lru_cache(64)
def site_pose(robot: Robot, site: str) -> Any:
    """The pose of the Robot's `site`: position (3,) [m] and rotation (3, 3) in the frame of its base. None if it has no
    such site."""
    spec = base_spec(20.0)
    add_robot(spec, robot)
    model = spec.compile()
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, f"robot/{site}")
    if number < 0:
        return None
    data = mujoco.MjData(model)
    data.qpos[:7] = 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
    mujoco.mj_kinematics(model, data)
    return data.site_xpos[number].copy(), data.site_xmat[number].reshape(3, 3).copy()


def _namespace(array):
    """The array module: NumPy, or JAX for JAX's arrays."""
    return array.__array_namespace__() if hasattr(array, "__array_namespace__") else np


def wheel_speeds(command: Array, robot: Robot | None = None) -> Array:
    """Speeds (..., W) [rad/s] of the Robot's hinges, ordered as its `wheels`, for `command` (..., 2): (v [m/s], w
    [rad/s]), which is clipped. robot: None for the Jackal."""
    robot = robot or load_robot("jackal")
    config, xp = robot.config, _namespace(command)
    limit = np.array([config.max_speed, config.max_yaw_rate])
    speed, yaw_rate = xp.moveaxis(xp.clip(command, -limit, limit), -1, 0)
    difference = yaw_rate * config.effective_track / 2
    left, right = speed - difference, speed + difference
    sides = [left] * len(robot.left) + [right] * len(robot.right)
    return xp.stack(sides, axis=-1) / config.rolling_radius * np.array(robot.forwards)


def wheel_actuators(model: mujoco.MjModel, robot: Robot | None = None, name: str = "robot") -> np.ndarray:
    """The indices (W,) in the MjModel's ctrl of the Robot's wheels, ordered as its `wheels`. robot: None for the
    Jackal."""
    robot = robot or load_robot("jackal")
    hinges = [model.joint(f"{name}/{wheel}").id for wheel in robot.wheels]
    return np.array([np.flatnonzero(model.actuator_trnid[:, 0] == hinge)[0] for hinge in hinges])


def wheel_dofs(model: mujoco.MjModel, robot: Robot, name: str = "robot") -> np.ndarray:
    """The indices (W,) in the MjModel's qvel of the Robot's wheels, ordered as its `wheels`."""
    return np.array([model.joint(f"{name}/{wheel}").dofadr[0] for wheel in robot.wheels])


def planar_pose(qpos: Array) -> Array:
    """Pose (..., 3), world frame [m, m, rad], of a free joint's `qpos` (..., 7)."""
    xp = _namespace(qpos)
    qpos = xp.asarray(qpos)
    w, x, y, z = qpos[..., 3], qpos[..., 4], qpos[..., 5], qpos[..., 6]
    yaw = xp.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    return xp.stack([qpos[..., 0], qpos[..., 1], yaw], axis=-1)


def planar_velocity(qpos: Array, qvel: Array) -> Array:
    """Speed ahead [m/s] and yaw rate [rad/s] (..., 2) of a free joint's `qpos` (..., 7) and `qvel` (..., 6).

    MuJoCo gives a free joint's linear velocity in the world frame and its angular velocity in the body frame.
    """
    xp = _namespace(qvel)
    qvel = xp.asarray(qvel)
    yaw = planar_pose(qpos)[..., 2]
    ahead = xp.cos(yaw) * qvel[..., 0] + xp.sin(yaw) * qvel[..., 1]
    return xp.stack([ahead, qvel[..., 5]], axis=-1)


def spawn_qpos(x: Any, y: Any, yaw: Any, config: RobotConfig | None = None) -> np.ndarray:
    """`qpos` (..., 7) of a robot that stands on the ground at `x`, `y` [m] (...), `yaw` [rad] (...). config: None for
    the Jackal."""
    config = config or load_robot("jackal").config
    x, y, yaw = np.broadcast_arrays(x, y, yaw)
    place = np.stack([x, y, np.full(yaw.shape, config.spawn_height)], axis=-1)
    return np.concatenate([place, geometry.yaw_quaternion(np.asarray(yaw, dtype=float))], axis=-1)


def footprint(pose: Array, config: RobotConfig | None = None) -> Array:
    """The footprint of a robot at `pose` (..., 3) as box rows (..., 5) of `macid.geometry`. config: None for the
    Jackal."""
    config = config or load_robot("jackal").config
    xp = _namespace(pose)
    pose = xp.asarray(pose)
    half_x, half_y = xp.full(pose.shape[:-1], config.half_length), xp.full(pose.shape[:-1], config.half_width)
    return xp.stack([pose[..., 0], pose[..., 1], half_x, half_y, pose[..., 2]], axis=-1)
