"""A reactive avoider on the 2D LIDAR: VFH+ among walls, extended to people who walk.

The base is VFH+ (Ulrich and Borenstein, "VFH+: Reliable obstacle avoidance for fast mobile robots", ICRA 1998): the
scan becomes a polar histogram of nearest obstacles, enlarged by the robot's radius, and a cost over candidate
directions (deviation from the goal, from the last choice, and how far the way is free) gives the direction to steer to.
This agent adds two things.

- People. The scan is cut into objects; those that fit a disc of a person's radius are tracked from scan to scan, which
  gives their velocities, and are remembered for a while where the scanner can't see. Candidate motions (a direction to
  turn to, at a speed) are rolled out with the robot's own dynamics and judged by the gaps that they leave to walls
  and to the predicted people.
- Dead ends. Where no direction leads closer to the goal, the wall in the way is followed until the goal is in
  sight from a place closer to it than where that began (as in TangentBug, Kamon et al. 1998).

Only the observation is used: the goal, the velocity and the LIDAR.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bson.agents.contract import Setting
from bson.agents.scan import Scan
from macid.state import RADIUS

_LEFT, _RIGHT = np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2])  # products in a least-squares fit


@dataclass(frozen=True)
class VfhConfig:
    """What `Vfh` assumes and weighs. Metres, seconds, radians; weights have no unit."""

    longest_period: float = 0.5  # between two calls: a person walks 0.7 m meanwhile
    acceleration: float = 3.25  # that the tyres give, in top speeds a second, for all shipped robots [1/s]
    turn_time: float = 0.25  # in which a small change of direction is to be made; at least 1.25 periods
    turn_lag: float = 0.1  # delay before the robot begins to turn

    # histogram
    sector: float = 3.75  # width of a sector [deg]
    clearance: float = 0.14  # room that a free way has to either side of the robot
    lookahead: float = 6.0  # nothing farther than this blocks a way
    blocked_weight: float = 12.0  # of the blocked share of a way, against radians off the goal
    keep_weight: float = 0.4  # of leaving the last direction, against radians off the goal
    follow_beyond: float = 1.3  # angle off the goal [rad]: a robot that has to turn this far follows the wall
    follow_free: float = 2.0  # length of way that is free enough along a followed wall
    leave_free: float = 4.0  # length of way towards the goal that is free enough to end following
    follow_gain: float = 0.5  # how much closer to the goal following must have brought the robot before it ends

    # people
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

    # motions
    horizon: float = 2.6
    step: float = 0.2  # time step of a motion's rollout
    speeds: tuple = (0.0, 0.35, 0.7, 1.0)  # speeds ahead, as shares of the top speed
    directions: tuple = (0.0, 7.0, 15.0, 26.0, 42.0, 65.0, 100.0)  # to either side [deg]
    back_speeds: tuple = (-0.35, -0.75)  # speeds back, as shares of the top speed
    back_directions: tuple = (0.0, 45.0)  # to either side [deg]
    person_gap: float = 0.7  # a smaller gap to a person costs
    wall_gap: float = 0.35  # a smaller gap to a wall costs
    patience: float = 1.2  # time constant with which later gaps count less
    person_weight: float = 1.0  # of gaps to people, against progress (1: at full speed to the target)
    wall_weight: float = 1.5  # of gaps to walls
    heading_weight: float = 0.05  # of ending up turned away from the target
    change_weight: float = 0.04  # of leaving the direction of the last motion
    back_weight: float = 0.1  # of driving back, where the LIDAR sees nothing


class Vfh:
    """The agent: called with one world's observation each control period, it returns an action (2,) in [-1, 1]."""

    def __init__(self, setting: Setting | None = None, config: VfhConfig = VfhConfig()):
        setting = Setting.default() if setting is None else setting
        setting.check_period(config.longest_period)
        if setting.person_radius != RADIUS:
            config = dataclasses.replace(config, person_radius=setting.person_radius)
        self.config, self._limit, self._period = config, setting.top, setting.control_period
        self.radius = round(setting.robot.radius, 2)  # radius of the disc around the footprint [m]
        self._clearance = self.radius + config.clearance
        self._scan = Scan(setting, config.longest_period)
        self._sector = self._scan.beams_in(math.radians(config.sector))
        self._gain = 1.0 - (1.0 - config.velocity_gain) ** (self._scan.period / 0.1)
        self._match = max(config.least_match, config.match_distance + config.match_speed * self._scan.period)
        self._missing = max(1, round(config.missing / self._scan.period))
        self._acceleration = config.acceleration * setting.built_for[0]
        self._turn_time = max(config.turn_time, 1.25 * self._period)
        self._prepare_motions()
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Forgets the last episode. The agent draws nothing, so the seed has no effect."""
        self._yaw, self._goal, self._rate = 0.0, None, 0.0
        self._steps, self._old = 0, 0  # control steps since the episode began, and since the last scan
        self._met = np.zeros((0, 2))  # wall points of that scan
        self._position = np.zeros(2)  # of the robot, goal-bound frame: origin at the goal, the robot's first axes
        self._seen_at, self._seen_velocity = np.zeros((0, 2)), np.zeros((0, 2))  # people, in the goal-bound frame
        self._sightings, self._unseen = np.zeros(0, int), np.zeros(0, int)  # scans with and, lately, without them
        self._steered, self._moved = 0.0, 0.0  # last choices of direction, in the goal-bound frame
        self._follow = None  # (side of the wall: +1 right, -1 left; goal distance where following began)

    def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The action (2,) for one world's observation (see bson.interfaces.gym.BsonEnv)."""
        goal, velocity = np.asarray(observation["goal"], float), np.asarray(observation["velocity"], float)
        self._localise(goal, velocity)
        self._old = self._steps % self._scan.every
        self._steps += 1
        walls = (self._met - self._position) @ self._rotation if self._old else self._look(self._scan.read(observation))
        target = self._steer(goal, walls)
        return self._move(target, velocity, walls)

    @property
    def people(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (n, 2) of the people believed in, robot frame's axes [m, m/s]."""
        places = self._seen_at + self._old * self._period * self._seen_velocity if self._old else self._seen_at
        return (places - self._position) @ self._rotation, self._seen_velocity @ self._rotation

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
                turn = _wrap(math.atan2(before[1], before[0]) - math.atan2(goal[1], goal[0]))
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
        c = self.config
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

    def _steer(self, goal, walls):
        """The point (2,) [m] to drive to, robot frame: the goal, or one in the direction of least cost."""
        c = self.config
        distance, bearing = np.hypot(*goal), math.atan2(goal[1], goal[0])
        reach = min(distance, c.lookahead)
        ranges = np.hypot(walls[:, 0], walls[:, 1])
        near = ranges < c.lookahead + self._clearance
        blocking, blocking_ranges = walls[near], ranges[near]
        free = self._free_way(np.array([bearing]), blocking, blocking_ranges)[0]
        if not len(blocking):
            self._follow = None
        if (
            self._follow is not None
            and self._scan.sees(bearing)
            and free >= min(reach, c.leave_free) - 0.2
            and distance < self._follow[1] - c.follow_gain
        ):
            self._follow = None
        if self._follow is None and free >= reach - 0.2:
            self._steered = self._yaw + bearing
            return goal
        directions = np.arctan2(walls[:, 1], walls[:, 0])
        free = self._free_way(directions, blocking, blocking_ranges)
        if self._follow is None:
            direction = self._least_cost(directions, free, bearing, reach)
            off = _wrap(direction - bearing)
            if abs(off) > c.follow_beyond:
                self._follow = (1.0 if off > 0 else -1.0, distance)
        else:
            direction = self._along_wall(directions, free, ranges)
        self._steered = self._yaw + direction
        return c.lookahead * np.array([math.cos(direction), math.sin(direction)])

    def _free_way(self, directions, points, ranges):
        """How far (n,) [m] a disc of radius `clearance` can go in `directions` (n,) [rad] before `points` (m, 2) [m].

        The result is at most the lookahead. ranges (m,): the points' distances. A robot that is too close to a wall can
        still turn away.
        """
        c = self.config
        if not len(points):
            return np.full(len(directions), c.lookahead)
        ux, uy = np.cos(directions)[:, None], np.sin(directions)[:, None]
        along = ux * points[:, 0] + uy * points[:, 1]
        half = along**2 - (ranges**2 - np.minimum(self._clearance, 0.95 * ranges) ** 2)  # of the chord, squared
        meets = (half > 0) & (along > 0)
        free = np.where(meets, along - np.sqrt(np.maximum(half, 0.0)), c.lookahead)
        return np.minimum(free.min(axis=1), c.lookahead)

    def _least_cost(self, directions, free, bearing, reach):
        """The direction [rad] of least cost, as in VFH+."""
        c = self.config
        off_goal = np.abs(_wrap(directions - bearing))
        off_last = np.abs(_wrap(directions + self._yaw - self._steered))
        blocked = 1.0 - np.minimum(free, reach) / reach
        return directions[np.argmin(off_goal + c.keep_weight * off_last + c.blocked_weight * blocked)]

    def _along_wall(self, directions, free, ranges):
        """The first free direction [rad], sweeping from the followed wall away from it."""
        assert self._follow is not None  # it is set while a wall is followed
        side = self._follow[0]
        order = np.argsort(side * directions)
        directions, free = directions[order], free[order]
        distance = np.where(side * directions < 0.3, ranges[order], np.inf)
        swept = np.arange(len(directions)) >= np.argmin(distance)
        usable = np.flatnonzero(swept & (free >= self.config.follow_free))
        return directions[usable[0]] if len(usable) else directions[-1]

    # --- motions

    def _prepare_motions(self):
        """Candidate motions: speeds (n,) [m/s], directions (n,) [rad], and ways (2, n, T) at 1 m/s."""
        c = self.config
        ahead = [math.radians(sign * d) for d in c.directions for sign in ((1, -1) if d else (1,))]
        back = [math.radians(sign * d) for d in c.back_directions for sign in ((1, -1) if d else (1,))]
        pairs = [(v, d) for v in c.speeds for d in ahead] + [(v, d) for v in c.back_speeds for d in back]
        shares, self._directions = np.array(pairs).T
        self._speeds = shares * self._limit[0]
        rate = np.clip(self._directions / self._turn_time, -self._limit[1], self._limit[1])
        self._rates = rate
        self._times = c.step * np.arange(1, round(c.horizon / c.step) + 1)
        turned = np.maximum(self._times - c.step / 2 - c.turn_lag, 0.0) * np.abs(rate)[:, None]
        heading = np.sign(self._directions)[:, None] * np.minimum(turned, np.abs(self._directions)[:, None])
        self._headings = np.moveaxis(_unit(heading), -1, 0) * c.step
        self._speed_change = self._acceleration * (self._times - c.step / 2)  # at most, by each step's middle
        self._discount = np.exp(-self._times / c.patience)
        self._discount /= self._discount.sum()

    def _rollout(self, speed):
        """Where (2, n, T) [m] the candidate motions lead from the present `speed` [m/s], robot frame."""
        now = np.clip(self._speeds[:, None], speed - self._speed_change, speed + self._speed_change)
        return np.cumsum(self._headings * now, axis=-1)

    def _move(self, target, velocity, walls):
        """The action (2,) of the cheapest motion to `target` (2,) [m]."""
        c = self.config
        way = self._rollout(velocity[0])
        bearing = math.atan2(target[1], target[0])
        left = np.sqrt(((way[0] - target[0]) ** 2 + (way[1] - target[1]) ** 2).min(axis=1))
        progress = math.hypot(*target) - left
        progress = np.where(self._speeds < 0, np.minimum(progress, 0.0), progress)  # driving back serves evading only
        cost = -progress / (self._limit[0] * c.horizon)
        cost += c.heading_weight * (1.0 - np.cos(self._directions - bearing))
        cost += c.change_weight * np.abs(_wrap(self._directions + self._yaw - self._moved))
        cost += c.back_weight * (self._speeds < 0)
        cost += c.person_weight * self._nearness(self._person_gaps(way), c.person_gap)
        cost += c.wall_weight * self._nearness(self._wall_gaps(way, walls), c.wall_gap)
        best = int(np.argmin(cost))
        direction, rate = self._directions[best], self._rates[best]
        if self._speeds[best] > 0 and abs(direction - bearing) < math.radians(5.0):
            direction, rate = bearing, bearing / self._turn_time  # the bearing lies between two candidates
        self._moved = self._yaw + direction
        return np.clip(np.array([self._speeds[best], rate]) / self._limit, -1.0, 1.0)

    def _nearness(self, gaps, limit):
        """Cost (n,) of `gaps` (n, T) [m] smaller than `limit` [m]: 1 at a touch, more where they overlap, so that no
        way leads through."""
        if gaps is None:
            return 0.0
        least = np.minimum.accumulate(gaps, axis=1)
        gaps = np.where(least < 0, least, gaps)
        return (np.maximum(1.0 - gaps / limit, 0.0) ** 2) @ self._discount

    def _person_gaps(self, way):
        """Least gaps (n, T) [m] between motions `way` (2, n, T) and people who keep their velocity; None: nobody."""
        c = self.config
        place, velocity = self.people
        near = (place**2).sum(axis=1) < c.person_range**2
        if not near.any():
            return None
        place, velocity = place[near].T[:, :, None], velocity[near].T[:, :, None]
        x, y = place + velocity * self._times  # (people, T)
        squared = (way[0][None] - x[:, None]) ** 2 + (way[1][None] - y[:, None]) ** 2
        return np.sqrt(squared.min(axis=0)) - (self.radius + c.person_radius)

    def _wall_gaps(self, way, walls):
        """Least gaps (n, T) [m] between motions `way` (2, n, T) and the points `walls` (m, 2); None: none near."""
        c = self.config
        reach = self._limit[0] * c.horizon + c.wall_gap + self.radius
        near = walls[(walls**2).sum(axis=1) < reach**2]
        if not len(near):
            return None
        x, y = way.reshape(2, -1).astype(np.float32)
        # |w - p|^2 = |p|^2 - 2 p.w + |w|^2 as a matrix product
        points = np.column_stack([-2.0 * near, np.ones(len(near)), (near**2).sum(axis=1)]).astype(np.float32)
        squared = (points @ np.stack([x, y, x * x + y * y, np.ones_like(x)])).min(axis=0)
        return np.sqrt(np.maximum(squared, 0.0)).reshape(way.shape[1:]) - self.radius


def _unit(angles):
    """Unit vectors (..., 2) in the directions `angles` (...) [rad]."""
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def _wrap(angle):
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
