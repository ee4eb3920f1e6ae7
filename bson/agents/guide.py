"""What guided robots see of a world whose map is known: the vector of bson.guided."""

import math
from collections.abc import Mapping

import numpy as np

from bson import guided
from bson.agents.ways import Ways, robot_frame
from bson.features import SCANS, SECTORS, closeness
from bson.planners import Grid
from bson.task import TaskConfig

MARGIN = 0.15  # between the robot's circle and walls on its way [m]
_FIELD = math.radians(135.0)  # to either side of the LIDAR's middle
_SEEN = 0.6  # a person is in sight where the beam ends at most this much nearer than its middle [m]


class Guide:
    """The guide of one robot of a task's `config` (a TaskConfig, or a Setting: what has robot, control_period and
    person_radius) in one episode. ways: Ways, or the grid, inflated by the robot, and the `goal` (2,)."""

    def __init__(self, config: TaskConfig, grid: Grid, goal: np.ndarray):
        self._ways = Ways(grid, goal)
        self._memory = Memory(config)
        self.length = 0.0  #: of the way from the last place seen [m]

    def see(
        self, observation: Mapping[str, np.ndarray], pose: np.ndarray, people: np.ndarray, in_sight: bool = False
    ) -> np.ndarray:
        """The vector (guided.SIZE,) for one world's Local `observation`, the robot's `pose` (3,) and the people's places
        (K, 2), world frame [m, rad]; to be called in each control step.

        People count as standing until they were seen twice. in_sight: whether only those whom the LIDAR sees are told
        of.
        """
        aim, beyond, self.length = self._ways.ahead(pose[:2])
        return self._memory.see(observation, pose, aim, beyond, self.length, people, in_sight)


class Memory:
    """The last scans and people's last places, of which the vector of bson.guided tells beside the way."""

    def __init__(self, config: TaskConfig):
        self._period, robot = config.control_period, config.robot
        self._top = (robot.max_speed, robot.max_yaw_rate)
        self._radii = robot.radius + config.person_radius
        self._scans = np.zeros((SCANS[-1] + 1, SECTORS), np.float32)
        self._people: np.ndarray | None = None

    def see(self, observation, pose, aim, beyond, length, people, in_sight):
        before = people if self._people is None else self._people
        self._people = people.copy()
        velocity = robot_frame((people - before) / self._period, pose[2])
        place = robot_frame(people - pose[:2], pose[2])
        if in_sight:
            seen = visible(place, observation["lidar"])
            place, velocity = place[seen], velocity[seen]
        return self.vector(
            observation,
            *robot_frame([aim - pose[:2], beyond - pose[:2]], pose[2]),
            length,
            place,
            velocity,
            fresh=before is people,
        )

    def vector(self, observation, aim, beyond, length, place, velocity, fresh):
        """The vector of the way's `aim` and `beyond` (2,), and of people at `place` (n, 2) with `velocity` (n, 2), all
        in the robot frame. fresh: whether an episode begins."""
        scan = closeness(observation["lidar"])
        if fresh:
            self._scans[:] = scan
        else:
            self._scans[1:] = self._scans[:-1]
            self._scans[0] = scan
        ahead = np.array([observation["velocity"][0], 0.0])
        return np.concatenate(
            [
                guided.own(observation, aim, beyond, np.asarray(length), self._top),
                self._scans[np.array(SCANS)].ravel(),
                guided.people(place, velocity, ahead, self._radii).ravel(),
            ]
        )


def visible(place: np.ndarray, lidar: np.ndarray) -> np.ndarray:
    """Whether the scan `lidar` (beams,) [m] sees the people at `place` (n, 2), robot frame [m]: (n,) bool."""
    angle, distance = np.arctan2(place[:, 1], place[:, 0]), np.hypot(place[:, 0], place[:, 1])
    beam = np.rint((angle + _FIELD) / (2 * _FIELD) * (len(lidar) - 1)).astype(int).clip(0, len(lidar) - 1)
    return (np.abs(angle) < _FIELD) & (lidar[beam] > distance - _SEEN)
