import sys

import numpy as np
import pytest

from bson.agents import BUILT_IN, AgentError, act, load_agent, reset_agent
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


@pytest.mark.parametrize("name", ["astar", "rrt", "rrt-star", "carrt-star", "orca-oracle", "mppi", "sfm-planner"])
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
    for angle, distance, stands in (
        (0, 1.5, True),
        (-29, 1.5, True),
        (29, 1.5, True),
        (0, 1.7, False),
        (40, 0.5, False),
    ):
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
        ("vhf", "Choose one of stop, random, goal, stop-and-go, vfh"),
        ("nowhere:agent", "can't import 'nowhere'"),
        ("missing.py", "no file 'missing.py'"),
        ("bson.agents.scripted:go", "no 'go' there.*goal"),
        ("bson.evaluation.metrics:GAMMA", "not callable"),
        ("bson.evaluation.metrics:Episode", "without arguments"),
    ],
)
def test_an_agent_that_cannot_be_had_is_told(name, told):
    with pytest.raises(AgentError, match=told):
        load_agent(name)


@pytest.mark.parametrize("answer", [[0.0], [np.nan, 0.0], "left", None, np.zeros((1, 2)), [0.0, np.inf]])
def test_an_answer_that_is_no_action_is_told(answer):
    with pytest.raises(AgentError, match="an action is two"):
        act(lambda observation, answer=answer: answer, OBSERVATION, "mine")


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


class Guarded:
    """As an array on a GPU."""

    def __array__(self, dtype=None, copy=None):
        raise TypeError("Implicit conversion to a NumPy array is not allowed. Use .get()")


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (Guarded(), "Guarded, which NumPy can't read as numbers: raised TypeError: Implicit conversion"),
        ([[0.1], [0.2]], "list of shape (2, 1)"),
        ([[0.1], [0.2, 0.3]], "raised ValueError"),
        ([Guarded(), 0.1], "Use .get()"),
        (["0.1", "0.2"], "no real numbers"),
        (np.array([1j, 0.5]), "complex128, no real numbers"),
        ({0.1: 0.2, 0.3: 0.4}, "an action is two numbers"),
    ],
)
def test_an_answer_that_numpy_cannot_read_is_one_line_with_the_reason(answer, told):
    with pytest.raises(AgentError) as caught:
        act(lambda observation, answer=answer: answer, OBSERVATION, "mine")
    text = str(caught.value)
    assert "'mine' returned" in text and told in text and "an action is two numbers" in text and "\n" not in text


def test_a_torch_tensor_is_detached():
    torch = pytest.importorskip("torch")
    weights = torch.tensor([0.25, -0.5], requires_grad=True)
    for answer in (weights * 2, [weights[0] * 2, weights[1] * 2], (weights * 2).detach()):
        assert act(lambda observation, answer=answer: answer, OBSERVATION, "mine").tolist() == [0.5, -1.0]


FAILING = """
import json
class Strict:
    def __init__(self):
        self.state = 3
    def __getattr__(self, name):
        raise RuntimeError("not ready")
class Picky:
    def __init__(self):
        raise OSError("no weights")
class Late:
    def reset(self, seed):
        self.missing.other
    def __call__(self, observation):
        return 0, 0
def divides(observation):
    return 1 / 0
def parses(observation):
    return json.loads("{")
def leaves(observation):
    exit(7)
def several(observation):
    raise ValueError("first\\nsecond")
"""


@pytest.mark.parametrize(
    ("attribute", "told"),
    [
        ("divides", "raised ZeroDivisionError: division by zero in {file}, line 17"),
        ("parses", "raised JSONDecodeError"),
        ("parses", "in {file}, line 19"),
        ("leaves", "called exit(7) in {file}, line 21"),
        ("several", "raised ValueError: first second in {file}, line 23"),
        ("Picky", "raised OSError: no weights in {file}, line 10"),
        ("Late", "raised AttributeError: 'Late' object has no attribute 'missing' in {file}, line 13"),
        ("Strict", "raised RuntimeError: not ready in {file}, line 7"),
        ("nobody", "There are: Strict, Picky, Late, divides, parses, leaves, several."),
    ],
)
def test_an_agents_failure_is_one_line_with_its_name_file_line_and_what_it_raised(tmp_path, attribute, told):
    file = tmp_path / "mine.py"
    file.write_text(FAILING)
    name = f"{file}:{attribute}"

    def drive():
        agent = load_agent(name)()
        reset_agent(agent, 0, name)
        act(agent, OBSERVATION, name)

    with pytest.raises(AgentError) as caught:
        drive()
    text = str(caught.value)
    assert f"Agent '{name}'" in text and told.format(file=file) in text and "\n" not in text


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("exit(7)", "called exit(7) in {file}, line 1"),
        ("import sys\nsys.exit()", "called exit() in {file}, line 2"),
        ("def agent(:", "SyntaxError"),
        ("import nowhere_at_all", "raised ModuleNotFoundError: No module named 'nowhere_at_all' in {file}, line 1"),
        ("from json import nothing", "raised ImportError"),
        ("1 / 0", "raised ZeroDivisionError: division by zero in {file}, line 1"),
        ("raise BaseExceptionGroup('x', [ValueError('y')])", "raised"),
        ("def __getattr__(name):\n    raise KeyError(name)", "raised KeyError: 'agent' in {file}, line 2"),
    ],
)
def test_a_module_that_fails_as_it_is_loaded_is_told_by_either_name(tmp_path, monkeypatch, content, told):
    (tmp_path / "failing_module.py").write_text(content)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    for name in ("failing_module.py", "failing_module:agent"):
        sys.modules.pop("failing_module", None)
        with pytest.raises(AgentError) as caught:
            load_agent(name)
        text = str(caught.value).replace(f"{tmp_path}/", "")
        assert f"Agent '{name}'" in text and told.format(file="failing_module.py") in text
        assert "\n" not in text


@pytest.mark.parametrize("name", [".near:agent", "..:agent", ":agent", "a/b:agent", "a b:agent", "a..b:agent", "1:2"])
def test_what_is_no_modules_name_is_told(name):
    with pytest.raises(AgentError, match=r"^Agent '.*' is no module's name"):
        load_agent(name)
