import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from macid import scene
from macid.geometry import rotate
from macid.layout import Layout, random_layout, sample_people
from macid.observation import COLUMNS, RAY_RANGE, RAYS, SIZE, cast_rays, observe
from macid.state import HEIGHT, RADIUS, CrowdState, parking_place

FLIP, FLIP_BOX = np.array([1.0, -1.0]), np.array([1.0, -1.0, 1.0, 1.0, -1.0])


def crowd_scene(seed, number=20, obstacles=5, size=20.0):
    """A random CrowdState, boxes and goals, float64."""
    rng = np.random.default_rng(seed)
    layout = random_layout(rng, obstacles, size)
    state = CrowdState(
        sample_people(rng, layout, number),
        rng.uniform(-3, 3, number),
        rng.uniform(-1, 1, (number, 2)),
        rng.uniform(-1, 1, number),
        rng.random(number) < 0.5,
    )
    return state, layout.boxes, rng.uniform(-9, 9, (number, 2)), layout


def split(observation):
    """The observation's columns by name; rays as (..., 12, 3)."""
    ends = np.cumsum([0, *COLUMNS.values()])
    parts = {name: observation[..., a:b] for name, a, b in zip(COLUMNS, ends[:-1], ends[1:], strict=True)}
    parts["rays"] = parts["rays"].reshape(*observation.shape[:-1], RAYS, 3)
    return parts


def lone(position=(0.0, 0.0), yaw=0.0, velocity=(0.5, 0.0)):
    return CrowdState(np.array([position]), np.array([yaw]), np.array([velocity]), np.zeros(1), np.zeros(1, bool))


def test_the_columns_sum_to_41():
    assert sum(COLUMNS.values()) == SIZE == 41
    state, boxes, goals, _ = crowd_scene(0)
    assert observe(state, boxes, goals).shape == (20, 41)


def test_an_observation_by_hand():
    state = CrowdState(
        position=np.array([[2.0, 1.0], [2.0, 4.0]]),
        yaw=np.array([np.pi / 2, 0.0]),
        velocity=np.array([[0.3, 0.4], [-1.0, 0.0]]),
        yaw_rate=np.array([-0.2, 0.0]),
        contact=np.array([True, False]),
    )
    wall_to_the_right = np.array([[6.0, 1.0, 1.0, 0.5, 0.0]])  # its face is 3 m away
    rays = np.tile([7.0, 0.0, 0.0], (RAYS, 1))
    rays[0] = [3.0 - RADIUS, 0.0 - 0.4, 1.0 + 0.3]  # walks to the left, which is +y of the body
    rays[9] = [3.0, -0.4, 0.3]
    expected = [4.0, 2.0, 0.5, -0.2, 1.0, *rays.ravel()]
    observation = observe(state, wall_to_the_right, np.array([[0.0, 5.0], [0.0, 0.0]]))
    np.testing.assert_allclose(observation[0], expected, atol=1e-12)


@pytest.mark.parametrize(("gap", "reading"), [(6.99, 6.99), (7.01, 7.0), (np.inf, 7.0)])
def test_a_miss_reads_the_range_and_no_relative_velocity(gap, reading):
    boxes = np.array([[min(gap, 900.0) + 1.0, 0.0, 1.0, 0.5, 0.0]])
    rays = split(observe(lone(), boxes, np.zeros((1, 2))))["rays"][0]
    np.testing.assert_allclose(rays[0], [reading, -0.5 * (gap < RAY_RANGE), 0.0], atol=1e-12)
    np.testing.assert_allclose(rays[1:], np.tile([7.0, 0.0, 0.0], (RAYS - 1, 1)))


def test_a_person_beyond_the_range_is_a_miss():
    state = lone()
    other = lone((7.36, 0.0), velocity=(0.0, 1.0))
    both = jax.tree.map(lambda *pair: np.concatenate(pair), state, other)
    nothing = np.array([[900.0, 900.0, 1.0, 1.0, 0.0]])
    np.testing.assert_allclose(split(observe(both, nothing, np.zeros((2, 2))))["rays"][0, 0], [7.0, 0.0, 0.0])
    both.position[1, 0] = 7.34
    np.testing.assert_allclose(split(observe(both, nothing, np.zeros((2, 2))))["rays"][0, 0], [6.99, -0.5, 1.0])


def test_the_nearer_one_is_seen():
    state = CrowdState(
        np.array([[0.0, 0.0], [3.0, 0.0], [2.0, 0.1]]),
        np.zeros(3),
        np.array([[0.0, 0.0], [0.1, 0.2], [0.3, 0.4]]),
        np.zeros(3),
        np.zeros(3, bool),
    )
    far_wall, near_wall = np.array([[6.0, 0.0, 1.0, 1.0, 0.0]]), np.array([[1.5, 0.0, 0.5, 1.0, 0.0]])
    goals = np.zeros((3, 2))
    np.testing.assert_allclose(split(observe(state, far_wall, goals))["rays"][0, 0, 1:], [0.3, 0.4])
    np.testing.assert_allclose(split(observe(state, near_wall, goals))["rays"][0, 0], [1.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("angle", [0.3, np.pi / 2, -2.5])
def test_turning_and_shifting_the_whole_scene_changes_nothing(angle):
    state, boxes, goals, _ = crowd_scene(1)

    def moved(points):
        return rotate(points, np.full(points.shape[:-1], angle)) + np.array([3.0, -7.0])

    turned_boxes = np.concatenate([moved(boxes[:, :2]), boxes[:, 2:4], boxes[:, 4:] + angle], axis=-1)
    turned = state._replace(
        position=moved(state.position), yaw=state.yaw + angle, velocity=rotate(state.velocity, np.full(20, angle))
    )
    np.testing.assert_allclose(observe(turned, turned_boxes, moved(goals)), observe(state, boxes, goals), atol=1e-7)


def test_a_mirrored_scene_mirrors_rays_and_flips_signs():
    state, boxes, goals, _ = crowd_scene(2)
    mirrored = state._replace(
        position=state.position * FLIP, yaw=-state.yaw, velocity=state.velocity * FLIP, yaw_rate=-state.yaw_rate
    )
    one, other = split(observe(state, boxes, goals)), split(observe(mirrored, boxes * FLIP_BOX, goals * FLIP))
    np.testing.assert_allclose(other["goal"], one["goal"] * FLIP, atol=1e-9)
    np.testing.assert_allclose(other["yaw_rate"], -one["yaw_rate"])
    for name in ("speed", "collision"):
        np.testing.assert_allclose(other[name], one[name])
    np.testing.assert_allclose(other["rays"], one["rays"][:, -np.arange(RAYS)] * [1.0, 1.0, -1.0], atol=1e-7)


def test_the_parked_and_far_boxes_change_nothing():
    state, boxes, goals, _ = crowd_scene(3)
    parked = parking_place(np.arange(20, 26))
    zeros = np.zeros(6)
    others = CrowdState(parked, zeros, np.ones((6, 2)), zeros, zeros.astype(bool))
    more = jax.tree.map(lambda *pair: np.concatenate(pair), state, others)
    far = np.tile([-900.0, 0.0, 0.5, 0.5, 0.0], (5, 1))
    observation = observe(more, np.concatenate([boxes, far]), np.concatenate([goals, parked]))
    np.testing.assert_array_equal(observation[:20], observe(state, boxes, goals))


def test_jax_answers_as_numpy_does():
    state, boxes, goals, _ = crowd_scene(4)
    single = jax.tree.map(lambda x: jnp.asarray(x, bool if x.dtype == bool else jnp.float32), state)
    answer = jax.jit(observe)(single, jnp.asarray(boxes, jnp.float32), jnp.asarray(goals, jnp.float32))
    assert answer.dtype == jnp.float32
    np.testing.assert_allclose(answer, observe(state, boxes, goals), atol=1e-3)


def test_worlds_with_boxes_of_their_own_equal_those_worlds_alone():
    worlds = [crowd_scene(seed)[:3] for seed in (5, 6)]
    state = jax.tree.map(lambda *fields: np.stack(fields), worlds[0][0], worlds[1][0])
    boxes, goals = (np.stack([world[i] for world in worlds]) for i in (1, 2))
    together = observe(state, boxes, goals)
    for i, world in enumerate(worlds):
        np.testing.assert_array_equal(together[i], observe(*world))


@pytest.mark.parametrize("seed", [7, 8])
def test_rays_agree_with_mj_ray_in_a_crowd(seed):
    state, boxes, _, layout = crowd_scene(seed)
    model = scene.crowd_spec(Layout(layout.size, layout.obstacles), 20).compile()
    data, geom = mujoco.MjData(model), np.zeros(1, np.int32)
    data.qpos.reshape(-1, 3)[:] = np.concatenate([state.position, state.yaw[:, None]], axis=-1)
    mujoco.mj_forward(model, data)
    distance, relative = cast_rays(state, boxes)
    people = 0
    for k in range(20):
        origin, body = np.array([*state.position[k], HEIGHT / 2]), model.body(f"person{k}").id
        for r in range(RAYS):
            angle = state.yaw[k] + r * np.pi / 6
            ray = np.array([np.cos(angle), np.sin(angle), 0.0])
            oracle = mujoco.mj_ray(model, data, origin, ray, None, 1, body, geom)
            assert distance[k, r] == pytest.approx(min(oracle, RAY_RANGE), abs=1e-6)
            name = model.geom(geom[0]).name
            hit = state.velocity[int(name[6:].split("/")[0])] if name.startswith("person") else np.zeros(2)
            people += name.startswith("person") and oracle < RAY_RANGE
            expected = hit - state.velocity[k] if oracle < RAY_RANGE else np.zeros(2)
            np.testing.assert_allclose(rotate(relative[k, r], state.yaw[k]), expected, atol=1e-12)
    assert people > 20
