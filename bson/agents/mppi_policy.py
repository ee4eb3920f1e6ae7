"""Model predictive path integral control (`bson.agents.mppi`) that predicts people by a published pedestrian policy.

For the first second the policy itself decides for the nearest people, in a rollout of what the Global observation
holds: everybody's place and velocity, the walls, and the way that the robot planned at its last decision. Where people
want to go, and of what temper they are, is in no observation: they are taken to want to go on as they walk, or to stay
where they stand, and to have one temper. After that second they keep their velocity.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from bson.agents.contract import Setting
from bson.agents.mppi import Mppi, MppiConfig
from bson.agents.orca_oracle import nearest_rows, occupied_boxes
from bson.agents.rollout import going_on
from macid import contacts, geometry
from macid.pedestrians import make_controller
from macid.state import MAX_YAW_RATE, RADIUS, STALLED, CrowdState, Traits

_STEP = 0.1  # between two of the policy's decisions [s]
_GOAL = 8.0  # distance of the goal that a person is taken to have, straight ahead [m]


@dataclass(frozen=True)
class MppiPolicyConfig(MppiConfig):
    """What `MppiPolicy` assumes and weighs."""

    model: str = "macid"  # pedestrian model that predicts
    lcf: float = 1.0  # everybody's temper
    decisions: int = 10  # that the model foresees
    boxes: int = 32  # number of the nearest walls that people see


class MppiPolicy(Mppi):
    """The agent: called with a world's Global observation each control period, it returns an action (2,) in [-1, 1]."""

    config: MppiPolicyConfig

    def __init__(self, setting: Setting | None = None, config: MppiPolicyConfig = MppiPolicyConfig()):
        self._model = _model(config.model)
        setting = Setting.default("global") if setting is None else setting
        self._period, self._person_radius = setting.control_period, np.float32(setting.person_radius)
        super().__init__(setting, config)

    def reset(self, seed: int | None = None) -> None:
        """Begins an episode; samples are drawn from `seed`."""
        super().reset(seed)
        self._boxes = self._yaw = None

    def _predicted(self, near):
        """Where the people `near` (n,) will be (n, horizon, 2) [m]."""
        view, c, times = self._view, self.config, self._controller.times
        if self._boxes is None:
            self._boxes = occupied_boxes(view.map)
        yaw, rate = self._turned(view.people_velocity)
        place, velocity = view.people[near], view.people_velocity[near]
        if not len(near):
            return np.zeros((0, len(times), 2))
        count = c.people
        state = np.column_stack([place, velocity])
        state = nearest_rows(state, np.arange(len(near)), count).astype(np.float32)
        facing = np.zeros((count, 2), np.float32)
        facing[: len(near)] = np.column_stack([yaw, rate])[near]
        walls = nearest_rows(self._boxes, geometry.point_box_distance(view.pose[:2], self._boxes), c.boxes)
        robot = self._robot(_STEP * np.arange(c.decisions + 1))
        foreseen = _foresee(
            self._model, state, facing, robot.astype(np.float32), walls.astype(np.float32), c.lcf, self._person_radius
        )
        foreseen = np.asarray(foreseen, float)[:, : len(near)]  # (decisions + 1, n, 2)
        index = np.clip(times / _STEP, 0.0, c.decisions - 1e-6)
        low = index.astype(int)
        share = (index - low)[:, None, None]
        ways = np.moveaxis(foreseen[low] * (1 - share) + foreseen[low + 1] * share, 0, 1)
        after = times > c.decisions * _STEP
        last = (foreseen[-1] - foreseen[-2]) / _STEP
        ways[:, after] = going_on(foreseen[-1], last, times[after] - c.decisions * _STEP)
        stays = self._standing.stands[near]
        ways[stays] = going_on(place[stays], velocity[stays], times)
        return ways

    def _turned(self, velocity):
        """Everybody's yaw (K,), from their `velocity` (K, 2) or, of people who stand, from where they last walked, and
        their yaw rates (K,)."""
        yaw = np.arctan2(velocity[:, 1], velocity[:, 0])
        before = yaw if self._yaw is None else self._yaw
        self._yaw = yaw = np.where(np.hypot(*velocity.T) > STALLED, yaw, before)
        return yaw, np.clip(geometry.wrap_angle(yaw - before) / self._period, -MAX_YAW_RATE, MAX_YAW_RATE)

    def _robot(self, times):
        """Where (T, 2) the robot will be at `times` (T,), as it planned a control period ago; first it stands."""
        pose, planned = self._view.pose[:2], self._controller.planned
        if planned is None:
            return np.tile(pose, (len(times), 1))
        known = self._controller.times - self._period
        return np.stack(
            [np.interp(times, [0.0, *known[known > 0]], [pose[i], *planned[known > 0, i]]) for i in (0, 1)], -1
        )


_model = functools.lru_cache(8)(functools.partial(make_controller, period=_STEP))


@functools.partial(jax.jit, static_argnums=0)
def _foresee(model, state, facing, robot, boxes, lcf, radius):
    """Places (T + 1, k, 2) of people whose `state` (k, 4) is x, y, and velocity, `facing` (k, 2) their yaw and yaw
    rate, beside a robot that will be at `robot` (T + 1, 2)."""
    k = state.shape[0]
    radii = jnp.full(k + 1, radius).at[k].set(RADIUS)  # people take the robot for a disc of the paper's
    goal = state[:, :2] + _GOAL * geometry.heading(facing[:, 0])

    def advance(carried, given):
        place, velocity, yaw, rate = carried
        where, speed = given
        every = jnp.concatenate([place, where[None]])
        crowd = CrowdState(
            every,
            jnp.append(yaw, jnp.arctan2(speed[1], speed[0])),
            jnp.concatenate([velocity, speed[None]]),
            jnp.append(rate, 0.0),
            contacts.touching(every, boxes, radii),
            Traits(radius=radii),
        )
        goals = jnp.concatenate([goal, where[None] + speed[None]])
        command = model(crowd, boxes, goals, jnp.full(k + 1, lcf, jnp.float32))[:k]
        velocity, rate = command[:, :2], command[:, 2]
        place = place + _STEP * velocity
        return (place, velocity, yaw + _STEP * rate, rate), place

    speeds = jnp.diff(robot, axis=0) / _STEP
    start = (state[:, :2], state[:, 2:], facing[:, 0], facing[:, 1])
    places = jax.lax.scan(advance, start, (robot[:-1], speeds))[1]
    return jnp.concatenate([state[None, :, :2], places])
