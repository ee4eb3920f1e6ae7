import operator
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kinematics import DOORWAY, OPEN, arrival_time, crowd, least_distance, walk

from macid.geometry import point_box_distance
from macid.pedestrians import make_controller, model_names
from macid.pedestrians.facing import face_velocity
from macid.pedestrians.orca import ORCA
from macid.pedestrians.social_force import SocialForce, ellipse
from macid.state import MAX_SPEED, MAX_YAW_RATE, RADIUS, parking_place

PUBLISHED = SocialForce(response=0.0)  # the kinematic loop's people follow at once
MODEL = replace(PUBLISHED, step_by_progress=True, body_radius=RADIUS)
MODELS = [MODEL, ORCA()]
both = pytest.mark.parametrize("model", MODELS, ids=["social_force", "orca"])


@partial(jax.jit, static_argnums=0)
def command_of(model, state, boxes, goals):
    return model(state, jnp.asarray(boxes), jnp.asarray(goals), None)


def scene(seed, shape=(12,), boxes=4):
    rng = np.random.default_rng(seed)
    state = crowd(rng.uniform(-5, 5, (*shape, 2)), rng.uniform(-1, 1, (*shape, 2)))
    state = state._replace(yaw=jnp.asarray(rng.uniform(-3, 3, shape), jnp.float32))
    centre, half, yaw = rng.uniform(-6, 6, (boxes, 2)), rng.uniform(0.1, 1, (boxes, 2)), rng.uniform(-3, 3, (boxes, 1))
    return state, np.concatenate([centre, half, yaw], axis=-1), rng.uniform(-9, 9, (*shape, 2))


@both
def test_lone_walker_reaches_its_speed_on_the_straight_line(model):
    goal = np.array([[6.0, 8.0]])
    states = walk(model, np.zeros((1, 2)), OPEN, goal, 8.0)
    position, speed = states.position[:, 0], np.linalg.norm(states.velocity[:, 0], axis=-1)
    assert speed[200] == pytest.approx(1.34, abs=0.01)
    assert np.abs(position @ [-0.8, 0.6]).max() < 0.1
    expected = 9.7 / 1.34 + (0.5 if model == MODEL else 0.0)  # the model's tau: v = v0 (1 - exp(-t / tau))
    assert arrival_time(states.position, goal, model.period)[0] == pytest.approx(expected, abs=0.05)


@both
@pytest.mark.parametrize("aside", [0.0, 0.1])
def test_two_people_head_on_pass_without_contact(model, aside):
    goals = np.array([[5.0, 0.0], [-5.0, aside]])
    states = walk(model, -goals * [1, -1], OPEN, goals, 15)
    assert least_distance(states.position) > 0.70
    assert arrival_time(states.position, goals, model.period).max() < 10


@both
def test_nobody_walks_through_a_wall(model):
    wall, start = np.array([[0.0, 0.0, 6.0, 0.1, 0.4]]), np.array([[-4.0, 3.0], [0.0, 3.0], [1.0, 5.0], [3.0, 4.0]])
    states = walk(model, start, wall, -start, 12)
    assert point_box_distance(states.position, wall).min() > 0.35


@both
@pytest.mark.parametrize(("y", "seconds"), [(0.0, 7.0), (0.3, 7.0), (4.0, 14.0)])
def test_a_person_passes_a_gap_of_1_2_m(model, y, seconds):
    goal = np.array([[4.0, 0.0]])
    states = walk(model, np.array([[-4.0, y]]), DOORWAY, goal, seconds)
    assert np.isfinite(arrival_time(states.position, goal, model.period)).all()
    assert point_box_distance(states.position, DOORWAY).min() > 0.35


@both
def test_parked_people_and_boxes_change_nothing(model):
    state, boxes, goals = scene(0)
    parked = crowd(parking_place(np.arange(12, 20)))
    both_states = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), state, parked)
    parked_boxes = np.concatenate([boxes, [[1000.0, -1000.0, 0.5, 0.5, 0.0], [1002.0, -1000.0, 0.0, 0.0, 0.0]]])
    more = command_of(model, both_states, parked_boxes, np.concatenate([goals, np.zeros((8, 2))]))
    assert np.isfinite(more).all()
    np.testing.assert_allclose(more[:12], command_of(model, state, boxes, goals), atol=1e-5)


@both
def test_worlds_of_a_batch_equal_the_same_worlds_alone(model):
    state, boxes, goals = scene(1, shape=(2, 12))
    each_boxes = np.stack([boxes, boxes + 0.5])
    shared, own = command_of(model, state, boxes, goals), command_of(model, state, each_boxes, goals)
    for i in range(2):
        alone = jax.tree.map(operator.itemgetter(i), state)
        np.testing.assert_allclose(shared[i], command_of(model, alone, boxes, goals[i]), atol=1e-5)
        np.testing.assert_allclose(own[i], command_of(model, alone, each_boxes[i], goals[i]), atol=1e-5)


@both
def test_degenerate_places_give_finite_commands(model):
    box = np.array([[0.0, 0.0, 1.0, 1.0, 0.3]])
    position = np.array([[3, 3], [3, 3], [0, 0], [0, 0], [0.9, 0], [5, 5], [-5, 5], [-5, 5.7]], float)
    velocity = np.zeros_like(position)
    velocity[6:] = [[0, 0.35], [0, -0.35]]  # each steps exactly onto the other's place in two seconds
    goals = np.zeros_like(position)
    goals[5] = position[5]
    more = np.array([[3.0, 3.0, 0.0, 0.0, 0.0], [6.0, 5.0, 1.0, 1.0, 0.0]])  # a point, and one that is touched
    for boxes in (OPEN, np.concatenate([box, more])):
        command = command_of(model, crowd(position, velocity), boxes, goals)
        assert np.isfinite(command).all()
        assert np.linalg.norm(command[:, :2], axis=-1).max() <= MAX_SPEED + 1e-5
    at_goal = command_of(model, crowd(position[5:6]), OPEN, goals[5:6])
    np.testing.assert_array_equal(at_goal, 0.0)


def test_the_ellipse_is_helbings_and_its_gradient_is_right():
    rng = np.random.default_rng(2)
    r, step = jnp.asarray(rng.uniform(-3, 3, (200, 2))), jnp.asarray(rng.uniform(-2, 2, (200, 2)))

    def published(r, step):
        total = jnp.linalg.norm(r) + jnp.linalg.norm(r - step)
        return jnp.sqrt(total**2 - step @ step) / 2

    b, gradient = jax.jit(ellipse)(r, step)
    np.testing.assert_allclose(b, jax.vmap(published)(r, step), atol=1e-4)
    np.testing.assert_allclose(gradient, jax.vmap(jax.grad(published))(r, step), atol=2e-3)


def test_force_of_somebody_who_stands_one_metre_ahead():
    state = crowd([[0.0, 0.0], [1.0, 0.0]])
    model = replace(PUBLISHED, veer=0.0)
    acceleration = jax.jit(model.acceleration)(state, OPEN, np.array([[9.0, 0.0], [9.0, 0.0]]))
    push = 2.1 / 0.3 * np.exp(-1 / 0.3)
    np.testing.assert_allclose(acceleration, [[1.34 / 0.5 - push, 0], [1.34 / 0.5 + 0.5 * push, 0]], atol=1e-5)


@pytest.mark.parametrize("velocity", [(0.6, 0.8), (-0.8, 0.6), (1.0, 0.0)])
def test_anothers_step_is_as_long_as_its_speed_makes_it_and_leads_where_it_wants_to_go(velocity):
    """Against eqs. 2 to 4 by hand: b's step is |v_b| dt e_b, however v_b lies to e_b; dt is 2 s."""
    place, other = np.array([0.0, 1.1]), np.array([-0.5, 0.3])
    wanted = np.array([1.0, 0.0])  # e_b, to a goal far to the right

    def potential(r, speed):
        step = speed * 2.0 * wanted
        b = np.sqrt((np.linalg.norm(r) + np.linalg.norm(r - step)) ** 2 - (speed * 2.0) ** 2) / 2
        return 2.1 * np.exp(-b / 0.3)

    def push(speed):
        around = 1e-4 * np.eye(2)
        apart = place - other
        return np.array([potential(apart - d, speed) - potential(apart + d, speed) for d in around]) / 2e-4

    state = crowd([place, other], [(0.0, 0.0), velocity])
    goals = np.array([[0.0, -50.0], [5e6, 0.3]])  # the other one stands in view: the weight is 1
    for model, speed in (
        (PUBLISHED, np.linalg.norm(velocity)),
        (replace(PUBLISHED, step_by_progress=True), max(0.0, velocity[0])),
    ):
        force = jax.jit(replace(model, veer=0.0).acceleration)(state, OPEN, goals)[0] - np.array([0.0, -1.34 / 0.5])
        np.testing.assert_allclose(force, push(speed), atol=2e-3)
    assert np.linalg.norm(push(np.linalg.norm(velocity)) - push(max(0.0, velocity[0]))) > 0.05 or velocity == (1.0, 0.0)


def test_the_models_steps():
    """social-force is as published; whom robots of before were trained among keeps its step under a name of its own."""
    models = {name: make_controller(name, 0.02) for name in model_names() if name.startswith("social-force")}
    assert models == {
        "social-force": SocialForce(),
        "social-force-progress": SocialForce(step_by_progress=True),
        "social-force-bodies": SocialForce(step_by_progress=True, body_radius=RADIUS),
    }


def test_force_of_a_wall():
    wall = np.array([[0.0, -1.4, 9.0, 1.0, 0.0]])  # its surface is 0.4 m from the person, who is at the goal
    acceleration = jax.jit(MODEL.acceleration)(crowd([[0.0, 0.0]]), wall, np.zeros((1, 2)))
    np.testing.assert_allclose(acceleration, [[0, 10 / 0.2 * np.exp(-0.4 / 0.2)]], rtol=1e-4, atol=1e-6)


def test_a_mirrored_scene_gives_a_mirrored_command():
    state, boxes, goals = scene(3)
    flip, flip_box = np.array([1.0, -1.0]), np.array([1.0, -1.0, 1.0, 1.0, -1.0])
    mirrored = state._replace(position=state.position * flip, velocity=state.velocity * flip, yaw=-state.yaw)
    model = replace(MODEL, veer=0.0)
    command, other = command_of(model, state, boxes, goals), command_of(model, mirrored, boxes * flip_box, goals * flip)
    np.testing.assert_allclose(other, command * np.array([1.0, -1.0, -1.0]), atol=1e-4)


def test_people_turn_to_where_they_walk():
    velocity = jnp.asarray([[0.0, 1.0], [-1.0, -0.01], [1.0, 0.0], [0.01, 0.0]])
    yaw = jnp.asarray([0.0, 3.1, 0.01, 2.0])
    rate = jax.jit(face_velocity)(velocity, yaw, 0.02)[:, 2]
    np.testing.assert_allclose(rate, [MAX_YAW_RATE, MAX_YAW_RATE, -0.5, 0.0], atol=1e-4)


def test_bodies_push_as_points_do_that_much_closer():
    model = replace(MODEL, veer=0.0)
    goals = np.array([[9.0, 0.0], [9.0, 0.0]])
    bodies = model.acceleration(crowd([[0.0, 0.0], [1.5, 0.0]]), OPEN, goals)
    points = replace(PUBLISHED, veer=0.0).acceleration(crowd([[0.0, 0.0], [0.8, 0.0]]), OPEN, goals)
    np.testing.assert_allclose(bodies, points, atol=1e-5)


def test_a_command_leads_by_what_a_lagging_body_misses():
    lagging = SocialForce(period=0.04)
    follow = lagging.response / (lagging.response + 0.02)
    command = lagging.lead  # for an acceleration of 1 m/s2 from rest
    velocity = 0.0
    for _ in range(2):
        velocity = follow * velocity + (1 - follow) * command
    assert velocity == pytest.approx(1.0 * 0.04)
