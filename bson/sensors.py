"""The robot's sensors: `mount(spec)` adds them to the scene, `read(sensordata)` gives their reading of many worlds.

Every sensor is an object with its name in the observation, its space and its reading.
"""

import dataclasses
import math

import gymnasium
import mujoco
import numpy as np


@dataclasses.dataclass(frozen=True)
class Lidar2D:
    """A planar laser scanner of the Hokuyo UST-10 kind, on the Jackal's front mount.

    Reading: (beams,) float32 [m], from `-field/2` on the robot's right counter-clockwise to `+field/2` on its left,
    robot frame. A beam that meets nothing within `range_max` reads range_max; nothing reads below range_min.
    """

    beams: int = 720
    field: float = math.radians(270)  # [rad]
    range_min: float = 0.1  # [m]
    range_max: float = 30.0  # [m]
    site: str = "lidar"  # of the robot: 0.40 m above ground, 0.12 m ahead of its centre

    key = "lidar"

    def __post_init__(self):
        if self.beams < 2 or not 0 < self.field <= 2 * math.pi or not 0 <= self.range_min < self.range_max:
            raise ValueError(f"Lidar2D needs at least 2 beams, a field in (0, 2 pi] and range_min < range_max: {self}.")

    @property
    def angles(self):
        """Directions of the beams (beams,) [rad], robot frame, counter-clockwise from ahead."""
        return np.linspace(-self.field / 2, self.field / 2, self.beams)

    @property
    def space(self):
        """The reading's space."""
        return gymnasium.spaces.Box(self.range_min, self.range_max, (self.beams,), np.float32)

    def mount(self, spec, robot="robot"):
        """Adds a rangefinder site for each beam to the body that carries the robot's LIDAR site."""
        mount = spec.site(f"{robot}/{self.site}")
        for index, angle in enumerate(self.angles):
            name = f"{robot}/{self.key}{index}"
            site = mount.parent.add_site(name=name, pos=mount.pos, group=4, size=[0.002, 0.002, 0.002])
            site.alt.type = mujoco.mjtOrientation.mjORIENTATION_ZAXIS
            site.alt.zaxis = [math.cos(angle), math.sin(angle), 0.0]
            spec.add_sensor(
                name=name,
                type=mujoco.mjtSensor.mjSENS_RANGEFINDER,
                objtype=mujoco.mjtObj.mjOBJ_SITE,
                objname=name,
                intprm=[1, 0, 0],  # of what a ray can return: its distance
                cutoff=self.range_max,
            )

    def bind(self, model, robot="robot"):
        """The reading function for `model`: sensordata (n, nsensordata) -> (n, beams)."""
        first = model.sensor(f"{robot}/{self.key}0").adr[0]
        columns = slice(first, first + self.beams)

        def read(sensordata):
            distance = sensordata[:, columns]
            distance = np.where(distance < 0, self.range_max, distance)
            return np.clip(distance, self.range_min, self.range_max).astype(np.float32)

        return read


@dataclasses.dataclass(frozen=True)
class Imu:
    """Accelerometer and gyro at the chassis origin, saturating as a common one does (16 g, 2000 degrees/s).

    Reading: (6,) float32: specific force x, y, z [m/s2] (about +9.81 upwards at rest), then angular velocity x, y, z
    [rad/s], robot frame.
    """

    max_force: float = 16 * 9.81  # [m/s2]
    max_rate: float = math.radians(2000)  # [rad/s]

    key = "imu"

    @property
    def limit(self):
        """Bounds (6,) of the reading."""
        return np.repeat(np.array([self.max_force, self.max_rate], np.float32), 3)

    @property
    def space(self):
        """The reading's space."""
        return gymnasium.spaces.Box(-self.limit, self.limit, dtype=np.float32)

    def mount(self, spec, robot="robot"):
        """Nothing to add: the robot's model carries both sensors."""

    def bind(self, model, robot="robot"):
        """The reading function for `model`: sensordata (n, nsensordata) -> (n, 6)."""
        names = (f"{robot}/imu_accelerometer", f"{robot}/imu_gyro")
        columns = np.concatenate([model.sensor(name).adr[0] + np.arange(3) for name in names])
        limit = self.limit
        return lambda sensordata: np.clip(sensordata[:, columns], -limit, limit).astype(np.float32)
