"""The second observation, its policies, and the scenes in which they learn."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from macid import encounters, networks
from macid.encounter_policy import EncounterPolicy, next_velocity, wanted_velocity
from macid.engines import make_engine
from macid.files import UsageError
from macid.geometry import rotate
from macid.learning import scenes
from macid.learning.ppo import init_mlp
from macid.pedestrians import make_controller
from macid.policy import load_policy
from macid.scene import PERSON, crowd_spec
from macid.state import CrowdState, Traits

RADIUS = 0.2
EMPTY = np.array([[500.0, 500.0, 1.0, 1.0, 0.0]])


def crowd(seed, number=12, size=6.0):
    """A random CrowdState with traits, boxes and goals."""
    rng = np.random.default_rng(seed)
    traits = Traits(
        np.full(number, RADIUS), rng.uniform(0.8, 1.6, number), np.full(number, 2.0), np.arange(number) // 2 * 2
    )
    state = CrowdState(
        rng.uniform(-size / 2, size / 2, (number, 2)),
        rng.uniform(-3, 3, number),
        rng.normal(0, 1, (number, 2)),
        np.zeros(number),
        rng.random(number) < 0.3,
        traits,
    )
    boxes = np.array([[4.0, 0.0, 0.2, 4.0, 0.0], [0.5, 2.0, 0.6, 0.3, 0.4]])
    return state, boxes, rng.uniform(-8, 8, (number, 2))


def split(observed):
    """(own numbers by name, people (..., PEOPLE, PERSON_SIZE))."""
    ends = np.cumsum([0, *encounters.OWN.values()])
    own = {name: observed[..., a:b] for name, a, b in zip(encounters.OWN, ends[:-1], ends[1:], strict=True)}
    people = observed[..., encounters.OWN_SIZE :]
    return own, people.reshape(*people.shape[:-1], encounters.PEOPLE, encounters.PERSON_SIZE)


def policy(seed=0, **recipe):
    keys = jax.random.split(jax.random.key(seed), 2)
    head = init_mlp(keys[0], (networks.OWN + 2 * 8, 16, 2), 1.0)
    person = init_mlp(keys[1], (networks.PERSON, 8, 9), 1.0)
    plain = [tuple((np.asarray(w), np.asarray(b)) for w, b in layers) for layers in (head, person)]
    return EncounterPolicy(plain[0], {"inputs": "encounters", "method": "macid-human", **recipe}, plain[1])


def test_the_columns_are_all_there_is():
    state, boxes, goals = crowd(0)
    assert encounters.observe(state, boxes, goals).shape == (12, encounters.SIZE)
    assert sum(encounters.COLUMNS.values()) == encounters.SIZE == 134


def test_a_single_person_who_comes_is_seen_in_the_frame_of_the_goal():
    state = CrowdState(
        np.array([[0.0, 0.0], [0.0, 3.0]]),
        np.zeros(2),
        np.array([[0.0, 1.0], [0.0, -1.0]]),
        np.zeros(2),
        np.zeros(2, bool),
        Traits(radius=np.full(2, RADIUS)),
    )
    own, people = split(encounters.observe(state, EMPTY, np.array([[0.0, 5.0], [1.0, 3.0]])))
    assert own["goal"][:, 0] == pytest.approx([5.0, 1.0])
    assert own["velocity"] == pytest.approx(np.array([[1.0, 0.0], [0.0, -1.0]]))
    assert people[0, 0] == pytest.approx([1.0, 3.0, 0.0, -2.0, 0.0, 1.3, 0.0])
    assert people[0, 1:] == pytest.approx(np.tile([0.0, 10.0, 0.0, 0.0, 0.0, 10.0, 0.0], (15, 1)))
    assert own["walls"] == pytest.approx(np.full((2, encounters.WALL_RAYS), encounters.WALL_RANGE))


def test_walls_are_measured_from_the_surface_of_the_body():
    state = CrowdState(
        np.zeros((1, 2)), np.zeros(1), np.zeros((1, 2)), np.zeros(1), np.zeros(1, bool), Traits(radius=np.array([0.3]))
    )
    own, _ = split(encounters.observe(state, np.array([[2.0, 0.0, 0.5, 3.0, 0.0]]), np.array([[0.0, 4.0]])))
    walls = own["walls"][0]
    quarter = encounters.WALL_RAYS // 4
    assert walls[-quarter] == pytest.approx(1.2)  # to the right of the way to the goal
    assert walls[0] == walls[quarter] == encounters.WALL_RANGE


@pytest.mark.parametrize("seed", range(4))
def test_an_observation_turns_with_the_world_and_moves_with_it(seed):
    state, boxes, goals = crowd(seed)
    angle, shift = 0.7, np.array([3.0, -2.0])

    def moved(points):
        return rotate(points, np.full(points.shape[:-1], angle)) + shift

    turned = state._replace(
        position=moved(state.position), yaw=state.yaw + angle, velocity=moved(state.velocity) - shift
    )
    boxes_turned = np.concatenate([moved(boxes[:, :2]), boxes[:, 2:4], boxes[:, 4:] + angle], axis=-1)
    before = encounters.observe(state, boxes, goals)
    assert encounters.observe(turned, boxes_turned, moved(goals)) == pytest.approx(before, abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_the_order_of_people_has_no_meaning(seed):
    state, boxes, goals = crowd(seed, number=24)
    order = np.random.default_rng(seed).permutation(24)
    shuffled = jax.tree.map(lambda leaf: leaf[order], state)
    before, after = encounters.observe(state, boxes, goals), encounters.observe(shuffled, boxes, goals[order])
    assert after == pytest.approx(before[order])
    # Nor has the order in which an observation names them, to a policy.
    own, people = before[..., : encounters.OWN_SIZE], split(before)[1]
    mixed = people[:, np.random.default_rng(seed).permutation(encounters.PEOPLE)]
    mixed = np.concatenate([own, mixed.reshape(24, -1)], axis=-1)
    assert policy()(mixed, 0.5) == pytest.approx(policy()(before, 0.5), abs=1e-5)


def test_those_who_meet_soonest_are_seen_though_others_are_nearer():
    number = 30
    angle = np.linspace(0, 2 * np.pi, number - 2, endpoint=False)
    ring = 3.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    position = np.concatenate([[[0.0, 0.0]], ring, [[8.0, 0.1]]])
    velocity = np.zeros((number, 2))
    velocity[-1] = [-2.0, 0.0]
    state = CrowdState(
        position,
        np.zeros(number),
        velocity,
        np.zeros(number),
        np.zeros(number, bool),
        Traits(radius=np.full(number, 0.2)),
    )
    people = split(encounters.observe(state, EMPTY, np.full((number, 2), [20.0, 0.0])))[1]
    assert people[0, 0, 1:3] == pytest.approx([8.0, 0.1])
    assert (people[0, :, 0] == 1).all()


def test_numpy_and_jax_agree_and_companions_are_told():
    state, boxes, goals = crowd(3)
    single = jax.tree.map(lambda leaf: leaf.astype(np.float32) if leaf.dtype == float else leaf, state)
    plain = encounters.observe(single, boxes.astype(np.float32), goals.astype(np.float32))
    jitted = jax.jit(encounters.observe)(jax.tree.map(jnp.asarray, single), jnp.asarray(boxes), jnp.asarray(goals))
    assert np.asarray(jitted) == pytest.approx(plain, abs=1e-4)
    assert (split(plain)[1][..., -1].sum(axis=-1) == 1).all()  # everybody has one companion


def test_a_policy_is_the_same_in_numpy_jax_and_torch_and_from_its_file(tmp_path):
    torch = pytest.importorskip("torch")
    state, boxes, goals = crowd(5, number=20)
    observed = np.float32(encounters.observe(state, boxes, goals))
    lcf = np.linspace(-2, 2, 20, dtype=np.float32)
    made = policy()
    made.save(tmp_path / "people")
    read = load_policy(str(tmp_path / "people.npz"))
    expected = made(observed, lcf)
    assert isinstance(read, EncounterPolicy) and (read(observed, lcf) == expected).all()
    assert np.asarray(jax.jit(made)(jnp.asarray(observed), jnp.asarray(lcf))) == pytest.approx(expected, abs=1e-5)
    assert made.to_torch()(torch.as_tensor(observed), torch.as_tensor(lcf)).detach().numpy() == pytest.approx(
        expected, abs=1e-5
    )


def test_what_a_network_that_says_nothing_wants_is_its_preferred_speed():
    assert wanted_velocity(np.zeros((3, 2)), np.array([0.5, 1.0, 2.5])) == pytest.approx(
        np.array([[0.5, 0], [1.0, 0], [2.0, 0]])
    )
    velocity = np.zeros((1, 2))
    for _ in range(30):
        velocity = next_velocity(np.zeros((1, 2)), velocity, np.array([1.2]), 0.1)
    assert velocity[0] == pytest.approx([1.2, 0.0], abs=1e-3)


@pytest.mark.parametrize(
    ("column", "value", "told"),
    [(0, np.nan, "goal"), (0, -1.0, "goal"), (7, -0.5, "walls"), (encounters.OWN_SIZE + 1, np.inf, "position")],
)
def test_what_cannot_be_understood_is_refused_by_name(column, value, told):
    state, boxes, goals = crowd(1)
    observed = np.float32(encounters.observe(state, boxes, goals))
    observed[3, column] = value
    with pytest.raises(ValueError, match=told):
        policy()(observed, 0.0)
    with pytest.raises(ValueError, match="LCF"):
        policy()(np.float32(encounters.observe(state, boxes, goals)), 3.0)
    with pytest.raises(ValueError, match="134 columns"):
        policy()(np.zeros((2, 41)), 0.0)


def test_walls_and_times_at_infinity_are_as_far_as_they_can_be():
    state, boxes, goals = crowd(1)
    observed = np.float32(encounters.observe(state, boxes, goals))
    far = observed.copy()
    far[:, 6] = encounters.WALL_RANGE
    endless = observed.copy()
    endless[:, 6] = np.inf
    assert (policy()(endless, 0.0) == policy()(far, 0.0)).all()


def test_files_that_do_not_fit_together_are_refused(tmp_path):
    made = policy()
    dataclasses.replace(made, recipe={"method": "macid"}).save(tmp_path / "other")
    with pytest.raises(UsageError, match="inputs"):
        load_policy(str(tmp_path / "other.npz"))
    with pytest.raises(ValueError, match="the network takes"):
        EncounterPolicy(made.layers[1:], made.recipe, made.person)
    policy(radius=3.0).save(tmp_path / "broad")
    with pytest.raises(UsageError, match="radius"):
        load_policy(str(tmp_path / "broad.npz"))


@pytest.mark.slow
def test_a_policy_walks_people_through_the_engine_and_both_engines_agree(tmp_path):
    policy().save(tmp_path / "people")
    controller = make_controller(str(tmp_path / "people.npz"), 0.1)
    which = scenes.SCENES["two-ways"]
    drawn = scenes.draw(which, np.random.default_rng(0), 1, RADIUS)
    number = 3
    model = crowd_spec(which.layout, number, dataclasses.replace(PERSON, radius=RADIUS)).compile()
    ends = {}
    for name in ("native", "mjx"):
        engine = make_engine(name, model, number, which.layout.boxes, 1)
        position = np.float32(drawn.position[:, :number])
        state = engine.init(position, np.zeros((1, number), np.float32))
        goals = jnp.asarray(position + np.float32([5.0, 0.0]))

        @jax.jit
        def one(state, engine=engine, goals=goals):
            crowd = engine.read(state)
            command = controller(crowd, engine.boxes, goals, jnp.zeros((1, number)))
            return engine.step(state, command, 5)

        for _ in range(5):
            state = one(state)
        ends[name] = np.asarray(engine.read(state).position)
    assert ends["native"] == pytest.approx(ends["mjx"], abs=1e-3)
    assert (ends["native"] != np.float32(drawn.position[:, :number])).any()
