"""Who touches whom: a geometric test, the same on all engines, so that scores don't depend on a solver's details."""

from macid import geometry
from macid.geometry import Array
from macid.state import CONTACT_GAP, RADIUS


def touching(position: Array, boxes: Array, radius: Array | float = RADIUS) -> Array:
    """Whether each person of `position` (..., K, 2) [m] is within CONTACT_GAP of another or of `boxes` (..., B, 5):
    (..., K). radius: of each person (..., K), or one number for all [m]."""
    xp = position.__array_namespace__()
    people = xp.any(touching_people(position, radius), axis=-1)
    to_boxes = geometry.point_box_distance(position, boxes[..., None, :, :])
    reach = radius + CONTACT_GAP
    return people | xp.any(to_boxes <= (reach if isinstance(reach, (int, float)) else reach[..., None]), axis=-1)


def touching_people(position: Array, radius: Array | float = RADIUS) -> Array:
    """Whether each two of the people at `position` (..., K, 2) [m] touch each other: (..., K, K), false on the
    diagonal. radius: as of `touching`."""
    both = 2 * radius if isinstance(radius, (int, float)) else radius[..., :, None] + radius[..., None, :]
    return geometry.pairs_within(position, both + CONTACT_GAP)
