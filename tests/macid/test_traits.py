"""Bodies of other radii, preferred and maximum speeds, and companions."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from kinematics import crowd, least_distance, walk

from macid import scene, traits
from macid.contacts import touching
from macid.crowd import Crowd, CrowdConfig
from macid.engines import make_engine
from macid.geometry import heading, rotate
from macid.layout import Layout, load_level, random_layout, sample_goals, sample_people
from macid.observation import RAY_RANGE, RAYS, cast_rays
from macid.pedestrians import MODELS, make_controller
from macid.pedestrians.orca import ORCA
from macid.pedestrians.social_force import SocialForce
from macid.policy import policy_names
from macid.scene import PersonConfig
from macid.state import CONTACT_GAP, HEIGHT, RADIUS, CrowdState, Traits

OPEN = Layout(40.0, [])
SLIM = 0.2


def test_the_papers_traits_given_outright_change_no_bit():
    layout = random_layout(np.random.default_rng(0), 3, 16.0)
    config = CrowdConfig(number=10, period=0.1, duration=1.0, goal_distance=(4.0, 9.0))
    told = dataclasses.replace(config, person=PersonConfig(radius=0.35), preferred_speed=None, max_speed=1.5)
    controller, ends = make_controller("macid", 0.1), []
    for each in (config, told):
        made = Crowd(layout, each)
        ends.append(made.rollout(made.reset(np.random.default_rng(3)), controller))
    jax.tree.map(np.testing.assert_array_equal, *ends)
    assert len(jax.tree.leaves(ends[0][0].traits)) == 0


@pytest.mark.parametrize("radius", [SLIM, 0.45])
def test_people_who_push_each_other_settle_two_radii_apart_and_touch(radius):
    model = scene.crowd_spec(OPEN, 2, PersonConfig(radius=radius)).compile()
    engine = make_engine("native", model, 2, OPEN.boxes, 1)
    state = engine.init(np.array([[[-1.0, 0.0], [1.0, 0.0]]]), np.zeros((1, 2)))
    command = jnp.asarray([[[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]])

    def step(state, _):
        return engine.step(state, command), engine.read(state)

    end, seen = jax.jit(lambda state: jax.lax.scan(step, state, length=100))(state)
    apart = np.linalg.norm(seen.position[:, 0, 0] - seen.position[:, 0, 1], axis=-1)
    last = engine.read(end).position[0]
    assert np.linalg.norm(last[0] - last[1]) == pytest.approx(2 * radius, abs=0.02)
    np.testing.assert_array_equal(seen.contact[:, 0, 0], apart <= 2 * radius + CONTACT_GAP)
    assert 0 < np.mean(seen.contact[:, 0, 0]) < 1
    np.testing.assert_allclose(seen.traits.radius, radius)


def test_the_contact_flag_comes_on_at_the_sum_of_both_radii():
    boxes, radius = np.array([[0.0, 9.0, 5.0, 1.0, 0.0]]), np.array([0.2, 0.3, 0.4])
    for more, expected in ((-1e-5, True), (1e-5, False)):
        people = np.array([[0.0, 0.0], [0.5 + CONTACT_GAP + more, 0.0], [0.0, 8.0 - 0.4 - CONTACT_GAP - more]])
        assert touching(people, boxes, radius).tolist() == [expected] * 3


def test_native_and_mjx_agree_on_slim_people():
    """Two push each other, and one walks by itself."""
    places = np.array([[[-0.7, 0.0], [0.7, 0.0], [0.0, 3.0]]])
    command = jnp.asarray([[[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.3, 1.0, 0.7]]])
    model = scene.crowd_spec(OPEN, 3, PersonConfig(radius=SLIM)).compile()
    ends = []
    for name in ("native", "mjx"):
        engine = make_engine(name, model, 3, OPEN.boxes, 1)

        def run(state, engine=engine):
            return jax.lax.scan(lambda s, _: (engine.step(s, command), None), state, None, length=60)[0]

        ends.append(engine.read(jax.jit(run)(jax.jit(engine.init)(places, np.zeros((1, 3))))))
    np.testing.assert_allclose(ends[1].position[0, 2], ends[0].position[0, 2], atol=1e-3)
    np.testing.assert_allclose(ends[1].position, ends[0].position, atol=1e-2)
    np.testing.assert_array_equal(ends[1].contact, [[True, True, False]])
    np.testing.assert_array_equal(ends[0].contact, ends[1].contact)


def test_rays_agree_with_mj_ray_among_slim_people():
    rng = np.random.default_rng(7)
    layout, number = random_layout(rng, 4, size=14.0), 20
    place = sample_people(rng, layout, number, radius=SLIM)
    velocity, yaw = rng.normal(size=(number, 2)), rng.uniform(-np.pi, np.pi, number)
    state = CrowdState(place, yaw, velocity, np.zeros(number), np.zeros(number, bool))
    distance, relative = cast_rays(state._replace(traits=Traits(radius=np.full(number, SLIM))), layout.boxes)
    model = scene.crowd_spec(layout, number, PersonConfig(radius=SLIM)).compile()
    data, geom = mujoco.MjData(model), np.zeros(1, np.int32)
    data.qpos[:] = np.column_stack([place, yaw]).ravel()
    mujoco.mj_forward(model, data)
    people = 0
    for k in range(number):
        origin, body = np.array([*place[k], HEIGHT / 2]), model.body(f"person{k}").id
        for r in range(RAYS):
            ray = np.array([*heading(yaw[k] + r * np.pi / 6), 0.0])
            oracle = mujoco.mj_ray(model, data, origin, ray, None, 1, body, geom)
            assert distance[k, r] == pytest.approx(min(oracle, RAY_RANGE), abs=1e-6)
            met = model.geom(geom[0]).name
            hit = velocity[int(met[6:].split("/")[0])] if met.startswith("person") else np.zeros(2)
            people += met.startswith("person") and oracle < RAY_RANGE
            expected = hit - velocity[k] if oracle < RAY_RANGE else np.zeros(2)
            np.testing.assert_allclose(rotate(relative[k, r], yaw[k]), expected, atol=1e-12)
    assert people > 10


def test_orca_keeps_the_sum_of_both_radii():
    cross = np.array([[-3.0, 0.02], [3.0, 0.0], [0.0, -3.0], [0.02, 3.0]])
    far = np.array([40.0, 0.0])  # where four others, of mixed radii, meet
    starts, goals = np.concatenate([cross, far + cross]), np.concatenate([-cross, far - cross])
    radius = jnp.asarray([SLIM] * 4 + [0.1, 0.1, 0.5, 0.5])

    @dataclasses.dataclass(frozen=True)
    class Own:
        period: float = 0.1

        def __call__(self, state, boxes, goals, lcf):
            return ORCA(self.period)(state._replace(traits=Traits(radius=radius)), boxes, goals, lcf)

    place = walk(Own(), starts, np.array([[900.0, 900.0, 1.0, 1.0, 0.0]]), goals, 8.0).position
    gap = np.linalg.norm(place[:, :, None] - place[:, None], axis=-1)
    assert (gap - np.asarray(radius[:, None] + radius) + 1e3 * np.eye(8)).min() > 0.0
    assert 0.4 <= least_distance(place[:, :4]) < 0.7
    assert np.linalg.norm(place[-1] - goals, axis=-1).max() < 0.3


def test_orcas_own_radius_and_the_traits_are_one():
    rng = np.random.default_rng(1)
    state = crowd(rng.uniform(-3, 3, (12, 2)), rng.uniform(-1, 1, (12, 2)))
    goals, boxes = rng.uniform(-5, 5, (12, 2)), np.array([[0.0, 0.0, 0.5, 0.2, 0.3], [2.0, 1.0, 0.2, 0.2, 0.0]])
    own = jax.jit(ORCA(radius=SLIM, preferred_speed=1.0, max_speed=1.2))(state, boxes, goals)
    given = Traits(jnp.full(12, SLIM), jnp.full(12, 1.0), jnp.full(12, 1.2))
    np.testing.assert_allclose(jax.jit(ORCA())(state._replace(traits=given), boxes, goals), own, atol=2e-4)


def test_social_force_takes_its_constants_from_the_traits():
    rng = np.random.default_rng(1)
    state = crowd(rng.uniform(-3, 3, (12, 2)), rng.uniform(-1, 1, (12, 2)))
    goals, boxes = rng.uniform(-5, 5, (12, 2)), np.array([[0.0, 0.0, 0.5, 0.2, 0.3]])
    own = jax.jit(SocialForce(body_radius=SLIM, desired_speed=1.0, max_speed=1.2))(state, boxes, goals)
    given = Traits(jnp.full(12, SLIM), jnp.full(12, 1.0), jnp.full(12, 1.2))
    model = SocialForce(body_radius=RADIUS)
    np.testing.assert_allclose(jax.jit(model)(state._replace(traits=given), boxes, goals), own, atol=1e-5)


WANTED, LCF = np.array([[0.7], [1.1], [1.34], [1.9]]), np.array([[-1.0], [0.0], [1.0], [2.0]])
FAST = Traits(preferred_speed=WANTED, max_speed=np.full((4, 1), 2.0))


@pytest.mark.parametrize("name", ["social-force", "macid-tri"])
def test_a_person_alone_walks_at_its_preferred_speed(name):
    made = Crowd(Layout(80.0, []), CrowdConfig(number=1, period=0.1, duration=6.0, max_speed=2.0), nworld=4)
    start = np.tile([[[-30.0, 0.0]]], (4, 1, 1))
    _, position = made.rollout(made.begin(start, -start, LCF, FAST), make_controller(name, 0.1))
    speed = np.linalg.norm(position[59, :, 0] - position[39, :, 0], axis=-1) / 2.0
    np.testing.assert_allclose(speed, WANTED[:, 0], rtol=0.03)


def test_every_model_keeps_a_preferred_speed_that_it_has():
    place, ahead, still = np.zeros((4, 1, 2)), np.full((4, 1, 2), [10.0, 0.0]), np.zeros((4, 1))
    velocity = np.concatenate([WANTED[..., None], still[..., None]], axis=-1)
    state = CrowdState(place, still, velocity, still, still.astype(bool), FAST)
    for name in [
        *(each for each in MODELS if each != "standing"),
        *(name for name in policy_names() if name.endswith("-0")),
        "macid-tri-1",
    ]:
        command = make_controller(name, 0.1)(state, np.array([[900.0, 900.0, 1.0, 1.0, 0.0]]), ahead, LCF)
        kept = 0.15 if name == "macid-human-0" else 0.03  # it weighs its pace against all else that it wants
        np.testing.assert_allclose(command[:, 0, 0], WANTED[:, 0], rtol=kept)


def test_the_maximum_speed_caps():
    config = CrowdConfig(number=6, period=0.1, duration=3.0, preferred_speed=1.4, max_speed=0.8)
    made = Crowd(Layout(20.0, []), config)
    episode = made.reset(np.random.default_rng(0))
    np.testing.assert_allclose(episode.traits.max_speed, 0.8)
    _, velocity = made.rollout(episode, make_controller("macid", 0.1), record=lambda state, episode: state.velocity)
    speed = np.linalg.norm(velocity, axis=-1)
    assert 0.7 < np.max(speed) < 0.81


def test_the_draws_of_before_stay_and_the_rest_comes_after_them():
    plain = Crowd(load_level(1), CrowdConfig(number=25), nworld=2)
    rich = CrowdConfig(number=25, preferred_speed="human", max_speed=2.0)
    starts, goals, lcf, none = plain.draw(np.random.default_rng(5), 2, (-2.0, 2.0))
    assert none == Traits()
    *same, _ = Crowd(load_level(1), rich, 2).draw(np.random.default_rng(5), 2, (-2.0, 2.0))
    for one, other in zip((starts, goals, lcf), same, strict=True):
        np.testing.assert_array_equal(one, other)
    rng = np.random.default_rng(5)  # as it always was
    first = [sample_people(rng, plain.layout, 25) for _ in range(2)]
    np.testing.assert_array_equal(starts, first)
    np.testing.assert_array_equal(goals, [sample_goals(rng, plain.layout, each) for each in first])
    np.testing.assert_array_equal(lcf, rng.uniform(-2.0, 2.0, (2, 25)))


def test_human_speeds_have_weidmanns_mean_and_nearly_the_streets_deviation():
    speed = traits.draw_preferred_speed(np.random.default_rng(0), "human", 20_000)
    assert speed.min() >= 0.4 and speed.max() <= 2.0
    assert speed.mean() == pytest.approx(1.32, abs=0.02) and speed.std() == pytest.approx(0.33, abs=0.02)
    assert set(traits.draw_preferred_speed(np.random.default_rng(0), 1.2, 3)) == {1.2}
    between = traits.draw_preferred_speed(np.random.default_rng(0), (0.8, 1.0), 100)
    assert 0.8 <= between.min() < 0.85 and 0.95 < between.max() <= 1.0


@pytest.mark.parametrize("radius", [SLIM, RADIUS])
def test_companions_start_side_by_side_and_share_a_goal(radius):
    layout = random_layout(np.random.default_rng(0), 4, 30.0)
    config = CrowdConfig(60, companions=0.6, preferred_speed="human", person=PersonConfig(radius=radius))
    starts, goals, _, found = Crowd(layout, config).draw(np.random.default_rng(1), 1, (0.0, 0.0))
    starts, goals, group, speed = starts[0], goals[0], found.group[0], found.preferred_speed[0]
    sizes = np.bincount(group, minlength=60)
    assert set(sizes) <= {0, 1, 2, 3} and (sizes == 3).any() and (sizes == 2).sum() > (sizes == 3).sum()
    assert 30 <= sizes[sizes > 1].sum() <= 36
    for person, first in enumerate(group):
        assert group[first] == first and speed[person] == speed[first]
        if person != first:
            assert 0.6 <= np.linalg.norm(starts[person] - starts[first]) <= 0.8
            assert np.linalg.norm(goals[person] - goals[first]) <= 0.8
    apart = np.linalg.norm(starts[:, None] - starts, axis=-1) + 9 * np.eye(60)
    assert apart.min() > 2 * radius
    assert not touching(starts, layout.boxes, radius).any()


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"preferred_speed": 3.0}, "preferred_speed must be a number or a range"),
        ({"preferred_speed": "brisk"}, "not 'brisk'"),
        ({"preferred_speed": (1.5, 1.0)}, "preferred_speed must be"),
        ({"max_speed": 2.5}, "max_speed must be a number from 0.1 to 2 m/s, not 2.5"),
        ({"companions": 1.5}, "companions must be a share from 0 to 1"),
    ],
)
def test_what_people_can_not_be_is_told(fields, told):
    with pytest.raises(ValueError, match=told):
        CrowdConfig(**fields)
    with pytest.raises(ValueError, match=r"radius must be a number from 0\.1 to 0\.5 m, not 0\.6"):
        PersonConfig(radius=0.6)
