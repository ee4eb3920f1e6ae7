import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from macid.geometry import norm
from macid.human import flows, measures, replay
from macid.human.data import OPEN_PERIOD, Bottleneck, Walks
from macid.human.figures import open_figures
from macid.human.measure import Troupe
from macid.human.stage import Body, Cast, Stage, sampled
from macid.layout import Layout
from macid.state import GOAL_RADIUS

OPEN = Layout(40.0, np.empty((0, 5)))
SPEED = 1.25


def blind(state, boxes, goals, lcf):
    """Straight to the goal, whoever is in the way: at the preferred speed, or else SPEED."""
    ahead = goals - state.position
    ahead = ahead / jnp.maximum(norm(ahead), 1e-6)[..., None]
    speed = SPEED if state.traits.preferred_speed is None else state.traits.preferred_speed[..., None]
    return jnp.concatenate([speed * ahead, jnp.zeros((*ahead.shape[:-1], 1))], axis=-1)


def cast(*people, walk=None, speed=None):
    """A Cast of people (comes, leaves, place, goal), who come at SPEED towards their goals."""
    comes, leaves, place, goal = (np.array(each, float) for each in zip(*people, strict=True))
    velocity = SPEED * (goal - place) / np.maximum(np.linalg.norm(goal - place, axis=-1), 1e-9)[:, None]
    return Cast(comes, leaves, place, velocity, goal, speed, walk)


def play(casts, duration, sample=0.1, layout=OPEN, controller=blind, period=0.1, radius=0.2, ring=None):
    rng = np.random.default_rng(0)
    return Stage(layout, casts, duration, controller, period, Body(radius), rng, ring=ring).play(sample)


def test_people_come_and_go_in_their_time():
    first = (0.0, 99.0, (-4.0, 0.0), (0.0, 0.0))
    late = (6.0, 99.0, (0.0, 5.0), (8.0, 5.0))
    short = (1.0, 3.0, (0.0, -5.0), (12.0, -5.0))
    (walks,) = play([cast(first, late, short)], 10.0)
    there = ~np.isnan(walks[..., 0])
    times = np.arange(len(walks)) * 0.1
    assert times[there[:, 0]].max() == pytest.approx((4.0 - GOAL_RADIUS) / SPEED, abs=0.15)
    assert times[there[:, 1]].min() == pytest.approx(6.0)
    assert times[there[:, 2]].min() == pytest.approx(1.0) and times[there[:, 2]].max() == pytest.approx(2.9)
    assert walks[60, 1] == pytest.approx([0.0, 5.0], abs=1e-6)
    straight = np.array([-4.0, 0.0]) + np.outer(times[:20] * SPEED, [1.0, 0.0])
    assert walks[:20, 0] == pytest.approx(straight, abs=0.02)  # they come with their speed


def test_a_slot_serves_one_after_the_other():
    people = [(4.0 * i, 4.0 * i + 3.0, (-2.0, float(i)), (8.0, float(i))) for i in range(4)]
    stage = Stage(OPEN, [cast(*people)], 16.0, blind, 0.1, Body(0.2), np.random.default_rng(0))
    assert stage.number == 1
    (walks,) = stage.play(0.1)
    there = ~np.isnan(walks[..., 0])
    assert there.any(axis=0).all() and there.sum(axis=1).max() == 1


def test_who_is_moved_walks_as_it_did_and_is_in_the_way():
    walk = np.full((26, 2, 2), np.nan)
    walk[:, 0] = np.array([0.0, 0.0]) + np.outer(np.arange(26) * 0.4, [0.0, 0.01])
    people = (0.0, 10.0, (0.0, 0.0), (0.0, 0.1)), (0.0, 10.0, (-3.0, 0.0), (5.0, 0.0))
    (walks,) = play([cast(*people, walk=walk)], 10.0, sample=0.4)
    assert walks[:25, 0] == pytest.approx(walk[:25, 0], abs=0.02)
    assert np.nanmax(walks[:, 1, 0]) < 0.0  # a blind walker stands before it


def test_a_world_of_a_batch_is_what_it_is_alone():
    one = cast((0.0, 9.0, (-4.0, 0.1), (4.0, 0.0)), (0.0, 9.0, (4.0, 0.0), (-4.0, 0.0)))
    two = cast((1.0, 9.0, (0.0, -3.0), (0.0, 3.0)))
    together = play([one, two], 8.0)
    alone = play([one], 8.0)[0], play([two], 8.0)[0]
    for both, single in zip(together, alone, strict=True):
        np.testing.assert_array_equal(both, single)


def test_a_troupe_gives_every_world_its_own_controller():
    slow = lambda *of: 0.5 * blind(*of)  # noqa: E731
    crossing = cast((0.0, 9.0, (-4.0, 0.0), (40.0, 0.0)))
    fast, half = play([crossing, crossing], 4.0, controller=Troupe([blind, slow]))
    assert fast[-1, 0, 0] == pytest.approx(1.0, abs=0.05) and half[-1, 0, 0] == pytest.approx(-1.5, abs=0.1)


def test_people_know_their_group_and_their_wishes():
    def together(state, boxes, goals, lcf):
        group = state.traits.group
        with_others = (group[..., :, None] == group[..., None, :]).sum(axis=-1) > 1
        return jnp.where(with_others[..., None], blind(state, boxes, goals, lcf), 0.0)

    people = [(0.0, 9.0, (-4.0, float(y)), (30.0, float(y))) for y in range(3)]
    crowd = cast(*people, speed=np.array([1.0, 0.5, 1.0]))._replace(group=np.array([7, 7, 3]))
    (walks,) = play([crowd], 4.0, controller=together)
    assert walks[-1, :, 0] == pytest.approx([0.0, -2.0, -4.0], abs=0.15)


def test_on_a_ring_people_go_round_and_meet_the_nearest_image():
    walker = cast((0.0, 99.0, (1.0, 3.0), (1.0, -7.0)))
    (walks,) = play([walker], 16.0, layout=flows.ring_layout(), ring=flows.RING)
    step = np.diff(walks[:, 0, 1])
    assert np.abs(walks[..., 1]).max() <= flows.RING / 2 + SPEED * 0.1
    assert (step - flows.RING * np.round(step / flows.RING)) == pytest.approx(-SPEED * 0.1, abs=0.01)
    # One who stands beyond the seam is in the way.
    stands = Cast(*(np.array(each) for each in ([0.0, 0.0], [99.0, 99.0], [[1.0, 3.5], [1.0, -2.0]])),
                  np.zeros((2, 2)), np.array([[1.0, 3.5], [1.0, -9.0]]), np.array([0.0, SPEED]))  # fmt: skip
    (walks,) = play([stands], 6.0, layout=flows.ring_layout(), ring=flows.RING)
    along = walks[-1, 1, 1] - walks[-1, 0, 1]
    assert (along - flows.RING * np.round(along / flows.RING)) == pytest.approx(0.4, abs=0.05)


def test_places_between_samples_are_interpolated_and_missing_ones_stay_missing():
    walk = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [np.nan, np.nan]])[:, None]
    found = sampled(walk, np.arange(4) * 0.08, np.array([0.0, 0.1, 0.16, 0.2, 0.5]))
    assert found[:3, 0, 0] == pytest.approx([0.0, 1.25, 2.0]) and np.isnan(found[3:]).all()


@pytest.mark.parametrize("radius", [0.2, 0.35])
@pytest.mark.parametrize("density", [0.8, 1.6, 2.0])
def test_a_lattice_has_room_and_its_density(radius, density):
    people = flows.ring_cast(density, Body(radius), np.random.default_rng(1), lambda number: None)
    moved, number = people.place, len(people.place)
    assert number / flows.RING / flows.RING_WIDTH == pytest.approx(density, abs=0.1)
    offset = moved[None] - moved[:, None]
    offset[..., 1] -= flows.RING * np.round(offset[..., 1] / flows.RING)
    distance = np.linalg.norm(offset, axis=-1) + 9 * np.eye(number)
    assert len(moved) == number and distance.min() >= 2 * radius - 0.011
    assert moved[:, 0].min() >= radius - 1e-9 and moved[:, 0].max() <= flows.RING_WIDTH - radius + 1e-9


def test_there_is_no_room_for_broad_people_at_high_density():
    number = round(2.4 * flows.RING * flows.RING_WIDTH)
    assert flows.lattice(number, flows.RING_WIDTH, flows.RING, 0.35) is None
    assert flows.lattice(number, flows.RING_WIDTH, flows.RING, 0.2) is not None


def test_a_crowd_begins_before_its_exit_and_its_goals_lie_behind_it():
    place, rng = Bottleneck(1.8, 1.2, -4.0, 4.0), np.random.default_rng(2)
    crowd = flows.exit_cast(place, 40, Body(0.2), rng, lambda number: None)
    assert (crowd.place[:, 1] > place.exit_y + 0.2).all() and (crowd.goal[:, 1] < place.exit_y).all()
    assert (np.abs(crowd.goal[:, 0] - 0.9) <= 0.4 + 1e-9).all()
    both = flows.two_ways_cast(18, flows.begin_density(18), Body(0.2), rng, lambda number: None)
    assert len(both.place) == 36 and (both.place[:18, 1] < 0).all() and (both.place[18:, 1] > 0).all()
    assert (both.goal[:18, 1] > 4).all() and (both.goal[18:, 1] < -4).all()


def made_up(people=90, samples=200, seed=0):
    """Walks of people who cross a square at random and see nobody, and of one who stands."""
    rng = np.random.default_rng(seed)
    position = np.full((samples, people + 1, 2), np.nan)
    for who in range(people):
        begin, angle, speed = rng.integers(0, samples - 20), rng.uniform(0, 2 * np.pi), rng.uniform(0.9, 1.6)
        ahead = np.outer(np.arange(-10, 10) * OPEN_PERIOD * speed, [np.cos(angle), np.sin(angle)])
        position[begin : begin + 20, who] = rng.uniform(-3, 3, 2) + ahead
    position[20:160, people] = (9.0, 9.0)
    return Walks("made up", OPEN_PERIOD, position)


def test_people_replayed_as_themselves_are_where_they_were():
    scenes = [replay.Scene(made_up())]
    values, curves = open_figures(scenes, replay.as_they_were(scenes))
    assert values["ADE"] == 0.0 and values["FDE"] == 0.0 and values["W"] == 0.0
    assert values["straightness"] == pytest.approx(1.0) and values["within"] == pytest.approx(0.0, abs=1e-9)
    assert sum(curves["speeds"]["share"]) == pytest.approx(1.0, abs=0.01)


def test_walking_blind_anticipates_nothing():
    scenes = [replay.Scene(made_up(200, 200))]
    speeds = [[scene.person.speed for scene in scenes]]
    (played,) = replay.play(scenes, blind, 0.1, Body(0.1), np.random.default_rng(0), speeds)
    values, _ = open_figures(scenes, played)
    assert values["E1"] < 0.4
    assert values["ADE"] < 0.3 and values["W"] < 0.05  # nobody keeps them from their ways
    stood = played.position[0][20:160, -1] - scenes[0].position[20:160, -1]
    assert np.abs(stood).max() < 0.02


def test_everybody_is_counted_in_one_window():
    scenes = [replay.Scene(made_up(120, 900, seed=3))]
    parts = replay.windows(scenes)
    assert len(parts) == 4
    counted = np.concatenate([part.who[part.counted] for part in parts])
    assert sorted(counted) == np.flatnonzero(~scenes[0].stands).tolist()
    for before, after in itertools.pairwise(parts):
        assert before.end == after.begin and after.start < after.begin
    assert measures.displacement_errors(scenes[0].position, scenes[0].position) == (0.0, 0.0)
