import numpy as np
import pytest

from bson.agents import BUILT_IN, AgentError, act, load_agent
from bson.sensors import Lidar2D
from macid.geometry import to_body

OBSERVATION = {
    "goal": np.array([10.0, 0.0], np.float32),
    "velocity": np.zeros(2, np.float32),
    "imu": np.zeros(6, np.float32),
    "lidar": np.full(720, 30.0, np.float32),
    "map": np.zeros((120, 120), np.uint8),  # of the Global track, from here on
    "map_origin": np.full(2, -15.0, np.float32),
    "map_resolution": np.array([0.25], np.float32),
    "pose": np.zeros(3, np.float32),
    "people": np.array([[3.0, 0.2], [-4.0, 2.0]], np.float32),
}


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_built_in_agent_acts_within_bounds(name):
    agent = load_agent(name)()
    if hasattr(agent, "reset"):
        agent.reset(0)
    for goal in ([10.0, 0.0], [-5.0, 3.0], [0.1, -0.1]):
        action = act(agent, {**OBSERVATION, "goal": np.array(goal, np.float32)}, name)
        assert (np.abs(action) <= 1.0).all()


@pytest.mark.parametrize("name", ["astar", "rrt", "rrt-star", "carrt-star", "orca-oracle"])
def test_planning_agents_find_the_way_round_a_wall(name):
    make = load_agent(name)
    assert make.track == "global" and load_agent("vfh").track == "local"
    agent, pose, goal = make(), np.array([-4.0, 0.0, 0.0]), np.array([4.0, 0.0])
    agent.reset(1)
    wall = OBSERVATION["map"].copy()
    wall[:70, 60] = 1  # along y up to 2.5 m, at x = 0
    nobody = np.full((0, 2), 0.0, np.float32)
    least = np.inf
    for _ in range(250):  # an ideal unicycle
        seen = {**OBSERVATION, "map": wall, "people": nobody, "pose": pose.astype(np.float32)}
        seen["goal"] = to_body(goal - pose[:2], pose[2]).astype(np.float32)
        v, w = act(agent, seen, name) * 2.0
        pose = pose + 0.1 * np.array([v * np.cos(pose[2]), v * np.sin(pose[2]), w])
        if pose[1] < 2.5:
            least = min(least, abs(pose[0] - 0.125) - 0.125)
        if np.linalg.norm(goal - pose[:2]) < 0.5:
            break
    else:
        pytest.fail("did not arrive")
    assert least > 0.2


def test_the_goal_agent_turns_towards_the_goal():
    goal = load_agent("goal")()
    assert goal({**OBSERVATION, "goal": np.array([0.0, 5.0])})[1] > 0.5
    assert goal({**OBSERVATION, "goal": np.array([0.0, -5.0])})[1] < -0.5
    assert goal(OBSERVATION)[0] > 0.5


def test_stop_and_go_stands_while_anything_is_near_ahead():
    agent, angles = load_agent("stop-and-go")(), Lidar2D().angles
    for angle, distance, stands in ((0, 1.5, True), (-29, 1.5, True), (29, 1.5, True), (0, 1.7, False), (40, 0.5, False)):
        lidar = np.full(720, 30.0, np.float32)
        lidar[np.abs(angles - np.radians(angle)).argmin()] = distance
        assert (agent({**OBSERVATION, "lidar": lidar}) == 0).all() == stands
    assert agent(OBSERVATION)[0] == 1.0  # 2 m/s


def test_the_random_agent_follows_its_seed():
    first, second = load_agent("random")(), load_agent("random")()
    first.reset(1)
    second.reset(1)
    assert np.array_equal(first(OBSERVATION), second(OBSERVATION))
    assert not np.array_equal(first(OBSERVATION), first(OBSERVATION))


def test_an_agent_may_be_a_file_a_function_or_a_class(tmp_path, monkeypatch):
    file = tmp_path / "mine.py"
    file.write_text(
        "class Slow:\n    def __call__(self, observation):\n        return [0.1, 0.0]\n\n"
        "def agent(observation):\n    return [0.2, 0.0]\n"
    )
    assert act(load_agent(str(file))(), OBSERVATION)[0] == 0.2
    make = load_agent(f"{file}:Slow")
    assert act(make(), OBSERVATION)[0] == 0.1 and make() is not make()
    monkeypatch.syspath_prepend(tmp_path)
    assert act(load_agent("mine:agent")(), OBSERVATION)[0] == 0.2


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("vhf", "Choose one of stop, random, goal, vfh"),
        ("nowhere:agent", "can't import 'nowhere'"),
        ("missing.py", "no file 'missing.py'"),
        ("bson.agents.scripted:go", "no 'go' there.*goal"),
        ("bson.metrics:GAMMA", "not callable"),
        ("bson.metrics:Episode", "without arguments"),
    ],
)
def test_an_agent_that_cannot_be_had_is_told(name, told):
    with pytest.raises(AgentError, match=told):
        load_agent(name)


@pytest.mark.parametrize("answer", [[0.0], [np.nan, 0.0], "left", None, np.zeros((1, 2)), [0.0, np.inf]])
def test_an_answer_that_is_no_action_is_told(answer):
    with pytest.raises(AgentError, match="an action is two"):
        act(lambda observation: answer, OBSERVATION, "mine")


def test_an_agents_own_failure_keeps_its_cause():
    with pytest.raises(RuntimeError, match="'mine' raised KeyError") as caught:
        act(lambda observation: observation["camera"], OBSERVATION, "mine")
    assert isinstance(caught.value.__cause__, KeyError)


def test_what_another_track_or_sensor_would_give_is_told():
    with pytest.raises(AgentError, match=r"asks for observation\['depth'\].*There are: .*lidar"):
        act(lambda observation: observation["depth"], OBSERVATION, "mine")


def test_a_class_is_built_once_a_world_and_a_file_may_import_its_neighbours(tmp_path, monkeypatch):
    (tmp_path / "beside.py").write_text("SPEED = 0.4\n")
    (tmp_path / "counted.py").write_text(
        "from __future__ import annotations\nfrom dataclasses import dataclass\nfrom beside import SPEED\n\n"
        "built = []\n\n@dataclass\nclass agent:\n    speed: float = SPEED\n\n"
        "    def __post_init__(self):\n        built.append(1)\n\n"
        "    def __call__(self, observation):\n        return [self.speed, len(built)]\n"
    )
    make = load_agent(str(tmp_path / "counted.py"))
    agents = [make(), make()]
    assert act(agents[0], OBSERVATION).tolist() == [0.4, 2.0]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "near.py").write_text("def agent(observation):\n    return [0.3, 0.0]\n")
    assert act(load_agent("near:agent")(), OBSERVATION)[0] == 0.3
