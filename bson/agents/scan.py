"""The 2D LIDAR for agents, at any place on the robot and with any beams."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bson.agents.contract import Setting, Unsuited
from bson.robot import describe, site_pose
from bson.sensors import Lidar2D

FAR = 30.0  # a miss reads at least this: a scanner that sees only 5 m has not met a wall there [m]
_LEVEL = math.radians(3.0)  # how far off level a scanner may look


class Scan:
    """The beams of the setting's Lidar2D (of several LIDARs the one with the key "lidar", or else the first).

    angles: (beams,) rising [rad], counter-clockwise from the robot's x axis. directions: (beams, 2), unit vectors.
    place: (2,) [m], where the beams begin. Both in the robot frame. reach [m]: how far the beams see. every: control
    steps from one scan to the next; the episode's first observation has the first scan. period: the same as a time [s].

    Raises Unsuited where there is no such LIDAR, or where it is not level, or where scans are farther apart than
    `longest` [s].
    """

    def __init__(self, setting: Setting, longest: float = math.inf):
        found = [sensor for sensor in setting.sensors if isinstance(sensor, Lidar2D)]
        if not found:
            has = ", ".join(type(sensor).__name__ for sensor in setting.sensors) or "none"
            raise Unsuited(f"needs a Lidar2D; the sensors are: {has}. Choose --sensor lidar2d.")
        lidar = min(found, key=lambda sensor: sensor.key != "lidar")
        position, frame = lidar.position, lidar.turn
        if position is None:
            pose = site_pose(describe(setting.robot), lidar.site)
            if pose is None:
                raise Unsuited(f"needs a Lidar2D on the robot, which has no site '{lidar.site}'.")
            position, frame = pose[0], pose[1] @ frame
        if abs(frame[2, 2]) < math.cos(_LEVEL):
            off = math.degrees(math.acos(abs(frame[2, 2])))
            raise Unsuited(f"needs a level Lidar2D; '{lidar.key}' is {off:.0f} degrees off.")
        self.key, self.place = lidar.key, np.array(position[:2], float)
        self.every = lidar.every(setting.control_period)
        self.period = self.every * setting.control_period
        if self.period > longest + 1e-9:
            raise Unsuited(f"needs a scan every {longest:g} s at least; '{lidar.key}' has a rate of {lidar.rate:g} Hz.")
        self.reach = float(np.float32(lidar.range_max))  # the reading of a miss
        self._overturned = bool(frame[2, 2] < 0)
        self._centre, self._half_field = math.atan2(frame[1, 0], frame[0, 0]), lidar.field / 2
        own = -lidar.angles[::-1] if self._overturned else lidar.angles
        self.angles = self._centre + own
        self.directions = np.stack([np.cos(self.angles), np.sin(self.angles)], axis=-1)
        self._step = lidar.field / (lidar.beams - 1)

    def read(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The distances (beams,) [m] of one world's observation, ordered as `angles`; at least FAR for a miss."""
        scan = np.asarray(observation[self.key], float)
        if self._overturned:
            scan = scan[::-1]
        return np.where(scan >= self.reach, FAR, scan) if self.reach < FAR else scan

    def beams_in(self, angle: float) -> int:
        """How many beams come nearest to spanning `angle` [rad]; at least 1."""
        return max(1, round(angle / self._step))

    def nearest(self, scan: np.ndarray, width: int) -> np.ndarray:
        """The index (sectors,) of the nearest beam of each sector of `width` beams; the last may have fewer."""
        missing = -len(scan) % width
        if missing:
            scan = np.append(scan, np.full(missing, np.inf))
        sectors = scan.reshape(-1, width)
        return sectors.argmin(axis=1) + np.arange(len(sectors)) * width

    def points(self, scan: np.ndarray, beams: np.ndarray) -> np.ndarray:
        """The ends (n, 2) [m], robot frame, of the beams with the indices `beams` (n,)."""
        return scan[beams, None] * self.directions[beams] + self.place

    def off_centre(self, angle: Any) -> Any:
        """`angle` [rad], robot frame, measured from the middle of the field, in [-pi, pi)."""
        return (angle - self._centre + math.pi) % (2 * math.pi) - math.pi if self._centre else angle

    def sees(self, angle: Any) -> Any:
        """Whether `angle` [rad] is in the field."""
        return np.abs(self.off_centre(angle)) <= self._half_field

    def beam_at(self, angle: float) -> int:
        """The index of the beam nearest to `angle` [rad]."""
        last = len(self.angles) - 1
        share = (self.off_centre(angle) + self._half_field) / (2 * self._half_field)
        return np.clip(np.rint(share * last), 0, last).astype(int)
