import jax
import jax.numpy as jnp
import numpy as np
import pytest

from macid.crowd import Crowd, CrowdConfig
from macid.layout import GOAL_DISTANCE, Layout, random_layout
from macid.pedestrians import make_controller
from macid.state import GOAL_RADIUS, RADIUS, parking_place

NOWHERE = [0.0, 500.0]  # a goal that nobody reaches


def constant(command):
    command = jnp.asarray(command, jnp.float32)
    return lambda state, boxes, goals, lcf: jnp.broadcast_to(command, (*state.position.shape[:-1], 3))


def episode_of(crowd, places, goals):
    """The episode, one world, of people at `places` who look along x and have `goals`."""
    places, goals = np.array(places, float), np.array(goals, float)
    start = crowd.reset(np.random.default_rng(0))
    state = jax.jit(crowd.engine.init)(places[None], np.zeros((1, len(places))))
    distance = jnp.asarray(np.linalg.norm(goals - places, axis=-1)[None], jnp.float32)
    return start._replace(physics=state, goals=jnp.asarray(goals[None], jnp.float32), distance=distance)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"number": 0}, "at least one person, not 0"),
        ({"period": 0.03}, "multiple of the physics step 0.02 s, not 0.03"),
        ({"period": 0.0}, "multiple of the physics step"),
        ({"period": -0.02}, "multiple of the physics step"),
        ({"period": float("inf")}, "multiple of the physics step"),
        ({"period": 1e308}, "multiple of the physics step"),
        ({"period": float("nan")}, "multiple of the physics step"),
        ({"lcf": (1.0, 0.0)}, r"range \(least, most\) in \[-2, 2\], not \(1.0, 0.0\)"),
        ({"lcf": (0.0, float("inf"))}, "range"),
    ],
)
def test_a_bad_config_is_told(fields, told):
    with pytest.raises(ValueError, match=told):
        CrowdConfig(**fields)


def test_the_papers_episode_has_1000_decisions():
    assert (CrowdConfig().steps, CrowdConfig().substeps) == (1000, 1)
    assert (CrowdConfig(period=0.1).steps, CrowdConfig(period=0.1).substeps) == (200, 5)


def test_a_long_decision_is_as_many_short_ones_and_no_longer_to_compile():
    layout, places = Layout(30.0, np.zeros((0, 5))), [[-5.0, 0.0], [-4.0, 0.3], [5.0, 1.0]]
    sizes, ends = [], []
    for period, decisions in ((0.02, 60), (1.2, 1), (12.0, 1)):
        crowd = Crowd(layout, CrowdConfig(number=3, period=period, duration=24.0))
        start = episode_of(crowd, places, [NOWHERE] * 3)
        command = constant([0.4, 0.0, 0.0])
        sizes.append(len(str(jax.make_jaxpr(lambda e, crowd=crowd: crowd.step(e, jnp.zeros((1, 3, 3))))(start))))
        if period < 12.0:
            ends.append(crowd.rollout(start, command, steps=decisions)[0])
    assert sizes[1] == pytest.approx(sizes[2], rel=0.05)
    short, long = ends
    np.testing.assert_array_equal(short.physics.qpos, long.physics.qpos)
    np.testing.assert_array_equal(short.collisions, long.collisions)
    np.testing.assert_allclose(short.travelled, long.travelled, rtol=1e-6)
    np.testing.assert_allclose(long.travelled, 0.48, atol=0.02)


def test_an_episode_begins_as_the_config_says():
    crowd = Crowd(random_layout(np.random.default_rng(0), 3, 30.0), CrowdConfig(number=8, lcf=(0.5, 0.75)), nworld=2)
    start = crowd.reset(np.random.default_rng(1))
    state = crowd.engine.read(start.physics)
    towards = np.asarray(start.goals - state.position)
    np.testing.assert_allclose(start.distance, np.linalg.norm(towards, axis=-1), rtol=1e-5)
    np.testing.assert_allclose(state.yaw, np.arctan2(towards[..., 1], towards[..., 0]), atol=1e-4)
    assert start.distance.min() >= GOAL_DISTANCE[0] - 1e-4 and start.distance.max() <= GOAL_DISTANCE[1] + 1e-4
    assert start.lcf.min() >= 0.5 and start.lcf.max() <= 0.75 and len(np.unique(start.lcf)) > 8
    assert start.walking.all() and not start.collisions.any() and not start.travelled.any() and not state.contact.any()
    assert not np.array_equal(state.position[0], state.position[1])


def test_a_walk_by_hand():
    """Three people: a walk to the goal, standing 5 mm from the wall, and standing there with the goal at hand."""
    wall = 10.0 - RADIUS - 0.005
    crowd = Crowd(Layout(20.0, []), CrowdConfig(number=3))
    start = episode_of(crowd, [[-5, 0], [5, wall], [-5, wall]], [[0, 0], NOWHERE, [-5, wall - 0.4]])
    end, positions = crowd.rollout(start, constant([[1, 0, 0], [0, 0, 0], [0, 0, 0]]), 300)
    x = np.asarray(positions[:, 0, 0, 0])
    on_map = x < 500
    assert end.walking.tolist() == [[False, True, False]]
    assert end.collisions.tolist() == [[0, 300, 1]]
    last, before = 0.0 - x[on_map][-1], 0.0 - x[on_map][-2]
    assert GOAL_RADIUS < last < before < GOAL_RADIUS + 0.06  # gone at the first decision within the goal's radius
    assert end.travelled[0, 0] == pytest.approx(5.0 - GOAL_RADIUS, abs=0.025)
    assert end.travelled[0, 0] >= 5.0 - GOAL_RADIUS
    assert abs(end.travelled[0, 1:]).max() < 1e-3
    np.testing.assert_array_equal(positions[-1, 0, 0], parking_place(0))
    np.testing.assert_array_equal(crowd.engine.read(end.physics).position[0, 2], parking_place(2))
    np.testing.assert_allclose(positions[-1, 0, 1], [5, wall], atol=1e-3)
    assert end.distance.tolist() == start.distance.tolist()


def test_who_has_arrived_is_in_nobodys_way():
    crowd = Crowd(Layout(20.0, []), CrowdConfig(number=2))
    start = episode_of(crowd, [[-3, 0], [0, 0]], [NOWHERE, [0.1, 0]])  # the second stands in the way, at its goal
    end, positions = crowd.rollout(start, constant([[1, 0, 0], [0, 0, 0]]), 300)
    assert end.collisions.tolist() == [[0, 0]]
    assert positions[-1, 0, 0, 0] > 2.5
    assert end.travelled[0, 0] == pytest.approx(float(crowd.engine.read(end.physics).position[0, 0, 0]) + 3, abs=1e-3)


def test_the_count_of_collisions_does_not_depend_on_the_period():
    places = [[-2, 0], [2, 0.2], [0, 2], [0.3, -2], [-2, -2], [2, 2]]
    command = np.concatenate([-np.array(places) * 0.5, np.full((6, 1), 0.3)], axis=-1)
    ends = []
    for period, steps in ((0.02, 200), (0.1, 40)):
        crowd = Crowd(Layout(8.0, [[0.0, 0.0, 0.3, 0.3, 0.2]]), CrowdConfig(6, period, goal_distance=(1.0, 9.0)))
        start = episode_of(crowd, places, [NOWHERE] * 6)
        ends.append(crowd.rollout(start, constant(command), steps)[0])
    assert ends[0].collisions.sum() > 200
    np.testing.assert_array_equal(ends[0].collisions, ends[1].collisions)
    np.testing.assert_allclose(ends[0].travelled, ends[1].travelled, rtol=1e-5)


def test_the_same_seed_gives_the_same_episode_bit_for_bit():
    crowd = Crowd(random_layout(np.random.default_rng(0), 2, 16.0), CrowdConfig(number=10), nworld=2)
    controller = make_controller("social-force", 0.02)
    one, other, same = (crowd.rollout(crowd.reset(np.random.default_rng(s)), controller, 150) for s in (3, 4, 3))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(same), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one[1], other[1])


def test_how_smoothly_people_walk_is_measured():
    crowd = Crowd(Layout(40.0, np.empty((0, 5))), CrowdConfig(number=2, duration=4.0))

    def controller(state, boxes, goals, lcf):  # the first walks up and down the speeds, the second stands and swings
        # The second's yaw is the clock: it turns by 0.01 rad a decision.
        step = jnp.round(state.yaw[:, 1] / (0.5 * 0.02)).astype(int) % 2
        speed = jnp.where(step == 0, 1.0, 0.6)
        commands = [
            jnp.stack([speed, 0 * speed, 0 * speed], -1),
            jnp.stack([0 * speed, 0 * speed, 0.5 + 0 * speed], -1),
        ]
        return jnp.stack(commands, axis=1)

    end, _ = crowd.rollout(episode_of(crowd, [[-15, 0], [15, 0]], [NOWHERE, NOWHERE]), controller)
    np.testing.assert_allclose(end.time, 4.0, rtol=1e-4)
    np.testing.assert_allclose(end.stalled, [[0.0, 4.0]], atol=0.03)
    assert end.turned[0, 0] == pytest.approx(0.0, abs=1e-3) and end.turned[0, 1] == pytest.approx(0.5, rel=0.05)
    assert end.sped[0, 1] == pytest.approx(0.0, abs=1e-3)
    assert 20.0 < end.sped[0, 0] < 200 * 0.4  # the body follows a command with a lag
