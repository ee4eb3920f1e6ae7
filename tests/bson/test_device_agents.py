"""Agents as JAX functions are the agents that NumPy runs."""

import json

import numpy as np
import pytest

from bson import benchmark, recurrent
from bson.agents import load_agent
from bson.agents.contract import AgentError, Setting
from bson.agents.learned import KINDS, setting_document, write
from bson.episodes.tracks import make_track
from bson.evaluation.device_agents import device_agent
from bson.evaluation.statistics import mean
from bson.task import TaskConfig
from macid.files import UsageError

CONFIG = TaskConfig()
OWN = """
import jax.numpy as jnp

def towards(observation):
    return jnp.clip(observation["goal"] / 5.0, -1.0, 1.0)

def numpy_only(observation):
    import numpy as np
    return np.asarray(observation["goal"]).clip(-1, 1)

def three(observation):
    return jnp.zeros(3)

def blind(observation):
    return observation["rgb"]

class Slower:
    def begin(self, observation):
        return jnp.ones(observation["goal"].shape[0])

    def act(self, memory, observation):
        return 0.1 * memory[:, None] * observation["goal"], memory / 2

class Growing(Slower):
    def act(self, memory, observation):
        return observation["goal"], (memory, memory)

class Needy:
    def __init__(self, a, b):
        pass
"""


@pytest.fixture
def own(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    return lambda name: f"{tmp_path / 'own.py'}:{name}"


@pytest.fixture
def gru_scans(tmp_path):
    """The file of a policy of the kind gru-scans, with random weights."""
    rng, kind = np.random.default_rng(0), KINDS["gru-scans"]
    shapes = [shape for part in recurrent.shapes("none").values() for shape in part]
    layers = [(rng.normal(0, 0.3, s).astype(np.float32), rng.normal(0, 0.1, s[1]).astype(np.float32)) for s in shapes]
    setting = setting_document(Setting.of(CONFIG, make_track(kind.track, kind.sensor)))
    write(tmp_path / "mine", layers, {"output": "clip", "inputs": "gru-scans", "setting": setting})
    return str(tmp_path / "mine.npz")


def drive(agent, config=CONFIG, worlds=3, steps=7):
    """The actions of `agent` on a device, and those of NumPy's agents, in random worlds: two arrays (steps, worlds,
    2)."""
    factory, rng = load_agent(agent), np.random.default_rng(1)
    track = make_track(factory.track, factory.sensor)
    ours = device_agent(agent, factory, config, track)
    theirs = [factory(Setting.of(config, track)) for _ in range(worlds)]
    for each in theirs:
        if hasattr(each, "reset"):
            each.reset(0)
    space, memory, found = track.space(config), None, []
    space.seed(3)
    for step in range(steps):
        seen = {key: np.stack([box.sample() for _ in range(worlds)]) for key, box in space.spaces.items()}
        for key in seen.keys() & {"lidar", "depth"}:  # near enough to be seen
            seen[key] = rng.uniform(0.3, 9.0, seen[key].shape).astype(np.float32)
        seen["goal"] = rng.uniform(-2.0, 2.0, (worlds, 2)).astype(np.float32)
        memory = ours.begin(seen) if step == 0 else memory
        actions, memory = ours.act(memory, seen)
        rows = [each({key: value[row] for key, value in seen.items()}) for row, each in enumerate(theirs)]
        found.append((np.asarray(actions), np.stack(rows)))
    return map(np.stack, zip(*found, strict=True))


@pytest.mark.parametrize("agent", ["goal", "stop", "ppo", "tac", "camera"])
def test_a_shipped_agent_acts_as_with_numpy(agent):
    one, other = drive(agent)
    np.testing.assert_allclose(one, other, atol=2e-5)
    assert agent == "stop" or other.std() > 0.05


def test_a_policy_that_was_trained_on_a_device_acts_as_with_numpy(gru_scans):
    one, other = drive(gru_scans)
    np.testing.assert_allclose(one, other, atol=2e-5)
    assert other.std() > 0.05


def test_goal_is_as_careful_with_long_control_periods():
    one, other = drive("goal", CONFIG.replace(control_period=0.4, pedestrian_period=0.1))
    np.testing.assert_allclose(one, other, atol=2e-5)


def test_a_function_and_an_object_of_the_user_s_own_are_agents(own):
    factory, track = load_agent(own("towards")), make_track("local", "lidar2d")
    agent = device_agent(own("towards"), factory, CONFIG, track)
    goal = np.array([[1.0, -2.0], [9.0, 0.0]], np.float32)
    actions, _ = agent.act(agent.begin({"goal": goal}), {"goal": goal})
    np.testing.assert_allclose(actions, [[0.2, -0.4], [1.0, 0.0]], atol=1e-6)
    agent = device_agent(own("Slower"), load_agent(own("Slower")), CONFIG, track)
    first, memory = agent.act(agent.begin({"goal": goal}), {"goal": goal})
    second, _ = agent.act(memory, {"goal": goal})
    np.testing.assert_allclose(second, 0.5 * first)


@pytest.mark.parametrize(
    ("name", "error", "told"),
    [
        ("numpy_only", UsageError, "functions that JAX can trace, not .*numpy_only': it raised .*own.py, line 9"),
        ("three", AgentError, r"returned float32 of shape \(3,\); an action is two numbers"),
        ("blind", UsageError, "it raised KeyError: 'rgb' in .*own.py, line 15"),
        ("Growing", AgentError, "its memory is"),
        ("Needy", AgentError, "must be constructible without arguments"),
    ],
)
def test_what_is_no_such_agent_is_told_in_one_line_before_anything_is_written(own, tmp_path, name, error, told):
    with pytest.raises(error, match=told) as caught:
        benchmark.evaluate(own(name), "smoke", out=tmp_path / "out", episodes=1, engine="warp")
    assert "\n" not in str(caught.value) and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_function_of_the_user_s_own_is_scored_as_on_the_native_engine(own, tmp_path):
    pytest.importorskip("warp")
    setting = {"num_pedestrians": 2, "map_size": 14.0, "goal_distance": (3.0, 6.0), "horizon": 80}
    found = {}
    for engine in ("native", "warp"):
        out = tmp_path / engine
        found[engine] = benchmark.evaluate(
            own("towards"), "smoke", out=out, episodes=3, overrides=setting, engine=engine, videos=0, quiet=True
        )
    for name in ("SNS", "RC", "SP"):
        np.testing.assert_allclose(found["warp"].metrics[name], found["native"].metrics[name], atol=2.0)
    assert json.loads((tmp_path / "warp" / "results.json").read_text())["engine"] == "warp"


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["goal", "tac", "ppo"])
def test_over_a_suite_an_agent_scores_as_on_the_native_engine(agent, tmp_path):
    pytest.importorskip("warp")
    found = [
        benchmark.evaluate(agent, "paper", out=tmp_path / engine, episodes=100, engine=engine, videos=0, quiet=True)
        for engine in ("native", "warp")
    ]
    rows = [one.rows for one in found]
    native, warp = (np.array([each[key]["SNS"] for key in rows[0]]) for each in rows)
    difference = mean((warp - native)[None])
    assert difference.low <= 0.0 <= difference.high
