"""A robot's MuJoCo model, from MJCF or URDF: it gets motors, contacts and places for sensors, and joins a world."""

import functools
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from bson.robot.description import Robot
from macid.scene import BIT_FLOOR, BIT_SOLID, base_spec
from macid.state import PHYSICS_STEP

MOUNTS = ("lidar", "lidar3d", "camera", "imu")  # every robot has these
_TYRE = {"friction": [0.8, 0.005, 0.0001], "solref": [0.15, 0.3], "solimp": [0.7, 0.7, 0.001, 0.5, 2.0]}
_HULL_CONTACT = (0, BIT_SOLID | BIT_FLOOR)  # contype, conaffinity
_HULL_FRICTION = [0.3, 0.005, 0.0001]
_UNSEEN = 3  # the group of shapes that films don't draw
_FRONT_FIELD = 42.0  # of the camera in films, upright [deg]
_BACKWARDS_UP = (0.5, 0.5, -0.5, -0.5)  # from x ahead, z up to a MuJoCo camera's -z ahead, y up


def add_robot(spec: mujoco.MjSpec, robot: Robot, name: str = "robot", hidden: bool = False) -> None:
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
