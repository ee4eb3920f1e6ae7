"""Who touches whom: a geometric test, the same on all engines, so that scores don't depend on a solver's details."""

from macid import geometry
from macid.geometry import Array
from macid.state import CONTACT_GAP, RADIUS


def touching(position: Array, boxes: Array) -> Array:
    """Whether each person of `position` (..., K, 2) [m] is within CONTACT_GAP of another or of `boxes` (..., B, 5):
    (..., K)."""
    xp = position.__array_namespace__()
    people = xp.any(touching_people(position), axis=-1)
    to_boxes = geometry.point_box_distance(position, boxes[..., None, :, :])
    return people | xp.any(to_boxes <= RADIUS + CONTACT_GAP, axis=-1)


def touching_people(position: Array) -> Array:
    """Whether each two of the people at `position` (..., K, 2) [m] touch each other: (..., K, K), false on the
    diagonal."""
    return geometry.pairs_within(position, 2 * RADIUS + CONTACT_GAP)
