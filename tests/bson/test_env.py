import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from bson import ENVIRONMENTS
from bson.evaluation.metrics import GAMMA
from bson.interfaces.gym import BsonEnv, BsonVectorEnv

SMALL = {"num_pedestrians": 4, "map_size": 20.0, "goal_distance": (6.0, 15.0)}
ID = "BSON/LocalLidar2D-v0"


def same(first, second):
    return all(np.array_equal(first[key], second[key]) for key in first)


@pytest.fixture(scope="module", params=ENVIRONMENTS)
def each(request):
    """Every environment, on a small map."""
    return gymnasium.make(request.param, **SMALL).unwrapped


def test_gymnasium_finds_no_fault(each):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(each, skip_render_check=True)


def test_a_vector_of_it_begins_with_its_own_observation(each):
    many = gymnasium.make_vec(each.spec.id, num_envs=2, **SMALL)
    observations, _ = many.reset(seed=4)
    assert many.observation_space.contains(observations)
    observation, _ = each.reset(seed=5)
    assert same(observation, {key: values[1] for key, values in observations.items()})
    observations, *_ = many.step(many.action_space.sample())
    assert many.observation_space.contains(observations)


def test_stable_baselines3_finds_no_fault(each):
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs the extra 'agents'")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        checker.check_env(each, warn=True)
    # It wants vectors and pictures, and remarks on arrays with two axes; its policy flattens them: see the next test.
    tables = [key for key, space in each.observation_space.items() if len(space.shape) == 2]
    assert {str(one.message).partition(" (")[0] for one in told} == {
        f"Your observation {key} has an unconventional shape" for key in tables
    }


def test_stable_baselines3_learns_from_all_that_is_observed():
    ppo = pytest.importorskip("stable_baselines3", reason="needs the extra 'agents'").PPO
    env = gymnasium.make("BSON/GlobalCamera-v0", **SMALL)
    model = ppo("MultiInputPolicy", env, n_steps=4, batch_size=4, n_epochs=1, device="cpu").learn(4)
    assert env.action_space.contains(model.predict(env.reset(seed=0)[0])[0])
    extractor = model.policy.features_extractor
    assert type(extractor.extractors["rgb"]).__name__ == "NatureCNN"
    flat = sum(np.prod(space.shape) for key, space in env.observation_space.items() if key != "rgb")
    assert extractor.features_dim == extractor.extractors["rgb"].features_dim + flat


def test_observations_are_in_their_space_through_a_whole_episode_with_collisions():
    env = gymnasium.make(ID, horizon=150, num_pedestrians=30, map_size=20.0, goal_distance=(6, 15))
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    done = False
    while not done:
        assert env.observation_space.contains(observation)
        observation, _, terminated, truncated, info = env.step([1.0, 0.6 * env.action_space.sample()[1]])
        done = terminated or truncated
    assert info["collisions"] > 0


def test_make_vec_gives_the_batched_engine():
    env = gymnasium.make_vec(ID, num_envs=16, **SMALL)
    assert type(env.unwrapped).__name__ == "BsonVectorEnv"
    observation, _ = env.reset(seed=0)
    assert observation["lidar"].shape == (16, 720)
    assert env.observation_space.contains(observation)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    assert reward.shape == terminated.shape == truncated.shape == info["distance"].shape == (16,)


def test_vector_worlds_play_the_same_episodes_as_single_ones_across_resets():
    many = gymnasium.make_vec(ID, num_envs=3, horizon=12, **SMALL)
    many.reset(seed=40)
    trace = []
    for step in range(30):
        observation, reward, *_, info = many.step(np.tile([0.7, np.sin(step)], (3, 1)).astype(np.float32))
        trace.append(({key: value[1] for key, value in observation.items()}, reward[1], info["seed"][1]))
    one = gymnasium.make(ID, horizon=12, **SMALL)
    observation, _ = one.reset(seed=41)
    done = False
    for step, (expected, expected_reward, seed) in enumerate(trace):
        if done:
            observation, info = one.reset()
            reward, done = 0.0, False
        else:
            observation, reward, terminated, truncated, info = one.step(np.array([0.7, np.sin(step)], np.float32))
            done = terminated or truncated
        assert same(observation, expected), step
        assert reward == expected_reward
        assert info["seed"] == seed


def test_a_seed_gives_the_same_episode_and_no_seed_a_new_one():
    env = gymnasium.make(ID, **SMALL)
    first, _ = env.reset(seed=3)
    other, _ = env.reset()
    again, info = env.reset(seed=3)
    assert same(first, again) and not same(first, other)
    assert info["seed"] == 3
    keyed, info = gymnasium.make(ID, seed=3, **SMALL).reset()
    assert same(first, keyed) and info["seed"] == 3


def test_goal_is_relative_in_the_robots_frame_and_the_robot_begins_facing_it():
    env = gymnasium.make(ID, **SMALL)
    observation, info = env.reset(seed=5)
    assert observation["goal"][0] == pytest.approx(info["start_distance"], abs=1e-4)
    assert observation["goal"][1] == pytest.approx(0.0, abs=1e-4)
    for _ in range(12):  # turning left brings the goal to the right
        observation, *_ = env.step(np.array([0.0, 0.5]))
    assert observation["goal"][1] < -1.0


def test_reward_is_eq_5():
    env = gymnasium.make(ID, num_pedestrians=0, map_size=20.0, goal_distance=(6, 15))
    _, before = env.reset(seed=1)
    total = 0.0
    while True:
        _, reward, terminated, truncated, info = env.step(np.array([0.8, 0.0]))
        expected = before["distance"] - info["distance"] + 2.0 * terminated
        assert reward == pytest.approx(expected, abs=1e-9)
        before, total = info, total + reward
        if terminated or truncated:
            break
    assert terminated and info["arrived"] and not truncated
    assert total == pytest.approx(info["start_distance"] - info["distance"] + 2.0)


def test_a_collision_costs_one_in_the_control_step_in_which_it_happens():
    env = gymnasium.make(ID, num_pedestrians=0, map_size=12.0, goal_distance=(5, 8))
    _, before = env.reset(seed=2)
    env.unwrapped.world.goal[0] = [16.0, 0.0]  # beyond the wall
    before = env.step(np.array([0.0, 0.0]))[-1]
    touched = 0
    for _ in range(200):
        _, reward, *_, info = env.step(np.array([0.6, 0.0]))
        collided = info["collisions"] > before["collisions"]
        touched += collided
        assert reward == pytest.approx(before["distance"] - info["distance"] - collided, abs=1e-9)
        before = info
    assert touched > 3


def test_info_has_all_that_the_score_needs():
    env = gymnasium.make(ID, num_pedestrians=0, map_size=20.0, goal_distance=(6, 15))
    env.reset(seed=1)
    terminated = False
    while not terminated:
        *_, terminated, _, info = env.step(np.array([0.75, 0.0]))
    completion = 1 - info["distance"] / info["start_distance"]
    efficiency = min(1.0, (info["start_distance"] - info["distance"]) / info["travelled"])
    speed = min(1.0, max(0.0, info["travelled"] / info["time"] - 0.5))
    sns = completion * GAMMA ** info["collisions"] * (50 * efficiency + 50 * speed)
    assert sns > 90.0


def test_options_of_a_reset_hold_for_that_episode_alone():
    env = gymnasium.make(ID, **SMALL)
    env.reset(seed=0, options={"num_pedestrians": 9, "lcf": 1.5, "pedestrian_model": "orca", "horizon": 3})
    world = env.unwrapped.world
    assert world.people.shape[1] == 9 and (world.lcf == 1.5).all() and world.config.pedestrian_model == "orca"
    ends = [env.step(np.zeros(2))[3] for _ in range(3)]
    assert ends == [False, False, True]
    env.reset(seed=0)
    assert env.unwrapped.world.people.shape[1] == 4
    with pytest.raises(ValueError, match="Choose among"):
        env.reset(options={"pedestrian": 3})
    with pytest.raises(ValueError, match="must be a dict"):
        env.reset(options=5)
    with pytest.raises(ValueError, match="give it to make"):
        env.reset(options={"map_size": 30.0})


def test_options_hold_through_a_vector_environments_own_resets():
    env = gymnasium.make_vec(ID, num_envs=2, **SMALL)
    env.reset(seed=0, options={"obstacle_density": 1.0, "horizon": 2})
    walls = env.unwrapped.world.boxes.shape[1]
    for _ in range(7):
        env.step(np.zeros((2, 2)))
    assert env.unwrapped.world.boxes.shape[1] == walls > 4
    env.reset(seed=0)
    assert env.unwrapped.world.boxes.shape[1] == 4


def test_next_step_and_same_step_autoreset_begin_the_same_episodes():
    results = {}
    for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP):
        env = gymnasium.make_vec(ID, num_envs=2, horizon=4, autoreset_mode=mode, **SMALL)
        env.reset(seed=0)
        firsts = []
        for _ in range(5):
            observation, _, _, truncated, info = env.step(np.full((2, 2), 0.3))
            firsts.append((observation, truncated.copy(), info))
        results[mode] = firsts
    same_step, next_step = results[AutoresetMode.SAME_STEP], results[AutoresetMode.NEXT_STEP]
    assert same_step[3][1].all() and next_step[3][1].all()
    assert same(same_step[3][0], next_step[4][0])  # the new episode's first observation
    final = same_step[3][2]["final_obs"][1]
    assert all(np.array_equal(final[key], next_step[3][0][key][1]) for key in final)
    assert same_step[3][2]["final_info"]["time"][1] == pytest.approx(0.4)


def test_disabled_autoreset_waits_for_a_masked_reset():
    env = gymnasium.make_vec(ID, num_envs=2, horizon=2, autoreset_mode=AutoresetMode.DISABLED, **SMALL)
    env.reset(seed=0)
    env.step(np.zeros((2, 2)))
    env.step(np.zeros((2, 2)))
    with pytest.raises(ValueError, match="reset_mask"):
        env.step(np.zeros((2, 2)))
    _, info = env.reset(options={"reset_mask": np.array([True, False])})
    assert info["time"].tolist() == [0.0, 0.2]
    with pytest.raises(ValueError, match="2 booleans"):
        env.reset(options={"reset_mask": np.array([True])})


def test_stepping_or_masking_before_the_first_reset_is_told():
    many = gymnasium.make_vec(ID, num_envs=2, **SMALL)
    with pytest.raises(gymnasium.error.ResetNeeded):
        many.step(np.zeros((2, 2)))
    with pytest.raises(gymnasium.error.ResetNeeded):
        many.reset(options={"reset_mask": np.array([True, False])})


@pytest.mark.parametrize("seed", [-1, 2**70, "one"])
def test_a_bad_seed_is_told(seed):
    with pytest.raises(ValueError, match="whole number from 0"):
        gymnasium.make_vec(ID, num_envs=2, **SMALL).reset(seed=seed)


@pytest.mark.parametrize("action", [[np.nan, 0.0], [0.0], [[0.0, 0.0]], [np.inf, 0.0]])
def test_a_bad_action_is_told(action):
    env = gymnasium.make(ID, disable_env_checker=True, **SMALL).unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match="An action must"):
        env.step(action)


@pytest.mark.parametrize(
    ("kwargs", "named"),
    [
        ({"track": "Locl"}, "Choose one of local, global"),
        ({"sensor": "sonar"}, "Choose one of lidar2d, "),
        ({"render_mode": "ansi"}, "rgb_array"),
    ],
)
def test_a_wrong_argument_is_told(kwargs, named):
    with pytest.raises(ValueError, match=named):
        gymnasium.make(ID, **kwargs)


def test_recording_statistics_wrapper_sees_whole_episodes():
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(gymnasium.make_vec(ID, num_envs=2, horizon=5, **SMALL))
    env.reset(seed=0)
    lengths = []
    for _ in range(14):
        *_, info = env.step(np.zeros((2, 2)))
        if "episode" in info:
            lengths += list(info["episode"]["l"][info["_episode"]])
    assert lengths and set(lengths) == {5}


def test_where_physics_fails_the_episode_is_cut_off_and_no_policy_sees_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings there
    config = {**SMALL, "pedestrian_model": "social-force"}
    env, many = BsonEnv(**config), BsonVectorEnv(2, **config, autoreset_mode="NextStep")
    action = np.array([0.5, 0.0])
    env.reset(seed=4)
    many.reset(seed=[3, 4])
    last, _, _, truncated, info = env.step(action)
    many.step([action, action])
    assert not truncated and info["fault"] == ""
    env.world.engine.qvel[0, 1] = many.world.engine.qvel[1, 1] = np.nan
    observation, reward, terminated, truncated, info = env.step(action)
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert "person0/y" in info["fault"] and same(observation, last)
    observations, _, _, truncated, infos = many.step([action, action])
    assert truncated.tolist() == [False, True]
    assert infos["fault"].tolist() == ["", info["fault"]]
    assert all(np.isfinite(value).all() for value in observations.values())
    *_, truncated, infos = many.step([action, action])  # the next episode
    assert not truncated.any() and infos["fault"].tolist() == ["", ""]
    observation, info = env.reset(seed=4)
    assert info["fault"] == ""
