import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from macid import scene
from macid.layout import Layout
from macid.physics import NativePhysics, make_physics, touching
from macid.state import CONTACT_GAP, FAR_AWAY, RADIUS, parking_place

STEPS = 100
LAYOUT = Layout(14.0, [[0.0, 0.0, 0.3, 0.3, 0.0]])
AROUND = np.stack([np.cos(np.arange(6) * np.pi / 3), np.sin(np.arange(6) * np.pi / 3)], axis=-1)
NUMBER = len(AROUND)
# Two worlds: everybody walks away from the middle; two push a box there, and two pairs beside it each other.
MEETING = np.array([[-1.5, 0.0], [1.5, 0.0], [-1.0, 1.6], [1.0, 1.6], [-1.0, -1.6], [1.0, -1.6]])
PLACES = np.stack([1.5 * AROUND, MEETING])
YAW = np.stack([np.linspace(-3, 3, NUMBER)] * 2)
COMMAND = np.zeros((2, NUMBER, 3), np.float32)
COMMAND[0] = np.concatenate([AROUND, np.full((NUMBER, 1), 0.7)], axis=-1)
COMMAND[1, :, 0] = -np.sign(MEETING[:, 0])


@pytest.fixture(scope="module")
def model():
    return scene.crowd_spec(LAYOUT, NUMBER).compile()


def runner(engine, steps=STEPS):
    def run(state, command):
        return jax.lax.scan(lambda state, _: (engine.step(state, command), None), state, None, length=steps)[0]

    return jax.jit(run)


class Worlds:
    """An engine with its compiled functions, shared by the tests."""

    def __init__(self, name, model):
        self.engine = make_physics(name, model, NUMBER, LAYOUT.boxes, 2)
        self.start = jax.jit(self.engine.init)(PLACES, YAW)
        self.end = runner(self.engine)(self.start, jnp.asarray(COMMAND))


@pytest.fixture(scope="module")
def native(model):
    return Worlds("native", model)


@pytest.fixture(scope="module")
def mjx(model):
    return Worlds("mjx", model)


def test_mjx_agrees_with_the_native_engine(native, mjx):
    one, other = native.engine.read(native.end), mjx.engine.read(mjx.end)
    free, colliding = 0, 1
    np.testing.assert_allclose(other.position[free], one.position[free], atol=1e-3)
    np.testing.assert_allclose(other.velocity[free], one.velocity[free], atol=1e-3)
    np.testing.assert_allclose(other.yaw[free], one.yaw[free], atol=1e-3)
    np.testing.assert_allclose(other.yaw_rate[free], one.yaw_rate[free], atol=1e-3)
    np.testing.assert_allclose(other.position[colliding], one.position[colliding], atol=1e-2)
    np.testing.assert_array_equal(other.contact, one.contact)
    assert not one.contact[free].any() and one.contact[colliding].all()
    np.testing.assert_allclose(abs(one.position[colliding, :, 0]), [0.3 + RADIUS] * 2 + [RADIUS] * 4, atol=0.02)


def test_a_step_keeps_types_so_that_nothing_compiles_twice(native, mjx):
    for worlds in (native, mjx):
        types = [jax.tree.map(lambda x: (x.dtype, x.shape, x.weak_type), s) for s in (worlds.start, worlds.end)]
        assert types[0] == types[1]


def test_the_start_is_as_asked_and_at_rest(native, mjx):
    for worlds in (native, mjx):
        state = worlds.engine.read(worlds.start)
        np.testing.assert_allclose(state.position, PLACES, rtol=1e-6)
        np.testing.assert_allclose(state.yaw, YAW, rtol=1e-6)
        assert not np.any(state.velocity) and not np.any(state.yaw_rate)


@pytest.mark.parametrize("world", [0, 1])
def test_native_worlds_equal_plain_mujoco(model, native, world):
    data = mujoco.MjData(model)
    data.qpos.reshape(NUMBER, 3)[:] = np.concatenate([PLACES, YAW[..., None]], axis=-1)[world]
    data.ctrl[:] = COMMAND[world].ravel()
    for _ in range(STEPS):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(native.end.qpos[world], data.qpos, atol=2e-4)
    np.testing.assert_allclose(native.end.qvel[world], data.qvel, atol=2e-3)


def test_worlds_of_a_batch_equal_the_same_worlds_alone(model, native):
    for world in range(2):
        engine = NativePhysics(model, NUMBER, LAYOUT.boxes, 1)
        start = jax.jit(engine.init)(PLACES[world : world + 1], YAW[world : world + 1])
        end = runner(engine)(start, jnp.asarray(COMMAND[world : world + 1]))
        for alone, batched in zip(end, native.end, strict=True):
            np.testing.assert_array_equal(alone[0], batched[world])


def test_a_run_depends_on_its_state_only(native):
    again = runner(native.engine)(native.start, jnp.asarray(COMMAND))  # the batch has been elsewhere meanwhile
    for one, other in zip(native.end, again, strict=True):
        np.testing.assert_array_equal(one, other)


def test_several_steps_in_one_call_are_those_steps(native):
    engine, command = native.engine, jnp.asarray(COMMAND)
    several = jax.jit(lambda state: engine.step(state, command, nstep=10))(native.start)
    single = runner(engine, steps=10)(native.start, command)
    np.testing.assert_allclose(several.qpos, single.qpos, atol=1e-5)
    np.testing.assert_allclose(several.qvel, single.qvel, atol=1e-4)


@pytest.mark.parametrize("name", ["native", "mjx"])
def test_place_puts_people_at_rest_and_leaves_the_others(name, request):
    worlds = request.getfixturevalue(name)
    engine, who = worlds.engine, np.zeros((2, NUMBER), bool)
    who[0, 1] = who[1, 4] = True
    away = np.float32(parking_place(np.arange(NUMBER)))
    placed = jax.jit(engine.place)(worlds.end, who, away)
    before, after = engine.read(worlds.end), engine.read(placed)
    np.testing.assert_array_equal(np.asarray(after.position)[who], away[[1, 4]])
    assert not np.any(np.asarray(after.velocity)[who]) and not np.any(np.asarray(after.yaw_rate)[who])
    assert np.abs(np.asarray(before.velocity)[0, 1]).max() > 0.1
    for field in ("position", "velocity", "yaw_rate"):
        np.testing.assert_array_equal(np.asarray(getattr(after, field))[~who], np.asarray(getattr(before, field))[~who])
    np.testing.assert_array_equal(after.yaw, before.yaw)
    warmstart = np.asarray(placed.qacc_warmstart).reshape(2, NUMBER, 3)
    assert not warmstart[who].any() and warmstart[~who].any()


def test_the_parked_stay_where_they_are(native):
    who = np.ones((2, NUMBER), bool)
    placed = native.engine.place(native.end, who, np.float32(parking_place(np.arange(NUMBER))))
    later = native.engine.read(runner(native.engine)(placed, jnp.zeros_like(COMMAND)))
    np.testing.assert_array_equal(later.position, native.engine.read(placed).position)
    assert not np.any(later.contact)
    assert np.all(PLACES < FAR_AWAY / 2) and np.all(later.position >= FAR_AWAY)


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize(("more", "expected"), [(-2e-3, True), (-1e-5, True), (1e-5, False), (2e-3, False)])
def test_touching_begins_at_the_contact_gap(xp, more, expected):
    boxes = xp.asarray([[0.0, 0.0, 1.0, 2.0, np.pi / 2]])
    people = xp.asarray([[5.0, 0.0], [5.0 + 2 * RADIUS + CONTACT_GAP + more, 0.0], [9.0, 0.0]])
    test = jax.jit(touching) if xp is jnp else touching
    assert test(people, boxes).tolist() == [expected, expected, False]
    reach = RADIUS + CONTACT_GAP + more
    side, corner = [0.5, 1.0 + reach], [2.0 + 0.6 * reach, -1.0 - 0.8 * reach]
    assert test(xp.asarray([side, corner, [-4.0, 0.0]]), boxes).tolist() == [expected, expected, False]


def test_nobody_touches_itself_and_who_is_inside_a_box_touches_it():
    boxes = np.array([[0.0, 0.0, 1.0, 1.0, 0.0]])
    assert touching(np.array([[0.0, -3.0]]), boxes).tolist() == [False]
    assert touching(np.array([[0.2, 0.0]]), boxes).tolist() == [True]


def test_touching_takes_worlds_with_boxes_of_their_own():
    people = np.zeros((2, 1, 2))
    boxes = np.array([[[0.5, 0.0, 0.3, 0.3, 0.0]], [[5.0, 0.0, 0.3, 0.3, 0.0]]])
    assert touching(people, boxes).tolist() == [[True], [False]]


def test_an_unknown_engine_names_the_engines(model):
    with pytest.raises(ValueError, match="Unknown engine 'bullet'. Choose one of native, mjx"):
        make_physics("bullet", model, NUMBER, LAYOUT.boxes, 1)
