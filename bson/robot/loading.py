"""Robots by name or file."""

import dataclasses
import functools
import hashlib
import pathlib
from typing import Any

import mujoco
import numpy as np

from bson.robot.checks import EXPAND, MODEL_BYTES, forwards, refuse_odd_models
from bson.robot.description import Robot, RobotConfig, read_fields
from macid import assets
from macid.documents import read_bytes, shown, shown_path
from macid.files import UsageError
from macid.registry import Kind


def robot_names() -> list[str]:
    """Names of the descriptions in assets/robots, sorted."""
    return assets.names("robots", ".toml")


def load_robot(name: str) -> Robot:
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
        model = _model(path, read_fields(path, changed))
        return _load(str(name), path, changed, (model.stat().st_mtime_ns, model.stat().st_size))
    except OSError as error:
        raise UsageError(f"Can't read the robot {shown_path(name)}: {error.strerror}.") from None


ROBOTS: Kind[Robot] = Kind("robot", shipped=robot_names, read=_read_robot, files=(".toml",))
_CURES = {
    ".xacro": EXPAND,
    **dict.fromkeys((".urdf", ".xml"), " A model needs a .toml description beside it (docs: bson.robot)."),
    ".dae": " A mesh is part of a model, an MJCF or URDF file, and that needs a .toml description (docs: bson.robot).",
}


def _model(path, fields):
    """The model's file that the description in `path` names. Raises UsageError."""
    model = path.parent / fields.model
    where = f"robot {shown_path(path)}, key 'model'"
    if model.suffix.lower() == ".xacro":
        raise UsageError(f"{where}: MuJoCo can't read xacro, {shown_path(fields.model)}.{EXPAND}")
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
def _load(name, path, changed, _model_changed):
    """The Robot of a description, checked by building it."""
    fields = read_fields(path, changed)
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
    content = read_bytes(model, "robot model", MODEL_BYTES)
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
        refuse_odd_models(content, model.parent)
        return dataclasses.replace(robot, forwards=forwards(robot))
    except (ValueError, RecursionError) as error:
        problem = " ".join(str(error).split()).encode("ascii", "backslashreplace").decode()[:600]
        raise UsageError(f"Robot {shown_path(name)}: {problem}") from None


def _quaternion(rpy):
    """(4,) of roll, pitch and yaw [rad] about fixed axes, as URDF has them."""
    quaternion = np.empty(4)
    mujoco.mju_euler2Quat(quaternion, rpy[::-1], "zyx")
    return tuple(quaternion)
