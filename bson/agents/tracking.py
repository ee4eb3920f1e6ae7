"""People and walls as the 2D LIDAR shows them, and where the robot is meanwhile, from the Local observation alone.

The scan is cut into objects; those that fit a disc of a person's radius are tracked from scan to scan, which gives
their velocities, and are remembered for a while where the scanner can't see.

The goal-bound frame, in which people are kept, has its origin at the goal, and the axes that the robot had as the
episode began.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bson.agents.contract import Setting
from bson.agents.scan import Scan
from macid.state import RADIUS

_LEFT, _RIGHT = np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2])  # products in a least-squares fit


@dataclass(frozen=True)
class TrackingConfig:
    """What `Tracking` assumes. Metres, seconds, radians."""

    longest_period: float = 0.5  # between two calls: a person walks 0.7 m meanwhile
    sector: float = 3.75  # width of a sector of the scan, of which only the nearest point counts as a wall's [deg]
    person_radius: float = RADIUS  # where the setting has no other
    person_range: float = 9.0  # within which people are looked for
    person_beams: int = 4  # least number of beams on an object that may be a person
    person_error: float = 0.025  # greatest root-mean-square deviation of a person's outline from a circle
    object_jump: float = 0.25  # difference of neighbouring beams' ranges that parts two objects
    match_distance: float = 0.2  # distance between the expected and the seen place of a person, beside the part below
    match_speed: float = 2.0  # assumed speed of a person whose velocity is not known yet, for the match [m/s]
    least_match: float = 0.4  # least value of both parts together
    velocity_gain: float = 0.4  # least weight of a new velocity in the estimate, in 0.1 s
    memory: float = 2.0  # how long an unseen person is believed in where the scanner can't see the place
    missing: float = 0.2  # the same where the scanner can see it
    standing_speed: float = 0.3  # who is slower stands
    standing_seen: float = 0.5  # for so long somebody must have been seen before it is told
    standing_memory: float = 15.0  # how long somebody who stood is believed in where the scanner can't see the place


class Tracking:
    """What an agent that drives by the LIDAR keeps of one world.

    Call `see` with each observation of an episode in turn; `config` holds the fields of a TrackingConfig.
    """

    def __init__(self, setting: Setting, config: Any):
        setting.check_period(config.longest_period)
        if setting.person_radius != RADIUS:
            config = dataclasses.replace(config, person_radius=setting.person_radius)
        self.config, self._period = config, setting.control_period
        self._scan = Scan(setting, config.longest_period)
        self._sector = self._scan.beams_in(math.radians(config.sector))
        self._gain = 1.0 - (1.0 - config.velocity_gain) ** (self._scan.period / 0.1)
        self._match = max(config.least_match, config.match_distance + config.match_speed * self._scan.period)
        self._missing = max(1, round(config.missing / self._scan.period))
        self.forget()

    def forget(self) -> None:
        """Forgets the last episode."""
        self._yaw, self._rate = 0.0, 0.0
        self._goal: Any = None
        self._steps, self._old = 0, 0  # control steps since the episode began, and since the last scan
        self._met = np.zeros((0, 2))  # wall points of that scan
        self._position = np.zeros(2)  # of the robot, goal-bound frame
        self._seen_at, self._seen_velocity = np.zeros((0, 2)), np.zeros((0, 2))  # people, in the goal-bound frame
        self._sightings, self._unseen = np.zeros(0, int), np.zeros(0, int)  # scans with and, lately, without them
        self._stood = np.zeros((0, 3))  # places of people who stood, and when they were seen to [s]

    def see(self, goal: np.ndarray, velocity: np.ndarray, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """Takes in an observation, with its goal and velocity (2,); returns the walls (sectors, 2) [m], robot frame."""
        self._localise(goal, velocity)
        self._old = self._steps % self._scan.every
        self._steps += 1
        return (self._met - self._position) @ self._rotation if self._old else self._look(self._scan.read(observation))

    @property
    def people(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (n, 2) of the people believed in, robot frame's axes [m, m/s]."""
        places = self._seen_at + self._old * self._period * self._seen_velocity if self._old else self._seen_at
        return (places - self._position) @ self._rotation, self._seen_velocity @ self._rotation

    @property
    def left_behind(self) -> np.ndarray:
        """Where (n, 2) those of `people` were seen last whom the robot has lost from its scanner's field, robot frame
        [m]."""
        lost = self._unseen > 0
        scans = self._unseen[lost, None]
        last = self.to_robot(self._seen_at[lost] - scans * self._scan.period * self._seen_velocity[lost])
        return last[~self.in_field(last)]

    def in_field(self, points: np.ndarray) -> np.ndarray:
        """Whether `points` (n, 2) [m], robot frame, are in the scanner's field, however far: (n,) bool."""
        offset = points - self._scan.place
        return self._scan.sees(np.arctan2(offset[:, 1], offset[:, 0]))

    def to_robot(self, points: np.ndarray) -> np.ndarray:
        """`points` (n, 2) [m] of the goal-bound frame in the robot frame."""
        return (points - self._position) @ self._rotation

    def to_goal_bound(self, points: np.ndarray) -> np.ndarray:
        """`points` (n, 2) [m] of the robot frame in the goal-bound frame."""
        return points @ self._rotation.T + self._position

    def crowd(self) -> tuple[np.ndarray, np.ndarray]:
        """Places (n, 2) of people, goal-bound frame [m], and which of them stand (n,) bool: of whom is believed in, and
        of who stood where the scanner could not see since. To be called every now and then."""
        c, now = self.config, self._steps * self._period
        self._stood = self._stood[self._stood[:, 2] > now - c.standing_memory]
        if len(self._stood):
            self._stood = self._stood[self._hidden(self._stood[:, :2], self._scanned)]
            near = ((self._stood[:, None, :2] - self._seen_at) ** 2).sum(axis=-1) < c.person_radius**2
            self._stood = self._stood[~near.any(axis=1)]
        slow = np.hypot(self._seen_velocity[:, 0], self._seen_velocity[:, 1]) < c.standing_speed
        slow &= self._sightings * self._scan.period >= c.standing_seen
        seen = np.column_stack([self._seen_at, np.full(len(slow), now)])
        known, standing = np.concatenate([seen, self._stood]), np.append(slow, np.ones(len(self._stood), bool))
        self._stood = known[standing]
        return known[:, :2], standing

    def _look(self, scan):
        """Takes a new `scan` (beams,) [m] into the people believed in; returns the walls (sectors, 2) [m], robot
        frame."""
        centres, beams = self._find_people(scan)
        self._track(centres @ self._rotation.T + self._position, scan)
        walls = self._walls(scan, beams)
        if self._scan.every > 1:
            self._met = walls @ self._rotation.T + self._position
        return walls

    # --- where the robot is

    def _localise(self, goal, velocity):
        """Updates the robot's yaw and position from the change of the goal's position; near the goal the yaw from the
        yaw rate."""
        if self._goal is not None:
            way = velocity[0] * self._period
            turn = (self._rate + velocity[1]) / 2 * self._period
            if np.hypot(*goal) > 1.0:
                before = self._goal - way * np.array([math.cos(turn / 2), math.sin(turn / 2)])
                turn = wrap(math.atan2(before[1], before[0]) - math.atan2(goal[1], goal[0]))
            self._yaw += turn
        self._goal, self._rate = goal, velocity[1]
        c, s = math.cos(self._yaw), math.sin(self._yaw)
        self._rotation = np.array([[c, -s], [s, c]])
        self._position = -self._rotation @ goal

    # --- people

    def _find_people(self, scan):
        """Centres (n, 2) [m] of person-like objects, robot frame, and which beams (beams,) meet them."""
        c = self.config
        beams = np.flatnonzero(scan < c.person_range)
        met = np.zeros(len(scan), bool)
        if len(beams) < c.person_beams:
            return np.zeros((0, 2)), met
        ranges = scan[beams]
        parted = (beams[1:] - beams[:-1] > 1) | (np.abs(ranges[1:] - ranges[:-1]) > c.object_jump)
        starts = np.concatenate([[0], np.flatnonzero(parted) + 1])
        counts = np.diff(np.append(starts, len(beams)))
        points = ranges[:, None] * self._scan.directions[beams]
        first, last = points[starts], points[starts + counts - 1]
        squared_size = ((last - first) ** 2).sum(axis=1)
        likely = (counts >= c.person_beams) & (squared_size < (2.1 * c.person_radius) ** 2)
        if not likely.any():
            return np.zeros((0, 2)), met
        chosen = np.repeat(likely, counts)
        beams, points, counts = beams[chosen], points[chosen], counts[likely]
        centres, error = self._fit_circles(points, self._scan.angles[beams], counts)
        person = error < c.person_error
        met[beams[np.repeat(person, counts)]] = True
        return centres[person] + self._scan.place, met

    def _fit_circles(self, points, angles, counts):
        """Least-squares centres (n, 2) of circles of a person's radius, and the root-mean-square errors (n,) [m].

        points (m, 2): objects of `counts` (n,) points, one after the other; angles (m,): their beams'. The fit is two
        Gauss-Newton steps, begun at a disc that is seen whole.
        """
        radius = self.config.person_radius
        starts = np.cumsum(counts) - counts
        label = np.repeat(np.arange(len(counts)), counts)
        px, py = np.ascontiguousarray(points.T)
        middle = (angles[starts] + angles[starts + counts - 1]) / 2
        distance = np.sqrt(np.minimum.reduceat(px * px + py * py, starts)) + radius
        x, y = distance * np.cos(middle), distance * np.sin(middle)
        parts, products = np.empty((3, len(label))), np.empty((6, len(label)))
        squared = np.zeros(len(counts))
        for _ in range(2):
            dx, dy = px - x[label], py - y[label]
            length = np.sqrt(dx * dx + dy * dy)
            error = length - radius
            parts[0], parts[1], parts[2] = dx / length, dy / length, error
            np.multiply(parts[_LEFT], parts[_RIGHT], out=products)
            xx, xy, yy, bx, by, squared = np.add.reduceat(products, starts, axis=1)
            xx, yy = xx + 1e-3 * counts, yy + 1e-3 * counts
            determinant = xx * yy - xy * xy
            x, y = x + (yy * bx - xy * by) / determinant, y + (xx * by - xy * bx) / determinant
        return np.stack([x, y], axis=-1), np.sqrt(squared / counts)

    def _track(self, seen, scan):
        """Matches the people `seen` (n, 2), goal-bound frame, with the people believed in, and updates the latter."""
        c, self._scanned = self.config, scan
        expected = self._seen_at + self._seen_velocity * self._scan.period
        old, new = _match(expected, seen, self._match)
        sightings = self._sightings[old] + 1
        measured = (seen[new] - self._seen_at[old]) / self._scan.period
        gain = np.maximum(1.0 / np.maximum(sightings - 1, 1), self._gain)[:, None]
        gain = np.where(self._unseen[old, None] > 0, 0.0, gain)
        velocity = self._seen_velocity[old] + gain * (measured - self._seen_velocity[old])

        lost = np.ones(len(expected), bool)
        lost[old] = False
        lost &= self._unseen * self._scan.period < c.memory
        lost &= self._hidden(expected, scan) | (self._unseen < self._missing)
        fresh = np.ones(len(seen), bool)
        fresh[new] = False
        count = int(fresh.sum())
        self._seen_at = np.concatenate([seen[new], expected[lost], seen[fresh]])
        self._seen_velocity = np.concatenate([velocity, self._seen_velocity[lost], np.zeros((count, 2))])
        self._sightings = np.concatenate([sightings, self._sightings[lost], np.ones(count, int)])
        self._unseen = np.concatenate([np.zeros(len(old), int), self._unseen[lost] + 1, np.zeros(count, int)])

    def _hidden(self, places, scan):
        """Whether the scanner can't see each of `places` (n, 2), goal-bound frame."""
        offset = (places - self._position) @ self._rotation - self._scan.place
        angle, distance = np.arctan2(offset[:, 1], offset[:, 0]), np.hypot(offset[:, 0], offset[:, 1])
        nearer = scan[self._scan.beam_at(angle)] < distance + self.config.person_radius
        return ~self._scan.sees(angle) | nearer | (distance > self._scan.reach)

    # --- walls

    def _walls(self, scan, people_beams):
        """The nearest point (sectors, 2) [m] in each sector of the scan without people, robot frame."""
        if people_beams.any():
            hidden, rest = np.flatnonzero(people_beams), np.flatnonzero(~people_beams)
            if len(rest):
                scan = scan.copy()
                scan[hidden] = np.interp(hidden, rest, scan[rest])
        return self._scan.points(scan, self._scan.nearest(scan, self._sector))


def wrap(angle):
    """`angle` [rad] in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _match(expected, seen, limit):
    """Pairs of rows of `expected` (n, 2) and `seen` (m, 2) that are each other's nearest and within `limit` [m]."""
    if not len(expected) or not len(seen):
        return np.zeros(0, int), np.zeros(0, int)
    squared = ((expected[:, None] - seen[None]) ** 2).sum(axis=-1)
    rows = np.arange(len(expected))
    nearest = squared.argmin(axis=1)
    mutual = (squared.argmin(axis=0)[nearest] == rows) & (squared[rows, nearest] < limit**2)
    return rows[mutual], nearest[mutual]
