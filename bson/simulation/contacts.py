"""The robot's contacts, by geometry, so that scores don't depend on solver details: surfaces within CONTACT_GAP
touch."""

import numpy as np

from bson import robot
from bson.robot import RobotConfig
from macid import geometry
from macid.geometry import Array
from macid.state import CONTACT_GAP, PHYSICS_STEP, RADIUS

COUNTERS = ("collisions_person", "collisions_robot_on_person", "collisions_obstacle", "collisions_wall")
APPROACH = 0.05  # below this speed towards a person, the robot was run into by the person [m/s]


def person_gaps(pose: Array, people: Array, config: RobotConfig, radius: float = RADIUS) -> Array:
    """Surface gaps [m] from the robot's footprint at `pose` (..., 3) to people of `radius` [m] at `people` (..., K, 2):
    (..., K)."""
    box = robot.footprint(pose, config)[..., None, None, :]
    return geometry.point_box_distance(people, box)[..., 0] - radius


def touches_people(
    pose: Array, way: Array, people: Array, config: RobotConfig, radius: float = RADIUS
) -> tuple[Array, Array]:
    """Whether the robot touches a person, and whether it moves at more than APPROACH towards a person whom it touches:
    both (...).

    pose (..., 3): at the end of a physics step; way (..., 2) [m]: the robot's in that step; people (..., K, 2) [m], of
    `radius` [m]. World frame.
    """
    touched = person_gaps(pose, people, config, radius) <= CONTACT_GAP
    offset = people - pose[..., None, :2]
    closing = (way[..., None, :] * offset).sum(axis=-1) > APPROACH * PHYSICS_STEP * geometry.norm(offset)
    return touched.any(axis=-1), (touched & closing).any(axis=-1)


def touches_boxes(pose: np.ndarray, boxes: np.ndarray, config: RobotConfig) -> np.ndarray:
    """Whether the footprint at `pose` (n, s, 3) touches each of the boxes (n, B, 5) of its world: (n, s, B)."""
    box = robot.footprint(pose, config)
    boxes = np.broadcast_to(boxes[:, None], (*pose.shape[:2], *boxes.shape[1:]))
    close = geometry.point_box_distance(pose[..., :2], boxes) <= config.radius + CONTACT_GAP
    contacts = np.zeros(close.shape, bool)
    rows, steps, which = np.nonzero(close)
    if len(rows):
        gaps = geometry.box_box_gap(box[rows, steps], boxes[rows, steps, which][:, None])[:, 0]
        contacts[rows, steps, which] = gaps <= CONTACT_GAP
    return contacts
