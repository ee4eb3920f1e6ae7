"""A robot's description: what its file says, and the numbers that a task may change."""

import dataclasses
import functools
import math
import pathlib
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from macid.documents import read_document, shown, shown_path
from macid.files import UsageError

MAX_SPEED = 5.0  # at most, so that nobody is met between two looks (bson.simulation.world) [m/s]
MAX_RADIUS = 0.8  # at most, so that a robot begins clear of obstacles (bson.task) [m]
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


class Description(msgspec.Struct, forbid_unknown_fields=True):
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


@functools.lru_cache(16)
def read_fields(path: pathlib.Path, _changed: Any) -> Description:
    """The content of the description in `path`, checked. _changed: when, so that it is read anew. Raises UsageError."""
    fields = read_document(path, Description, "robot")
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
