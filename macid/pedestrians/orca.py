"""Pedestrians moved by optimal reciprocal collision avoidance: ORCA (van den Berg, Guy, Lin, Manocha, ISRR 2011).

A half-plane of velocities is a unit normal n (..., 2) and an offset c (...) [m/s]: v is permitted where n.v >= c.

The paper solves its linear programs line by line. Here all lines are solved at once, since in the plane the best
velocity is either the one asked for or the best point of one of the lines: no loop, and no order that matters.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from macid.geometry import Array, box_corners, norm, rotate
from macid.pedestrians.facing import STANDING, face_velocity
from macid.pedestrians.social_force import TINY, away_from_boxes, left_of, unit
from macid.state import MAX_SPEED, RADIUS, CrowdState

EPSILON = 1e-5  # of slopes and speeds in the linear programs [m/s], as in RVO2
NO_LIMIT = -1e3  # offset of a half-plane that permits every velocity [m/s]
CHUNK = 32  # people for whom `least_violation` is solved at a time


def _dot(a, b):
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


def _behind(value: Any, axes: int) -> Any:
    """`value`, a number, or an array (...) with `axes` more axes behind its own."""
    return value if np.isscalar(value) else jnp.expand_dims(value, tuple(range(-axes, 0)))


def _select(array, index):
    """Row `index` (...) of `array` (..., N, 2): (..., 2)."""
    return jnp.take_along_axis(array, index[..., None, None], axis=-2)[..., 0, :]


def permits(normal: Array, offset: Array, velocity: Array) -> Array:
    """Whether all half-planes (..., N) permit `velocity` (..., 2), up to EPSILON: (...)."""
    return jnp.all(_dot(normal, velocity[..., None, :]) >= offset - EPSILON, axis=-1)


def permitted_segments(normal: Array, offset: Array, top_speed: float) -> tuple[Array, Array, Array]:
    """The part of every line (..., N) that all the other half-planes and the disc of `top_speed` [m/s] permit.

    A point of line i is c_i n_i + t left_of(n_i). Returns the least and the greatest t (..., N) and whether there is
    one at all (..., N). Linear program 1 of the paper, for all lines.
    """
    half_chord = jnp.sqrt(jnp.maximum(top_speed**2 - offset**2, 0.0))
    here, other = normal[..., :, None, :], normal[..., None, :, :]
    slope = _dot(other, left_of(here))
    required = offset[..., None, :] - offset[..., :, None] * _dot(other, here)  # slope * t >= required
    parallel = jnp.abs(slope) < EPSILON
    bound = required / jnp.where(parallel, 1.0, slope)
    low = jnp.maximum(-half_chord, jnp.max(bound, axis=-1, where=slope >= EPSILON, initial=-jnp.inf))
    high = jnp.minimum(half_chord, jnp.min(bound, axis=-1, where=slope <= -EPSILON, initial=jnp.inf))
    excluded = jnp.any(parallel & (required > EPSILON), axis=-1)
    return low, high, (jnp.abs(offset) <= top_speed) & ~excluded & (low <= high + EPSILON)


def closest_permitted(normal: Array, offset: Array, target: Array, top_speed: float) -> tuple[Array, Array]:
    """The permitted velocity (..., 2) closest to `target` (..., 2), and whether there is any (...).

    Half-planes normal (..., N, 2), offset (..., N), and the disc of `top_speed` [m/s]. Linear program 2 of the paper.
    """
    in_disc = target * jnp.minimum(1.0, top_speed / jnp.maximum(norm(target), TINY))[..., None]
    low, high, exists = permitted_segments(normal, offset, top_speed)
    tangent = left_of(normal)
    along = jnp.clip(_dot(tangent, target[..., None, :]), low, high)
    points = offset[..., None] * normal + along[..., None] * tangent
    points = jnp.concatenate([in_disc[..., None, :], points], axis=-2)
    exists = jnp.concatenate([permits(normal, offset, in_disc)[..., None], exists], axis=-1)
    cost = jnp.where(exists, norm(points - target[..., None, :]), jnp.inf)
    return _select(points, jnp.argmin(cost, axis=-1)), jnp.any(exists, axis=-1)


def least_violation(normal: Array, offset: Array, hard: int, target: Array, top_speed: float) -> Array:
    """The velocity (..., 2) that violates the half-planes after the first `hard` ones the least, max c - n.v.

    The first `hard` half-planes and the disc of `top_speed` [m/s] hold; standing must be permitted by them, and is what
    comes out should rounding leave nothing. Linear program 3 of the paper: where half-plane i is the most violated one,
    which other half-planes' bisectors with i bound, the best velocity is as far along n_i as possible. Of equally good
    ones (a stretch between two opposite half-planes), the one nearest to `target` (..., 2) is taken.
    """
    soft_normal, soft_offset = normal[..., hard:, :], offset[..., hard:]
    soft = soft_offset.shape[-1]
    difference = soft_normal[..., None, :, :] - soft_normal[..., :, None, :]  # (..., i, j, 2)
    excess = soft_offset[..., None, :] - soft_offset[..., :, None]
    length = norm(difference)
    same = length < EPSILON
    never = jnp.where(excess > EPSILON, -NO_LIMIT, NO_LIMIT)
    bisector_offset = jnp.where(same, never, excess / jnp.where(same, 1.0, length))
    bisector = jnp.where(same[..., None], jnp.asarray([1.0, 0.0]), difference / jnp.maximum(length, EPSILON)[..., None])

    def for_every_region(hard_part):
        return jnp.broadcast_to(hard_part, (*offset.shape[:-1], soft, *hard_part.shape[offset.ndim :]))

    lines = jnp.concatenate([for_every_region(normal[..., None, :hard, :]), bisector], axis=-2)  # (..., i, N, 2)
    offsets = jnp.concatenate([for_every_region(offset[..., None, :hard]), bisector_offset], axis=-1)
    low, high, exists = permitted_segments(lines, offsets, top_speed)
    tangent = left_of(lines)
    gain = _dot(tangent, soft_normal[..., None, :])
    level = jnp.clip(_dot(tangent, target[..., None, None, :]), low, high)
    along = jnp.where(gain > EPSILON, high, jnp.where(gain < -EPSILON, low, level))
    points = offsets[..., None] * lines + along[..., None] * tangent

    furthest = top_speed * soft_normal
    points = jnp.concatenate([points, furthest[..., None, :]], axis=-2)
    exists = jnp.concatenate([exists, permits(lines, offsets, furthest)[..., None]], axis=-1)
    points = points.reshape(*offset.shape[:-1], -1, 2)
    exists = exists.reshape(*offset.shape[:-1], -1)
    violation = jnp.max(soft_offset[..., None, :] - _dot(soft_normal[..., None, :, :], points[..., None, :]), axis=-1)
    violation = jnp.where(exists, violation, jnp.inf)
    as_good = violation <= jnp.min(violation, axis=-1, keepdims=True) + EPSILON
    best = jnp.argmin(jnp.where(as_good, norm(points - target[..., None, :]), jnp.inf), axis=-1)
    return jnp.where(jnp.any(exists, axis=-1)[..., None], _select(points, best), 0.0)


def best_velocity(normal: Array, offset: Array, hard: int, target: Array, top_speed: float) -> Array:
    """Linear program 2, and linear program 3 for people for whom it has no answer: velocity (Q, 2) [m/s].

    normal (Q, N, 2), offset (Q, N), of which the first `hard` come from obstacles; target (Q, 2). Program 3 costs ten
    times as much, so it runs for CHUNK people at a time, as often as needed, and not at all where everybody has room.
    """
    people = target.shape[0]
    velocity, feasible = closest_permitted(normal, offset, target, top_speed)
    if offset.shape[-1] == hard:
        return jnp.where(feasible[:, None], velocity, 0.0)
    chunk = min(CHUNK, people)
    stuck = jnp.nonzero(~feasible, size=people + chunk, fill_value=people)[0]
    number = jnp.sum(~feasible)

    def some_left(carry):
        return carry[0] < number

    def solve_chunk(carry):
        first, velocity = carry
        index = jax.lax.dynamic_slice_in_dim(stuck, first, chunk)
        row = jnp.minimum(index, people - 1)
        solved = least_violation(normal[row], offset[row], hard, target[row], top_speed)
        return first + chunk, velocity.at[index].set(solved, mode="drop")

    return jax.lax.while_loop(some_left, solve_chunk, (jnp.zeros_like(number), velocity))[1]


@dataclass(frozen=True)
class ORCA:
    """Half the avoidance of every neighbour, all of the avoidance of obstacles, else straight to the goal.

    People: the paper's half-plane through v + u/2, with `1/period` in place of the horizon for people who overlap.
    Obstacles: v must leave the velocity obstacle of a disc against a box, which is convex, by the half-plane that
    touches it closest to the present v; full responsibility, and standing is always permitted. All decide at once,
    from the state alone.

    The preferred velocity leads to the goal at `preferred_speed`, no further than the goal within a period, and is
    turned by `veer` to the right, for everybody alike: without it, two who meet exactly head-on stand. The obstacle
    horizon is short, as walls don't turn towards anybody and a body stops within
    centimetres; it makes the approach speed to a wall (gap / horizon), and goals may lie close to walls.

    Three or more who meet from all sides lock all the same: each permits the others only to stand. So a person is
    blocked where other people, not boxes, let it get on towards its goal at less than `blocked` of its preferred speed.
    A blocked person asks for a velocity turned to the right by the first of `detours` instead, and, if that hardly
    moves it either, by the next. People who lock walk around each other, as on a roundabout, until their goals lie
    ahead; nobody else's step changes, and a person who faces a wall stands, as before. (RVO2's examples turn
    everybody's preferred velocity by a tiny random angle, which doesn't undo a lock.)
    """

    period: float = 0.02  #: between two decisions [s]
    preferred_speed: float = 1.34  #: as social force's [m/s]
    max_speed: float = MAX_SPEED  #: [m/s]
    radius: float = RADIUS  #: of everybody whose traits leave it open [m]
    margin: float = 0.02  #: added to the radius, since a body lags behind its command [m]
    neighbor_distance: float = 10.0  #: [m]
    max_neighbors: int = 10
    horizon: float = 5.0  #: for people [s]
    max_obstacles: int = 8  #: the nearest ones count
    obstacle_horizon: float = 1.0  #: [s]
    veer: float = 0.01  #: [rad]
    blocked: float = 0.2  #: share of the preferred speed
    detours: tuple[float, ...] = (1.3, 2.2)  #: [rad]

    def __call__(self, state: CrowdState, boxes: Array, goals: Array, lcf: Array | None = None) -> Array:
        """World-frame velocity [m/s] and yaw rate [rad/s]: (..., K, 3). `lcf` has no meaning here and is ignored.

        state (..., K), boxes (B, 5) or (..., B, 5), goals (..., K, 2) [m].
        """
        position, velocity = jnp.asarray(state.position, jnp.float32), jnp.asarray(state.velocity, jnp.float32)
        speed, most = state.speeds(self.preferred_speed, self.max_speed)
        radius = state.traits.radius
        preferred = self.preferred_velocity(position, jnp.asarray(goals, jnp.float32), speed)
        boxes = jnp.asarray(boxes, jnp.float32)
        box_normal, box_offset = self.obstacle_half_planes(position, velocity, boxes, radius, most)
        normal, offset = self.neighbor_half_planes(position, velocity, radius)
        hard, lines = box_offset.shape[-1], box_offset.shape[-1] + offset.shape[-1]
        normal = jnp.concatenate([box_normal, normal], axis=-2).reshape(preferred.size // 2, lines, 2)
        offset = jnp.concatenate([box_offset, offset], axis=-1).reshape(preferred.size // 2, lines)
        if np.isscalar(most):
            chosen = self.chosen_velocity(normal, offset, hard, preferred.reshape(-1, 2))
        else:  # in shares of everybody's top speed, as the programs have one for all
            top = jnp.reshape(most, (-1, 1))
            own = replace(self, max_speed=1.0)
            chosen = top * own.chosen_velocity(normal, offset / top, hard, preferred.reshape(-1, 2) / top)
        chosen = chosen.reshape(preferred.shape)
        return face_velocity(chosen, jnp.asarray(state.yaw, jnp.float32), self.period)

    def chosen_velocity(self, normal: Array, offset: Array, hard: int, preferred: Array) -> Array:
        """The velocity (Q, 2) [m/s] of people who prefer `preferred` (Q, 2): `best_velocity`, or a way around.

        normal (Q, N, 2), offset (Q, N), of which the first `hard` come from obstacles.
        """
        chosen = best_velocity(normal, offset, hard, preferred, self.max_speed)
        speed = norm(preferred)
        among_boxes, _ = closest_permitted(normal[:, :hard], offset[:, :hard], preferred, self.max_speed)
        slowed, walled = (_dot(v, unit(preferred)) < self.blocked * speed for v in (chosen, among_boxes))
        blocked = slowed & ~walled & (speed > STANDING)
        for angle in self.detours:
            asked = rotate(preferred, jnp.full_like(speed, -angle))
            limits = jnp.where(blocked[:, None], offset, NO_LIMIT)  # so the others cost nothing
            around = jax.lax.cond(
                jnp.any(blocked),
                lambda limits=limits, asked=asked: best_velocity(normal, limits, hard, asked, self.max_speed),
                lambda chosen=chosen: chosen,
            )
            chosen = jnp.where(blocked[:, None], around, chosen)
            blocked &= norm(chosen) < self.blocked * speed
        return chosen

    def preferred_velocity(self, position: Array, goals: Array, preferred_speed: Array | float | None = None) -> Array:
        """(..., K, 2) [m/s], world frame. preferred_speed: everybody's (..., K) [m/s], instead of its own."""
        to_goal = goals - position
        speed = self.preferred_speed if preferred_speed is None else preferred_speed
        speed = jnp.minimum(speed, norm(to_goal) / self.period)
        straight = speed[..., None] * unit(to_goal)
        return rotate(straight, jnp.full_like(speed, -self.veer))

    def neighbor_half_planes(
        self, position: Array, velocity: Array, radius: Array | None = None
    ) -> tuple[Array, Array]:
        """Half-planes (..., K, N, 2), (..., K, N) against the nearest neighbours, eq. 5: n.v >= n.(v_now + u/2).

        radius: everybody's (..., K) [m], instead of its own for all.
        """
        people = position.shape[-2]
        count = min(self.max_neighbors, people - 1)
        gap = norm(position[..., None, :, :] - position[..., :, None, :])
        gap = jnp.where(jnp.eye(people, dtype=bool), jnp.inf, gap)
        negative, index = jax.lax.top_k(-gap, count)
        distance = -negative
        ahead = jnp.take_along_axis(position[..., None, :, :], index[..., None], axis=-2) - position[..., :, None, :]
        closing = velocity[..., :, None, :] - jnp.take_along_axis(velocity[..., None, :, :], index[..., None], axis=-2)

        both = 2 * (self.radius + self.margin)
        if radius is not None:
            its = jnp.take_along_axis(jnp.broadcast_to(radius[..., None, :], gap.shape), index, axis=-1)
            both = radius[..., None] + its + 2 * self.margin
        overlapping = distance < both
        horizon = jnp.where(overlapping, self.period, self.horizon)
        from_cutoff = closing - ahead / horizon[..., None]  # w of the paper
        cutoff_length = norm(from_cutoff)
        lower_index = jnp.where(index > jnp.arange(people)[:, None], -1.0, 1.0)[..., None]  # coinciding people part
        apart = lower_index * jnp.asarray([1.0, 0.0])
        cutoff_normal = jnp.where(cutoff_length[..., None] < TINY, apart, unit(from_cutoff))
        along = _dot(from_cutoff, ahead)
        at_cutoff = overlapping | ((along < 0) & (along**2 > both**2 * cutoff_length**2))

        leg = jnp.sqrt(jnp.maximum(distance**2 - both**2, 0.0))[..., None]
        side = jnp.where(_dot(left_of(ahead), from_cutoff) > 0, 1.0, -1.0)[..., None]
        leg_normal = side * leg * left_of(ahead) - _behind(both, 1) * ahead
        leg_normal = leg_normal / jnp.maximum(distance, TINY)[..., None] ** 2

        normal = jnp.where(at_cutoff[..., None], cutoff_normal, leg_normal)
        change = jnp.where(at_cutoff, both / horizon - cutoff_length, -_dot(leg_normal, closing))  # u.n
        offset = _dot(normal, velocity[..., :, None, :]) + change / 2
        return normal, jnp.where(distance < self.neighbor_distance, offset, NO_LIMIT)

    def obstacle_half_planes(
        self,
        position: Array,
        velocity: Array,
        boxes: Array,
        radius: Array | None = None,
        max_speed: Array | float | None = None,
    ) -> tuple[Array, Array]:
        """Half-planes (..., K, M, 2), (..., K, M) against the nearest boxes.

        radius, max_speed: everybody's (..., K) [m], [m/s], instead of its own for all.

        With C the box widened by the radius and seen from the person, the velocities that hit it within the horizon T
        are the convex set of the C / t, t <= T. Its half-planes outside are n.v >= h(n) / T for every n with h(n) <= 0,
        h(n) = max over corners of n.corner, plus the radius. The one to use has the greatest n.v - h(n) / T, which is
        v's signed distance to the set. It is among the normals of the box's sides, of the arcs around its corners
        as seen from v, and of the tangents from the person to those arcs. A person who touches the box has none of
        these, and must not go on towards its closest point.
        """
        count = min(self.max_obstacles, boxes.shape[-2])
        if count == 0:
            shape = (*position.shape[:-1], 0)
            return jnp.zeros((*shape, 2)), jnp.zeros(shape)
        boxes = boxes.reshape((1,) * (position.ndim - boxes.ndim) + boxes.shape)
        wide: Any = (self.radius if radius is None else radius) + self.margin
        top_speed: Any = self.max_speed if max_speed is None else max_speed
        distance, away = away_from_boxes(position, boxes[..., None, :, :])
        negative, index = jax.lax.top_k(-distance, count)
        distance, away = -negative, jnp.take_along_axis(away, index[..., None], axis=-2)

        axis = jnp.stack([jnp.cos(boxes[..., 4]), jnp.sin(boxes[..., 4])], axis=-1)
        outline = jnp.concatenate([box_corners(boxes), axis[..., None, :]], axis=-2)  # (..., B, 5, 2)
        outline = outline.reshape(*boxes.shape[:-1], 10)
        outline = jnp.take_along_axis(outline[..., None, :, :], index[..., None], axis=-2)
        outline = outline.reshape(*index.shape, 5, 2)
        corner, axis = outline[..., :4, :] - position[..., None, None, :], outline[..., 4, :]  # (..., K, M, 4, 2)

        v = velocity[..., None, None, :]
        side = jnp.stack([axis, left_of(axis), -axis, -left_of(axis)], axis=-2)
        arc = unit(v - corner / self.obstacle_horizon)
        squared = _dot(corner, corner)
        leg = jnp.sqrt(jnp.maximum(squared - _behind(wide**2, 2), 0.0))[..., None] * left_of(corner)
        back, squared = -_behind(wide, 3) * corner, jnp.maximum(squared, _behind(wide**2, 2))[..., None]
        tangent = jnp.concatenate([(back + leg) / squared, (back - leg) / squared], axis=-2)
        normal = jnp.concatenate([away[..., None, :], side, arc, tangent], axis=-2)  # (..., K, M, 17, 2)
        reach = jnp.max(_dot(normal[..., :, None, :], corner[..., None, :, :]), axis=-1) + _behind(wide, 2)  # h(n)

        is_normal = jnp.abs(_dot(normal, normal) - 1.0) < 1e-3
        outside = _dot(normal, v) - reach / self.obstacle_horizon
        outside = jnp.where(is_normal & (reach <= 1e-4), outside, -jnp.inf)
        best = jnp.argmax(outside, axis=-1)  # the first, away from the closest point, where there is none
        offset = jnp.minimum(jnp.take_along_axis(reach, best[..., None], axis=-1)[..., 0], 0.0) / self.obstacle_horizon
        in_reach = distance < _behind(self.obstacle_horizon * top_speed + wide, 1)
        return _select(normal, best), jnp.where(in_reach, offset, NO_LIMIT)
