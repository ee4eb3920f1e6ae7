"""What environments hold on to, give back, and hand on: resets with other options, threads, copies, forks, closing."""

import copy
import itertools
import json
import os
import pickle
import subprocess
import sys
import threading
import warnings
import weakref

import gymnasium
import numpy as np
import pytest

import bson
import bson.dm
from bson import robot
from bson.episodes.session import KEPT, Session
from bson.episodes.tracks import LocalTrack, make_track, sensor_documents
from bson.interfaces.gym import BsonEnv, BsonVectorEnv
from bson.sensors import Camera, Imu, Lidar2D, RgbCamera
from bson.simulation.people import BOXES, ROWS, decision, rows_for
from bson.simulation.scene import build_spec, structure
from bson.simulation.world import MAX_WORLDS, World
from bson.task import MAX_PEDESTRIANS, TaskConfig
from macid.drawing.gl import gl_problem
from macid.pedestrians import make_controller
from macid.reward import RewardWeights
from macid.state import CrowdState, parking_place

SMALL = {"num_pedestrians": 4, "map_size": 20.0, "goal_distance": (6.0, 15.0)}
ID = "BSON/LocalLidar2D-v0"
ACTION = np.array([0.6, 0.2])
draws = pytest.mark.skipif(gl_problem() is not None, reason=str(gl_problem()))


def same(first, second):
    return first.keys() == second.keys() and all(np.array_equal(first[key], second[key]) for key in first)


# Resets with other options.


def test_sizes_that_decisions_are_filled_up_to_have_the_papers_and_round_distances_as_they_were():
    for people in (24, 50, 100, 200):
        assert rows_for(people) == people + 1  # the robot is one more
    for people in range(1, MAX_PEDESTRIANS + 1):
        rows = rows_for(people)
        assert people < rows and (people).bit_length() == (rows - 1).bit_length()  # geometry.first_disc's mask
    assert list(ROWS) == sorted(ROWS) and list(BOXES) == sorted(BOXES)


@pytest.mark.parametrize(("people", "boxes"), [(2, 4), (10, 9), (20, 30)])
def test_what_fills_a_decision_up_changes_no_learned_persons_decision_by_a_bit(people, boxes):
    rng = np.random.default_rng(people)
    controller = make_controller("macid", 0.1)
    rows = rows_for(people)
    assert people + 1 < rows
    for _ in range(4):
        half = 2.0 + np.sqrt(people)
        packed = np.zeros((people + 1, 10), np.float32)
        packed[:, :2], packed[:, 2] = rng.uniform(-half, half, (people + 1, 2)), rng.uniform(-4, 4, people + 1)
        packed[:, 3:6], packed[:, 6:8] = rng.normal(0, 0.8, (people + 1, 3)), rng.uniform(-20, 20, (people + 1, 2))
        packed[:-1, 8] = rng.uniform(-2, 2, people)
        solid = np.concatenate(
            [rng.uniform(-half, half, (boxes, 2)), rng.uniform(0.1, 2, (boxes, 2)), rng.uniform(-2, 2, (boxes, 1))], -1
        ).astype(np.float32)
        exact = decision((controller,), people + 1, boxes)(packed, solid)
        filled, boxed = np.zeros((rows, 10), np.float32), np.zeros((64, 5), np.float32)
        filled[:, :2] = filled[:, 6:8] = parking_place(np.arange(rows))
        boxed[:, :2], boxed[:, 2:4] = -parking_place(np.arange(64)), 0.1
        filled[: people + 1], boxed[:boxes] = packed, solid
        padded = decision((controller,), rows, 64)(filled, boxed)
        assert np.array_equal(np.asarray(padded)[: 3 * people], np.asarray(exact)[: 3 * people])
        state = CrowdState(packed[:, :2], packed[:, 2], packed[:, 3:5], packed[:, 5], np.zeros(people + 1, bool))
        assert np.isfinite(np.asarray(controller(state, solid, packed[:, 6:8], packed[:, 8]))).all()


@pytest.mark.parametrize("model", ["macid", {"social-force": 0.5, "orca": 0.5}])
def test_an_episode_is_the_same_made_alone_in_a_batch_and_by_a_resets_options(model):
    asked = {"num_pedestrians": 7, "obstacle_density": 0.4, "pedestrian_model": model}
    made = BsonEnv(**{**SMALL, **asked})
    turned, many = BsonEnv(**SMALL), BsonVectorEnv(2, **{**SMALL, **asked})
    turned.reset(seed=0, options={"num_pedestrians": 9, "horizon": 77})
    turned.step(ACTION)
    first, second = made.reset(seed=5)[0], turned.reset(seed=5, options=asked)[0]
    many.reset(seed=[4, 5])
    for _ in range(15):
        assert same(first, second)
        first, second = made.step(ACTION)[0], turned.step(ACTION)[0]
        third = many.step(np.array([[0.1, 0.9], ACTION]))[0]
        assert same(first, {key: value[1] for key, value in third.items()})
    assert np.array_equal(made.world.qpos, turned.world.qpos)


def test_options_that_need_no_other_model_keep_the_world_and_few_decisions_are_compiled():
    env = BsonEnv(**SMALL)
    env.reset(seed=0)
    world = env.world
    for options in (
        {"horizon": 5, "lcf": 1.0, "goal_distance": (7.0, 9.0)},
        {"reward": {"goal": 3.0}, "pedestrian_model": "social-force"},
        {"control_period": 0.2, "pedestrian_period": 0.04},
        {"lcf_each": (0.0, 1.0, -1.0, 2.0)},
    ):
        env.reset(seed=1, options=options)
        assert env.world is world
        env.step(ACTION)
    before, made = decision.cache_info(), []
    for people in range(9, 16):
        env.reset(seed=2, options={"num_pedestrians": people})
        env.step(ACTION)
        made.append(weakref.ref(env.world))
    assert decision.cache_info().misses - before.misses <= 1
    assert sum(ref() is not None for ref in made) == KEPT


def test_a_models_structure_is_what_its_scene_has():
    base = TaskConfig(**SMALL)
    assert structure(base) == structure(base.replace(horizon=5, lcf=0.5, pedestrian_period=0.02))
    changes = ({"num_pedestrians": 5}, {"obstacle_density": 0.5}, {"map_size": 21.0}, {"robot": {"half_width": 0.2}})
    for change in changes:
        assert structure(base) != structure(base.replace(**change))
    model = build_spec(base.replace(obstacle_density=0.5), ()).compile()
    assert model.nmocap == World(base.replace(obstacle_density=0.5)).boxes.shape[1] > 4


def test_memory_stays_flat_over_resets_with_other_options():
    env, rng = BsonEnv(**SMALL), np.random.default_rng(0)

    def play(count):
        for _ in range(count):
            people, density = int(rng.integers(0, 16)), float(rng.uniform())
            env.reset(seed=int(rng.integers(99)), options={"num_pedestrians": people, "obstacle_density": density})

    def megabytes():
        with open("/proc/self/statm") as f:
            return int(f.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    if not os.path.exists("/proc/self/statm"):
        pytest.skip("tells its memory otherwise")
    play(20)
    before = megabytes()
    play(60)
    assert megabytes() - before < 12.0


def test_resets_with_other_options_let_go_of_what_they_replace():
    env, rng, made = BsonEnv(**SMALL), np.random.default_rng(1), []
    read = robot.model._prepared.cache_info().misses
    for _ in range(60):
        people, density = int(rng.integers(0, 16)), float(rng.uniform())
        env.reset(seed=int(rng.integers(99)), options={"num_pedestrians": people, "obstacle_density": density})
        world = env.world
        assert world.people_goals.shape == (1, people, 2)  # ways are found
        made.append([weakref.ref(each) for each in (world, world.engine, world.model, world.layouts[0]) if each])
    for alive in itertools.zip_longest(*made):  # without a garbage collection
        assert len({id(ref()) for ref in alive if ref is not None and ref() is not None}) <= KEPT
    assert robot.model._prepared.cache_info().misses <= read + 1  # one robot's model is not read again
    env.close()
    assert not any(ref() is not None for ref in made[0])


@pytest.mark.parametrize("options", [{"obstacle_density": 0.8}, {"map": "hall"}, {"map": "office"}])
def test_ways_are_the_same_whenever_they_are_asked_for(options):
    config = TaskConfig(num_pedestrians=6).replace(**options)
    first, second = World(config, 2), World(config, 2)
    for world in (first, second):
        world.reset([0, 1], [3, 4])
    ends = second.destinations(0)
    goals = first.people_goals.copy()
    third = copy.deepcopy(second)

    def fail():
        with second.whole():  # a step that fails takes the ways back
            second.step([0, 1], np.zeros((2, 2)))
            raise ValueError("failed")

    with pytest.raises(ValueError, match="failed"):
        fail()
    for _ in range(5):
        for world in (first, second, third):
            world.step([0], [[0.0, 0.0]])
    for world in (second, third):
        assert np.array_equal(first.qpos, world.qpos) and np.array_equal(first.people_goals, world.people_goals)
        assert np.array_equal(first.people_goals[1], goals[1])
    assert np.array_equal(first.destinations(0), ends)


def test_a_reset_that_fails_leaves_the_episode_as_it_was():
    env, other = BsonEnv(**SMALL), BsonEnv(**SMALL)
    for each in (env, other):
        each.reset(seed=3)
        each.step(ACTION)
    for options in ({"goal_distance": (100.0, 110.0)}, {"num_pedestrians": 300}):
        with pytest.raises(ValueError, match="goal|people|pedestrians"):
            env.reset(options=options)
    assert env.world.config == other.world.config
    for _ in range(3):
        assert same(env.step(ACTION)[0], other.step(ACTION)[0])
    assert env.reset()[1]["seed"] == other.reset()[1]["seed"]


# Steps that fail.


class _Failing(Imu):
    """An IMU that fails when told so."""

    def bind(self, world, robot="robot"):
        read = super().bind(world, robot)

        def fail_or_read(world, ids):
            if _Failing.fails:
                raise OSError("the cable is loose")
            return read(world, ids)

        return fail_or_read


_Failing.fails = False


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_no_failed_step_moves_anything(mode):
    sensors = (Lidar2D(noise=1.0), _Failing(noise=1.0))
    settings = {**SMALL, "sensor": sensors, "horizon": 4, "autoreset_mode": mode}
    env, other = BsonVectorEnv(2, **settings), BsonVectorEnv(2, **settings)
    for each in (env, other):
        each.reset(seed=1)
    for _ in range(11):  # across autoresets
        _Failing.fails = True
        with pytest.raises(OSError, match="cable"):
            env.step(np.tile(ACTION, (2, 1)))
        _Failing.fails = False
        ours, theirs = env.step(np.tile(ACTION, (2, 1))), other.step(np.tile(ACTION, (2, 1)))
        assert same(ours[0], theirs[0]) and np.array_equal(ours[1], theirs[1])
    assert np.array_equal(env.world.qpos, other.world.qpos)


# Threads, and closing.


def _in_a_thread(work):
    found = []
    thread = threading.Thread(target=lambda: found.append(work()))
    thread.start()
    thread.join()
    return found[0]


@draws
def test_cameras_and_films_work_from_any_one_thread_at_a_time():
    env, other = (BsonEnv(sensor="camera", render_mode="rgb_array", **SMALL) for _ in range(2))
    assert same(env.reset(seed=1)[0], _in_a_thread(lambda: other.reset(seed=1))[0])
    for turn in range(4):
        here, there = env.step(ACTION)[0], _in_a_thread(lambda other=other: other.step(ACTION))[0]
        assert same(here, there)
        if turn == 1:
            env, other = other, env
    assert np.array_equal(_in_a_thread(env.render), other.render())
    made = _in_a_thread(lambda: BsonEnv(sensor="camera", **SMALL))
    made.reset(seed=1)
    _in_a_thread(made.close)
    _in_a_thread(env.close)
    assert other.step(ACTION)[0]["rgb"].std() > 1


def _every_kind():
    pytest.importorskip("pettingzoo", reason="needs the extra 'pettingzoo'")
    from macid.parallel_env import CrowdParallelEnv

    crowd = CrowdParallelEnv(1, number=3)
    walk = {agent: np.zeros(2, np.float32) for agent in crowd.possible_agents}
    return [
        (BsonEnv(**SMALL), ACTION),
        (gymnasium.make(ID, **SMALL), ACTION.astype(np.float32)),
        (BsonVectorEnv(2, **SMALL), np.tile(ACTION, (2, 1))),
        (bson.dm.load(**SMALL, seed=1), ACTION),
        (crowd, walk),
    ]


def test_a_closed_environment_closes_again_and_refuses_all_else():
    for env, action in _every_kind():
        env.reset()
        env.step(action)
        env.close()
        env.close()
        for call in (lambda env=env, action=action: env.step(action), env.reset):
            with pytest.raises(gymnasium.error.ClosedEnvironmentError, match="closed"):
                call()


@draws
def test_closing_frees_what_draws_and_what_steps():
    env = BsonEnv(sensor="camera", render_mode="rgb_array", **SMALL)
    env.reset(seed=1)
    env.render()
    world, renderer, film = env.world, env.world.engine.renderer, env._film
    env.close()
    assert not hasattr(world, "engine") and renderer._gl is None and film._gl is None
    with pytest.raises(gymnasium.error.ClosedEnvironmentError):
        world.step([0], [[0.0, 0.0]])


# Copies.


def _observed(result):
    """What a reset or a step gave, as arrays."""
    if hasattr(result, "observation"):
        return [np.asarray(value) for value in result.observation.values()]
    return [np.asarray(value) for value in result[0].values()]


def test_a_pickled_environment_begins_the_same_episodes_and_a_deep_copy_plays_on_equally():
    for env, action in _every_kind():
        env.reset(**({} if isinstance(env, bson.dm.Environment) else {"seed": 2}))
        for _ in range(4):
            env.step(action)
        copied, pickled = copy.deepcopy(env), pickle.loads(pickle.dumps(env))
        for _ in range(6):
            for ours, theirs in zip(_observed(env.step(action)), _observed(copied.step(action)), strict=True):
                assert np.array_equal(ours, theirs)
        copied.close()  # the other goes on
        env.step(action)
        seed = {} if isinstance(env, bson.dm.Environment) else {"seed": 3}
        if seed:
            for ours, theirs in zip(_observed(env.reset(**seed)), _observed(pickled.reset(**seed)), strict=True):
                assert np.array_equal(ours, theirs)
        else:
            assert pickled.reset().first()


def test_a_copy_takes_noise_later_seeds_and_the_record_along():
    settings = {**SMALL, "sensor": (Imu(noise=1.0), Lidar2D(noise=2.0, rate=5.0)), "horizon": 6}
    env = BsonEnv(**settings)
    env.reset(seed=2)
    for _ in range(3):
        env.step(ACTION)
    copied = copy.deepcopy(env)
    for _ in range(2):
        for _ in range(3):
            ours, theirs = env.step(ACTION), copied.step(ACTION)
            assert same(ours[0], theirs[0]) and ours[1:4] == theirs[1:4]
        ours, theirs = env.reset(), copied.reset()
        assert same(ours[0], theirs[0]) and ours[1]["seed"] == theirs[1]["seed"]


def test_a_spec_goes_through_json_with_sensors_rewards_and_robots_of_ones_own():
    sensors = (Imu(rate=5.0), Lidar2D(beams=90, position=(0.1, 0.0, 0.4), noise=np.float64(0.5)))
    env = gymnasium.make(ID, sensor=sensors, reward=RewardWeights(1.0, 3.0, 2.0), lcf=(0.0, 1.0), **SMALL)
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert same(env.reset(seed=4)[0], again.reset(seed=4)[0])
    assert again.unwrapped.config == env.unwrapped.config
    for each in (sensors, ("camera"), Lidar2D(), (_Failing(),)):
        documents = json.loads(json.dumps(sensor_documents(each)))
        assert make_track("local", documents) == make_track("local", each)
    many = gymnasium.make_vec(ID, num_envs=2, sensor=sensors, **SMALL)
    assert gymnasium.make_vec(many.spec).single_observation_space == many.single_observation_space
    for wrong, named in (({"kind": "Sonar"}, "Sonar"), ({"kind": "Imu", "beam": 3}, "beam"), ({}, "None")):
        with pytest.raises(ValueError, match=named):
            make_track("local", [wrong])


# Forks.


@pytest.mark.parametrize("imported", ["before", "within"])
def test_a_fork_after_any_use_of_jax_is_refused_in_one_line(imported):
    code = f"""
import os, warnings
warnings.simplefilter("ignore")
import jax.numpy as jnp
{"import bson" if imported == "before" else ""}
jnp.ones(3).sum().block_until_ready()
reader, writer = os.pipe()
if os.fork() == 0:
    try:
        from bson.interfaces.gym import BsonEnv
        env = BsonEnv(num_pedestrians=1)
        env.reset(seed=0)
        env.step([0.1, 0.1])
    except RuntimeError as error:
        os.write(writer, str(error).encode())
    os._exit(0)
os.wait()
os.close(writer)
print(os.read(reader, 1000).decode())
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert "context='spawn'" in run.stdout and run.stdout.count("\n") == 1, run.stderr


def test_worlds_made_before_a_fork_are_refused_in_the_child():
    session = Session(TaskConfig(**{**SMALL, "num_pedestrians": 0}), LocalTrack())
    session.reset([0], [1])
    reader, writer = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Python and JAX warn of the fork
        child = os.fork()
    if child == 0:
        try:
            session.step([0], ACTION[None])
        except RuntimeError as error:
            os.write(writer, str(error).encode())
        os._exit(0)
    os.waitpid(child, 0)
    assert b"spawn" in os.read(reader, 1000)


def test_without_a_display_glfw_is_told_each_time_and_nothing_aborts():
    code = """
from bson.interfaces.gym import BsonEnv
for _ in range(2):
    try:
        BsonEnv(sensor="camera", num_pedestrians=0)
    except RuntimeError as error:
        print(error)
"""
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    run = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        env={**environment, "MUJOCO_GL": "glfw"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.count("OpenGL can't draw here") == 2


def test_dm_control_without_egl_gives_all_but_pictures():
    code = """
import ctypes, ctypes.util
found, opened = ctypes.util.find_library, ctypes.CDLL
ctypes.util.find_library = lambda name: None if "EGL" in name else found(name)
class CDLL(opened):
    def __init__(self, name, *args, **kwargs):
        if name and "EGL" in str(name):
            raise OSError("no EGL")
        super().__init__(name, *args, **kwargs)
ctypes.CDLL = CDLL
import bson.dm
env = bson.dm.load(num_pedestrians=1, map_size=12.0, goal_distance=(2.0, 8.0))
env.reset()
print(env.step([0.5, 0.0]).observation["lidar"].shape)
"""
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "MUJOCO_GL")}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0 and "(720,)" in run.stdout, run.stderr


# Numbers.


@pytest.mark.parametrize("value", [1e308, 10**400, -(10**400), np.inf, np.nan])
def test_numbers_that_nothing_has_are_refused_by_name(value):
    fields = ("num_pedestrians", "pedestrian_density", "obstacle_density", "map_size", "control_period", "horizon")
    for name in (*fields, "pedestrian_period", "lcf", "goal_distance"):
        with pytest.raises(ValueError, match=name):
            TaskConfig(**{name: value})
    for name, wrong in (
        ("pedestrian_model", {"macid": value, "orca": value}),
        ("lcf_each", [value] * 24),
        ("reward", {"goal": value}),
        ("robot", {"max_speed": value}),
    ):
        with pytest.raises(ValueError, match=f"(?i){name}"):  # "Robot 'jackal': max_speed must be ..."
            TaskConfig(**{name: wrong})
    for field in ("distance", "goal", "collision"):
        with pytest.raises(ValueError, match=field):
            RewardWeights(**{field: value})
    for kind, names in ((Imu, ("rate", "noise", "max_force")), (Lidar2D, ("range_max", "sigma", "yaw", "field"))):
        for name in names:
            with pytest.raises(ValueError, match=name):
                kind(**{name: value})
    with pytest.raises(ValueError, match="field"):
        Camera(key="a", field=(value, 0.5))
    with pytest.raises(ValueError, match="position"):
        RgbCamera(position=(0.0, value, 0.0))


@pytest.mark.parametrize("rate", [5e-324, 1e-300, 0, -1.0])
def test_a_rate_that_never_comes_is_refused(rate):
    with pytest.raises(ValueError, match="rate must be None or a frequency above 0 Hz"):
        Imu(rate=rate)


def test_counts_of_people_and_worlds_are_bounded():
    for people in (MAX_PEDESTRIANS + 1, 2**62, 10**400):
        with pytest.raises(ValueError, match=f"at most {MAX_PEDESTRIANS}"):
            TaskConfig(num_pedestrians=people)
    with pytest.raises(ValueError, match=f"at most {MAX_PEDESTRIANS}"):
        TaskConfig(pedestrian_density=1.0, map_size=500.0)
    for number in (0, -1, MAX_WORLDS + 1, 2**62, 10**400, 1.5, "two", True):
        with pytest.raises(ValueError, match=f"num_envs must be a whole number of at least 1, at most {MAX_WORLDS}"):
            BsonVectorEnv(number, **SMALL)
        with pytest.raises(ValueError, match="nworld"):
            World(TaskConfig(**SMALL), number)
    parallel_env = pytest.importorskip("macid.parallel_env", reason="needs the extra 'pettingzoo'")
    for number in (parallel_env.MAX_PEOPLE + 1, 10**400, 1.5, "two", 0):
        with pytest.raises(ValueError, match="number must be a whole number|at least one person"):
            parallel_env.CrowdParallelEnv(1, number=number)


def test_options_whose_keys_are_no_names_are_refused():
    for env in (BsonEnv(**SMALL), BsonVectorEnv(2, **SMALL)):
        for options in ({1: 2}, {None: 1, "horizon": 3}, {(1, 2): 3}):
            with pytest.raises(ValueError, match="by name"):
                env.reset(options=options)
    for name in ("robot", "reward", "pedestrian_model"):
        with pytest.raises(ValueError, match=name):
            TaskConfig(**{name: {1: 2.0}})


def test_seeds_of_numpy_are_seeds_everywhere():
    for env, _ in _every_kind():
        if isinstance(env, bson.dm.Environment):
            ours, theirs = (bson.dm.load(**SMALL, seed=seed).reset() for seed in (3, np.int64(3)))
        else:
            ours = env.reset(seed=3)
            theirs = env.reset(seed=np.int64(3))
        for one, other in zip(_observed(ours), _observed(theirs), strict=True):
            assert np.array_equal(one, other)


def test_films_go_as_fast_as_what_happens():
    for period, fps in ((0.1, 10), (0.02, 50), (0.2, 5), (0.08, 12.5)):
        settings = {**SMALL, "control_period": period, "pedestrian_period": period}
        assert BsonEnv(**settings).metadata["render_fps"] == pytest.approx(fps)
        assert BsonVectorEnv(1, **settings).metadata["render_fps"] == pytest.approx(fps)
    env = BsonEnv(**SMALL)
    env.reset(options={"control_period": 0.2})
    assert env.metadata["render_fps"] == 5
    env.reset()
    assert env.metadata["render_fps"] == 10


@pytest.mark.parametrize("action", [[np.nan, 0.0], [np.inf, 0.0], [0.0], [[0.0, 0.0]], [[0.0], [1.0, 2.0]], "ahead"])
def test_dm_env_refuses_the_actions_that_gymnasium_does(action):
    env = bson.dm.load(**SMALL, seed=1)
    env.reset()
    with pytest.raises(ValueError, match="An action must"):
        env.step(action)
    assert np.isfinite(env.step([0.1, 0.1]).reward)


# stable-baselines3.


def test_stable_baselines3_learns_from_what_make_vec_gives():
    ppo = pytest.importorskip("stable_baselines3", reason="needs the extra 'agents'").PPO
    from bson.learning.vec_env import WorldsVecEnv

    traces = {}
    for mode in ("NextStep", "SameStep", "Disabled"):
        env = WorldsVecEnv(gymnasium.make_vec(ID, num_envs=2, autoreset_mode=mode, horizon=5, **SMALL))
        env.seed(7)
        trace = [env.reset()]
        for step in range(12):
            observation, reward, done, infos = env.step(np.full((2, 2), 0.3, np.float32))
            trace.append(observation)
            assert done.all() == (step % 5 == 4) and reward.dtype == np.float32
            for info in infos:
                assert ("terminal_observation" in info) == done.all()
        traces[mode] = trace
    single = BsonEnv(horizon=5, **SMALL)
    single.reset(seed=8)
    for _ in range(5):
        last, *_, truncated, info = single.step(np.full(2, 0.3, np.float32))
    assert truncated
    for trace in traces.values():
        assert all(same(one, other) for one, other in zip(trace, traces["NextStep"], strict=True))
        assert same(single.reset()[0], {key: value[1] for key, value in trace[5].items()})
        single.reset(seed=8)
    env.seed(7)
    env.reset()
    for _ in range(5):
        *_, infos = env.step(np.full((2, 2), 0.3, np.float32))
    assert same(infos[1]["terminal_observation"], last) and infos[1]["TimeLimit.truncated"]
    assert infos[1]["episode"]["l"] == 5 and infos[1]["time"] == info["time"]
    ppo("MultiInputPolicy", env, n_steps=8, batch_size=8, n_epochs=1, device="cpu").learn(16)
    env.close()
    with pytest.raises(ValueError, match="make_vec"):
        WorldsVecEnv(single)
