import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("pettingzoo")

from pettingzoo.test import parallel_api_test, parallel_seed_test

from macid import watch
from macid.crowd import Crowd, CrowdConfig
from macid.layout import Layout, load_level
from macid.parallel_env import CrowdParallelEnv
from macid.pedestrians.learned import Learned
from macid.policy import load_policy
from macid.reward import RewardWeights

NEAR = CrowdConfig(period=0.1, duration=4.0, goal_distance=(1.0, 5.0))
ROOM = Layout(12.0, [[0.0, 0.0, 0.5, 0.5, 0.3]], name="room")
STAND, WALK = np.array([-1.0, 0.0]), np.array([1.0, 0.0])


@pytest.fixture(scope="module")
def env():
    return CrowdParallelEnv(ROOM, NEAR, number=6)


def everybody(env, action):
    return {agent: action for agent in env.agents}


def towards_goals(observations):
    """Actions that turn to the goal and walk."""
    angle = {agent: np.arctan2(seen[1], seen[0]) for agent, seen in observations.items()}
    return {agent: np.array([np.cos(turn), np.clip(2 * turn, -1, 1)]) for agent, turn in angle.items()}


def test_pettingzoos_own_tests(env):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "Unknown option 'options'")  # the test tries one
        parallel_api_test(env, num_cycles=100)
        parallel_seed_test(lambda: CrowdParallelEnv(ROOM, NEAR, number=3))


def test_agents_and_spaces(env):
    observations, infos = env.reset(seed=1)
    assert env.agents == env.possible_agents == [f"person_{index}" for index in range(6)]
    assert set(observations) == set(infos) == set(env.agents)
    for agent in env.agents:
        assert observations[agent].shape == (41,) and observations[agent].dtype == np.float32
        assert env.action_space(agent).shape == (2,)
    assert CrowdParallelEnv(1, NEAR).possible_agents[-1] == "person_24"
    assert len(CrowdParallelEnv(1, NEAR, number=3).possible_agents) == 3
    assert len(CrowdParallelEnv(ROOM, CrowdConfig(number=4, goal_distance=(1.0, 9.0))).possible_agents) == 4


@pytest.mark.parametrize("choose", ["random", "goals"])
def test_observations_stay_in_their_space_and_last_ones_are_from_the_goal(env, choose):
    observations, _ = env.reset(seed=3)
    for index, agent in enumerate(env.agents):
        env.action_space(agent).seed(index)
    arrived = 0
    while env.agents:
        if choose == "random":
            actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        else:
            actions = towards_goals(observations)
        observations, _, terminations, truncations, _ = env.step(actions)
        for agent, seen in observations.items():
            assert env.observation_space(agent).contains(seen)
            assert (np.hypot(*seen[:2]) <= 0.5) == terminations[agent]
            assert not (terminations[agent] and truncations[agent])
            arrived += terminations[agent]
            assert (agent in env.agents) == (not terminations[agent] and not truncations[agent])
    assert choose == "random" or arrived >= 4


def test_an_action_is_a_share_of_the_top_speeds():
    env = CrowdParallelEnv(Layout(60.0, []), CrowdConfig(period=0.1), number=2)
    first, _ = env.reset(seed=0)
    for action, speed, rate in ((WALK, 1.5, 0.0), ((0.0, 0.5), 0.75, 0.5), ((-1.0, -1.0), 0.0, -1.0), ((7, 9), 1.5, 1)):
        for _ in range(5):
            seen = env.step(everybody(env, action))[0]
        for agent in env.agents:
            assert seen[agent][2:4] == pytest.approx([speed, rate], abs=0.02)
    assert all(first[agent][0] > 7.9 and abs(first[agent][1]) < 1e-3 for agent in env.agents)  # facing the goal


def test_agents_have_speeds_of_their_own_and_companions():
    config = CrowdConfig(period=0.1, preferred_speed=(0.8, 1.2), max_speed=2.0, companions=1.0)
    env = CrowdParallelEnv(Layout(60.0, []), config, number=3)
    _, infos = env.reset(seed=0)
    assert len({infos[agent]["group"] for agent in env.agents}) == 1
    assert all(0.8 <= infos[agent]["preferred_speed"] <= 1.2 for agent in env.agents)
    for _ in range(5):
        seen = env.step(everybody(env, WALK))[0]
    assert [seen[agent][2] for agent in env.agents] == pytest.approx([2.0] * 3, abs=0.02)


def test_rewards_are_eq_5_and_eq_1():
    weights = RewardWeights(distance=2.0, goal=3.0, collision=0.5)
    env = CrowdParallelEnv(ROOM, NEAR, number=14, weights=weights)
    observations, _ = env.reset(seed=5, options={"lcf": {"person_0": 1.5, "person_1": -2.0}})
    touched = arrived = 0
    while env.agents:
        crowd, walking = env.crowd, list(env.agents)
        before = {agent: np.hypot(*observations[agent][:2]) for agent in walking}
        counts = dict(zip(env.possible_agents, np.asarray(env._episode.collisions[0]), strict=True))
        observations, rewards, terminations, _, infos = env.step(towards_goals(observations))
        own = {}
        for agent in walking:
            closer = before[agent] - np.hypot(*observations[agent][:2])
            contact = infos[agent]["collisions"] > counts[agent]
            own[agent] = 2.0 * closer + 3.0 * terminations[agent] - 0.5 * contact
            touched, arrived = touched + contact, arrived + terminations[agent]
            assert infos[agent]["individual"] == pytest.approx(own[agent], abs=1e-4)
        state = crowd.engine.read(env._episode.physics)
        place = {agent: np.asarray(state.position[0, int(agent[7:])]) for agent in walking}
        for agent in walking:
            info = infos[agent]
            assert rewards[agent] == pytest.approx(info["individual"] + info["lcf"] * info["neighborhood"], abs=1e-5)
            if not any(terminations.values()):  # who has arrived is no longer in place
                near = [own[o] for o in walking if o != agent and np.hypot(*(place[o] - place[agent])) <= 5.0]
                assert info["neighborhood"] == pytest.approx(np.mean(near) if near else 0.0, abs=1e-4)
    assert touched and arrived
    assert (infos["person_0"]["lcf"] if "person_0" in infos else 1.5) == 1.5


def test_the_individual_reward_alone():
    env = CrowdParallelEnv(ROOM, NEAR, number=6, reward="individual")
    env.reset(seed=5)
    _, rewards, _, _, infos = env.step(everybody(env, WALK))
    assert all(rewards[agent] == infos[agent]["individual"] for agent in env.agents)
    assert any(infos[agent]["neighborhood"] != 0 for agent in env.agents)


def test_lcfs_can_be_set(env):
    env.reset(seed=2)
    drawn = dict(env.lcf)
    assert len(set(drawn.values())) == 6 and all(-2 <= value <= 2 for value in drawn.values())
    env.lcf = {"person_2": 0.25}
    assert env.lcf == {**drawn, "person_2": 0.25}
    infos = env.step(everybody(env, STAND))[-1]
    assert {agent: info["lcf"] for agent, info in infos.items()} == env.lcf
    env.lcf = (1.0, 1.5)
    assert all(1.0 <= value <= 1.5 for value in env.lcf.values()) and len(set(env.lcf.values())) == 6
    _, infos = env.reset(options={"lcf": -1})
    assert {info["lcf"] for info in infos.values()} == {-1.0}
    _, infos = env.reset()
    assert len({info["lcf"] for info in infos.values()}) == 6
    with pytest.raises(TypeError):
        env.lcf["person_0"] = 1.0  # a copy would swallow it


@pytest.mark.parametrize(
    "value", [float("nan"), (2.0, 1.0), (1.0, 2.0, 3.0), "high", {"person_9": 1.0}, {"person_0": "x"}]
)
def test_a_bad_lcf_is_told_and_changes_nothing(env, value):
    env.reset(seed=2)
    before = dict(env.lcf)
    with pytest.raises(ValueError, match="lcf|LCF|Unknown agent 'person_9'"):
        env.lcf = value
    assert env.lcf == before


def test_bad_arguments_and_actions_are_told(env):
    with pytest.raises(ValueError, match="Unknown reward 'shared'. Choose one of individual, coordinated"):
        CrowdParallelEnv(1, reward="shared")
    with pytest.raises(ValueError, match="Unknown level 9"):
        CrowdParallelEnv(9)
    with pytest.raises(ValueError, match="at least one person, not 0"):
        CrowdParallelEnv(1, number=0)
    with pytest.raises(gymnasium.error.ResetNeeded):
        CrowdParallelEnv(ROOM, NEAR, number=2).step({})
    env.reset(seed=0)
    with pytest.raises(ValueError, match="person_3 is missing"):
        env.step({agent: STAND for agent in env.agents if agent != "person_3"})
    for bad in (np.zeros(3), [np.nan, 0.0]):
        with pytest.raises(ValueError, match="2 finite numbers, not person_5"):
            env.step({**everybody(env, STAND), "person_5": bad})
    with pytest.warns(UserWarning, match="'lcfs' is ignored"):
        env.reset(options={"lcfs": 1.0})


def test_truncation_at_the_horizon_and_a_reset_goes_on_to_another_episode(env):
    first, _ = env.reset(seed=0)
    for step in range(40):
        assert len(env.agents) == 6
        truncations = env.step(everybody(env, STAND))[3]
        assert all(truncated == (step == 39) for truncated in truncations.values())
    assert env.agents == []
    with pytest.raises(gymnasium.error.ResetNeeded, match="Nobody"):
        env.step({})
    second, _ = env.reset()
    assert not np.array_equal(first["person_0"], second["person_0"])
    for expected in (first, second):
        seen, _ = env.reset(seed=0) if expected is first else env.reset()
        assert all(np.array_equal(seen[agent], expected[agent]) for agent in expected)


def drive(env, policy, seed):
    """An episode of `policy`, from the observations and infos alone."""
    observations, infos = env.reset(seed=seed)
    arrived, collisions = set(), {}
    while env.agents:
        seen = np.stack([observations[agent] for agent in env.agents])
        lcf = np.array([infos[agent]["lcf"] for agent in env.agents])
        actions = dict(zip(env.agents, policy.action(seen, lcf), strict=True))
        observations, _, terminations, _, infos = env.step(actions)
        arrived |= {agent for agent, done in terminations.items() if done}
        collisions |= {agent: info["collisions"] for agent, info in infos.items()}
    return arrived, collisions


def test_a_shipped_policy_plays_the_evaluations_episode():
    policy, config = load_policy("macid"), CrowdConfig(25, 0.1, 5.0, goal_distance=(2.0, 9.0))
    env = CrowdParallelEnv(1, config)
    arrived, collisions = drive(env, policy, 5)
    crowd = Crowd(load_level(1), config)
    end, positions = crowd.rollout(crowd.reset(np.random.default_rng((5, 1))), Learned(policy, 0.1))
    assert 10 < len(arrived) < 25 and max(collisions.values()) > 0
    assert arrived == {env.possible_agents[index] for index in np.flatnonzero(~np.asarray(end.walking[0]))}
    assert list(collisions.values()) == end.collisions[0].tolist()
    recording = env.recording("macid")
    assert recording.position.shape == (51, 25, 2) and recording.duration == pytest.approx(5.0)
    np.testing.assert_allclose(recording.position[:50], positions[:, 0], atol=1e-3)


def test_a_recording_is_what_macid_watch_records():
    config = CrowdConfig(period=0.1, duration=1.0)
    env = CrowdParallelEnv(1, config)
    drive(env, load_policy("macid"), 4)
    mine, theirs = env.recording("macid"), watch.record("macid", 1, config, seed=4)
    for name in ("lcf", "goals", "position", "yaw", "walking", "collisions"):
        np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), atol=1e-4)
    assert (mine.pedestrian, mine.level, mine.seed, mine.period) == ("macid", 1, 4, 0.1)


def test_an_outcomes_neighbours_are_who_walked():
    """Three in a row, 4 m apart, starting to walk; the third has left before, so that it is nobody's neighbour."""
    crowd = Crowd(Layout(40.0, []), CrowdConfig(number=3, period=0.1))
    start = crowd.reset(np.random.default_rng(0))
    places = np.array([[[-4.0, 0.0], [0.0, 0.0], [4.0, 0.0]]])
    goals = jnp.asarray([[[15.0, 0.0], [0.51, 0.0], [15.0, 0.0]]], jnp.float32)
    episode = start._replace(physics=crowd.engine.init(places, np.zeros((1, 3))), goals=goals)
    command = jnp.asarray([[[1.0, 0, 0]] * 3], jnp.float32)
    transition = jax.jit(crowd.transition)
    _, alive = transition(episode, command)
    assert alive.arrived.tolist() == [[False, True, False]]
    walker, arriver = float(alive.individual[0, 0]), float(alive.individual[0, 1])
    assert walker == pytest.approx(10 * 0.032, abs=0.01) and arriver == pytest.approx(1 + walker, abs=0.02)
    np.testing.assert_allclose(alive.neighborhood[0], [arriver, walker, arriver], rtol=1e-4)
    _, gone = transition(episode._replace(walking=jnp.array([[True, True, False]])), command)
    np.testing.assert_allclose(gone.individual[0], [walker, arriver, 0.0], rtol=1e-4)
    np.testing.assert_allclose(gone.neighborhood[0], [arriver, walker, 0.0], rtol=1e-4)
