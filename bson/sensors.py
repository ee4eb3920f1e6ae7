"""The robot's sensors: each is one frozen configuration that mounts itself on a scene, reads many worlds and adds its
noise.

Every sensor has its key in the observation, its space, and the frame of its readings: x ahead, y left, z up, on the
robot unless `yaw` or `pitch` turn it. No sensor sees the robot that carries it. Noise is off (0) unless asked for:

| sensor | standard deviation at noise=1 | from |
|---|---|---|
| Lidar2D | 0.001 m | Clearpath's Jackal, Hokuyo UST-10; 0.012 m is SICK's figure for the LMS1xx |
| Lidar3D | 0.008 m | the simulator velodyne_simulator; 0.03 m is Velodyne's accuracy of the VLP-16 |
| DepthCamera | 0.0038 z^2 m, z in metres | Grunnet-Jepsen et al., tuning guide for Intel's D400 cameras |
| RgbCamera | 0.007 of white, for the three colours of a pixel at once | Gazebo's tutorial on sensor noise |
| Imu | 0.005 m/s2 and 0.005 rad/s | Clearpath's Jackal |

The noise is white: drawn anew for each reading, independent between beams, pixels and axes.
"""

import dataclasses
import itertools
import math
import numbers
import zlib
from collections.abc import Callable
from typing import Any

import gymnasium
import mujoco
import numpy as np

from macid.documents import MOST_NUMBER, is_number, shown
from macid.drawing.gl import Unavailable

_LEAST_RATE = 1e-9  # [Hz]
_MOST_NOISE = 1e6  # standard deviations
LOOK = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # MuJoCo's camera: x right, y up, -z ahead


def _number(least=-MOST_NUMBER, most=MOST_NUMBER, above=-math.inf):
    """Whether a value is a number in [least, most] and greater than `above`."""
    return lambda value: is_number(value, least, most) and value > above


def _whole(least, most):
    """Whether a value is a whole number in [least, most]."""
    return lambda value: isinstance(value, numbers.Integral) and not isinstance(value, bool) and least <= value <= most


def _numbers(count, each, rising=False):
    """Whether a value is `count` numbers that `each` accepts, in rising order if so asked."""

    def check(value):
        return (
            isinstance(value, (tuple, list, np.ndarray))
            and len(value) == count
            and all(each(one) for one in value)
            and not (rising and any(low >= high for low, high in itertools.pairwise(value)))
        )

    return check


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sensor:
    """The base of all sensors. Raises ValueError for a value outside its domain, naming both.

    key: the reading's name in the observation. rate [Hz]: a reading is taken at the reset and every 1 / rate seconds,
    a multiple of the control period, and kept in between; None: in every control step. noise: in standard deviations
    of the sensor's own figure (above): 0 is none, 1 as published.
    """

    key: str
    rate: float | None = None
    noise: float = 0.0

    def __post_init__(self):
        self._check("key", lambda value: isinstance(value, str) and value.isidentifier(), "an identifier")
        rates = _number(_LEAST_RATE)
        domain = f"None or a frequency above 0 Hz, at least {_LEAST_RATE:g} Hz"
        self._check("rate", lambda value: value is None or rates(value), domain)
        self._check(
            "noise", _number(0, _MOST_NOISE), f"a number of at least 0 (1: as published), at most {_MOST_NOISE:g}"
        )

    def _check(self, name, good, domain):
        value = getattr(self, name)
        if not good(value):
            raise ValueError(f"{type(self).__name__}: {name} must be {domain}, not {shown(value)}.")
        if isinstance(value, (list, np.ndarray)):
            object.__setattr__(self, name, tuple(float(one) for one in value))

    @property
    def space(self) -> gymnasium.spaces.Box:
        """The space of one world's reading."""
        raise NotImplementedError

    def mount(self, spec: mujoco.MjSpec, robot: str = "robot") -> None:
        """Adds to the scene `spec` what the sensor needs there."""
        raise NotImplementedError

    def export(self, spec: mujoco.MjSpec, robot: str = "robot") -> dict[str, Any]:
        """Adds to the scene `spec`, in which it is mounted, MuJoCo's own sensors with the same readings, for programs
        without this project. Returns notes for these programs, ready for JSON; an empty dict where MuJoCo has no sensor
        with this reading."""
        return {}

    def bind(self, world: Any, robot: str = "robot") -> Callable[[Any, np.ndarray], np.ndarray]:
        """The reading function for a World: called once, when the World is made, this method gives read(world, ids) ->
        (n, *space.shape).

        Readings are exact, of the last `forward` of the world's engine (bson.simulation.engines.base); noise is added
        afterwards. Raises an error where the sensor can't work.
        """
        raise NotImplementedError

    def noisy(self, reading: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """`reading`, one world's, with noise drawn from the numpy Generator `rng`."""
        raise NotImplementedError

    def every(self, control_period: float) -> int:
        """Control steps from one reading to the next. Raises ValueError where `rate` doesn't fit the period [s]."""
        if self.rate is None:
            return 1
        steps = round(1 / (self.rate * control_period))
        if steps < 1 or abs(steps * self.rate * control_period - 1) > 1e-6:
            fits = ", ".join(f"{1 / (control_period * number):.4g}" for number in (1, 2, 3))
            raise ValueError(
                f"{type(self).__name__}: a rate of {self.rate:g} Hz does not fit the control period of "
                f"{control_period:g} s: 1 / rate must be a multiple of it. Choose None, or {fits}, ... Hz."
            )
        return steps

    def generator(self, seed: int) -> np.random.Generator:
        """The numpy Generator of this sensor's noise in the episode `seed`: no other sensor draws from it."""
        return np.random.default_rng((zlib.crc32(self.key.encode()), seed))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mounted(Sensor):
    """A sensor with a place on the robot.

    position: x, y, z [m] in the frame of the robot's body; None: at the robot's site named `site`. yaw [rad]:
    counter-clockwise from the robot's x axis; pitch [rad]: downwards, after the yaw.
    """

    site: str
    position: tuple[float, float, float] | None = None
    yaw: float = 0.0
    pitch: float = 0.0

    def __post_init__(self):
        super().__post_init__()
        self._check("site", lambda value: isinstance(value, str), "the name of a site of the robot")
        self._check(
            "position",
            lambda value: value is None or _numbers(3, _number())(value),
            "None or three numbers x, y, z [m]",
        )
        for name in ("yaw", "pitch"):
            self._check(name, _number(-math.pi, math.pi), "an angle in [-pi, pi] rad")

    @property
    def turn(self) -> np.ndarray:
        """The rotation (3, 3) of the sensor's frame in the frame of its place: `yaw` and `pitch`."""
        sy, cy, sp, cp = math.sin(self.yaw), math.cos(self.yaw), math.sin(self.pitch), math.cos(self.pitch)
        return np.array([[cy * cp, -sy, cy * sp], [sy * cp, cy, sy * sp], [-sp, 0.0, cp]])

    def _place(self, spec, robot):
        """The body that carries the sensor, the place there (3,) [m], and the rotation (3, 3) of its frame."""
        site = spec.site(f"{robot}/{self.site}")
        if self.position is None and site is None:
            raise ValueError(f"The robot has no site '{self.site}' for its '{self.key}': give the sensor a position.")
        frame = self.turn
        if self.position is None:
            turned = np.empty(9)
            mujoco.mju_quat2Mat(turned, site.quat)
            return site.parent, site.pos, turned.reshape(3, 3) @ frame
        return spec.joint(robot).parent, self.position, frame


def _quaternion(frame):
    """The rotation (3, 3) as a quaternion (4,)."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(frame).ravel())
    return quaternion


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ranging(Mounted):
    """A sensor that measures distances along `directions`. A beam that meets nothing within range_max reads range_max;
    no reading is below range_min.

    sigma: standard deviation of a distance, times `noise`; in metres unless the sensor says otherwise.
    """

    range_min: float
    range_max: float
    sigma: float
    _sigma_unit = "m"

    def __post_init__(self):
        super().__post_init__()
        self._check("range_min", _number(least=0), "a distance of at least 0 m")
        self._check("range_max", _number(above=self.range_min), f"a distance above range_min ({self.range_min:g} m)")
        self._check("sigma", _number(least=0), f"a number of at least 0 {self._sigma_unit}")

    @property
    def directions(self) -> np.ndarray:
        """Vectors (..., 3) in the sensor's frame, each from the sensor to a point that reads 1 m."""
        raise NotImplementedError

    @property
    def space(self) -> gymnasium.spaces.Box:
        """The space of one world's reading."""
        return gymnasium.spaces.Box(self.range_min, self.range_max, self.directions.shape[:-1], np.float32)

    def points(self, reading: np.ndarray) -> np.ndarray:
        """The points (N, 3) [m], sensor's frame, that one `reading` met within range."""
        reading = np.asarray(reading)
        met = reading < self.range_max
        return reading[met][:, None] * self.directions[met]

    def noisy(self, reading: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """`reading` with noise on every distance at which something was met."""
        error = rng.standard_normal(reading.shape, np.float32) * np.float32(self.noise * self.sigma)
        return np.where(reading < self.range_max, self._within(reading + error * self._growth(reading)), reading)

    def _within(self, distance):
        """`distance` as it is read: in range, float32."""
        return np.clip(distance, self.range_min, self.range_max).astype(np.float32)

    def _growth(self, reading):
        """The factor on `sigma` at the distances `reading`."""
        return 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lidar(Ranging):
    """A scanner: the reading is the distances along its beams, unit vectors. It does not see the body that carries
    it."""

    def mount(self, spec: mujoco.MjSpec, robot: str = "robot") -> None:
        """Adds the site from which the beams start."""
        body, place, frame = self._place(spec, robot)
        body.add_site(name=f"{robot}/{self.key}_beams", pos=place, quat=_quaternion(frame), group=4, size=[0.002] * 3)

    def export(self, spec: mujoco.MjSpec, robot: str = "robot") -> dict[str, Any]:
        """A site and a rangefinder for each beam, in the reading's order; they don't see the body that carries them."""
        mounted = spec.site(f"{robot}/{self.key}_beams")
        frame, quaternion = np.empty(9), np.empty(4)
        mujoco.mju_quat2Mat(frame, mounted.quat)
        directions = self.directions
        for index in np.ndindex(directions.shape[:-1]):
            name = "/".join(map(str, (robot, self.key, *index)))
            mujoco.mju_quatZ2Vec(quaternion, frame.reshape(3, 3) @ directions[index])
            mounted.parent.add_site(name=name, pos=mounted.pos, quat=quaternion, group=4, size=[0.002] * 3)
            spec.add_sensor(
                name=name,
                type=mujoco.mjtSensor.mjSENS_RANGEFINDER,
                objtype=mujoco.mjtObj.mjOBJ_SITE,
                objname=name,
                intprm=[1 << int(mujoco.mjtRayDataField.mjRAYDATA_DIST), 0, 0],
                cutoff=self.range_max,
                noise=self.noise * self.sigma,
            )
        first = "/".join((robot, self.key, *("0" for _ in directions.shape[:-1])))
        bounds = {"range_min": self.range_min, "range_max": self.range_max, "no_hit": -1.0}
        return {"read_as": "beams", "first": first, "sensors": directions[..., 0].size, **bounds}

    def bind(self, world: Any, robot: str = "robot") -> Callable[[Any, np.ndarray], np.ndarray]:
        """The reading function: the engine's rays, which ignore the body that carries the sensor."""
        site, shape = world.model.site(f"{robot}/{self.key}_beams").id, self.directions.shape[:-1]
        rays = world.engine.add_rays(site, self.directions.reshape(-1, 3))
        return lambda world, ids: self._within(world.engine.rays(ids, rays)).reshape(-1, *shape)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lidar2D(Lidar):
    """A planar laser scanner of the Hokuyo UST-10 kind, on the Jackal's front mount, 0.40 m above ground.

    Reading: (beams,) float32 [m], from `-field/2` on the robot's right counter-clockwise to `+field/2` on its left.
    """

    key: str = "lidar"
    beams: int = 720
    field: float = math.radians(270)  # [rad]
    range_min: float = 0.1  # [m]
    range_max: float = 30.0  # [m]
    sigma: float = 0.001  # [m]
    site: str = "lidar"  # 0.12 m ahead of the Jackal's centre

    def __post_init__(self):
        super().__post_init__()
        self._check("beams", _whole(2, 100_000), "a whole number from 2 to 100000")
        self._check("field", _number(above=0, most=2 * math.pi), "an angle in (0, 2 pi] rad")

    @property
    def angles(self) -> np.ndarray:
        """Directions of the beams (beams,) [rad], counter-clockwise from ahead."""
        return np.linspace(-self.field / 2, self.field / 2, self.beams)

    @property
    def directions(self) -> np.ndarray:
        """Unit vectors (beams, 3) of the beams, in the sensor's frame."""
        return np.stack([np.cos(self.angles), np.sin(self.angles), np.zeros(self.beams)], axis=-1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lidar3D(Lidar):
    """A spinning scanner of the Velodyne VLP-16 kind, above the Jackal's centre, 0.385 m above ground.

    Reading: a range image (rows, columns) float32 [m]. Row 0 is the lowest, the last the highest, `elevation` apart in
    equal steps. Column 0 looks straight back, the middle column ahead; the columns between them look to the robot's
    right, the others to its left (counter-clockwise, as in Lidar2D). `points(reading)` is the point cloud. At 10 Hz the
    device has 1,800 columns.
    """

    key: str = "lidar3d"
    rows: int = 16
    columns: int = 360
    elevation: tuple[float, float] = (-math.radians(15), math.radians(15))  # lowest and highest row [rad]
    range_min: float = 0.1  # [m]
    range_max: float = 100.0  # [m]
    sigma: float = 0.008  # [m]
    site: str = "lidar3d"

    def __post_init__(self):
        super().__post_init__()
        self._check("rows", _whole(2, 128), "a whole number from 2 to 128")
        self._check("columns", _whole(4, 1800), "a whole number from 4 to 1800")
        steep = _number(-math.pi / 2, math.pi / 2)
        self._check("elevation", _numbers(2, steep, rising=True), "two rising angles in [-pi/2, pi/2] rad")

    @property
    def elevations(self) -> np.ndarray:
        """Elevations (rows,) [rad] of the rows, upwards from level."""
        return np.linspace(*self.elevation, self.rows)

    @property
    def azimuths(self) -> np.ndarray:
        """Azimuths (columns,) [rad] of the columns, counter-clockwise from ahead."""
        return 2 * np.pi * (np.arange(self.columns) - self.columns // 2) / self.columns

    @property
    def directions(self) -> np.ndarray:
        """Unit vectors (rows, columns, 3) of the beams, in the sensor's frame."""
        up, round_ = self.elevations[:, None], self.azimuths[None]
        level = np.cos(up)
        return np.stack([level * np.cos(round_), level * np.sin(round_), np.sin(up) + 0 * round_], axis=-1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Camera(Mounted):
    """A pinhole camera of the RealSense D435 kind, at the Jackal's front, 0.27 m above ground. Row 0 of a picture is
    the highest, column 0 the leftmost.

    width, height [pixels]; field: horizontal and vertical angle [rad]. The default is the D435's whole colour picture,
    69 x 42 degrees, scaled to 160 x 120, so that a pixel spans more across than down: `focal` has both lengths.
    Pictures have no shadows and no anti-aliasing: a pixel shows the surface that the ray through its middle meets.
    Needs OpenGL.
    """

    width: int = 160
    height: int = 120
    field: tuple[float, float] = (math.radians(69), math.radians(42))
    site: str = "camera"

    def __post_init__(self):
        super().__post_init__()
        for name in ("width", "height"):
            self._check(name, _whole(1, 4096), "a whole number of pixels from 1 to 4096")
        angle = _number(above=0, most=math.radians(170))
        self._check("field", _numbers(2, angle), "two angles (horizontal, vertical) in (0, 170] degrees, in rad")

    @property
    def focal(self) -> tuple[float, float]:
        """Focal lengths (horizontal, vertical) [pixels]; the optical axis meets the picture's middle."""
        across, up = (side / (2 * math.tan(angle / 2)) for side, angle in zip(self.size, self.field, strict=True))
        return across, up

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [pixels]."""
        return self.width, self.height

    @property
    def directions(self) -> np.ndarray:
        """Rays (height, width, 3) through the pixels' middles, in the sensor's frame, 1 long along the optical axis."""
        across, down = (np.arange(side) + 0.5 - side / 2 for side in self.size)
        left, up = np.meshgrid(-across / self.focal[0], -down / self.focal[1])
        return np.stack([np.ones_like(left), left, up], axis=-1)

    def mount(self, spec: mujoco.MjSpec, robot: str = "robot") -> None:
        """Adds the camera, named `robot`/`key`."""
        body, place, frame = self._place(spec, robot)
        body.add_camera(
            name=f"{robot}/{self.key}",
            pos=place,
            quat=_quaternion(frame @ LOOK),
            resolution=self.size,
            sensor_size=[2 * math.tan(angle / 2) for angle in self.field],
            focal_length=[1.0, 1.0],
        )

    def export(self, spec: mujoco.MjSpec, robot: str = "robot") -> dict[str, Any]:
        """Nothing to add: the camera is mounted already. The program draws its pictures itself, in the camera's
        resolution, without shadows."""
        return {"read_as": "picture", "camera": f"{robot}/{self.key}", "width": self.width, "height": self.height}

    def _bind(self, world, robot):
        """The function look(world, ids) -> (RGB, depth), see `Engine.pictures`."""
        try:
            camera = world.engine.add_camera(f"{robot}/{self.key}")
        except Unavailable as error:
            raise Unavailable(f"The camera '{self.key}' needs pictures; LIDARs do without. {error}") from None
        return lambda world, ids: world.engine.pictures(ids, camera)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RgbCamera(Camera):
    """A colour camera. Reading: (height, width, 3) uint8, red, green, blue.

    sigma: standard deviation of the brightness, as a share of white, times `noise`.
    """

    key: str = "rgb"
    sigma: float = 0.007

    def __post_init__(self):
        super().__post_init__()
        self._check("sigma", _number(0, 1), "a share of white in [0, 1]")

    @property
    def space(self) -> gymnasium.spaces.Box:
        """The space of one world's reading."""
        return gymnasium.spaces.Box(0, 255, (self.height, self.width, 3), np.uint8)

    def bind(self, world: Any, robot: str = "robot") -> Callable[[Any, np.ndarray], np.ndarray]:
        """The reading function. Raises macid.drawing.gl.Unavailable without OpenGL."""
        look = self._bind(world, robot)
        return lambda world, ids: look(world, ids)[0]

    def noisy(self, reading: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """`reading` with noise on the brightness of each pixel."""
        error = rng.standard_normal((*reading.shape[:2], 1), np.float32) * np.float32(255 * self.noise * self.sigma)
        return np.clip(np.rint(reading + error), 0, 255).astype(np.uint8)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DepthCamera(Camera, Ranging):  # in this order, so that the camera's site holds
    """A depth camera. Reading: (height, width) float32 [m], along the optical axis, not along the pixel's ray.

    A pixel that meets nothing within range_max reads range_max, and no reading is below range_min. By default the
    picture is aligned with the colour camera's, pixel by pixel, as the D435's driver does it; the stereo pair's own
    field is 85 x 58 degrees.

    sigma: standard deviation of a depth z is sigma z^2 [1/m], times `noise`: a stereo camera errs by a share of a pixel
    of disparity, so by z^2 * subpixel / (focal length * baseline). For the D435: 0.08 pixels (Intel: below 0.1 on
    textured surfaces), 848 pixels over 90 degrees (a focal length of 424), 0.05 m.
    """

    key: str = "depth"
    range_min: float = 0.3  # [m]
    range_max: float = 10.0  # [m]
    sigma: float = 0.08 / (424 * 0.05)
    _sigma_unit = "1/m"

    def export(self, spec: mujoco.MjSpec, robot: str = "robot") -> dict[str, Any]:
        """As Camera.export, with the range to which depths are clipped [m]."""
        bounds = {"range_min": self.range_min, "range_max": self.range_max}
        return {**super().export(spec, robot), "read_as": "depth", **bounds}

    def bind(self, world: Any, robot: str = "robot") -> Callable[[Any, np.ndarray], np.ndarray]:
        """The reading function. Raises macid.drawing.gl.Unavailable without OpenGL."""
        look = self._bind(world, robot)
        return lambda world, ids: self._within(look(world, ids)[1])

    def _growth(self, reading):
        return reading**2


@dataclasses.dataclass(frozen=True, kw_only=True)
class Imu(Sensor):
    """Accelerometer and gyro at the chassis origin, saturating as a common one does (16 g, 2000 degrees/s).

    Reading: (6,) float32: specific force x, y, z [m/s2] (about +9.81 upwards at rest), then angular velocity x, y, z
    [rad/s], robot frame.

    sigma_force, sigma_rate: standard deviations, times `noise`.
    """

    key: str = "imu"
    max_force: float = 16 * 9.81  # [m/s2]
    max_rate: float = math.radians(2000)  # [rad/s]
    sigma_force: float = 0.005  # [m/s2]
    sigma_rate: float = 0.005  # [rad/s]

    def __post_init__(self):
        super().__post_init__()
        for name, unit in (("max_force", "m/s2"), ("max_rate", "rad/s")):
            self._check(name, _number(above=0), f"a number above 0 {unit}")
        for name, unit in (("sigma_force", "m/s2"), ("sigma_rate", "rad/s")):
            self._check(name, _number(least=0), f"a number of at least 0 {unit}")

    @property
    def limit(self) -> np.ndarray:
        """Bounds (6,) of the reading."""
        return np.repeat(np.array([self.max_force, self.max_rate], np.float32), 3)

    @property
    def space(self) -> gymnasium.spaces.Box:
        """The space of one world's reading."""
        return gymnasium.spaces.Box(-self.limit, self.limit, dtype=np.float32)

    def mount(self, spec: mujoco.MjSpec, robot: str = "robot") -> None:
        """Nothing to add: the robot's model carries both sensors."""

    def export(self, spec: mujoco.MjSpec, robot: str = "robot") -> dict[str, Any]:
        """The robot's model has both sensors; here they saturate, too."""
        kinds = {"accelerometer": (self.max_force, self.sigma_force), "gyro": (self.max_rate, self.sigma_rate)}
        for kind, (most, sigma) in kinds.items():
            sensor = spec.sensor(f"{robot}/imu_{kind}")
            sensor.cutoff, sensor.noise = most, self.noise * sigma
        return {"read_as": "imu", **{kind: f"{robot}/imu_{kind}" for kind in kinds}}

    def bind(self, world: Any, robot: str = "robot") -> Callable[[Any, np.ndarray], np.ndarray]:
        """The reading function."""
        names = (f"{robot}/imu_accelerometer", f"{robot}/imu_gyro")
        columns = np.concatenate([world.model.sensor(name).adr[0] + np.arange(3) for name in names])
        limit = self.limit
        return lambda world, ids: np.clip(world.engine.sensordata[ids][:, columns], -limit, limit).astype(np.float32)

    def noisy(self, reading: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """`reading` with noise on each axis."""
        sigma = np.repeat([self.sigma_force, self.sigma_rate], 3) * self.noise
        return np.clip(reading + sigma * rng.standard_normal(6), -self.limit, self.limit).astype(np.float32)
