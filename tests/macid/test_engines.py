import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from macid import scene
from macid.contacts import touching
from macid.crowd import Crowd, CrowdConfig
from macid.engines import ENGINES, best_engine, engine_kind, make_engine
from macid.engines.base import EngineOverflow
from macid.engines.native import NativeEngine
from macid.files import UsageError
from macid.layout import Layout
from macid.learning import ppo
from macid.learning import trainer as trainer_module
from macid.learning.config import TrainConfig
from macid.learning.train import train
from macid.learning.trainer import Trainer
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
        self.engine = make_engine(name, model, NUMBER, LAYOUT.boxes, 2)
        self.start = jax.jit(self.engine.init)(PLACES, YAW)
        self.end = runner(self.engine)(self.start, jnp.asarray(COMMAND))


@pytest.fixture(scope="module")
def native(model):
    return Worlds("native", model)


@pytest.fixture(scope="module")
def mjx(model):
    return Worlds("mjx", model)


@pytest.fixture(scope="module")
def warp(model):
    pytest.importorskip("warp")
    return Worlds("warp", model)


@pytest.mark.parametrize(("name", "colliding_within"), [("mjx", 1e-2), ("warp", 1e-3)])
def test_an_engine_agrees_with_the_native_one(native, name, colliding_within, request):
    other_worlds = request.getfixturevalue(name)
    one, other = native.engine.read(native.end), other_worlds.engine.read(other_worlds.end)
    free, colliding = 0, 1
    np.testing.assert_allclose(other.position[free], one.position[free], atol=1e-3)
    np.testing.assert_allclose(other.velocity[free], one.velocity[free], atol=1e-3)
    np.testing.assert_allclose(other.yaw[free], one.yaw[free], atol=1e-3)
    np.testing.assert_allclose(other.yaw_rate[free], one.yaw_rate[free], atol=1e-3)
    np.testing.assert_allclose(other.position[colliding], one.position[colliding], atol=colliding_within)
    np.testing.assert_array_equal(other.contact, one.contact)
    assert not one.contact[free].any() and one.contact[colliding].all()
    np.testing.assert_allclose(abs(one.position[colliding, :, 0]), [0.3 + RADIUS] * 2 + [RADIUS] * 4, atol=0.02)


@pytest.mark.parametrize("name", ENGINES)
def test_a_step_keeps_types_so_that_nothing_compiles_twice(name, request):
    worlds = request.getfixturevalue(name)
    types = [jax.tree.map(lambda x: (x.dtype, x.shape, x.weak_type), s) for s in (worlds.start, worlds.end)]
    assert types[0] == types[1]


@pytest.mark.parametrize("name", ENGINES)
def test_the_start_is_as_asked_and_at_rest(name, request):
    worlds = request.getfixturevalue(name)
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
        engine = NativeEngine(model, NUMBER, LAYOUT.boxes, 1)
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


@pytest.mark.parametrize("name", ENGINES)
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
    coming, facing = np.full((2, NUMBER, 2), [0.6, -0.8]), np.full((2, NUMBER), 0.5)
    came = engine.read(jax.jit(engine.place)(worlds.end, who, away, coming, facing))
    for field, there in (("velocity", [0.6, -0.8]), ("yaw", 0.5), ("yaw_rate", 0.0)):
        one, other = (np.asarray(getattr(each, field)) for each in (before, came))
        np.testing.assert_allclose(other[who], np.broadcast_to(there, other[who].shape), atol=1e-6)
        np.testing.assert_array_equal(other[~who], one[~who])
    np.testing.assert_array_equal(came.position, after.position)
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


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("bullet", "Unknown engine 'bullet'. Choose one of native, mjx, warp"),
        ("native:threads=2", "The engine 'native' has no option 'threads'. It has none"),
    ],
)
def test_an_unknown_engine_or_option_is_told(model, name, told):
    with pytest.raises(UsageError, match=told):
        make_engine(name, model, NUMBER, LAYOUT.boxes, 1)


def test_on_a_cpu_the_native_engine_is_the_best():
    name, why = best_engine()
    assert name == "native" and "no GPU" in why


def test_without_warp_it_is_told_what_to_install(model, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UsageError, match="needs the package warp-lang: pip install warp-lang==") as caught:
        make_engine("warp", model, NUMBER, LAYOUT.boxes, 1)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ("contact=2", "no option 'contact'\\. Choose one of contacts, "),
        ("contacts=0", "contacts must be at least 1, not 0"),
        ("contacts=many", "contacts must be of its default's kind, 2, not 'many'"),
        ("solver=lu", "solver must be one of auto, newton, cg, not 'lu'"),
    ],
)
def test_wrong_options_of_warp_are_told(options, told):
    pytest.importorskip("warp")
    with pytest.raises(UsageError, match=told):
        engine_kind(f"warp:{options}")


def test_warp_worlds_of_a_batch_and_of_stacks_equal_the_same_worlds_alone(model, warp):
    """Those of a batch, the same one by one, and three stacked batches, as of several seeds."""
    engine, steps = warp.engine, 40
    command = jnp.asarray(COMMAND)
    end = runner(engine, steps)(warp.start, command)
    alone = make_engine("warp", model, NUMBER, LAYOUT.boxes, 1)
    for world in range(2):
        start = alone.init(PLACES[world : world + 1], YAW[world : world + 1])
        one = runner(alone, steps)(start, command[world : world + 1])
        np.testing.assert_allclose(one.qpos[0], end.qpos[world], atol=1e-5)
    scale = jnp.array([1.0, 0.5, 0.0])[:, None, None, None]
    stacked = jax.vmap(runner(engine, steps), (None, 0))(warp.start, scale * command)
    assert stacked.qpos.shape == (3, 2, 3 * NUMBER)
    np.testing.assert_allclose(stacked.qpos[0], end.qpos, atol=1e-5)
    half = runner(engine, steps)(warp.start, 0.5 * command)
    np.testing.assert_allclose(stacked.qpos[1], half.qpos, atol=1e-5)
    np.testing.assert_allclose(stacked.qpos[2], warp.start.qpos, atol=1e-5)


def test_too_little_room_in_warp_is_an_error_that_names_the_option(model, warp):
    engine = make_engine("warp:contacts=1", model, NUMBER, LAYOUT.boxes, 1)
    apart = jax.jit(engine.init)(PLACES[:1], YAW[:1])
    engine.step(apart, jnp.zeros((1, NUMBER, 3)))
    engine.check()
    heap = engine.init(np.full((1, NUMBER, 2), 3.0) + 0.01 * AROUND, YAW[:1])  # all touch all: 15 contacts
    jax.block_until_ready(engine.step(heap, jnp.zeros((1, NUMBER, 3))))
    with pytest.raises(EngineOverflow, match=r"too little room for contacts: 1 contacts a person.*warp:contacts=2"):
        engine.check()
    warp.engine.check()  # has room for as many


def test_a_crowd_on_warp_comes_to_where_the_native_one_does(model, warp):
    config = CrowdConfig(number=NUMBER, duration=1.0)
    layout = Layout(30.0, [[0.0, 0.0, 0.3, 0.3, 0.0]])
    ends = {}
    for engine in ("native", "warp"):
        crowd = Crowd(layout, config, nworld=2, engine=engine)
        start = crowd.reset(np.random.default_rng(3))
        end, _ = crowd.rollout(start, lambda state, boxes, goals, lcf: jnp.ones((2, NUMBER, 3)))
        assert crowd.engine.faults(end.physics) == ["", ""]
        ends[engine] = end
    np.testing.assert_allclose(ends["warp"].travelled, ends["native"].travelled, atol=1e-3)
    np.testing.assert_array_equal(ends["warp"].collisions, ends["native"].collisions)


def test_warp_trains_several_seeds_at_once_and_goes_on_where_it_stopped(tmp_path, monkeypatch):
    pytest.importorskip("warp")
    small = Layout(30.0, [[0.0, 0.0, 0.3, 0.3, 0.0]], pedestrians=NUMBER)
    monkeypatch.setattr(trainer_module, "load_level", lambda level: small)
    config = TrainConfig(
        engine="warp", nworld=2, rollout=4, episode=2, agent_steps=4 * 48, ppo=ppo.PpoConfig(batch=24, epochs=1)
    )
    with pytest.raises(ValueError, match="'warp' runs on one device, not on 2"):
        Trainer(config, [jax.devices()[0]] * 2)
    quiet = {"show": lambda line: None}
    whole = train(config, tmp_path / "whole", seeds=2, **quiet)
    arrived, fetch = [], jax.device_get

    def interrupted(logs):
        arrived.append(logs)
        if len(arrived) == 3:
            raise KeyboardInterrupt
        return fetch(logs)

    with monkeypatch.context() as patch:
        patch.setattr(jax, "device_get", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train(config, tmp_path / "parts", seeds=2, **quiet)
    lines = []
    parts = train(config, tmp_path / "parts", seeds=2, resume=True, show=lines.append)
    assert lines[0] == "resumed at iteration 2 of 4"
    for one, other in zip(whole, parts, strict=True):
        for layer, like in zip(one.layers, other.layers, strict=True):
            np.testing.assert_allclose(layer[0], like[0], atol=2e-3)
