import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from macid import geometry, scene
from macid.state import RADIUS

FLIP, FLIP_BOX = np.array([1.0, -1.0]), np.array([1.0, -1.0, 1.0, 1.0, -1.0])


def random_boxes(rng, number, reach=8.0):
    centre, half = rng.uniform(-reach, reach, (number, 2)), rng.uniform(0.1, 1.5, (number, 2))
    return np.concatenate([centre, half, rng.uniform(-4, 4, (number, 1))], axis=-1)


def random_scene(seed, discs=12, boxes=10, origins=20, rays=24):
    """Origins (O, 2) outside of everything, unit directions (O, R, 2), disc centres (N, 2) and boxes (B, 5)."""
    rng = np.random.default_rng(seed)
    centres, boxes, origin = rng.uniform(-8, 8, (discs, 2)), random_boxes(rng, boxes), rng.uniform(-9, 9, (500, 2))
    free = np.linalg.norm(origin[:, None] - centres, axis=-1).min(axis=-1) > RADIUS
    free &= ~np.stack([inside(origin, box) for box in boxes]).any(axis=0)
    angle = rng.uniform(-np.pi, np.pi, (origins, rays))
    angle[:, :4] = np.arange(4) * np.pi / 2
    return origin[free][:origins], np.stack([np.cos(angle), np.sin(angle)], axis=-1), centres, boxes


def inside(points, box):
    """Whether points (P, 2) lie in `box` (5,): written apart from macid.geometry."""
    ahead = np.array([np.cos(box[4]), np.sin(box[4])])
    offset = points - box[:2]
    return (abs(offset @ ahead) <= box[2]) & (abs(offset @ [-ahead[1], ahead[0]]) <= box[3])


def boundary(box, number=400):
    """Points (4 * number, 2) around `box` (5,), at most 3 / number apart for halves up to 1.5."""
    t = np.linspace(-1, 1, number)
    one = np.ones(number)
    local = np.concatenate([np.stack(side, axis=-1) for side in ((t, one), (t, -one), (one, t), (-one, t))]) * box[2:4]
    c, s = np.cos(box[4]), np.sin(box[4])
    return local @ np.array([[c, s], [-s, c]]) + box[:2]


def nearest(origin, directions, centres, boxes):
    xp = origin.__array_namespace__()
    discs = geometry.ray_disc_distance(origin, directions, centres, RADIUS)
    return xp.minimum(xp.min(discs, axis=-1), xp.min(geometry.ray_box_distance(origin, directions, boxes), axis=-1))


def mj_rays(origins, directions, centres, boxes):
    spec = scene.base_spec(20.0)
    scene.add_people(spec, len(centres))
    scene.add_boxes(spec, boxes)
    model = spec.compile()
    data, hit = mujoco.MjData(model), np.zeros(1, np.int32)
    data.qpos.reshape(-1, 3)[:, :2] = centres
    mujoco.mj_forward(model, data)
    distance = [
        mujoco.mj_ray(model, data, np.array([*origin, 0.5]), np.array([*direction, 0.0]), None, 1, -1, hit)
        for origin, row in zip(origins, directions, strict=True)
        for direction in row
    ]
    distance = np.reshape(distance, directions.shape[:-1])
    return np.where(distance < 0, np.inf, distance)


@pytest.mark.parametrize("seed", range(4))
def test_rays_agree_with_mj_ray(seed):
    things = random_scene(seed)
    oracle = mj_rays(*things)
    assert 100 < np.isinf(oracle).sum() < 0.7 * oracle.size
    origins, directions, centres, boxes = things
    np.testing.assert_allclose(nearest(origins, directions, centres, boxes), oracle, atol=1e-6, rtol=0)
    single = jax.jit(nearest)(*(jnp.asarray(x, jnp.float32) for x in things))
    np.testing.assert_allclose(single, oracle, atol=1e-3, rtol=0)


def test_a_mirrored_scene_mirrors_its_rays():
    origins, directions, centres, boxes = random_scene(9)
    mirrored = nearest(origins * FLIP, directions * FLIP, centres * FLIP, boxes * FLIP_BOX)
    np.testing.assert_allclose(mirrored, nearest(origins, directions, centres, boxes), atol=1e-9)


def test_a_ray_that_starts_inside_does_not_see_it_and_none_looks_back():
    directions = np.stack([np.cos(np.arange(12.0)), np.sin(np.arange(12.0))], axis=-1)
    box = np.array([[0.0, 0.0, 1.0, 1.0, 0.3]])
    assert np.isinf(geometry.ray_box_distance(np.array([0.2, 0.1]), directions, box)).all()
    assert np.isinf(geometry.ray_disc_distance(np.array([0.2, 0.1]), directions, box[:, :2], 0.5)).all()
    away = np.array([[1.0, 0.0]])
    assert np.isinf(geometry.ray_box_distance(np.array([3.0, 0.0]), away, box)).all()
    assert np.isinf(geometry.ray_disc_distance(np.array([3.0, 0.0]), away, box[:, :2], 0.5)).all()


@pytest.mark.parametrize("seed", range(3))
def test_the_first_disc_is_the_nearest(seed):
    origins, directions, centres, _ = random_scene(seed, discs=50)
    every = geometry.ray_disc_distance(origins, directions, centres, RADIUS)
    for dtype, tolerance in ((np.float32, 1e-4), (np.float64, 1e-12)):
        scene = (x.astype(dtype) for x in (origins, directions, centres))
        distance, index = geometry.first_disc(*scene, RADIUS)
        assert distance.dtype == dtype
        np.testing.assert_allclose(distance, every.min(axis=-1), rtol=tolerance)
        hit = np.isfinite(distance)
        assert 100 < hit.sum() < hit.size
        np.testing.assert_array_equal(index[hit], every.argmin(axis=-1)[hit])
    jitted = jax.jit(geometry.first_disc)(
        *(jnp.asarray(x, jnp.float32) for x in (origins, directions, centres)), RADIUS
    )
    np.testing.assert_allclose(jitted[0], every.min(axis=-1), rtol=0, atol=1e-3)


def test_rays_by_hand():
    origin, ahead = np.zeros(2), np.array([[1.0, 0.0]])
    disc = geometry.ray_disc_distance(origin, ahead, np.array([[5.0, 3.0]]), 3.5)
    assert disc[0, 0] == pytest.approx(5 - 13**0.5 / 2)
    boxes = np.array([[5.0, 0.0, 1.0, 2.0, 0.0], [5.0, 0.0, 1.0, 2.0, np.pi / 2], [5.0, 0.0, 1.0, 1.0, np.pi / 4]])
    np.testing.assert_allclose(geometry.ray_box_distance(origin, ahead, boxes)[0], [4.0, 3.0, 5 - 2**0.5])


def test_point_and_box_against_their_sampled_boundaries():
    rng = np.random.default_rng(1)
    points, boxes = rng.uniform(-4, 4, (60, 2)), random_boxes(rng, 20, reach=3.0)
    distance = geometry.point_box_distance(points, boxes)
    within = np.stack([inside(points, box) for box in boxes], axis=-1)
    assert 20 < within.sum() < within.size / 2
    for i, box in enumerate(boxes):
        around = np.linalg.norm(points[:, None] - boundary(box), axis=-1).min(axis=-1)
        np.testing.assert_allclose(distance[:, i], np.where(within[:, i], 0.0, around), atol=4e-3)


def test_gap_between_boxes_against_their_sampled_boundaries():
    rng = np.random.default_rng(2)
    boxes = random_boxes(rng, 25, reach=4.0)
    gaps = np.stack([geometry.box_box_gap(box, boxes) for box in boxes])
    np.testing.assert_allclose(gaps, gaps.T, atol=1e-9)
    assert (np.diag(gaps) == 0).all()
    overlaps = 0
    for i in range(25):
        for j in range(i):
            mine, other = boundary(boxes[i], 60), boundary(boxes[j], 60)
            if inside(mine, boxes[j]).any() or inside(other, boxes[i]).any():
                assert gaps[i, j] == 0
                overlaps += 1
            else:
                around = np.linalg.norm(mine[:, None] - other, axis=-1).min()
                assert gaps[i, j] == pytest.approx(around, abs=0.05)
                assert gaps[i, j] <= around + 1e-9
    assert 20 < overlaps < 250


def test_a_box_within_a_box_and_crossed_boxes_overlap():
    box = np.array([0.0, 0.0, 2.0, 2.0, 0.4])
    others = np.array([[0.1, 0.0, 0.1, 0.1, 1.0], [0.0, 0.0, 9.0, 0.1, 1.0], [0.0, 0.0, 0.1, 9.0, 0.4]])
    np.testing.assert_array_equal(geometry.box_box_gap(box, others), 0.0)


@pytest.mark.parametrize("xp", [np, jnp])
def test_wrap_angle_stays_in_its_range_and_is_the_same_angle(xp):
    angle = xp.asarray([-np.pi, np.pi, 3 * np.pi, 0.0, 1.0, -1.0, 40.0, -40.0, 2 * np.pi, -1e-9])
    wrapped = np.asarray(geometry.wrap_angle(angle))
    assert (wrapped >= -np.pi - 1e-6).all() and (wrapped < np.pi).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * np.asarray(angle)), atol=1e-5)


def test_body_frame_and_back():
    np.testing.assert_allclose(geometry.to_body(np.array([0.0, 2.0]), np.array(np.pi / 2)), [2, 0], atol=1e-12)
    np.testing.assert_allclose(geometry.rotate(np.array([1.0, 0.0]), np.array(np.pi / 2)), [0, 1], atol=1e-12)
    vector, yaw = np.random.default_rng(0).normal(size=(9, 2)), np.linspace(-9, 9, 9)
    np.testing.assert_allclose(geometry.rotate(geometry.to_body(vector, yaw), yaw), vector)


def test_corners_lie_counter_clockwise_on_the_boundary():
    boxes = random_boxes(np.random.default_rng(3), 10)
    corners = geometry.box_corners(boxes)
    edge = np.roll(corners, -1, axis=1) - corners
    following = np.roll(edge, -1, axis=1)
    assert (edge[..., 0] * following[..., 1] - edge[..., 1] * following[..., 0] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(edge, axis=-1)[:, :2], 2 * boxes[:, 2:4])
    np.testing.assert_allclose(corners.mean(axis=1), boxes[:, :2])


def test_numpy_and_jax_answer_alike():
    origins, _, _, boxes = random_scene(5)
    function = geometry.point_box_distance
    answer = function(jnp.asarray(origins), jnp.asarray(boxes))
    assert isinstance(answer, jax.Array) and isinstance(function(origins, boxes), np.ndarray)
    np.testing.assert_allclose(answer, function(origins, boxes), atol=1e-4)


def test_numpy_and_jax_find_the_same_gaps():
    boxes = random_boxes(np.random.default_rng(6), 10)
    answer = jax.jit(geometry.box_box_gap)(jnp.asarray(boxes), jnp.asarray(np.stack([boxes[::-1]] * 10)))
    np.testing.assert_allclose(answer, geometry.box_box_gap(boxes, np.stack([boxes[::-1]] * 10)), atol=1e-4)


@pytest.mark.parametrize(
    ("apart", "velocity", "expected"),
    [
        ((3.0, 0.0), (-1.0, 0.0), 2.6),  # head-on: the gap over the speed
        ((3.0, 0.0), (1.0, 0.0), np.inf),
        ((3.0, 0.5), (-1.0, 0.0), np.inf),  # it passes by 0.1 m
        ((3.0, 0.3), (-1.0, 0.0), 3.0 - (0.16 - 0.09) ** 0.5),
        ((0.3, 0.0), (1.0, 0.0), 0.0),  # they overlap
        ((3.0, 0.0), (0.0, 0.0), np.inf),
    ],
)
def test_the_time_to_collision_of_two_discs(apart, velocity, expected):
    found = geometry.time_to_collision(np.array(apart), np.array(velocity), np.array(0.4))
    assert found == pytest.approx(expected)


def test_discs_that_graze_each_other_touch_where_that_counts():
    past = np.array([3.0, 0.5]), np.array([-1.0, 0.0]), 0.5
    assert geometry.time_to_collision(*past) == np.inf
    assert geometry.time_to_collision(*past, grazing=True) == 3.0
