"""Model predictive path integral control among people (Williams, Aldrich and Theodorou, "Model predictive path integral
control: from theory to parallel computation", J. Guidance, Control, and Dynamics 2017; Williams et al.,
"Information-theoretic model predictive control", T-RO 2018).

Each control period the agent draws sequences of commands around its last plan, rolls the robot's own dynamics out under
each of them, and judges the ways by a cost S: the time that the robot will need, the length of its way, and what it may
touch. The new plan is the mean of the sequences weighted by exp(-S / temperature). The agent drives the plan's first
command.

- The rest of the way, beyond the horizon, costs what the best way around walls and crowds costs from there: a field
  over the whole map that solves the eikonal equation (`bson.planners.way_field`) anew every second. A metre of way
  costs more the denser people are there, and much more close to somebody who stands: crowds that jam at a corner or in
  a door leave no way for minutes, and who drives into them does not come out.
- People are predicted for as long as the horizon (`MppiPolicy` says otherwise): they keep their velocity. The room that
  they are given grows with how far ahead they are predicted.
- Some of the sequences come from other controllers than the last plan, as in Biased-MPPI (Trevisan and Alonso-Mora,
  RA-L 2024): to follow the field at several speeds, at several angles to it, to turn on the spot, to stand, to drive
  back. If one sequence is better than the weighted mean, which may lie between two ways around somebody, the agent
  takes that sequence.

Sequences come in pairs that turn to opposite sides, so that the mirrored world gives the mirrored action.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from bson.agents.arrival import well_in
from bson.agents.contract import Setting
from bson.agents.global_view import GlobalView, Standing
from bson.agents.rollout import RolloutConfig, gaps, going_on, robot_row, rollout
from bson.planners import Grid
from bson.planners.way_field import rate_by_clearance, way_field
from macid.geometry import to_body, wrap_angle
from macid.state import FAR_AWAY, GOAL_RADIUS


@dataclass(frozen=True)
class MppiConfig(RolloutConfig):
    """What `Mppi` assumes and weighs. Metres, seconds, radians. Costs have the unit of points of the SNS, of 100."""

    longest_period: float = 0.5  # between two decisions: a person walks 0.7 m meanwhile
    step: float = 0.1  # of the rollout; at least the control period
    horizon: int = 30  # steps of the rollout
    pairs: int = 224  # of sequences around the last plan
    knots: tuple = (0.0, 0.1, 0.3, 0.6, 1.0, 1.5, 2.2, 3.0)  # of sequences' deviations, as shares of 3 s
    speed_noise: float = 0.25  # standard deviation of a deviation of the speed, in top speeds
    rate_noise: float = 0.4  # likewise of the yaw rate, in top yaw rates
    temperature: float = 0.5  # [points]
    guided_speeds: tuple = (1.0, 0.75, 0.5, 0.25)  # of sequences that follow the field, in top speeds
    guided_angles: tuple = (0.0, 0.25, 0.5, 0.8, 1.2, 1.8)  # to either side of it
    guided_time: float = 0.9  # after which half of them turn back to it
    turn_time: float = 0.25  # in which a guided sequence makes its turn

    people: int = 24  # number of the nearest people who count
    person_room: float = 0.3  # a gap that is smaller costs
    person_growth: float = 0.2  # growth of that room for each second ahead [m/s]
    person_weight: float = 200.0  # of a touch [points/s]
    press_weight: float = 20.0  # of more people than one around the robot [points/s], beside what each gap costs
    press_gap: float = 0.4  # over which somebody counts e times less as being around
    give: float = 0.02  # a way that leads so far into people, beyond what they walk into the robot, does not come out
    patience: float = 1.2  # time constant with which what comes later counts less
    wall_gap: float = 0.1  # beside the radius; a smaller gap counts as a touch
    wall_room: float = 0.3  # a gap that is smaller by this much costs
    wall_weight: float = 100.0  # of a touch [points/s]
    wall_cost: float = 300.0  # of a metre of way nearer to a wall than half the robot's width: of no discount
    time_weight: float = 6.0  # [points/s]
    length_weight: float = 2.0  # of way driven or to go [points/m]
    back_weight: float = 1.0  # of driving back, beside the length [points/m]
    arrived: float = 0.33  # from the goal: a way is driven on so far into its circle

    remap: float = 1.0  # between two looks at the whole map, as people move on it
    standing_time: float = 1.5  # of the running mean of people's velocities
    standing_speed: float = 0.3  # whose running mean is slower stands
    standing_room: float = 0.1  # between half the robot's width and somebody who stands
    standing_comfort: float = 0.5  # further distance within which a metre of way costs more
    standing_cost: float = 12.0  # of a metre of way nearer than that room
    crowd_spread: float = 1.5  # standard deviation of the kernel by which people's density is told
    crowd_free: float = 0.3  # density that costs nothing [1/m2]
    crowd_cost: float = 4.0  # of a metre of way for each person/m2 above it

    margin: float = 0.12  # beside the radius: the least distance between ways and walls where there is room
    comfort: float = 0.5  # further distance from walls within which a metre of way costs more
    comfort_cost: float = 0.5  # at the margin's end, for each metre
    blocked_cost: float = 30.0  # of a metre of way nearer than the margin


class World(NamedTuple):
    """What the compiled part is told: a patch of the map around the robot, people, and the robot's abilities."""

    state: Any  #: (5,) x, y, yaw, v, w
    goal: Any  #: (2,)
    origin: Any  #: (2,) the centre of the patch's first cell [m]
    way: Any  #: (PATCH, PATCH) length of the way to the goal [m]
    clearance: Any  #: (PATCH, PATCH) distance to the nearest wall [m]
    people: Any  #: (people, horizon, 2) where each will be [m]
    step: Any  #: [s]
    resolution: Any  #: [m]
    robot: Any  #: (6,) top speed, top yaw rate, acceleration, half length, half width, radius
    person_radius: Any


PATCH = 72  # cells of a side of the patch: 18 m at the map's resolution


class Controller:
    """The part that all agents of this kind share: it turns a map with a goal, and people, into actions."""

    def __init__(self, setting: Setting, config: MppiConfig):
        self.config, self._setting, self._period = config, setting, setting.control_period
        self.step = max(config.step, setting.control_period)
        self.times = self.step * np.arange(1, config.horizon + 1)  # of the rollout [s]
        self.radius = setting.robot.radius
        self._top = setting.top
        self._robot = robot_row(config, setting)
        self._person_radius = np.float32(setting.person_radius)
        times = np.arange(config.horizon) / (config.horizon - 1)
        knots = np.asarray(config.knots) / config.knots[-1]
        self._spread = np.stack([np.interp(times, knots, row) for row in np.eye(len(knots))]).astype(np.float32)
        self.reset(0)

    def reset(self, seed: int | None) -> None:
        """Forgets the last plan."""
        self._rng = np.random.default_rng(seed)
        self._plan = np.zeros((self.config.horizon, 2), np.float32)
        self.planned = None  # the way (horizon, 2) of the last plan [m], from the place where it was made

    def rate(self, occupied: np.ndarray, clear: np.ndarray) -> np.ndarray:
        """The cost (rows, columns) of a metre of way in cells that are `clear` [m] from what is `occupied`."""
        c = self.config
        least = self.radius + c.margin
        return rate_by_clearance(occupied, clear, least, c.comfort, c.comfort_cost, c.blocked_cost)

    def crowd(self, grid: Grid, people: np.ndarray, standing: np.ndarray) -> np.ndarray:
        """What a metre of way costs more in each cell (rows, columns) among `people` (n, 2) [m], of whom some are
        `standing` (n,) bool: people who stand close together leave no way, and a crowd that moves delays."""
        c = self.config
        density = grid.counted(people) / grid.resolution**2
        density = np.asarray(ndimage.gaussian_filter(density, c.crowd_spread / grid.resolution))
        cost = c.crowd_cost * np.maximum(density - c.crowd_free, 0.0)
        free = grid.counted(people[standing]) == 0
        if not free.all():
            distance = np.asarray(ndimage.distance_transform_edt(free)) * grid.resolution
            least = float(self._person_radius) + float(self._robot[4]) + c.standing_room
            cost += c.standing_cost * np.clip(1.0 - (distance - least) / c.standing_comfort, 0.0, 1.0)
        return cost

    def set_map(self, grid: Grid, goal: np.ndarray, people: np.ndarray, standing: np.ndarray) -> None:
        """Takes a map with a goal (2,), and `people` (n, 2) [m] on it, of whom some are `standing` (n,) bool."""
        self._grid, self._goal = grid, np.asarray(goal, np.float32)
        rate = self.rate(grid.occupied, grid.clearance) + self.crowd(grid, people, standing)
        way = way_field(grid, goal, rate)
        self._ways = np.pad(way, PATCH // 2, mode="edge")
        self._clear = np.pad(np.asarray(grid.clearance, np.float32), PATCH // 2)

    def _patch(self, row, column):
        """The lengths of ways and the clearances (PATCH, PATCH) around the cell (row, column)."""
        patch = (slice(row, row + PATCH), slice(column, column + PATCH))
        return self._ways[patch], self._clear[patch]

    def decide(self, pose: np.ndarray, velocity: np.ndarray, people: np.ndarray) -> np.ndarray:
        """The action (2,) at `pose` (3,) and `velocity` (2,) among `people` (n, horizon, 2), where they will be."""
        c, grid = self.config, self._grid
        row, column = np.clip(grid.cells(pose[:2]), 0, np.subtract(grid.shape, 1))
        origin = grid.centres(np.array([row, column]) - PATCH // 2)
        filled = np.full((c.people, c.horizon, 2), FAR_AWAY, np.float32)
        filled[: len(people)] = people[: c.people]
        world = World(
            np.array([0, 0, pose[2], *velocity], np.float32),
            (self._goal - pose[:2]).astype(np.float32),
            (origin - pose[:2]).astype(np.float32),
            *self._patch(row, column),
            (filled - pose[:2]).astype(np.float32),
            np.float32(self.step),
            np.float32(grid.resolution),
            self._robot,
            self._person_radius,
        )
        noise = self._rng.standard_normal((c.pairs, len(c.knots), 2), np.float32)
        plan, way = (np.asarray(each) for each in _improved(c, world, self._plan, noise, self._spread))
        share = self._period / self.step
        self._plan = (1 - share) * plan + share * np.concatenate([plan[1:], plan[-1:]])
        self.planned = way + pose[:2]
        action = np.clip(plan[0].astype(float) / self._top, -1.0, 1.0)
        return well_in(action, to_body(self._goal - pose[:2], pose[2]), float(velocity[0]), self._setting)


def _lookup(world, x, y):
    """Bilinear weights and indices of places in the patch."""
    u = jnp.clip((x - world.origin[0]) / world.resolution, 0.0, PATCH - 1.001)
    v = jnp.clip((y - world.origin[1]) / world.resolution, 0.0, PATCH - 1.001)
    j, i = u.astype(jnp.int32), v.astype(jnp.int32)
    return i * PATCH + j, u - j, v - i


def _nearest_node(world, x, y):
    """The index of the patch's cell whose centre is nearest to each place."""
    j, i = (jnp.clip(jnp.rint((at - low) / world.resolution), 0, PATCH - 1).astype(jnp.int32)
            for at, low in ((x, world.origin[0]), (y, world.origin[1])))  # fmt: skip
    return i * PATCH + j


def _read(field, place):
    """Values of a field (PATCH * PATCH,) at places of `_lookup`."""
    index, u, v = place
    below = field[index] * (1 - u) + field[index + 1] * u
    above = field[index + PATCH] * (1 - u) + field[index + PATCH + 1] * u
    return below * (1 - v) + above * v


def _guided(config):
    """Guided sequences: speeds (share), angles, and whether they turn back to the field; then fixed (v, w)."""
    rows = []
    for speed in config.guided_speeds:
        for angle in config.guided_angles:
            for sign in (1, -1) if angle else (1,):
                for back in (False, True) if angle else (False,):
                    rows.append((speed, sign * angle, back))
    speeds, angles, back = (np.array(column, np.float32) for column in zip(*rows, strict=True))
    fixed = [(0, 0), (0, 1), (0, -1)]
    fixed += [(v, w) for v in (-0.25, -0.5, -1.0) for w in (-0.5, 0, 0.5)]
    fixed += [(v, w) for v in (0.5, 1.0) for w in (-1.0, -0.5, 0, 0.5, 1.0)]
    return speeds, angles, back, np.array(fixed, np.float32)


def _costs(config, world, x, y, yaw, v):
    """The costs (N,) of ways (T, N)."""
    c, step = config, world.step
    times = step * jnp.arange(1, x.shape[0] + 1, dtype=jnp.float32)[:, None]
    there = (x - world.goal[0]) ** 2 + (y - world.goal[1]) ** 2 < c.arrived**2
    before = jnp.concatenate([jnp.zeros((1, x.shape[1]), bool), there[:-1]])
    going = jnp.cumprod(1.0 - before, axis=0)  # until the goal
    weight = step * jnp.exp(-times / c.patience) * going
    people = jnp.swapaxes(world.people, 0, 1)
    each = gaps(world.robot, x, y, yaw, people, world.person_radius)
    gap = jnp.min(each, axis=-1)
    still = jnp.broadcast_to(world.state[:3, None, None], (3, x.shape[0], 1))
    standing = jnp.min(gaps(world.robot, still[0], still[1], still[2], people, world.person_radius), axis=-1)
    into = gap < jnp.minimum(standing, 0.0) - c.give  # by the robot's own motion
    least = jax.lax.cummin(jnp.where(into, gap, jnp.inf), axis=0)
    gap = jnp.minimum(gap, least)  # no way leads through somebody
    risk = jnp.maximum(1.0 - gap / (c.person_room + c.person_growth * times), 0.0) ** 2
    cost = c.person_weight * jnp.sum(weight * risk, axis=0)
    around = jnp.sum(jnp.exp(-jnp.maximum(each, 0.0) / c.press_gap), axis=-1)
    cost += c.press_weight * jnp.sum(weight * jnp.maximum(around - 1.0, 0.0), axis=0)
    place = _lookup(world, x, y)
    clear = _read(world.clearance.ravel(), place)
    through = step * jnp.sum(jnp.abs(v) * going * (clear < world.robot[4]), axis=0)  # no way leads through a wall
    cost += (c.length_weight + c.time_weight / world.robot[0]) * c.wall_cost * through
    clear = clear - world.robot[5] - c.wall_gap
    cost += c.wall_weight * jnp.sum(weight * jnp.maximum(1.0 - clear / c.wall_room, 0.0) ** 2, axis=0)
    left = _read(world.way.ravel(), (place[0][-1], place[1][-1], place[2][-1]))
    left = jnp.maximum(left - GOAL_RADIUS, 0.0) * going[-1] * (1 - there[-1])
    way = step * jnp.sum(jnp.abs(v) * going, axis=0)
    cost += c.time_weight * (step * jnp.sum(going, axis=0) + left / world.robot[0])
    cost += c.length_weight * (way + left)
    cost += c.back_weight * step * jnp.sum(jnp.maximum(-v, 0.0) * going, axis=0)
    return cost


@functools.partial(jax.jit, static_argnums=0)
def _improved(config, world, plan, noise, spread):
    """The new plan (T, 2), and the way that it leads (T, 2)."""
    c = config
    top, top_rate = world.robot[0], world.robot[1]
    limit = jnp.stack([top, top_rate])
    deviation = jnp.einsum("nkc,kt->tnc", noise, spread) * jnp.stack([c.speed_noise * top, c.rate_noise * top_rate])
    mirrored = deviation * jnp.asarray([1.0, -1.0])
    around = plan[:, None] + jnp.concatenate([jnp.zeros_like(deviation[:, :1]), deviation, mirrored], axis=1)
    speeds, angles, back, fixed = _guided(c)
    horizon = plan.shape[0]
    guided = jnp.stack([jnp.broadcast_to(speeds * top, (horizon, len(speeds))), jnp.zeros((horizon, len(speeds)))], -1)
    steady = jnp.broadcast_to(fixed * limit, (horizon, *fixed.shape))
    commands = jnp.clip(jnp.concatenate([around, steady, guided], axis=1), -limit, limit)
    number = commands.shape[1]
    is_guided = jnp.arange(number) >= number - len(speeds)
    time = world.step * jnp.arange(horizon)[:, None]
    angle = jnp.where((back > 0) & (time > c.guided_time), 0.0, angles)
    angle = jnp.concatenate([jnp.zeros((horizon, number - len(speeds))), angle], axis=1)
    dy, dx = jnp.gradient(world.way)
    heading = jnp.arctan2(-dy, -dx).ravel()
    turn_time = jnp.maximum(c.turn_time, 1.25 * world.step)

    def steer(command, x, y, yaw, angle):
        """Guided sequences' yaw rates follow the field."""
        along = heading[_nearest_node(world, x, y)] + angle
        rate = jnp.clip(wrap_angle(along - yaw) / turn_time, -top_rate, top_rate)
        return jnp.stack([command[:, 0], jnp.where(is_guided, rate, command[:, 1])], axis=-1)

    x, y, yaw, v, commands = rollout(c, world.robot, world.state, world.step, commands, steer, (angle,))
    costs = _costs(c, world, x, y, yaw, v)
    best = jnp.argmin(costs)
    weights = jax.nn.softmax(-(costs - costs[best]) / c.temperature)
    mean = jnp.einsum("n,tnc->tc", weights, commands)
    two = jnp.stack([mean, commands[:, best]], axis=1)
    x, y, yaw, v, both = rollout(c, world.robot, world.state, world.step, two)
    chosen = jnp.argmin(_costs(c, world, x, y, yaw, v))
    return both[:, chosen], jnp.stack([x, y], axis=-1)[:, chosen]


class Mppi:
    """The agent: called with a world's Global observation each control period, it returns an action (2,) in [-1, 1]."""

    track, sensor = "global", "lidar2d"

    def __init__(self, setting: Setting | None = None, config: MppiConfig = MppiConfig()):
        setting = Setting.default("global") if setting is None else setting
        setting.check_period(config.longest_period)
        self.config = config
        self._view = GlobalView(setting)
        self._controller = Controller(setting, config)
        self._remap = setting.steps(config.remap)
        self._standing = Standing(setting.control_period, config.standing_time, config.standing_speed)
        self.reset(0)

    def reset(self, seed: int | None = None) -> None:
        """Begins an episode; samples are drawn from `seed`."""
        self._view.reset()
        self._controller.reset(seed)
        self._standing.forget()
        self._steps = 0

    def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The action (2,) for one world's Global observation (see bson.interfaces.gym.BsonEnv)."""
        view, control = self._view, self._controller
        view.see(observation)
        self._look()
        distance = np.hypot(*(view.people - view.pose[:2]).T)
        near = np.argsort(distance, kind="stable")[: self.config.people]
        return control.decide(view.pose, np.asarray(observation["velocity"], float), self._predicted(near))

    def _look(self):
        """Looks now and then where people stand, and plans the way anew."""
        view = self._view
        self._standing.see(view.people_velocity)
        if self._steps % self._remap == 0:
            self._controller.set_map(view.map, view.goal, view.people, self._standing.stands)
        self._steps += 1

    def _predicted(self, near):
        """Where the people `near` (n,) will be (n, horizon, 2) [m]: they keep their velocity."""
        return going_on(self._view.people[near], self._view.people_velocity[near], self._controller.times)
