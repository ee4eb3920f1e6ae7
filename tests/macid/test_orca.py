from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kinematics import DOORWAY, OPEN, arrival_time, crowd, least_distance, ring, walk

from macid.geometry import box_corners, point_box_distance
from macid.pedestrians.orca import NO_LIMIT, ORCA, best_velocity, closest_permitted, least_violation
from macid.state import parking_place

MODEL = ORCA()
TOP_SPEED = 1.5
GRID = np.stack(np.meshgrid(*[np.linspace(-TOP_SPEED, TOP_SPEED, 201)] * 2), axis=-1).reshape(-1, 2)
GRID = GRID[np.linalg.norm(GRID, axis=-1) <= TOP_SPEED]


def half_planes(seed, cases, lines, low, high):
    rng = np.random.default_rng(seed)
    angle, target = rng.uniform(-np.pi, np.pi, (cases, lines)), rng.uniform(-1.2, 1.2, (cases, 2))
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    normal[::4, 1] = normal[::4, 0]  # parallel, same sense
    normal[1::4, 1] = -normal[1::4, 0]  # parallel, opposite sense
    return [jnp.asarray(x, jnp.float32) for x in (normal, rng.uniform(low, high, (cases, lines)), target)]


def slack(normal, offset, velocity):
    """n.v - c of half-planes (C, N) at `velocity` (P, 2) for all cases or (C, 1, 2): (C, P, N)."""
    return np.einsum("cnd,...pd->c...pn" if velocity.ndim == 2 else "cnd,cpd->cpn", normal, velocity) - offset[:, None]


def test_the_closest_permitted_velocity_against_a_grid():
    normal, offset, target = half_planes(0, 60, 7, -1.2, 0.3)
    velocity, feasible = jax.jit(closest_permitted, static_argnums=3)(normal, offset, target, TOP_SPEED)
    permitted = (slack(np.asarray(normal), np.asarray(offset), GRID) >= 0).all(axis=-1)
    distance = np.where(permitted, np.linalg.norm(GRID - target[:, None], axis=-1), np.inf).min(axis=-1)
    assert 10 < feasible.sum() < 60
    assert not (permitted.any(axis=-1) & ~feasible).any()
    ours = slack(np.asarray(normal), np.asarray(offset), np.asarray(velocity)[:, None])[:, 0].min(axis=-1)
    assert ours[feasible].min() > -1e-4
    assert np.linalg.norm(velocity, axis=-1).max() < TOP_SPEED + 1e-4
    own_distance = np.linalg.norm(velocity - target, axis=-1)
    assert (own_distance <= distance + 1e-4)[feasible].all()


@pytest.mark.parametrize("hard", [0, 3])
def test_the_least_violation_against_a_grid(hard):
    normal, offset, target = half_planes(1, 60, 9, -0.6, 1.2)
    offset = offset.at[:, :hard].add(-0.6).at[:, :hard].min(0.0)
    velocity = jax.jit(least_violation, static_argnums=(2, 4))(normal, offset, hard, target, TOP_SPEED)
    normal, offset = np.asarray(normal), np.asarray(offset)
    permitted = (slack(normal[:, :hard], offset[:, :hard], GRID) >= 0).all(axis=-1)
    violation = -slack(normal[:, hard:], offset[:, hard:], GRID).min(axis=-1)
    best = np.where(permitted, violation, np.inf).min(axis=-1)
    ours = slack(normal, offset, np.asarray(velocity)[:, None])[:, 0]
    assert (ours[:, :hard] > -1e-4).all()
    assert np.linalg.norm(velocity, axis=-1).max() < TOP_SPEED + 1e-4
    assert (-ours[:, hard:].min(axis=-1) <= best + 1e-4).all()


def test_least_violation_is_solved_for_all_who_need_it_and_for_no_others():
    normal, offset, target = half_planes(2, 150, 6, -0.5, 0.9)
    velocity = jax.jit(best_velocity, static_argnums=(2, 4))(normal, offset, 0, target, TOP_SPEED)
    closest, feasible = jax.jit(closest_permitted, static_argnums=3)(normal, offset, target, TOP_SPEED)
    assert 64 < (~feasible).sum() < 150
    least = jax.jit(least_violation, static_argnums=(2, 4))(normal, offset, 0, target, TOP_SPEED)
    np.testing.assert_allclose(velocity, np.where(feasible[:, None], closest, least), atol=1e-5)


def signed_distance(velocity, corners, radius, horizon):
    """Of `velocity` (2,) to the velocities that bring a disc onto the hull of `corners` (C, 2), seen from it."""
    angle = np.linspace(-np.pi, np.pi, 50_000)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    reach = (normal @ corners.T).max(axis=-1) + radius
    return np.where(reach <= 0, normal @ velocity - reach / horizon, -np.inf).max()


def test_half_planes_touch_the_velocity_obstacles():
    rng = np.random.default_rng(3)
    obstacle_half_planes = jax.jit(MODEL.obstacle_half_planes)
    neighbor_half_planes = jax.jit(MODEL.neighbor_half_planes)
    person, radius = np.zeros((1, 2)), 0.37
    for _ in range(40):
        velocity, centre = rng.uniform(-1.5, 1.5, (1, 2)), rng.uniform(-3, 3, 2)
        box = np.array([[*centre, *rng.uniform(0, 2, 2), rng.uniform(-3, 3)]])
        if point_box_distance(person, box) > radius:
            normal, offset = obstacle_half_planes(*map(jnp.float32, (person, velocity, box)))
            distance = signed_distance(velocity[0], box_corners(box)[0], radius, MODEL.obstacle_horizon)
            if offset[0, 0] > NO_LIMIT:
                assert normal[0, 0] @ velocity[0] - offset[0, 0] == pytest.approx(distance, abs=2e-4)
                assert offset[0, 0] <= 0
        if np.linalg.norm(centre) > 2 * radius:
            other = rng.uniform(-1.5, 1.5, 2)
            position, both = np.stack([person[0], centre]), np.stack([velocity[0], other])
            normal, offset = neighbor_half_planes(jnp.float32(position), jnp.float32(both))
            distance = signed_distance(velocity[0] - other, centre[None], 2 * radius, MODEL.horizon)
            assert normal[0, 0] @ velocity[0] - offset[0, 0] == pytest.approx(distance / 2, abs=2e-4)
            np.testing.assert_allclose(normal[0], -normal[1], atol=1e-4)


def test_two_who_overlap_part_within_a_period():
    normal, offset = jax.jit(MODEL.neighbor_half_planes)(jnp.asarray([[0.0, 0.0], [0.7, 0.0]]), jnp.zeros((2, 2)))
    np.testing.assert_allclose(normal[:, 0], [[-1, 0], [1, 0]], atol=1e-6)
    np.testing.assert_allclose(offset[:, 0], 0.5 * 0.04 / 0.02, rtol=1e-4)


def rings(cases):
    """Starts and goals (C, K, 2) of antipodal rings, (people, radius [m], heading [rad]) each; the rest are parked."""
    most = max(people for people, _, _ in cases)
    start = np.tile(parking_place(np.arange(most)).astype(float), (len(cases), 1, 1))
    goals = start.copy()
    for index, (people, radius, heading) in enumerate(cases):
        start[index, :people] = ring(people, radius, heading)
        goals[index, :people] = -start[index, :people]
    return start, goals


def all_arrive(cases, period, seconds):
    """Asserts that everybody of the rings arrives in time and, at the usual period, nobody touches anybody."""
    start, goals = rings(cases)
    states = walk(replace(MODEL, period=period), start, OPEN, goals, seconds)
    for index, case in enumerate(cases):
        walked = states.position[:, index, : case[0]]
        assert least_distance(walked) > (0.70 if period == MODEL.period else 0.5), case
        assert np.isfinite(arrival_time(walked, goals[index, : case[0]], period)).all(), case


def test_antipodal_rings_resolve():
    rings = [(3, 3.0, 0.0), (5, 3.0, 0.4), (12, 8.0, 0.0), (16, 8.0, 1.0), (20, 8.0, 0.0), (20, 10.0, 0.0)]
    all_arrive(rings, 0.02, 45)


@pytest.mark.slow
@pytest.mark.parametrize("radius", [3.0, 5.0, 8.0, 11.0, 15.0])
@pytest.mark.parametrize("period", [0.02, 0.1])
def test_antipodal_rings_of_every_size_resolve(period, radius):
    sizes = [people for people in range(2, 41) if 2 * radius * np.sin(np.pi / people) > 0.76]
    all_arrive([(people, radius, heading) for people in sizes for heading in (0.0, 0.7)], period, 120)


def test_only_who_is_blocked_asks_for_another_way():
    rng = np.random.default_rng(5)
    state = crowd(rng.uniform(-6, 6, (6, 40, 2)), rng.uniform(-1, 1, (6, 40, 2)))
    goals = jnp.asarray(rng.uniform(-9, 9, (6, 40, 2)), jnp.float32)
    boxes = jnp.asarray([[0.0, 0.0, 1.0, 0.5, 0.3], [4.0, 2.0, 0.5, 2.0, 0.0]], jnp.float32)
    plain = jax.jit(replace(MODEL, detours=()))(state, boxes, goals)[..., :2]
    ours = jax.jit(MODEL)(state, boxes, goals)[..., :2]
    preferred = MODEL.preferred_velocity(state.position, goals)
    speed = np.linalg.norm(preferred, axis=-1)
    progress = (plain * preferred).sum(axis=-1) / speed
    blocked = progress < MODEL.blocked * speed
    assert 20 < blocked.sum() < 200
    np.testing.assert_array_equal(np.asarray(ours)[~blocked], np.asarray(plain)[~blocked])
    assert (np.linalg.norm(ours - plain, axis=-1)[blocked] > 0.01).mean() > 0.2  # many overlap, and only part


def test_who_faces_a_wall_and_nobody_else_stands():
    wall = np.array([[0.0, 0.0, 0.2, 3.0, 0.0]])
    states = walk(MODEL, np.array([[-2.0, 0.0]]), wall, np.array([[2.0, 0.0]]), 4)
    assert np.linalg.norm(states.velocity[-1, 0]) < 0.05


def test_walking_along_a_wall_is_not_slowed():
    wall = np.array([[0.0, -0.5, 30.0, 0.1, 0.0]])
    states = walk(MODEL, np.array([[-8.0, 0.0]]), wall, np.array([[8.0, 0.0]]), 5)  # 0.4 m beside it
    assert states.position[-1, 0, 0] > -8 + 1.34 * 5 * 0.999


def test_a_doorway_is_not_slowing():
    states = walk(MODEL, np.array([[-4.0, 0.0]]), DOORWAY, np.array([[4.0, 0.0]]), 5)
    assert states.position[-1, 0, 0] > -4 + 1.34 * 5 * 0.99


def test_a_crowd_among_boxes_touches_nothing():
    rng = np.random.default_rng(4)
    places = np.stack(np.meshgrid(np.arange(5), np.arange(5)), axis=-1).reshape(-1, 2) * 3.0
    boxes = np.concatenate([places[:12] + 1.5, rng.uniform(0.2, 0.6, (12, 2)), rng.uniform(-3, 3, (12, 1))], axis=-1)
    goals = rng.permutation(places)
    states = walk(MODEL, places, boxes, goals, 20)
    assert point_box_distance(states.position, boxes).min() > 0.35
    assert least_distance(states.position) > 0.70
    assert np.isfinite(arrival_time(states.position, goals, MODEL.period)).mean() > 0.7


def test_the_longer_period_works_too():
    model = replace(MODEL, period=0.1)
    goals = np.array([[5.0, 0.0], [-5.0, 0.0]])
    states = walk(model, -goals, OPEN, goals, 10)
    assert least_distance(states.position) > 0.70
    assert np.linalg.norm(states.position[-1] - goals, axis=-1).max() < 0.02
