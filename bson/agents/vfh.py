"""A reactive avoider on the 2D LIDAR: VFH+ among walls, extended to people who walk.

The base is VFH+ (Ulrich and Borenstein, "VFH+: Reliable obstacle avoidance for fast mobile robots", ICRA 1998): the
scan becomes a polar histogram of nearest obstacles, enlarged by the robot's radius, and a cost over candidate
directions (deviation from the goal, from the last choice, and how far the way is free) gives the direction to steer to.
This agent adds two things.

- People, whom `bson.agents.tracking` finds in the scan. Candidate motions (a direction to turn to, at a speed) are
  rolled out with the robot's own dynamics and judged by the gaps that they leave to walls and to the predicted people.
- Dead ends. Where no direction leads closer to the goal, the wall in the way is followed until the goal is in
  sight from a place closer to it than where that began (as in TangentBug, Kamon et al. 1998).

Only the observation is used: the goal, the velocity and the LIDAR.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bson.agents.contract import Setting
from bson.agents.tracking import Tracking, TrackingConfig, wrap


@dataclass(frozen=True)
class VfhConfig(TrackingConfig):
    """What `Vfh` assumes and weighs. Metres, seconds, radians; weights have no unit."""

    acceleration: float = 3.25  # that the tyres give, in top speeds a second, for all shipped robots [1/s]
    turn_time: float = 0.25  # in which a small change of direction is to be made; at least 1.25 periods
    turn_lag: float = 0.1  # delay before the robot begins to turn

    # histogram
    clearance: float = 0.14  # room that a free way has to either side of the robot
    lookahead: float = 6.0  # nothing farther than this blocks a way
    blocked_weight: float = 12.0  # of the blocked share of a way, against radians off the goal
    keep_weight: float = 0.4  # of leaving the last direction, against radians off the goal
    follow_beyond: float = 1.3  # angle off the goal [rad]: a robot that has to turn this far follows the wall
    follow_free: float = 2.0  # length of way that is free enough along a followed wall
    leave_free: float = 4.0  # length of way towards the goal that is free enough to end following
    follow_gain: float = 0.5  # how much closer to the goal following must have brought the robot before it ends

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


class Vfh(Tracking):
    """The agent: called with one world's observation each control period, it returns an action (2,) in [-1, 1]."""

    def __init__(self, setting: Setting | None = None, config: VfhConfig = VfhConfig()):
        setting = Setting.default() if setting is None else setting
        super().__init__(setting, config)
        self._limit = setting.top
        self.radius = round(setting.robot.radius, 2)  # radius of the disc around the footprint [m]
        self._clearance = self.radius + config.clearance
        self._acceleration = config.acceleration * setting.built_for[0]
        self._turn_time = max(config.turn_time, 1.25 * self._period)
        self._prepare_motions()
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Forgets the last episode. The agent draws nothing, so the seed has no effect."""
        self.forget()
        self._steered, self._moved = 0.0, 0.0  # last choices of direction, in the goal-bound frame
        self._follow = None  # (side of the wall: +1 right, -1 left; goal distance where following began)

    def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The action (2,) for one world's observation (see bson.interfaces.gym.BsonEnv)."""
        goal, velocity = np.asarray(observation["goal"], float), np.asarray(observation["velocity"], float)
        walls = self.see(goal, velocity, observation)
        target = self._steer(goal, walls)
        return self._move(target, velocity, walls)

    # --- directions

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
            off = wrap(direction - bearing)
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
        off_goal = np.abs(wrap(directions - bearing))
        off_last = np.abs(wrap(directions + self._yaw - self._steered))
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
        cost += c.change_weight * np.abs(wrap(self._directions + self._yaw - self._moved))
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
