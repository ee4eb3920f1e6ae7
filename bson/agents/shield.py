"""A shield for robots that learned to drive by the LIDAR: their command goes through unless it leads into a touch, and
then another takes its place (Alshiekh et al., "Safe reinforcement learning via shielding", AAAI 2018: a shield after
the agent, which interferes as little as it can).

At each decision the shield foresees the robot, by its own dynamics, under the policy's command and a fixed set of
others. A command is admissible, as in the dynamic window approach (Fox, Burgard and Thrun, IEEE Robotics and Automation
Magazine, 1997), where the robot can brake after it and touch nothing. People move meanwhile: where they come nearer,
to go on for a while before braking may be better, and does as well. How far a command is from being admissible is its
risk, a time: sooner and closer touches weigh more. The command with the least sum of change and weighted risk is
driven.

People are tracked and keep their velocity; who is out of sight behind the robot may also stand where they were seen
last. Walls are what the scans show, now or, behind the robot, a moment ago.

A policy that only presses on would stand before the obstacle for ever. A robot that got nowhere for a while is led on
instead, by the admissible command that brings it nearest to the way ahead; where none does, it draws back first.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bson.agents import learned
from bson.agents.arrival import well_in
from bson.agents.contract import Setting, act
from bson.agents.guide import MapSight, ScanSight
from bson.agents.rollout import RolloutConfig, gap, going_on, robot_row, rollout
from macid.geometry import wrap_angle
from macid.state import FAR_AWAY


@dataclass(frozen=True)
class ShieldConfig(RolloutConfig):
    """What `Shield` assumes and weighs. Metres, seconds, radians. Changes of a command count in top speeds."""

    step: float = 0.1  # of what is foreseen; at least the control period
    horizon: float = 1.2
    hold: float = 0.6  # for so long a command may go on before the robot brakes
    speeds: tuple = (-0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0)  # of other commands, in top speeds
    rates: tuple = (0.0, 0.25, -0.25, 0.5, -0.5, 1.0, -1.0)  # in top yaw rates
    rate_share: float = 0.5  # change of the speed that counts as much as one of the yaw rate, each in top ones
    back_weight: float = 1.0  # of backing faster than the policy wants, as nobody is seen behind
    bump: float = 0.3  # a robot that backs and is so much slower than foreseen ran into something unseen [m/s]
    risk_weight: float = 10.0  # [1/s]
    risk_enough: float = 1e-6  # below which a command is admissible [s]

    people: int = 12  # number of the nearest people who count
    person_room: float = 0.1  # a gap that is smaller is a risk
    person_growth: float = 0.15  # growth of that room for each second ahead [m/s]
    give: float = 0.02  # so much farther into somebody than who stands is into the robot counts as driving through
    patience: float = 1.0  # time constant with which what comes later counts less
    points: int = 128  # number of the nearest wall points that count
    sector: float = 2.5  # width of a sector of the scan, of which only the nearest point counts [deg]
    reach: float = 2.5  # within which wall points count
    behind: float = 1.5  # within which wall points out of sight are remembered
    wall_room: float = 0.06
    wall_room_per_speed: float = 0.03  # further room for each m/s [s]
    wall_least: float = 0.02  # room that is asked for however near a wall is already
    touch: float = 0.005  # a gap to a wall that counts as none

    stuck_time: float = 3.0  # a robot that got no farther than stuck_way in this time is stuck
    stuck_way: float = 0.5
    free_way: float = 1.0  # it is free again so far from there
    stuck_risk: float = 50.0  # weight of risk then, against metres [m/s]
    back_cost: float = 0.5  # metres nearer that a metre of backing costs
    turn_worth: float = 0.3  # metres nearer to the way ahead that a radian of turning towards it is worth
    least_gain: float = 0.1  # where no command brings it so much nearer, it draws back
    back_way: float = 0.5  # by so much
    detours: tuple = (0.0, 20.0, -20.0, 40.0, -40.0, 60.0, -60.0, 90.0, -90.0, 120.0, -120.0)  # off the way ahead [deg]
    detour_way: float = 1.5  # length that has to be free
    detour_room: float = 0.08  # on either side of the robot's width


class Shield:
    """The agent `policy` of one world of `setting` behind the shield: called with one world's observation each control
    period, it returns an action (2,) in [-1, 1]. policy: any agent with the LIDAR, or for `guard` alone what
    has its `eyes`. The shield sees by the LIDAR alone; `eyes` that see a map (MapSight) tell it the way ahead.

    Raises Unsuited where there is no level Lidar2D.
    """

    track, sensor = "local", "lidar2d"

    def __init__(self, policy: Any, setting: Setting, config: ShieldConfig = ShieldConfig()):
        self.config, self._policy = config, policy
        eyes = getattr(policy, "eyes", None)
        self._shared = isinstance(eyes, ScanSight)
        self.sight: ScanSight = eyes if isinstance(eyes, ScanSight) else ScanSight(setting)  #: what it sees by
        self._guide = eyes if isinstance(eyes, MapSight) else self.sight
        self._setting, self._period = setting, setting.control_period
        self._top, self._robot = setting.top, robot_row(config, setting)
        self._person_radius = np.float32(setting.person_radius)
        self._step = max(config.step, setting.control_period)
        self._times = self._step * np.arange(1, round(config.horizon / self._step) + 1)
        rate, speed = np.meshgrid(config.rates, config.speeds)
        self._others = np.stack([speed.ravel(), rate.ravel()], axis=-1)
        self._stuck_steps = setting.steps(config.stuck_time)
        self.reset(None)

    def reset(self, seed: int | None) -> None:
        """Begins an episode."""
        if (reset := getattr(self._policy, "reset", None)) is not None:
            reset(seed)
        if not self._shared:
            self.sight.reset()
        self._walls = np.zeros((0, 2))  # points, goal-bound frame [m]
        self._been: list[np.ndarray] = []  # places of the last decisions, goal-bound frame [m]
        self._stuck_at: np.ndarray | None = None  # where the robot got stuck, until it is free
        self._backs_from: np.ndarray | None = None  # where it began to draw back, until it has
        self._back = 0.0  # 1 where it draws back ahead, -1 backwards
        self._foreseen: float | None = None  # its speed now, if it backs and meets nothing [m/s]

    def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The action (2,) for one world's observation (see bson.interfaces.gym.BsonEnv)."""
        return self.guard(act(self._policy, observation), observation)

    def guard(self, wish: np.ndarray, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """What to drive (2,) in place of the policy's action `wish` (2,) on one world's observation, which its eyes, if
        they are shared, have seen."""
        wish, speed = np.clip(np.asarray(wish, float), -1.0, 1.0), float(observation["velocity"][0])
        wish = well_in(wish, observation["goal"], speed, self._setting)
        if not self._shared:
            self.sight.look_ahead(observation)
        tried = self._commands(wish)
        self._feel(speed)
        people, walls = self._people(), self._near_walls()
        self._note(self.sight.to_goal_bound(np.zeros((1, 2)))[0])
        aim = self._guide.aim if self._stuck_at is None else self._detour(people[:, 0], walls)
        risk, gain, way = (
            np.asarray(each, float)
            for each in _foreseen(
                self.config,
                np.array([0.0, 0.0, 0.0, *observation["velocity"]], np.float32),
                self._robot,
                np.float32(self._step),
                (tried * self._top).astype(np.float32),
                people,
                walls,
                self._person_radius,
                aim.astype(np.float32),
            )
        )
        chosen = self._choose(tried, risk, gain, way)
        self._expect(speed, float(tried[chosen, 0] * self._top[0]))
        return tried[chosen]

    def _commands(self, wish):
        """Shares (N, 2) of top speed and yaw rate: `wish` (2,) first, then those that differ from it in one of both,
        and the fixed ones."""
        speeds, rates = np.array(self.config.speeds), np.array(self.config.rates)
        slower = np.stack([speeds, np.full(len(speeds), wish[1])], axis=-1)
        turned = np.stack([np.full(len(rates), wish[0]), rates], axis=-1)
        return np.concatenate([wish[None], turned, slower, self._others])

    def _choose(self, tried, risk, gain, way):
        """The index of the command to drive: of those `tried` (N, 2), with their `risk` (N,) [s], and the `gain` and
        `way` (N,) [m] that they bring."""
        c = self.config
        if self._stuck_at is not None:
            return int(np.argmin(c.stuck_risk * risk - self._worth(risk <= c.risk_enough, gain, way)))
        if risk[0] <= c.risk_enough:
            return 0
        change = np.hypot(tried[:, 0] - tried[0, 0], c.rate_share * (tried[:, 1] - tried[0, 1]))
        change += c.back_weight * np.maximum(min(tried[0, 0], 0.0) - tried[:, 0], 0.0)
        return int(np.argmin(change + c.risk_weight * risk))

    def _worth(self, admissible, gain, way):
        """What commands (N,) are worth to a stuck robot [m]: how much nearer to the way ahead they bring it, or how far
        away from here."""
        c = self.config
        if self._backs_from is None and not (gain[admissible] > c.least_gain).any():
            self._backs_from = self._been[-1]
            self._been = self._been[-1:]
            ahead, behind = (np.max(sign * way, where=admissible, initial=0.0) for sign in (1.0, -1.0))
            self._back = 1.0 if ahead > behind else -1.0
        return gain if self._backs_from is None else self._back * way

    def _detour(self, people, walls):
        """Where (2,) [m], robot frame, to lead a stuck robot on among `people` (K, 2) and `walls` (P, 2): in the
        direction that is least off the way ahead and free, as in the vector field histogram (Borenstein and Koren,
        IEEE Transactions on Robotics and Automation, 1991); straight to the way ahead where none is."""
        c, aim = self.config, self._guide.aim
        length = min(c.detour_way, float(np.hypot(*aim)))
        angles = math.atan2(aim[1], aim[0]) + np.radians(c.detours)
        rays = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        free = np.ones(len(rays), bool)
        for points, radius in ((people, self._person_radius), (walls, 0.0)):
            along = points @ rays.T
            aside = np.abs(points[:, :1] * rays[:, 1] - points[:, 1:] * rays[:, 0])
            met = (along > 0) & (along < length + radius) & (aside < self._robot[4] + c.detour_room + radius)
            free &= ~met.any(axis=0)
        return length * rays[free.argmax()] if free.any() else aim

    def _note(self, place):
        """Notes whether the robot, at `place` (2,), is stuck, or free again, or has drawn back or can't."""
        c = self.config
        self._been = [*self._been[-self._stuck_steps :], place]
        still = len(self._been) > self._stuck_steps and np.hypot(*(place - self._been[0])) < c.stuck_way
        if self._stuck_at is None and still:
            self._stuck_at = place
        elif self._stuck_at is not None and np.hypot(*(place - self._stuck_at)) > c.free_way:
            self._stuck_at = self._backs_from = None
            self._been = []
        if self._backs_from is not None and (still or np.hypot(*(place - self._backs_from)) > c.back_way):
            self._backs_from = None

    def _expect(self, speed, command):
        """Foresees the speed a control period after the `command`, both [m/s], where the robot backs."""
        most = self._robot[2] * self._period
        after = speed + np.clip(command - speed, -most, most)
        self._foreseen = after if max(after, command) < 0.0 else None

    def _feel(self, speed):
        """Takes what stopped the robot from behind, whose `speed` is now [m/s], for a wall that was out of sight."""
        if self._foreseen is not None and speed - self._foreseen > self.config.bump:
            half_length, half_width = self._robot[3:5]
            across = np.linspace(-half_width, half_width, 5)
            behind = np.stack([np.full(5, -half_length - self.config.wall_least), across], axis=-1)
            self._walls = np.concatenate([self._walls, self.sight.to_goal_bound(behind)])

    def _people(self):
        """Where the nearest people will be (people, T, 2) [m], robot frame."""
        c, (places, velocities) = self.config, self.sight.people
        last = self.sight.left_behind
        places, velocities = np.concatenate([places, last]), np.concatenate([velocities, np.zeros_like(last)])
        near = np.argsort(np.hypot(*places.T), kind="stable")[: c.people]
        people = np.full((c.people, len(self._times), 2), FAR_AWAY, np.float32)
        people[: len(near)] = going_on(places[near], velocities[near], self._times)
        return people

    def _near_walls(self):
        """The nearest wall points (points, 2) [m], robot frame."""
        c, sight = self.config, self.sight
        points, fresh = sight.to_robot(self._walls), sight.new_walls(np.radians(c.sector), c.reach)
        if fresh is not None:
            points = points[~sight.in_field(points) & (np.hypot(*points.T) < c.behind)]
            points = np.concatenate([fresh, points])
            self._walls = sight.to_goal_bound(points)
        near = np.argsort(np.hypot(*points.T), kind="stable")[: c.points]
        walls = np.full((c.points, 2), FAR_AWAY, np.float32)
        walls[: len(near)] = points[near]
        return walls


class GruShield(Shield):
    """The shipped policy `gru` behind the shield. untrained: whether it may drive in a setting other than the one in
    which it was trained."""

    shipped = "gru"

    def __init__(self, setting: Setting | None = None, untrained: bool = False):
        setting = Setting.default(self.track) if setting is None else setting
        super().__init__(learned.load(self.shipped, untrained).made(setting), setting)


class GruMapShield(GruShield):
    """The shipped policy `gru-map` behind the shield."""

    track, shipped = "global", "gru-map"


@functools.partial(jax.jit, static_argnums=0)
def _foreseen(config, state, robot, step, commands, people, walls, person_radius, aim):
    """Of `commands` (N, 2) [m/s, rad/s] at `state` (5,), robot frame, among `people` (K, T, 2) and `walls` (P, 2): the
    risk (N,) [s], how much nearer to `aim` (2,) they bring the robot (N,), and how far ahead (N,) [m]."""
    c, horizon, n = config, people.shape[1], commands.shape[0]
    times = step * jnp.arange(1, horizon + 1, dtype=jnp.float32)[:, None]
    begins = times - step
    on = jnp.concatenate([begins < 0.5 * step, begins < c.hold - 0.5 * step], axis=1)  # (T, 2): brake at once, or later
    sequences = jnp.where(on[:, :, None, None], commands, 0.0).reshape(horizon, 2 * n, 2)
    x, y, yaw, v, _ = rollout(c, robot, state, step, sequences)
    still = jnp.zeros((3, horizon, 1))

    people = jnp.swapaxes(people, 0, 1)
    near = gap(robot, x, y, yaw, people, person_radius)
    standing = gap(robot, still[0], still[1], still[2], people, person_radius)
    into = near < jnp.minimum(standing, 0.0) - c.give  # by the robot's own motion
    short = jnp.maximum(1.0 - near / (c.person_room + c.person_growth * times), 0.0)
    short = jnp.maximum(short, jax.lax.cummax(jnp.where(into, short, 0.0), axis=0))  # no way leads through somebody

    walls = jnp.broadcast_to(walls, (horizon, *walls.shape))
    near, present = gap(robot, x, y, yaw, walls, 0.0), gap(robot, still[0], still[1], still[2], walls, 0.0)
    room = jnp.clip(present - c.touch, c.wall_least, c.wall_room + c.wall_room_per_speed * jnp.abs(v))
    lack = jnp.maximum(1.0 - near / room, 0.0)
    into = (near <= c.touch) & (present > c.touch)
    lack = jnp.maximum(lack, jax.lax.cummax(jnp.where(into, lack, 0.0), axis=0))

    risk = (step * jnp.exp(-times / c.patience) * (short + lack)).sum(axis=0).reshape(2, n).min(axis=0)
    x, y, yaw = (each[-1, n:] for each in (x, y, yaw))
    off, first = (
        jnp.abs(wrap_angle(jnp.arctan2(aim[1] - b, aim[0] - a) - turn)) for a, b, turn in ((x, y, yaw), (0, 0, 0))
    )
    nearer = jnp.hypot(aim[0], aim[1]) - jnp.hypot(aim[0] - x, aim[1] - y)
    return risk, nearer + c.turn_worth * (first - off) - c.back_cost * jnp.maximum(-x, 0.0), x
