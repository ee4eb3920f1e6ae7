"""Pedestrians moved by the social force model of Helbing and Molnar (Phys. Rev. E 51, 4282, 1995)."""

import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from macid.geometry import Array, in_box_frame, norm, rotate
from macid.pedestrians.facing import face_velocity
from macid.state import MAX_SPEED, PHYSICS_STEP, RESPONSE, CrowdState

TINY = 1e-6  # lengths below this have no direction [m]
_CLOSEST = 0.02  # people who touch count as this far apart [m]


def unit(vector: Array) -> Array:
    """Direction of `vector` (..., 2); zero where it is shorter than TINY."""
    length = norm(vector)[..., None]
    return jnp.where(length < TINY, 0.0, vector / jnp.maximum(length, TINY))


def left_of(vector: Array) -> Array:
    """`vector` (..., 2) turned by a quarter turn counter-clockwise."""
    return jnp.stack([-vector[..., 1], vector[..., 0]], axis=-1)


def away_from_boxes(point: Array, boxes: Array) -> tuple[Array, Array]:
    """Distance [m] from `point` (..., 2) to each of `boxes` (..., B, 5), and the direction away from it.

    Returns (..., B) and unit vectors (..., B, 2), world frame. Inside and on the boundary the distance is 0 and the
    direction is the normal of the nearest side.
    """
    local = in_box_frame(point, boxes)
    side = jnp.where(local < 0, -1.0, 1.0)
    beyond = jnp.abs(local) - boxes[..., 2:4]
    outside = jnp.maximum(beyond, 0.0)
    distance = norm(outside)
    x_side_nearer = beyond[..., :1] >= beyond[..., 1:]
    nearest_side = jnp.concatenate([x_side_nearer, ~x_side_nearer], axis=-1).astype(point.dtype)
    direction = side * jnp.where(distance[..., None] < TINY, nearest_side, unit(outside))
    return distance, rotate(direction, jnp.broadcast_to(boxes[..., 4], distance.shape))


def ellipse(r: Array, step: Array) -> tuple[Array, Array]:
    """Semi-minor axis b (...) [m] of Helbing's ellipse, eq. 4, and its gradient by r (..., 2).

    r (..., 2) leads from the other person, one focus, to oneself; the other focus is where it will be after `step`
    (..., 2) [m]: 2b = sqrt((|r| + |q|)^2 - |step|^2) with q = r - step. In a form that float32 bears,

        (2b)^2 = 2 (|r||q| + r.q),   grad b = (|r| + |q|) / (2 sqrt(|r||q|)) * (the bisector of r and q).

    Between the foci b is 0 and has a crease; there the bisector points to the left of the step, which is to the right
    of a person who walks towards it. This decides exact head-on encounters.
    """
    q = r - step
    r_length, q_length = jnp.maximum(norm(r), TINY), jnp.maximum(norm(q), TINY)
    product = r_length * q_length
    dot = jnp.sum(r * q, axis=-1)
    cross = r[..., 0] * q[..., 1] - r[..., 1] * q[..., 0]
    opposite = dot < 0
    squared = jnp.where(opposite, cross**2 / (product + jnp.abs(dot)), product + dot)  # equal, without cancellation
    b = jnp.sqrt(0.5 * squared)
    r_unit, q_unit = unit(r), unit(q)
    turn = jnp.where(cross >= -TINY * product, 1.0, -1.0)[..., None]
    bisector = unit(jnp.where(opposite[..., None], turn * left_of(r_unit - q_unit), r_unit + q_unit))
    return b, ((r_length + q_length) / (2 * jnp.sqrt(product)))[..., None] * bisector


@dataclass(frozen=True)
class SocialForce:
    """acceleration = (v0 e - v) / tau - sum_b w grad_r V(b) - sum_B grad U(d), with e the direction to the goal.

    V(b) = V0 exp(-b / sigma) of `ellipse`, U(d) = U0 exp(-d / R), and w = 1 for what pushes from within the field of
    view around e, 0.5 elsewhere: eqs. 1 to 9 with the published constants.

    As published, people are points: r leads from centre to centre, d from a centre to an obstacle's surface. Bodies of
    0.35 m that are driven so push each other; with `body_radius` = 0.35 m, or people's own radii where they have them,
    r counts from surface to surface, as in many simulators, and they hardly touch.

    Another person's next step is |v_b| dt long, with |v_b| its speed, and lies in the direction e_b in which it wants
    to go, as published. A robot among the people whose goal nobody is to know gets `position + velocity` for a goal.

    With `step_by_progress` the step's length is max(0, v_b . e_b) dt instead, the same for a person who gets where it
    wants: with |v_b|, two people who meet in close quarters can lock and drift off together, each taking the drift for
    the other's step. On the maps for validation (v1 to v4) that, and no more, raises arrivals from 62, 70, 45, 29% to
    71, 77, 61, 40%, and lowers CP from 145, 148, 331, 429 to 87, 102, 233, 338. The model `social-force` is as
    published, `social-force-progress` has the other step, and so has `social-force-bodies`, where it counts for more:
    arrivals there are 69, 69, 52, 34%, with the published step 54, 49, 29, 15%, and CP 0.0 to 0.3 instead of 0.2 to
    9.6.

    Where this differs from the paper: everybody has the mean desired speed instead of a Gaussian one; speed is capped
    at 1.3 v0 (1.74 m/s) or MAX_SPEED, whichever is less; no attraction; and in place of fluctuations e is turned by
    `veer` to the right, as exact head-on encounters end in a standstill without.
    """

    period: float = 0.02  #: between two decisions [s]
    desired_speed: float = 1.34  #: v0 [m/s]
    top_speed_ratio: float = 1.3  #: speed cap / v0
    max_speed: float = MAX_SPEED  #: [m/s]
    relaxation_time: float = 0.5  #: tau [s]
    person_strength: float = 2.1  #: V0 [m2/s2]
    person_range: float = 0.3  #: sigma [m]
    step_time: float = 2.0  #: dt, how far ahead another's step reaches [s]
    obstacle_strength: float = 10.0  #: U0 [m2/s2]
    obstacle_range: float = 0.2  #: R [m]
    field_of_view: float = 200.0  #: 2 phi [deg]
    unseen_weight: float = 0.5  #: c
    step_by_progress: bool = False  #: another's step follows from its speed towards its goal, not from its speed
    veer: float = 0.01  #: [rad]
    body_radius: float = 0.0  #: taken off each person's side of distances between people [m]; above 0: its own, if any
    response: float = RESPONSE  #: time constant with which the body follows a commanded velocity [s]

    @property
    def lead(self) -> float:
        """By how much a command must lead the velocity per acceleration [s], for the body to get that acceleration.

        A body with the time constant T makes up 1 - (T / (T + h))^n of the difference in n implicit steps of h.
        """
        missed = (self.response / (self.response + PHYSICS_STEP)) ** round(self.period / PHYSICS_STEP)
        return self.period / (1.0 - missed)

    def __call__(self, state: CrowdState, boxes: Array, goals: Array, lcf: Array | None = None) -> Array:
        """World-frame velocity [m/s] and yaw rate [rad/s]: (..., K, 3). `lcf` has no meaning here and is ignored.

        state (..., K), boxes (B, 5) or (..., B, 5), goals (..., K, 2) [m]. The command is v + acceleration * lead.
        """
        velocity = jnp.asarray(state.velocity, jnp.float32)
        command = velocity + self.acceleration(state, boxes, goals) * self.lead
        desired, most = state.speeds(self.desired_speed, self.max_speed)
        top_speed = self.top_speed_ratio * desired
        top_speed = min(top_speed, most) if np.isscalar(top_speed) else jnp.minimum(top_speed, most)
        command = command * jnp.minimum(1.0, top_speed / jnp.maximum(norm(command), TINY))[..., None]
        return face_velocity(command, jnp.asarray(state.yaw, jnp.float32), self.period)

    def acceleration(self, state: CrowdState, boxes: Array, goals: Array) -> Array:
        """Sum of the social forces (..., K, 2) [m/s2]."""
        position, velocity = jnp.asarray(state.position, jnp.float32), jnp.asarray(state.velocity, jnp.float32)
        straight = unit(jnp.asarray(goals, jnp.float32) - position)
        direction = rotate(straight, jnp.full(straight.shape[:-1], -self.veer))
        desired, _ = state.speeds(self.desired_speed, self.max_speed)
        desired = desired if np.isscalar(desired) else jnp.asarray(desired)[..., None]
        drive = (desired * direction - velocity) / self.relaxation_time
        people = self._from_people(position, velocity, direction, state.traits.radius)
        return drive + people + self._from_boxes(position, jnp.asarray(boxes, jnp.float32))

    def _from_people(self, position, velocity, direction, radius):
        apart = 2 * self.body_radius
        if self.body_radius and radius is not None:
            apart = radius[..., :, None] + radius[..., None, :]
        r = position[..., :, None, :] - position[..., None, :, :]  # (..., K, K, 2) from the second to the first
        r = unit(r) * jnp.maximum(norm(r) - apart, _CLOSEST)[..., None]
        progress = jnp.maximum(jnp.sum(velocity * direction, axis=-1), 0.0)
        speed = progress if self.step_by_progress else norm(velocity)
        step = speed[..., None] * self.step_time * direction
        b, gradient = ellipse(r, step[..., None, :, :])
        steepness = self.person_strength / self.person_range * jnp.exp(-b / self.person_range)
        force = steepness[..., None] * gradient  # -grad V
        towards_it = -jnp.sum(direction[..., :, None, :] * force, axis=-1)
        seen = towards_it >= norm(force) * math.cos(math.radians(self.field_of_view / 2))
        weight = jnp.where(seen, 1.0, self.unseen_weight) * (1.0 - jnp.eye(position.shape[-2], dtype=jnp.float32))
        return jnp.sum(weight[..., None] * force, axis=-2)

    def _from_boxes(self, position, boxes):
        distance, away = away_from_boxes(position, boxes[..., None, :, :])
        steepness = self.obstacle_strength / self.obstacle_range * jnp.exp(-distance / self.obstacle_range)
        return jnp.sum(steepness[..., None] * away, axis=-2)
