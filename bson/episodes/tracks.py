"""Tracks: a track defines the robot's observation and its space."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from bson import sensors as shipped
from bson.robot import RobotConfig
from bson.sensors import DepthCamera, Imu, Lidar2D, Lidar3D, RgbCamera, Sensor
from bson.simulation.data import MAP_RESOLUTION
from bson.task import TaskConfig
from macid import geometry
from macid.documents import shown
from macid.files import UsageError
from macid.registry import Kind


def velocity_limit(robot: RobotConfig) -> np.ndarray:
    """Bounds (2,) of an observed (v [m/s], w [rad/s]): above the motors' limits, as a push can move the robot
    faster."""
    return np.array([4 * robot.max_speed, 10 * robot.max_yaw_rate], np.float32)


@dataclasses.dataclass(frozen=True)
class LocalTrack:
    """The Local track (paper, sec. VI-A): the relative goal, the robot's own motion, and its sensors."""

    sensors: tuple = (Imu(), Lidar2D())

    def space(self, config: TaskConfig) -> gymnasium.spaces.Dict:
        """The observation space of one world."""
        reach = config.map_size * np.sqrt(2.0)
        limit = velocity_limit(config.robot)
        return gymnasium.spaces.Dict(
            {
                "goal": gymnasium.spaces.Box(-reach, reach, (2,), np.float32),
                "velocity": gymnasium.spaces.Box(-limit, limit, dtype=np.float32),
                **{sensor.key: sensor.space for sensor in self.sensors},
            }
        )

    def observe(self, world: Any, ids: Any) -> dict[str, np.ndarray]:
        """Observations of the worlds `ids`, each array with a leading axis (len(ids),); copies."""
        pose = world.pose[ids]
        limit = velocity_limit(world.config.robot)
        return {
            "goal": geometry.to_body(world.goal[ids] - pose[:, :2], pose[:, 2]).astype(np.float32),
            "velocity": np.clip(world.velocity[ids], -limit, limit).astype(np.float32),
            **{sensor.key: world.readings[sensor.key][ids].copy() for sensor in self.sensors},
        }


@dataclasses.dataclass(frozen=True)
class GlobalTrack(LocalTrack):
    """The Global track (paper, sec. VI-A): the Local track's observation, the map, the robot's pose, and people's
    positions."""

    def space(self, config: TaskConfig) -> gymnasium.spaces.Dict:
        """The observation space of one world."""
        half, cells = config.map_size / 2, round(config.map_size / MAP_RESOLUTION)
        box = gymnasium.spaces.Box
        reach = np.array([2 * half, 2 * half, np.pi], np.float32)  # twice the map: a push may lift somebody over a wall
        return gymnasium.spaces.Dict(
            {
                **super().space(config).spaces,
                "map": box(0, 1, (cells, cells), np.uint8),
                "map_origin": box(-half, half, (2,), np.float32),
                "map_resolution": box(0.0, np.float32(2 * MAP_RESOLUTION), (1,), np.float32),
                "pose": box(-reach, reach, dtype=np.float32),
                "people": box(-2 * half, 2 * half, (config.people, 2), np.float32),
            }
        )

    def observe(self, world: Any, ids: Any) -> dict[str, np.ndarray]:
        """As LocalTrack.observe."""
        half = world.config.map_size / 2
        return {
            **super().observe(world, ids),
            "map": np.stack([world.occupancy(index) for index in ids]).astype(np.uint8),
            "map_origin": np.full((len(ids), 2), -half, np.float32),
            "map_resolution": np.full((len(ids), 1), MAP_RESOLUTION, np.float32),
            "pose": np.concatenate(
                [
                    np.clip(world.pose[ids, :2], -2 * half, 2 * half),
                    geometry.wrap_angle(world.pose[ids, 2:]).clip(-np.float32(np.pi), np.float32(np.pi)),
                ],
                axis=-1,
            ).astype(np.float32),
            "people": np.clip(world.people[ids, :, :2], -2 * half, 2 * half).astype(np.float32),
        }


SENSORS = {
    "lidar2d": (Imu(), Lidar2D()),
    "lidar3d": (Imu(), Lidar3D()),
    "camera": (Imu(), RgbCamera(), DepthCamera()),
}
TRACKS = {"local": LocalTrack, "global": GlobalTrack}
RESERVED = ("goal", "velocity", "map", "map_origin", "map_resolution", "pose", "people")  # the tracks' own keys
KEYS = {*RESERVED, *(sensor.key for sensors in SENSORS.values() for sensor in sensors)}  # that some track gives


def _own_track(found, name):
    """The user's own track: a class that is made with sensors, as LocalTrack is."""
    if not (isinstance(found, type) and issubclass(found, LocalTrack)):
        wanted = "a class derived from bson.episodes.tracks.LocalTrack"
        raise UsageError(f"Track '{name}' must be {wanted}, not {shown(found)}.")
    return found


def _own_sensors(found, name):
    """The user's own sensors: one sensor, a sensor's class, or a tuple of these."""
    chosen = [
        each() if isinstance(each, type) else each for each in (found if isinstance(found, tuple | list) else [found])
    ]
    if not chosen or not all(isinstance(each, Sensor) for each in chosen):
        raise UsageError(
            f"Sensor '{name}' must be a bson.sensors.Sensor, its class, or a tuple of these, not {shown(found)}."
        )
    return tuple(chosen)


def _own_kind(found, name):
    if not (isinstance(found, type) and issubclass(found, Sensor)):
        raise UsageError(f"There is no sensor {name!r}: a dict's kind is a class of bson.sensors, or 'module:class'.")
    return found


TRACK_KIND: Kind[type[LocalTrack]] = Kind("track", TRACKS, own="class", check=_own_track)
SENSOR_KIND: Kind[tuple[Sensor, ...]] = Kind("sensor", SENSORS, own="attribute", check=_own_sensors)
_SHIPPED = {name: kind for name, kind in vars(shipped).items() if isinstance(kind, type) and issubclass(kind, Sensor)}
_CLASS_KIND: Kind[type[Sensor]] = Kind("sensor", _SHIPPED, own="class", check=_own_kind)  # for a "kind" in a document


def make_track(track: str, sensor: Any) -> LocalTrack:
    """The track `track` ("local", "global", or the user's own class) with `sensor`: a name of SENSORS; the user's own
    sensors, e.g. `(Imu(), Lidar2D(beams=360, rate=10.0))`; the name of such sensors (`file.py:SENSORS`); or their form
    by `sensor_documents`. Raises UsageError, naming the valid choices."""
    return TRACK_KIND.load(track)(_sensors(sensor))


def sensor_label(sensor: Any) -> str:
    """The argument `sensor` of `make_track`, for people to read: its name, or the kinds of the user's own sensors."""
    return sensor if isinstance(sensor, str) else " + ".join(type(one).__name__ for one in _sensors(sensor))


def sensor_settings(sensors: Sequence[Sensor]) -> list[dict[str, Any]]:
    """Sensors' configurations, ready for JSON: [{"kind": ..., field: value, ...}, ...]."""
    return [{"kind": type(one).__name__, **dataclasses.asdict(one)} for one in sensors]


def sensor_documents(chosen: Any) -> Any:
    """The argument `sensor` of `make_track`, ready for JSON: its name, or [{"kind": ..., field: value, ...}, ...],
    where the kind of a sensor outside bson.sensors is "module:class"."""
    return chosen if isinstance(chosen, str) else [_document(one) for one in _sensors(chosen)]


def _document(sensor):
    kind = type(sensor)
    name = kind.__name__ if getattr(shipped, kind.__name__, None) is kind else f"{kind.__module__}:{kind.__qualname__}"
    fields = {
        field.name: list(value)
        if isinstance(value, tuple)
        else value.item()
        if isinstance(value, np.generic)
        else value
        for field in dataclasses.fields(sensor)
        for value in [getattr(sensor, field.name)]
    }
    return {"kind": name, **fields}


def _of_document(document):
    """The sensor that a dict of `sensor_documents` describes. Raises ValueError, naming the faulty field."""
    fields: dict[str, Any] = dict(document)
    kind = _CLASS_KIND.load(fields.pop("kind", None))
    known = [field.name for field in dataclasses.fields(kind)]
    if unknown := sorted(map(str, set(fields) - set(known))):
        raise ValueError(f"{kind.__name__} has no field {unknown[0]!r}. Choose among {', '.join(known)}.")
    values: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in fields.items()}
    return kind(**values)


def _sensors(chosen):
    sensors = SENSOR_KIND.load(chosen) if isinstance(chosen, str) else chosen
    sensors = (sensors,) if isinstance(sensors, (Sensor, dict)) else sensors
    if isinstance(sensors, (tuple, list)):
        sensors = [_of_document(one) if isinstance(one, dict) else one for one in sensors]
    if not isinstance(sensors, (tuple, list)) or not all(isinstance(one, Sensor) for one in sensors):
        raise UsageError(
            f"Unknown sensor {shown(chosen)}. {SENSOR_KIND.help[:-1]}, or a tuple of bson.sensors' configurations."
        )
    keys = [one.key for one in sensors]
    if taken := {key for key in keys if keys.count(key) > 1 or key in RESERVED}:
        raise ValueError(f"Sensors' keys must differ, also from {', '.join(RESERVED)}: {', '.join(sorted(taken))}.")
    return tuple(sensors)
