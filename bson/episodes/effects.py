"""The effects of a robot on people, measured on a pair: the robot's episode, and the same people for as long without
the robot."""

from typing import Any

import numpy as np

from macid import geometry
from macid.state import CONTACT_GAP, GOAL_RADIUS

SOCIAL_SPACE = 3.6  # people within this distance count as met, surface to surface [m]


def _first_ways(people, goals):
    """The control step (K,) at which people (T + 1, K, 3) reach their `goals` (K, 2), the last step where they never
    do; and the metres (K,) walked until then that brought them no closer."""
    distance = geometry.norm(people[..., :2] - goals)
    there = distance <= GOAL_RADIUS
    step = np.where(there.any(axis=0), there.argmax(axis=0), len(people) - 1)
    walked = np.concatenate([0 * distance[:1], np.cumsum(geometry.norm(np.diff(people[..., :2], axis=0)), axis=0)])
    who = np.arange(people.shape[1])
    return step, walked[step, who] - (distance[0] - distance[step, who])


def _contacts(people, who, radius):
    """The number (K,) of control steps after which each of the people `who` (K,) bool touches another of `people` (T +
    1, K, 3), all of `radius` [m]."""
    places, steps = people[1:, :, :2], np.zeros(people.shape[1], int)
    for person in np.flatnonzero(who):
        apart = geometry.norm(places - places[:, person, None])
        apart[:, person] = np.inf
        steps[person] = (apart.min(axis=-1) <= 2 * radius + CONTACT_GAP).sum()
    return steps


def _met(episode):
    """Whether the robot came near each person (K,), within SOCIAL_SPACE as discs, before the person's first goal was
    reached."""
    apart = geometry.norm(episode.people[..., :2] - episode.pose[:, None, :2])
    near = apart < SOCIAL_SPACE + episode.robot_radius + episode.person_radius
    return near.any(axis=0) & (near.argmax(axis=0) <= _first_ways(episode.people, episode.people_goals)[0])


def find_effects(episode: Any) -> dict[str, np.ndarray]:
    """The robot's effects on each person whom it met on the way to that person's first goal: {name: (K,)}, NaN for all
    other people. {} where the Episode has no pair (people_alone).

    delay [s]: how much later the person reaches the goal than without the robot. A person who gets there in one of the
    two runs only counts as arriving at the end of the other; a person who gets there in neither has NaN. detour [m]:
    how much farther the person walks to the goal, beyond the metres that bring the person closer. added_contact [s]:
    how much longer the person touches other people, over the whole episode.
    """
    if episode.people_alone is None:
        return {}
    both = episode.people, episode.people_alone
    (step, way), (step_alone, way_alone) = (_first_ways(people, episode.people_goals) for people in both)
    met = _met(episode)
    contacts, contacts_alone = (_contacts(people, met, episode.person_radius) for people in both)
    there = np.minimum(step, step_alone) < len(episode.people) - 1
    return {
        "delay": np.where(met & there, (step - step_alone) * episode.period, np.nan),
        "detour": np.where(met, way - way_alone, np.nan),
        "added_contact": np.where(met, (contacts - contacts_alone) * episode.period, np.nan),
    }
