"""The robot's worlds as functions on MJX-Warp, against the native engine."""

import functools

import gymnasium
import numpy as np
import pytest

pytest.importorskip("warp")

import jax
import jax.numpy as jnp

import bson
from bson import benchmark
from bson.agents import learned
from bson.episodes.session import Session
from bson.episodes.tracks import make_track
from bson.interfaces.device import DeviceWorlds
from bson.interfaces.functional import BsonFuncEnv
from bson.sensors import Imu, Lidar2D, Lidar3D
from bson.simulation.batched import COLLISIONS
from bson.simulation.engines import warp
from bson.simulation.pool import Pool
from bson.task import TaskConfig
from macid.files import UsageError

WORLDS, SEED = 3, 3
CONFIG = {"num_pedestrians": 5, "obstacle_density": 0.5, "map_size": 12.0, "goal_distance": (6.0, 12.0), "horizon": 60}
SMALL = {"num_pedestrians": 4, "map_size": 14.0, "goal_distance": (5.0, 12.0), "horizon": 8}


@pytest.fixture(scope="module")
def env():
    return BsonFuncEnv("global", "lidar2d", WORLDS, seed=SEED, pool=2 * WORLDS, **CONFIG)


@functools.cache
def _functions(env):
    """initial(slots) and step(states, actions, over, slots), compiled for all worlds."""
    initial = jax.jit(jax.vmap(env.initial, in_axes=(0, None)))
    follow = jax.jit(jax.vmap(env.follow, in_axes=(0, 0, 0, 0, None)))

    def step(states, actions, over=(False,) * WORLDS, slots=(0,) * WORLDS):
        return follow(
            states, jnp.asarray(actions, jnp.float32), jnp.asarray(over), jnp.asarray(slots), env.default_params
        )

    return lambda slots: initial(jnp.asarray(slots), env.default_params), step


def _native(env, count=WORLDS, seed=SEED):
    session = Session(env.config, env.track, count, seeds=range(seed, seed + count))
    return session, session.reset(np.arange(count), np.arange(seed, seed + count))


def _observed(env, states):
    return jax.device_get(jax.vmap(env.observation)(states))


def test_same_seed_same_first_observation(env):
    states = _functions(env)[0](np.arange(WORLDS))
    seen, (session, wanted) = _observed(env, states), _native(env)
    assert set(seen) == set(wanted)
    for name, value in wanted.items():
        assert seen[name].dtype == value.dtype
        assert seen[name].shape == value.shape
        np.testing.assert_allclose(seen[name], value, atol=1e-4, err_msg=name)
        assert all(one in env.observation_space[name] for one in seen[name])
    info, native = jax.device_get(jax.vmap(env.state_info)(states)), session.info(np.arange(WORLDS))
    assert set(info) == set(native)
    for name in set(info) - {"seed", "fault"}:
        np.testing.assert_allclose(info[name], native[name], atol=1e-4, err_msg=name)
    assert (info["seed"][:, 0] == native["seed"]).all()
    assert not info["fault"].any()


def test_equal_commands_lead_to_the_same_places(env):
    initial, step = _functions(env)
    states, (session, _) = initial(np.arange(WORLDS)), _native(env)
    rng, every = np.random.default_rng(0), np.arange(WORLDS)
    for number in range(20):
        if number % 5 == 0:
            action = rng.uniform(-1.0, 1.0, (WORLDS, 2)).astype(np.float32)
        before, states = states, step(states, action)
        reward = jax.vmap(env.reward)(before, action, states)
        _, wanted, _, _ = session.step(every, action)
        np.testing.assert_allclose(reward, wanted, atol=1e-3)
    world = session.world
    np.testing.assert_allclose(states.pose, world.pose, atol=1e-2)
    people = states.motion.qpos[:, : 3 * 5].reshape(WORLDS, 5, 3)
    np.testing.assert_allclose(people[..., :2], world.people[..., :2], atol=1e-2)
    np.testing.assert_allclose(states.travelled, world.travelled, atol=1e-2)
    assert (states.counts[:, 0] == world.collisions).all()
    assert not states.overflow.any()


@pytest.mark.slow
def test_slim_people_with_speeds_of_their_own_and_companions_move_alike():
    people = {"person_radius": 0.2, "preferred_speed": "human", "person_max_speed": 2.0, "companions": 0.6}
    env = BsonFuncEnv("local", "lidar2d", 2, seed=SEED, pool=2, **CONFIG | people | {"num_pedestrians": 6})
    states = jax.jit(jax.vmap(env.initial, in_axes=(0, None)))(jnp.arange(2), env.default_params)
    step, (session, wanted) = jax.jit(jax.vmap(env.transition)), _native(env, 2)
    np.testing.assert_allclose(_observed(env, states)["lidar"], wanted["lidar"], atol=1e-4)
    np.testing.assert_allclose(states.drawn.traits.preferred_speed[0], session.world.traits(0).preferred_speed)
    rng = np.random.default_rng(0)
    for _ in range(15):
        action = rng.uniform(-1.0, 1.0, (2, 2)).astype(np.float32)
        states = step(states, action)
        session.step(np.arange(2), action)
    world = session.world
    places = states.motion.qpos[:, : 3 * 6].reshape(2, 6, 3)
    np.testing.assert_allclose(places[..., :2], world.people[..., :2], atol=1e-2)
    np.testing.assert_allclose(states.nearest_person, world.nearest_person, atol=1e-2)


def test_among_routes_people_and_the_beams_of_a_3d_lidar_are_the_native_ones():
    """On a map with routes. After each step a native world is put into the device's state, and sees the same."""
    sensors = (Lidar3D(), Lidar2D(noise=0.0, key="flat", beams=90, yaw=1.0, pitch=0.1, range_max=4.0))
    setting = {"map": "corridor-flow", "num_pedestrians": 6, "goal_distance": (10.0, 19.0)}
    env = BsonFuncEnv("local", sensors, 2, seed=SEED, pool=2, **setting)
    session, wanted = _native(env, 2)
    world, every, rng = session.world, np.arange(2), np.random.default_rng(1)
    initial, step = jax.jit(jax.vmap(env.initial, in_axes=(0, None))), jax.jit(jax.vmap(env.transition))
    states = initial(jnp.arange(2), env.default_params)
    assert (np.asarray(states.drawn.turns) > 1).any()  # ways have waypoints
    np.testing.assert_allclose(jax.vmap(env.world.headings)(states), world.people_goals, atol=1e-4)
    seen = _observed(env, states)
    for key in ("lidar3d", "flat"):
        assert seen[key].shape == wanted[key].shape
        np.testing.assert_allclose(seen[key], wanted[key], atol=1e-4, err_msg=key)
    assert (wanted["flat"] == 4.0).any() and (wanted["lidar3d"] == 100.0).any()  # what meets nothing reads the range
    onlooker, _ = _native(env, 2)
    for _ in range(4):
        action = rng.uniform(-1.0, 1.0, (2, 2)).astype(np.float32)
        states = step(states, action)
        session.step(every, action)
        np.testing.assert_allclose(states.motion.qpos[:, :18], world.qpos[:, :18], atol=2e-3)
        onlooker.world.engine.qpos[:] = np.asarray(states.motion.qpos)
        onlooker.world.place(every)
        seen, wanted = _observed(env, states), onlooker.observe(every)
        for key in ("lidar3d", "flat"):
            off = np.abs(seen[key] - wanted[key])
            edges = off > 1e-4 * np.maximum(1.0, wanted[key] / 10.0)  # a beam that just passes somebody
            assert edges.mean() < 1e-3, key
    assert (states.counts == np.stack([getattr(world, name) for name in COLLISIONS], axis=-1)).all()


def _placed(states, session, pose, people=None):
    """Both engines' worlds with the robot at `pose` (3,), and the people at `people` (K, 2), all at rest."""
    world = session.world
    standing = world.people.copy()
    if people is not None:
        standing[..., :2] = people
    world.place(np.arange(world.nworld), pose=np.tile(pose, (world.nworld, 1)), people=standing)
    qpos = world.qpos.copy()
    zero = jnp.zeros_like(states.motion.qvel)
    motion = states.motion._replace(qpos=jnp.asarray(qpos, jnp.float32), qvel=zero, warmstart=zero)
    return states._replace(motion=motion)


@pytest.mark.parametrize("what", ["wall", "person"])
def test_what_the_robot_runs_into_counts_alike(env, what):
    initial, step = _functions(env)
    states, (session, _) = initial(np.arange(WORLDS)), _native(env)
    people = np.stack([np.linspace(-4.0, 4.0, 5), np.full(5, 5.2)], axis=-1)
    pose = (5.65, -5.2, 0.0) if what == "wall" else (0.0, 5.2 - 0.9, np.pi / 2)
    states = _placed(states, session, pose, people)
    for _ in range(5):
        action = np.tile([1.0, 0.0], (WORLDS, 1))
        states = step(states, action)
        session.step(np.arange(WORLDS), action)
    world = session.world
    wanted = np.stack([getattr(world, name) for name in COLLISIONS], axis=-1)
    assert (wanted[:, 0] > 5).all()
    assert (np.abs(np.asarray(states.counts) - wanted) <= 1).all()


def test_the_next_episode_begins_by_itself(env):
    initial, step = _functions(env)
    over, slots = np.array([False, True, False]), np.array([0, 4, 0])
    action = np.tile([0.5, 0.2], (WORLDS, 1))
    states = step(initial(np.arange(WORLDS)), action)
    after = step(states, action, over, slots)
    fresh = initial(slots)
    assert after.steps.tolist() == [2, 0, 2]
    for name in ("pose", "counts", "travelled", "distance", "stage"):
        np.testing.assert_allclose(getattr(after, name)[1], getattr(fresh, name)[1], atol=1e-6)
    for one, other in zip(jax.tree.leaves(after.readings), jax.tree.leaves(fresh.readings), strict=True):
        np.testing.assert_allclose(one[1], other[1], atol=1e-4)


def test_episodes_end_at_the_goal_and_at_the_horizon(env):
    states = _functions(env)[0](np.arange(WORLDS))
    there = states._replace(arrived=jnp.array([True, False, True]), steps=jnp.array([5, 60, 60]))
    assert jax.vmap(env.terminal)(there).tolist() == [True, False, True]
    assert jax.vmap(env.truncation)(there).tolist() == [False, True, False]


def test_worlds_on_the_device_take_each_episode_once(env):
    worlds = DeviceWorlds(env, seed=SEED, pool=12, workers=0)
    try:
        carry, _ = worlds.begin()
        step, seeds = jax.jit(worlds.step), carry.states.drawn.seed[:, 0].tolist()
        assert seeds == [SEED, SEED + 1, SEED + 2]
        for _ in range(4):
            carry = carry._replace(over=jnp.ones(WORLDS, bool))
            carry, outcome = step(carry, jnp.zeros((WORLDS, 2)), worlds.ready())
            worlds.done(carry)
            assert np.asarray(outcome.began).all()
            assert not np.asarray(outcome.reward).any()
            seeds += carry.states.drawn.seed[:, 0].tolist()
        assert seeds == list(range(SEED, SEED + len(seeds)))
    finally:
        worlds.close()


def test_pool_keeps_what_is_not_used_yet():
    pool = Pool(TaskConfig(num_pedestrians=2), 8, seed=5)
    try:
        pool.ensure(7)  # blocks of two
        assert np.asarray(pool.episodes.seed)[:, 0].tolist() == list(range(5, 13))
        pool.used(3)
        pool.ensure(7)
        assert np.asarray(pool.episodes.seed)[:, 0].tolist() == [13, 14, *range(7, 13)]  # 8 is used up, 9 is not
        pool.used(5)
        pool.ensure(7)
        assert np.asarray(pool.episodes.seed)[:, 0].tolist() == [*range(13, 21)]
        with pytest.raises(ValueError, match="larger"):
            pool.ensure(8)
    finally:
        pool.close()


@functools.cache
def _vector(output):
    return gymnasium.make_vec("BSON/GlobalCamera-v0", num_envs=2, engine="warp", output=output, workers=0, **SMALL)


def test_vector_form_is_the_native_one_but_for_rounding():
    env, native = _vector("numpy"), gymnasium.make_vec("BSON/GlobalCamera-v0", num_envs=2, **SMALL)
    assert env.observation_space == native.observation_space
    assert env.action_space == native.action_space
    (seen, info), (wanted, told) = env.reset(seed=7), native.reset(seed=7)
    assert set(info) == set(told)
    assert info["seed"].tolist() == [7, 8]
    over = np.zeros(2, bool)
    for number in range(10):
        assert env.observation_space.contains(seen)
        for name in set(wanted) - {"rgb", "depth", "map"}:
            assert seen[name].dtype == wanted[name].dtype
            np.testing.assert_allclose(seen[name][~over], wanted[name][~over], atol=5e-3, err_msg=name)
        assert (seen["map"] == wanted["map"]).all()
        off = np.abs(seen["rgb"].astype(int) - wanted["rgb"])
        assert off.mean() < 3
        assert np.percentile(off, 98) < 25
        assert np.percentile(np.abs(seen["depth"] - wanted["depth"]), 98) < 0.01
        assert np.isfinite(info["pose"]).all()
        assert (info["fault"] == "").all()
        if number == 6:
            break
        action = np.tile([0.6, 0.3 * number - 0.5], (2, 1)).astype(np.float32)
        seen, reward, *ends, info = env.step(action)
        wanted, rewarded, *ended, _ = native.step(action)
        np.testing.assert_allclose(reward, rewarded, atol=1e-3)
        assert np.array_equal(ends, ended)
        assert reward.dtype == rewarded.dtype


def test_vector_form_goes_on_with_other_episodes():
    env = _vector("numpy")
    env.reset(seed=7)
    seeds = []
    for _ in range(2 * SMALL["horizon"] + 2):
        _, reward, *_, info = env.step(np.zeros((2, 2)))
        if (info["time"] == 0).any():
            seeds += info["seed"].tolist()
            assert not reward[info["time"] == 0].any()
    assert seeds == [9, 10, 11, 12]


def _kept(*parts):
    """{name: a copy} of the arrays in dicts."""
    return {name: np.array(np.asarray(value)) for part in parts for name, value in part.items() if value is not None}


@pytest.mark.parametrize("output", ["numpy", "jax", pytest.param("torch", marks=pytest.mark.slow)])
def test_vector_form_gives_arrays_of_the_device_that_no_later_step_touches(output):
    torch = pytest.importorskip("torch") if output == "torch" else None
    kind = {"numpy": np.ndarray, "jax": jax.Array, "torch": getattr(torch, "Tensor", None)}[output]
    env = _vector("numpy")
    env.unwrapped._output = output
    try:
        first = env.reset(seed=7)
        kept = _kept(*first)
        actions = torch.ones((2, 2), requires_grad=True) if torch else jnp.ones((2, 2))
        seen, reward, terminated, truncated, info = env.step(actions)
        assert all(isinstance(value, kind) for value in [*seen.values(), reward, terminated, truncated, info["pose"]])
        after = _kept(seen, info)
        env.step(np.zeros((2, 2)))
        for name, value in _kept(*first).items():
            np.testing.assert_array_equal(value, kept[name], err_msg=name)
        for name, value in _kept(seen, info).items():
            np.testing.assert_array_equal(value, after[name], err_msg=name)
        if output == "numpy":
            assert all(value.flags.writeable for value in [*seen.values(), reward, *info.values()])
    finally:
        env.unwrapped._output = "numpy"


def test_equal_seeds_give_equal_episodes_and_an_action_that_is_not_finite_a_fault():
    env, seen = _vector("numpy"), []
    for _ in range(2):
        env.reset(seed=11)
        seen.append([env.step(np.full((2, 2), 0.4))[0] for _ in range(3)])
    for one, other in zip(*seen, strict=True):
        for name, value in one.items():
            np.testing.assert_array_equal(value, other[name], err_msg=name)
    env.reset(seed=11)
    for wrong in (np.full((2, 2), np.nan), np.zeros(2), [["a", 1], [0, 0]]):
        with pytest.raises(ValueError, match="An action must"):
            env.step(wrong)
    *_, truncated, info = env.step(jnp.array([[0.0, 0.0], [jnp.nan, 0.0]]))
    assert truncated.tolist() == [False, True] and info["fault"].tolist() == ["", "physics failed"]
    seen, *_, info = env.step(np.zeros((2, 2)))
    assert info["seed"].tolist() == [11, 13] and env.observation_space.contains(seen)


def test_what_the_vector_form_lacks_is_told_in_one_line():
    with pytest.raises(ValueError, match="native"):
        gymnasium.make_vec("BSON/LocalLidar2D-v0", num_envs=2, engine="cuda")
    refused = {
        "numpy, jax, torch, not 'list'": {"output": "list"},
        "NextStep": {"autoreset_mode": "SameStep"},
        "one seed": {"seed": [1, 2]},
        "pool must be None or a whole number of at least 1, not -5": {"pool": -5},
        "pool must be .*, not 2.5": {"pool": 2.5},
        "workers must be .* at least 0, not 'x'": {"workers": "x"},
        r"limits must be a dict of fields of WarpConfig, solver, .*, not \{'foo': 1\}": {"limits": {"foo": 1}},
        "contacts must be a number of at least 0, not nan": {"limits": {"contacts": float("nan")}},
        "rows must be a number of at least 0, not -20.0": {"limits": {"rows": -20.0}},
        "iterations must be a whole number of at least 1, not 0": {"limits": {"iterations": 0}},
        "graph must be True or False, not 'yes'": {"limits": {"graph": "yes"}},
        "solver must be one of newton, cg, not 'lu'": {"limits": {"solver": "lu"}},
    }
    for words, arguments in refused.items():
        with pytest.raises(ValueError, match=words) as caught:
            gymnasium.make_vec("BSON/LocalLidar2D-v0", num_envs=2, engine="warp", **arguments)
        assert "\n" not in str(caught.value)
    small = gymnasium.make_vec("BSON/LocalLidar2D-v0", num_envs=3, engine="warp", pool=2, workers=0, **SMALL)
    with pytest.raises(ValueError, match="A pool of 2 episodes can't have 3 ready: give it a larger size"):
        small.reset(seed=1)
    for _ in range(2):
        small.close()
    for call in (lambda: small.step(np.zeros((3, 2))), lambda: small.reset(seed=1)):
        with pytest.raises(gymnasium.error.ClosedEnvironmentError):
            call()


@pytest.mark.slow
@pytest.mark.parametrize("name", bson.ENVIRONMENTS)
def test_every_environment_has_both_forms(name):
    kwargs = bson.ENVIRONMENTS[name]
    settings = {**SMALL, "pedestrian_model": {"macid": 1.0, "orca": 1.0, "standing": 1.0}, "pedestrian_period": 0.02}
    env = BsonFuncEnv(**kwargs, num_envs=2, seed=5, **settings)
    native = gymnasium.make_vec(name, num_envs=2, **settings)
    wanted, _ = native.reset(seed=5)
    initial, transition = jax.jit(jax.vmap(env.initial, in_axes=(0, None))), jax.jit(jax.vmap(env.transition))
    state, keys = initial(jnp.arange(2), env.default_params), jax.random.split(jax.random.key(0), 2)
    assert jax.vmap(env.fresh, in_axes=(0, None))(keys, env.default_params).steps.tolist() == [0, 0]
    for number in range(4):
        seen = _observed(env, state)
        assert env.observation_space.spaces.keys() == seen.keys()
        for row in range(2):
            assert {key: value[row] for key, value in seen.items()} in env.observation_space
        for key in set(wanted) - {"rgb", "depth"}:
            off = np.abs(seen[key].astype(float) - wanted[key])
            assert np.percentile(off, 99) < 0.01, key
        if number == 3:
            break
        action = jnp.array([[0.5, 0.5], [1.0, -0.2]])
        state = transition(state, action)
        wanted, *_ = native.step(np.asarray(action))


@pytest.mark.slow
@pytest.mark.parametrize("name", bson.ENVIRONMENTS)
def test_every_environment_s_vector_form_keeps_to_its_spaces(name):
    env = gymnasium.make_vec(name, num_envs=1, engine="warp", workers=0, **SMALL)
    native = gymnasium.make_vec(name, num_envs=1, **SMALL)
    assert env.observation_space == native.observation_space and env.action_space == native.action_space
    (seen, info), (_, told) = env.reset(seed=4), native.reset(seed=4)
    kinds = ({key: (value.dtype.kind, value.shape) for key, value in each.items()} for each in (info, told))
    assert next(kinds) == next(kinds)
    env.action_space.seed(0)
    seeds = []
    for _ in range(2 * SMALL["horizon"] + 1):
        assert env.observation_space.contains(seen)
        seen, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert reward.shape == terminated.shape == truncated.shape == (1,) and np.isfinite(reward).all()
        assert not (terminated & truncated).any() and info["fault"][0] == ""
        seeds.append(int(info["seed"][0]))
    assert sorted(set(seeds)) == list(range(4, 4 + len(set(seeds)))) and len(set(seeds)) >= 2
    env.close()
    native.close()


@pytest.mark.slow
def test_noise_and_rates_are_those_of_the_sensors():
    sensors = Imu(noise=1.0), Lidar2D(noise=20.0, rate=5.0), Lidar2D(key="clean")
    env = BsonFuncEnv("local", sensors, 2, seed=5, **SMALL)
    state = jax.jit(jax.vmap(env.initial, in_axes=(0, None)))(jnp.arange(2), env.default_params)
    off = np.asarray(state.readings["lidar"] - state.readings["clean"])
    assert 0.01 < off.std() < 0.03
    assert not np.array_equal(off[0], off[1])
    transition = jax.jit(jax.vmap(env.transition))
    after = transition(state, jnp.zeros((2, 2)))
    assert (np.asarray(after.readings["lidar"]) == np.asarray(state.readings["lidar"])).all()
    assert (np.asarray(after.readings["imu"]) != np.asarray(state.readings["imu"])).all()
    last = transition(after, jnp.zeros((2, 2)))
    assert (np.asarray(last.readings["lidar"]) != np.asarray(after.readings["lidar"])).mean() > 0.9


@pytest.mark.slow
def test_a_shipped_policy_scores_alike_on_a_device():
    from bson.evaluation.device_agents import device_agent
    from bson.evaluation.metrics import measure
    from bson.evaluation.on_device import play
    from bson.evaluation.play import run_episodes

    config = TaskConfig(
        num_pedestrians=3, pedestrian_model="standing", map_size=14.0, goal_distance=(5.0, 9.0), horizon=150
    )
    seeds = [3, 4, 5, 6]
    agent = learned.load("ppo")
    track = make_track(agent.track, agent.sensor)
    ours = play(device_agent("ppo", agent, config, track), config, (agent.track, agent.sensor), seeds)
    native = run_episodes(agent, config, track, seeds)
    for one, other in zip(ours, native, strict=True):
        assert (one.seed, one.arrived) == (other.seed, other.arrived)
        np.testing.assert_allclose(one.boxes, other.boxes)
        assert one.shortest == other.shortest
        assert one.duration == pytest.approx(other.duration, abs=0.3)
        np.testing.assert_allclose(one.pose[:10], other.pose[:10], atol=1e-2)
        assert measure(one).keys() == measure(other).keys()
        assert measure(one)["SNS"] == pytest.approx(measure(other)["SNS"], abs=3.0)


def test_what_the_engine_can_not_score_is_told_in_one_line(tmp_path):
    for words, arguments in {
        "learned policies, and functions that JAX can trace, not 'vfh'": {},
        "no pairs": {"paired": True},
        "--track": {"track": "global"},
    }.items():
        agent = "ppo" if arguments else "vfh"
        with pytest.raises(UsageError, match=words):
            benchmark.evaluate(agent, "smoke", out=tmp_path / "out", episodes=1, engine="warp", **arguments)
    assert not (tmp_path / "out").exists()


def test_without_warp_it_is_told_what_to_install(monkeypatch):
    monkeypatch.setattr(warp, "has_warp", lambda: False)
    monkeypatch.setattr(warp, "_warp", warp._warp.__wrapped__)
    with pytest.raises(UsageError, match=r"pip install warp-lang==.* \(the extra 'warp'\)"):
        gymnasium.make_vec("BSON/LocalLidar2D-v0", num_envs=2, engine="warp")


def test_room_that_runs_out_is_told_by_the_number_to_raise():
    engine = object.__new__(warp.WarpEngine)
    engine.config, engine.rows = warp.WarpConfig(), 94
    assert "more than 94 constraint rows: raise WarpConfig.rows (6)" in engine.explain(1)
    assert "raise WarpConfig.contacts (16 a world)" in engine.explain(8)


@pytest.mark.slow
def test_contacts_that_find_no_room_are_an_error():
    env = gymnasium.make_vec(
        "BSON/LocalLidar2D-v0",
        num_envs=20,
        engine="warp",
        sensor=(),
        num_pedestrians=0,
        limits={"contacts": 0.0},
        workers=0,
    )  # room for 64, and twenty robots have eighty wheels
    env.reset(seed=0)
    env.step(np.zeros((20, 2)))
    with pytest.raises(RuntimeError, match=r"raise WarpConfig\.contacts"):  # told by the step after
        env.step(np.zeros((20, 2)))
    env.close()
