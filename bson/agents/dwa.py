"""The Dynamic Window Approach on the 2D LIDAR (Fox, Burgard and Thrun, IEEE Robotics and Automation Magazine, 1997).

Each control period the agent looks at the velocities (v, w) that the motors can reach within it: the dynamic window.
Each velocity is an arc, and the scan says how far the robot's footprint can go along it. A velocity is admissible where
the robot can stop before it touches anything. Of the admissible velocities the agent takes the one with the greatest

    heading_weight * heading + clearance_weight * clearance + speed_weight * speed,

each term in [0, 1]. The heading says how well the robot looks towards the goal a moment later, the clearance how far
the arc is free and how much room it leaves, the speed how fast the robot drives. Where no velocity is admissible, or
the best is to stand, the robot turns on the spot until there is a way ahead, or backs out where it can't turn.

Two things are not in the paper. The clearance includes the room beside the arc, and very close to something the robot
is slow: otherwise it drives on beside a person whose way slowly meets its own, until they touch. The speed counts less
close to the goal and when leading away from it: otherwise the robot circles the goal.

The agent knows people only from the present scan, as if they stood still. It has neither memory nor map, so dead ends
may hold the robot. Both are limits of the method.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bson.agents.contract import Setting
from bson.agents.scan import Scan


@dataclass(frozen=True)
class DwaConfig:
    """What `Dwa` assumes and weighs. Metres, seconds, radians; weights have no unit.

    The shipped robots all take about 0.3 s to the top speed and 0.1 s to the top yaw rate that they are built for, so
    accelerations are given in top speeds and top yaw rates a second.
    """

    longest_period: float = 0.5  # between two calls: a person walks 0.7 m meanwhile
    acceleration: float = 3.25  # with which the tyres speed the robot up, in top speeds a second [1/s]
    yaw_acceleration: float = 9.0  # in top yaw rates a second [1/s]
    braking: float = 1.5  # deceleration on which a stop can count, in top speeds a second [1/s]
    yaw_braking: float = 5.0  # likewise, in top yaw rates a second [1/s]
    max_lateral_acceleration: float = 2.5  # beyond it the Jackal turns more sharply than commanded [m/s2]
    speeds: int = 9  # number of speeds in the window
    rates: int = 15

    sector: float = 2.25  # width of a sector of the scan, of which only the nearest point counts [deg]
    far: float = 2.5  # length of an arc that is looked at
    far_turn: float = 2.0  # turn along an arc that is looked at, if it comes first [rad]
    steps: int = 14  # number of steps of an arc
    near: float = 1.2  # gap below which room is short
    margin: float = 0.06  # by which the footprint is grown
    margin_per_speed: float = 0.1  # further margin for each m/s [s]
    slack: float = 0.1  # within the margin: the share of the gap by which the robot may come closer
    pass_time: float = 0.05  # the top speed is the present gap divided by this [s]
    creep: float = 0.4  # speed allowed at any gap; at most half the top speed [m/s]

    heading_time: float = 0.3  # the heading is judged after this time
    heading_weight: float = 1.5
    clearance_weight: float = 2.0
    speed_weight: float = 1.0
    approach_time: float = 1.0  # a speed that would reach the goal sooner than this is worth no more

    standing: float = 0.05  # the robot stands below this share of its top speed
    escape_rate: float = 1.2  # yaw rate of turning on the spot; at most the top yaw rate [rad/s]
    escape_speed: float = 0.4  # speed of backing out; at most half the top speed [m/s]


class Dwa:
    """The agent: called with one world's observation each control period, it returns an action (2,) in [-1, 1]."""

    def __init__(self, setting: Setting | None = None, config: DwaConfig = DwaConfig()):
        setting = Setting.default() if setting is None else setting
        setting.check_period(config.longest_period)
        robot, self.config, self._limit = setting.robot, config, setting.top
        self._period, self._scan = setting.control_period, Scan(setting, config.longest_period)
        self._sector = self._scan.beams_in(math.radians(config.sector))
        self._half = np.array([robot.half_length, robot.half_width])  # half the footprint's sides [m]
        self._reach = config.far + 2 * self._half[0] + (self._scan.period - self._period) * robot.max_speed
        self._acceleration = np.array([config.acceleration, config.yaw_acceleration]) * setting.built_for
        self._braking = np.array([config.braking, config.yaw_braking]) * setting.built_for
        self._slow = min(config.creep, robot.max_speed / 2)
        self._standing = min(config.standing * robot.max_speed, self._acceleration[0] * self._period / 2)
        self._escape_speed = min(config.escape_speed, robot.max_speed / 2)
        self._escape_rate = min(config.escape_rate, robot.max_yaw_rate)
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Forgets the last episode. The agent draws nothing, so the seed has no effect."""
        self._steps, self._met = 0, np.zeros((0, 2))  # steps so far; points (m, 2) [m] of the last scan
        self._side = 0.0  # where the robot turns on the spot until a way ahead is free: 1 left, -1 right, 0 neither

    def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The action (2,) for one world's observation (see bson.interfaces.gym.BsonEnv)."""
        goal, velocity = np.asarray(observation["goal"], float), np.asarray(observation["velocity"], float)
        if self._steps % self._scan.every == 0:
            self._met = self._points(self._scan.read(observation))
        else:
            self._met = self._left_behind(self._met, velocity)
        self._steps += 1
        points = self._met
        bearing = math.atan2(goal[1], goal[0])
        speed, rate = self.window(velocity, bearing)
        clearance, admissible = self._clearance(speed, rate, points, np.hypot(*goal))
        admissible &= np.abs(speed * rate) <= self.config.max_lateral_acceleration
        value = np.where(admissible & (rate * self._side >= 0), self._value(speed, rate, clearance, goal), -np.inf)
        best = int(value.argmax())
        if np.isinf(value[best]) or speed[best] < self._standing:
            return self._escape(points, bearing) / self._limit
        self._side = 0.0
        return np.array([speed[best], rate[best]]) / self._limit

    def window(self, velocity: np.ndarray, bearing: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Velocities v (n,) [m/s] and w (n,) [rad/s] within a control period's reach of `velocity` (2,).

        A grid, and the yaw rate that turns the robot towards the goal, `bearing` [rad], in heading_time.
        """
        c = self.config
        now = np.clip(velocity, [0.0, -self._limit[1]], self._limit)
        change = self._acceleration * self._period
        low, high = np.clip([now - change, now + change], [0.0, -self._limit[1]], self._limit)
        rates = np.linspace(low[1], high[1], c.rates)
        rates = np.append(rates, np.clip([0.0, bearing / c.heading_time], low[1], high[1]))
        speed, rate = np.meshgrid(np.linspace(low[0], high[0], c.speeds), rates)
        return speed.ravel(), rate.ravel()

    def _points(self, scan):
        """The nearest point (m, 2) [m] of each sector of the scan that is in reach, robot frame."""
        nearest = self._scan.nearest(scan, self._sector)
        nearest = nearest[scan[nearest] < self._reach]
        return self._scan.points(scan, nearest)

    def _left_behind(self, points, velocity):
        """Where `points` (m, 2) [m] are, robot frame, after a control step at `velocity` (2,) (v, w)."""
        way, turn = velocity * self._period
        offset = points - way * np.array([math.cos(turn / 2), math.sin(turn / 2)])
        c, s = math.cos(turn), math.sin(turn)
        return offset @ np.array([[c, -s], [s, c]])

    def _clearance(self, speed, rate, points, distance):
        """The clearance (n,) in [0, 1] of the arcs of `speed` and `rate` (n,), and whether each is admissible (n,).

        An arc ends `far` or `far_turn` on, or where the footprint comes closer to a point than the margin; a robot that
        is within the margin already may go on, but come hardly closer. The clearance is the mean of gap / near, at most
        1, as far as the goal at `distance` [m] is, and 0 beyond the end. A speed too high for the present gap is never
        admissible.
        """
        c = self.config
        length = np.minimum(c.far / np.maximum(np.abs(speed), 1e-3), c.far_turn / np.maximum(np.abs(rate), 1e-3))
        time = length[:, None] * np.arange(c.steps + 1) / c.steps  # (n, steps + 1) [s]
        gap = self._gaps(speed[:, None], rate[:, None], time, points)
        margin = np.minimum(c.margin + c.margin_per_speed * np.abs(speed), gap[:, 0] - c.slack * np.abs(gap[:, 0]))
        hit = np.logical_or.accumulate(gap[:, 1:] < margin[:, None], axis=1)
        hit |= (np.abs(speed) > np.maximum(self._slow, gap[:, 0] / c.pass_time))[:, None]
        room = np.where(hit, 0.0, np.clip(gap[:, 1:] / c.near, 0.0, 1.0))
        clearance = room.mean(axis=1, where=np.abs(speed)[:, None] * time[:, :-1] <= distance)
        free = length * (~hit).mean(axis=1)  # [s]
        braking, yaw_braking = self._braking
        stop = self._period + np.maximum(np.abs(speed) / (2 * braking), np.abs(rate) / (2 * yaw_braking))
        return clearance, ~hit[:, -1] | (free >= stop)

    def _gaps(self, speed, rate, time, points):
        """Least gap (n, T) [m] of `points` (m, 2) to the footprint, `time` (n, T) [s] along an arc; negative inside."""
        if not len(points):
            return np.full(time.shape, self.config.far)
        turn = rate * time
        chord = speed * time * np.sinc(turn / (2 * np.pi))  # of the arc, in the direction at half the turn
        x, y = chord * np.cos(turn / 2), chord * np.sin(turn / 2)
        c, s = np.cos(turn), np.sin(turn)
        rows = np.column_stack([points, np.ones(len(points))]).astype(np.float32)  # into the footprint's frame
        ahead = rows @ np.stack([c, s, -c * x - s * y]).reshape(3, -1).astype(np.float32)
        aside = rows @ np.stack([-s, c, s * x - c * y]).reshape(3, -1).astype(np.float32)
        beyond = np.maximum(np.abs(ahead) - np.float32(self._half[0]), np.abs(aside) - np.float32(self._half[1]))
        return beyond.min(axis=0).reshape(time.shape)

    def _value(self, speed, rate, clearance, goal):
        """The objective (n,) of velocities `speed` (n,), `rate` (n,) with `clearance` (n,), for `goal` (2,) [m]."""
        c = self.config
        turn = rate * c.heading_time
        chord = speed * c.heading_time * np.sinc(turn / (2 * np.pi))
        bearing = np.arctan2(goal[1] - chord * np.sin(turn / 2), goal[0] - chord * np.cos(turn / 2)) - turn
        heading = 1.0 - np.abs((bearing + np.pi) % (2 * np.pi) - np.pi) / np.pi
        fast = np.minimum(1.0, 2.0 * heading) * np.minimum(speed, np.hypot(*goal) / c.approach_time) / self._limit[0]
        return c.heading_weight * heading + c.clearance_weight * clearance + c.speed_weight * fast

    def _escape(self, points, bearing):
        """The command (2,) (v, w) out of a place without an admissible motion ahead."""
        c = self.config
        if not self._side:
            self._side = 1.0 if bearing >= 0 else -1.0
        speed = np.array([0.0, -self._escape_speed])
        rate = np.array([self._side * self._escape_rate, 0.0])
        _, admissible = self._clearance(speed, rate, points, c.far)
        best = int(admissible.argmax())
        return np.array([speed[best], rate[best]]) if admissible[best] else np.zeros(2)
