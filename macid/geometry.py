"""Planar geometry on arrays: frames, angles, distances, and rays against discs and boxes.

Every function takes NumPy or JAX arrays and answers in kind (the array API's namespace), so that one text serves the
jitted training loop, the benchmark's bookkeeping and the tests.

Frames: the world frame has x to the right and y up the map, angles counter-clockwise from +x [rad]. A body frame has
x ahead and y to the left. A box is a row `(x, y, half_x, half_y, yaw)` [m, m, m, m, rad].
"""

import math
from typing import Any, TypeAlias

Array: TypeAlias = Any  #: in signatures: an array of NumPy or of JAX
BOX_COLUMNS = ("x", "y", "half_x", "half_y", "yaw")
NO_HIT = math.inf


def _namespace(array):
    return array.__array_namespace__()


def wrap_angle(angle: Array) -> Array:
    """`angle` [rad], any shape, brought into [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def heading(yaw: Array) -> Array:
    """The unit vector (..., 2) ahead of bodies at `yaw` (...) [rad]."""
    xp = _namespace(yaw)
    return xp.stack([xp.cos(yaw), xp.sin(yaw)], axis=-1)


def from_frame(vector: Array, ahead: Array) -> Array:
    """`vector` (..., 2) of a frame whose x axis is the unit vector `ahead` (..., 2): seen from outside, (..., 2)."""
    x, y, c, s = vector[..., 0], vector[..., 1], ahead[..., 0], ahead[..., 1]
    return _namespace(vector).stack([c * x - s * y, s * x + c * y], axis=-1)


def to_frame(vector: Array, ahead: Array) -> Array:
    """`vector` (..., 2) seen in a frame whose x axis is the unit vector `ahead` (..., 2): (..., 2)."""
    x, y, c, s = vector[..., 0], vector[..., 1], ahead[..., 0], ahead[..., 1]
    return _namespace(vector).stack([c * x + s * y, c * y - s * x], axis=-1)


def rotate(vector: Array, angle: Array) -> Array:
    """`vector` (..., 2) turned by `angle` (...) [rad], counter-clockwise. Body frame to world frame for a body's
    yaw."""
    return from_frame(vector, heading(angle))


def yaw_quaternion(yaw: Array) -> Array:
    """Quaternion (..., 4), w first, of a turn by `yaw` (...) [rad] about the vertical."""
    xp = _namespace(yaw)
    zero = xp.zeros_like(yaw)
    return xp.stack([xp.cos(yaw / 2), zero, zero, xp.sin(yaw / 2)], axis=-1)


def to_body(vector: Array, yaw: Array) -> Array:
    """World-frame `vector` (..., 2) seen from bodies at `yaw` (...) [rad]: (..., 2), body frame."""
    return to_frame(vector, heading(yaw))


def norm(vector: Array) -> Array:
    """Length (...) of `vector` (..., 2)."""
    xp = _namespace(vector)
    return xp.sqrt(vector[..., 0] ** 2 + vector[..., 1] ** 2)


def pairs_within(position: Array, distance: Array | float) -> Array:
    """Which of the points `position` (..., K, 2) are at most `distance` apart, one number or (..., K, K): (..., K, K)
    bool, False for a point and itself."""
    xp = _namespace(position)
    offset = position[..., :, None, :] - position[..., None, :, :]
    squared = offset[..., 0] ** 2 + offset[..., 1] ** 2
    return (squared <= distance**2) & ~xp.eye(position.shape[-2], dtype=bool)


def time_to_collision(position: Array, velocity: Array, reach: Array | float, grazing: bool = False) -> Array:
    """When two discs that keep their velocities touch [s] (...), the least t >= 0 with |position + velocity t| = reach:
    infinity for never, 0 where they overlap.

    position, velocity (..., 2): of the other's centre, less one's own [m, m/s]; reach (...): the radii's sum [m].
    grazing: whether discs that graze each other touch; there the time has no gradient.
    """
    xp = _namespace(position)
    a = velocity[..., 0] ** 2 + velocity[..., 1] ** 2
    b = position[..., 0] * velocity[..., 0] + position[..., 1] * velocity[..., 1]
    c = position[..., 0] ** 2 + position[..., 1] ** 2 - reach**2
    discriminant = b**2 - a * c
    met = (b < 0) & (discriminant >= 0 if grazing else discriminant > 0)
    root = xp.sqrt(xp.where(met, discriminant, xp.ones_like(discriminant)))
    # c / (root - b) is the lesser root of a t^2 + 2 b t + c, without the cancellation in -b - root.
    time = c / xp.where(met, root - b, xp.ones_like(b))
    time = xp.where(met, time, xp.full_like(time, math.inf))
    return xp.where(c <= 0, xp.zeros_like(time), time)


def in_box_frame(point: Array, boxes: Array) -> Array:
    """`point` (..., 2) in the frame of each of `boxes` (..., B, 5): (..., B, 2) [m]."""
    return to_body(point[..., None, :] - boxes[..., :2], boxes[..., 4])


def point_box_distance(point: Array, boxes: Array) -> Array:
    """Distance [m] from `point` (..., 2) to each of `boxes` (..., B, 5): (..., B); 0 inside."""
    xp = _namespace(point)
    outside = xp.abs(in_box_frame(point, boxes)) - boxes[..., 2:4]
    return norm(xp.maximum(outside, xp.zeros_like(outside)))


def box_corners(boxes: Array) -> Array:
    """Corners of `boxes` (..., B, 5), counter-clockwise: (..., B, 4, 2), world frame [m]."""
    xp = _namespace(boxes)
    sign = xp.asarray([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]], dtype=boxes.dtype)
    local = sign * boxes[..., None, 2:4]
    return rotate(local, boxes[..., None, 4]) + boxes[..., None, :2]


def box_box_gap(box: Array, boxes: Array) -> Array:
    """Distance [m] between the rectangle `box` (..., 5) and each of `boxes` (..., B, 5): (..., B); 0 where they
    overlap.

    Two convex polygons that don't overlap are closest at a corner of one of them; they overlap where no side of either
    separates them (separating axis theorem).
    """
    xp = _namespace(box)
    one = box[..., None, :]  # (..., 1, 5)
    corners, other_corners = box_corners(one), box_corners(boxes)

    def outside(points, frame):  # points in the rectangle's own frame, and half its sides: outside is beyond these
        return to_body(points - frame[..., None, :2], frame[..., None, 4]), frame[..., None, 2:4]

    local_one, half_other = outside(corners, boxes)
    local_other, half_one = outside(other_corners, one)

    def corner_distance(local, half):
        beyond = xp.abs(local) - half
        return xp.min(norm(xp.maximum(beyond, xp.zeros_like(beyond))), axis=-1)

    def separated(local, half):
        return xp.any((xp.min(local, axis=-2) > half[..., 0, :]) | (xp.max(local, axis=-2) < -half[..., 0, :]), axis=-1)

    gap = xp.minimum(corner_distance(local_one, half_other), corner_distance(local_other, half_one))
    apart = separated(local_one, half_other) | separated(local_other, half_one)
    return xp.where(apart, gap, xp.zeros_like(gap))


def ray_disc_distance(origin: Array, direction: Array, centre: Array, radius: Array) -> Array:
    """How far rays run before they meet discs.

    origin (..., 2), unit direction (..., R, 2), centre (..., N, 2), radius () or (..., N), one frame [m].
    Returns (..., R, N) [m]: infinity where a ray misses. A ray that starts inside a disc does not see it.
    """
    xp = _namespace(origin)
    offset = centre - origin[..., None, :]  # (..., N, 2)
    along = direction[..., :, None, 0] * offset[..., None, :, 0] + direction[..., :, None, 1] * offset[..., None, :, 1]
    squared = (offset[..., 0] ** 2 + offset[..., 1] ** 2 - radius**2)[..., None, :]
    discriminant = along**2 - squared
    distance = along - xp.sqrt(xp.maximum(discriminant, xp.zeros_like(discriminant)))
    return xp.where((discriminant >= 0) & (distance > 0), distance, xp.full_like(distance, NO_HIT))


def first_disc(origin: Array, direction: Array, centre: Array, radius: Array) -> tuple[Array, Array]:
    """How far rays run before they meet a disc (..., R) [m], infinity for a miss, and which disc: its index (..., R).

    Arguments as in `ray_disc_distance`. The distance falls short by at most N parts in 2^23 (float32).
    """
    xp = _namespace(origin)
    distance = ray_disc_distance(origin, direction, centre, radius)
    # A distance's last bits give way to the disc's index, so that one minimum finds both (numbers above zero order as
    # their bits do): XLA makes one fused loop of it, and several slow passes of an argmin or of a mask.
    integers = {2: xp.int16, 4: xp.int32, 8: xp.int64}[distance.dtype.itemsize]
    mask = (1 << (centre.shape[-2] - 1).bit_length()) - 1
    numbered = (distance.view(integers) & ~mask) | xp.arange(centre.shape[-2], dtype=integers)
    least = xp.min(numbered, axis=-1)
    return (least & ~mask).view(distance.dtype), least & mask


def ray_box_distance(origin: Array, direction: Array, boxes: Array) -> Array:
    """How far rays run before they meet boxes, by the slab method.

    origin (..., 2), unit direction (..., R, 2), boxes (..., B, 5), one frame [m].
    Returns (..., R, B) [m]: infinity where a ray misses. A ray that starts inside a box does not see it.
    """
    xp = _namespace(origin)
    local_origin = in_box_frame(origin, boxes)[..., None, :, :]  # (..., 1, B, 2)
    yaw = boxes[..., None, :, 4]
    local_direction = to_body(direction[..., :, None, :], yaw)  # (..., R, B, 2)
    tiny = 1e-9
    safe = xp.where(xp.abs(local_direction) < tiny, xp.full_like(local_direction, tiny), local_direction)
    middle, reach = -local_origin / safe, boxes[..., None, :, 2:4] / xp.abs(safe)
    near, far = middle - reach, middle + reach
    enter = xp.maximum(near[..., 0], near[..., 1])
    leave = xp.minimum(far[..., 0], far[..., 1])
    return xp.where((enter <= leave) & (enter > 0), enter, xp.full_like(enter, NO_HIT))
