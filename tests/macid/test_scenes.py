"""The scenes in which people learn to walk like people, and what it costs them there (macid.learning.scenes)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from macid.layout import clearance
from macid.learning import scenes
from macid.learning.scene_trainer import SceneConfig, collision_energy, costs
from macid.state import CrowdState, Traits

RADIUS = 0.2
CONFIG = SceneConfig()
NO_BOXES = np.zeros((1, 5), np.float32) + np.float32([90.0, 90.0, 0.1, 0.1, 0.0])


@pytest.mark.parametrize("name", sorted(scenes.SCENES))
def test_a_scene_has_room_and_its_gates_lead_on(name):
    which = scenes.SCENES[name]
    drawn = scenes.draw(which, np.random.default_rng(3), 3, RADIUS, companions=0.5)
    for position, gates, first, group in zip(*drawn, strict=True):
        apart = np.linalg.norm(position[:, None] - position, axis=-1)
        assert apart[~np.eye(len(position), dtype=bool)].min() >= 2 * RADIUS
        here = np.abs(position).max(axis=-1) < which.layout.size
        assert which.fewest <= here.sum() <= which.number
        gate = gates[np.arange(len(first)), first]
        leads = group == np.arange(len(group))
        assert not scenes.passed(gate, position)[leads].any()
        aim = scenes.goal(gate, position)
        assert scenes.passed(gate[gate[:, 4] > 0], aim[gate[:, 4] > 0]).all()  # one who gets there is through
        assert (group <= np.arange(len(group))).all()


def test_the_ways_of_the_scene_with_boxes_lead_everybody_to_every_place_past_them():
    which = scenes.SCENES["boxes"]
    rng = np.random.default_rng(5)
    half = which.layout.size / 2 - 0.5
    start = rng.uniform(-half, half, (400, 2))
    start = start[clearance(start, which.layout.boxes) > 0.4]
    gate = np.tile([0.0, 0.0, 1.0, 0.0, 0.0], (len(start), 1))
    gate[:, :2] = which.places[rng.integers(len(which.places), size=len(start))]
    position, least = start.copy(), np.full(len(start), np.inf)
    for _ in range(450):
        goals = scenes.goal(gate, position)
        left = np.linalg.norm(goals - position, axis=-1, keepdims=True)
        along = scenes.ahead(which.ways, which.places, gate, position, goals)
        position = position + np.minimum(0.08, left) * along
        least = np.minimum(least, clearance(position, which.layout.boxes))
    assert np.linalg.norm(gate[:, :2] - position, axis=-1).max() < 0.01
    assert (least > 0.1).mean() > 0.95  # hardly anybody is led along a box's very edge
    assert np.linalg.norm(along, axis=-1) == pytest.approx(np.where(left[:, 0] > 1e-6, 1.0, 0.0), abs=1e-5)


def test_a_scene_without_places_leads_straight():
    which = scenes.SCENES["crossing"]
    gate = np.float32([[9.5, 0, 1, 0, 2.0]])
    position = np.float32([[0.0, 1.0]])
    goals = scenes.goal(gate, position)
    along = scenes.ahead(which.ways, np.empty((0, 2)), gate, position, goals)
    assert along == pytest.approx((goals - position) / np.linalg.norm(goals - position))


# --- what a collision course costs


def energy(position, velocity):
    return float(collision_energy(jnp.asarray(position), jnp.asarray(velocity), jnp.asarray(2 * RADIUS), CONFIG))


def test_only_who_comes_closer_costs_and_the_sooner_the_more():
    ahead = [energy([distance, 0.1], [-1.5, 0.0]) for distance in (1.0, 2.0, 4.0, 8.0)]
    assert ahead == sorted(ahead, reverse=True) and ahead[-1] > 0
    assert energy([2.0, 0.1], [1.5, 0.0]) == 0.0  # goes away
    assert energy([4.0, 2 * RADIUS + CONFIG.reach + 0.01], [-1.5, 0.0]) == 0.0  # passes with room


def test_the_slope_of_a_collision_course_leads_aside_even_near_its_middle():
    slope = jax.grad(lambda p: collision_energy(p, jnp.asarray([-2.6, 0.0]), jnp.asarray(2 * RADIUS), CONFIG))
    for aside in (0.02, 0.1, 0.2, 0.3):
        left, right = slope(jnp.asarray([4.0, aside])), slope(jnp.asarray([4.0, -aside]))
        assert left[1] < -0.05 and right[1] == pytest.approx(-left[1])  # the other one's place: farther aside is better
        assert left[0] == pytest.approx(right[0]) and left[0] < 0


def crowd(position, velocity, group=None):
    """A crowd of one world whose people want 1.3 m/s."""
    position, velocity = np.float32([position]), np.float32([velocity])
    shape = position.shape[:2]
    group = np.arange(shape[1]) if group is None else np.asarray(group)
    traits = Traits(
        np.full(shape, RADIUS, np.float32),
        np.full(shape, 1.3, np.float32),
        np.full(shape, 2.0, np.float32),
        group[None],
    )
    zero = np.zeros(shape, np.float32)
    return CrowdState(position, zero, velocity, zero, np.zeros(shape, bool), traits)


def cost(before, after, ahead=(1.0, 0.0)):
    along = np.broadcast_to(np.float32(ahead), before.position.shape)
    found = costs(before, after, along, NO_BOXES, 0.1, CONFIG)
    return {name: np.asarray(each)[0] for name, each in found.items()}


def test_who_walks_alone_as_wanted_has_no_cost_and_who_stands_misses_its_pace():
    walks = crowd([[0, 0]], [[1.3, 0]])
    assert all(each == pytest.approx(0.0, abs=1e-6) for each in cost(walks, walks).values())
    stands = crowd([[0, 0]], [[0, 0]])
    assert cost(stands, stands)["pace"] == pytest.approx(1.0)
    aside = crowd([[0, 0]], [[1.3, 1.3]])
    assert cost(aside, aside)["aside"] == pytest.approx(1.0) and cost(aside, aside)["pace"] == pytest.approx(0.0)
    assert cost(stands, walks)["change"] == pytest.approx((1.3 / 0.1) ** 2)


def test_companions_cost_nothing_on_a_common_course_and_something_apart():
    near = crowd([[0, 0], [1.5, 0]], [[1.3, 0], [0.5, 0]], group=[0, 0])
    strangers = crowd([[0, 0], [1.5, 0]], [[1.3, 0], [0.5, 0]])
    assert cost(near, near)["meet"].max() == 0.0 < cost(strangers, strangers)["meet"].min()
    assert cost(near, near)["apart"] == pytest.approx([0.5, 0.5], abs=1e-3)
    assert cost(strangers, strangers)["apart"].max() == 0.0


def test_a_crowd_around_makes_a_collision_course_cost_less_and_headway_is_for_who_walks_behind():
    pair = [[0, 0], [2.5, 0.1]], [[1.3, 0], [-1.3, 0]]
    alone = crowd(*pair)
    company = [[-0.8, 1.2], [-0.8, -1.2]], [[1.3, 0], [1.3, 0]]
    among = crowd(pair[0] + company[0], pair[1] + company[1])
    assert 0 < cost(among, among)["meet"][0] < cost(alone, alone)["meet"][0]
    row = crowd([[0, 0], [0.7, 0]], [[1.3, 0], [1.3, 0]])
    behind, before = cost(row, row)["headway"]
    missing = CONFIG.headway_time * 1.3 - 0.3
    assert before == 0.0 and behind == pytest.approx(min(missing, 0.6), rel=0.05)
    spread = crowd([[0, 0], [2.0, 0]], [[1.3, 0], [1.3, 0]])
    assert cost(spread, spread)["headway"].max() == 0.0
