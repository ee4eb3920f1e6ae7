"""Agents drive what they are told that they drive: other robots, control periods and LIDARs, or refuse to."""

import dataclasses
import json
import math

import numpy as np
import pytest

import bson.cli
from bson.agents import BUILT_IN, AgentError, Setting, Unsuited, learned, load_agent
from bson.agents.global_view import GlobalView
from bson.agents.scan import Scan
from bson.agents.vfh import Vfh
from bson.episodes.session import Session
from bson.episodes.tracks import make_track
from bson.evaluation.play import run_episodes
from bson.features import FEATURES, motion
from bson.robot import JACKAL
from bson.sensors import Imu, Lidar2D
from bson.task import TaskConfig
from macid import geometry
from macid.policy import write_network
from macid.state import RADIUS

SETTINGS = {
    "diffbot": {"robot": "diffbot"},
    "courier": {"robot": "courier"},
    "0.04 s": {"control_period": 0.04},
    "0.2 s": {"control_period": 0.2},
}
PERIODS = (0.02, 0.04, 0.1, 0.2)
EMPTY = {"num_pedestrians": 0, "map_size": 14.0, "goal_distance": (4.0, 6.0)}
QUICK = ["--set", "map_size=20.0", "--set", "goal_distance=(6,12)", "--set", "num_pedestrians=1", "--set", "horizon=3"]
LOCAL = make_track("local", "lidar2d")


def setting(track="local", sensor="lidar2d", **task):
    return Setting.of(TaskConfig(**task), make_track(track, sensor))


class Watched:
    """An agent whose actions are noted."""

    def __init__(self, agent, actions):
        self._agent, self._actions = agent, actions

    def reset(self, seed):
        if hasattr(self._agent, "reset"):
            self._agent.reset(seed)

    def __call__(self, observation):
        self._actions.append(np.array(self._agent(observation), float))
        return self._actions[-1]


@pytest.mark.parametrize("task", SETTINGS.values(), ids=SETTINGS)
@pytest.mark.parametrize(
    "name", [name for name in BUILT_IN if name not in ("stop", "random", "gru-shield", "gru-map-shield")]
)
def test_every_built_in_agent_drives_to_the_goal_of_an_empty_world(name, task):
    factory, actions = load_agent(name), []
    config, track = TaskConfig(**EMPTY, **task), make_track(factory.track, factory.sensor)
    (episode,) = run_episodes(lambda setting: Watched(factory(setting), actions), config, track, [3], name)
    assert episode.arrived
    assert episode.collisions == 0
    assert np.isfinite(actions).all()
    assert np.abs(actions).max() <= 1.0
    assert episode.duration < 3.0 + 1.7 * episode.start_distance / min(1.5, config.robot.max_speed)


@pytest.mark.parametrize("robot", ["jackal", "diffbot", "courier"])
def test_no_agent_asks_for_more_than_the_robot_can_do(robot):
    """What it commands is what it has judged: no action is cut off."""
    its = setting("global", robot=robot)
    vfh, dwa, planner = (load_agent(name)(its) for name in ("vfh", "dwa", "astar"))
    assert np.abs(vfh._speeds).max() == its.robot.max_speed
    assert np.abs(vfh._rates).max() <= its.robot.max_yaw_rate
    for velocity in ([0.0, 0.0], its.top, -its.top):
        speed, rate = dwa.window(np.array(velocity))
        assert speed.max() <= its.robot.max_speed
        assert np.abs(rate).max() <= its.robot.max_yaw_rate
    rng = np.random.default_rng(0)
    for _ in range(50):
        path = np.cumsum(rng.normal(0.0, 1.0, (5, 2)), axis=0)
        assert (np.abs(planner._follower(rng.normal(0.0, 2.0, 3), path)) <= its.top + 1e-9).all()


def scan_of(person, sensor, place):
    """The reading of a person's disc at `person` (2,) by `sensor` at `place` (2,) of a robot at the origin."""
    rays = geometry.heading(sensor.angles)
    distance = geometry.ray_disc_distance(np.asarray(place, float), rays, np.array([person]), RADIUS)
    return np.clip(distance.min(axis=-1), sensor.range_min, sensor.range_max).astype(np.float32)


@pytest.mark.parametrize("robot", ["jackal", "diffbot"])
@pytest.mark.parametrize("every", [1, 3])
@pytest.mark.parametrize("period", PERIODS)
def test_a_person_who_walks_at_130_is_predicted_at_130(period, every, robot):
    """every: control steps from one scan to the next."""
    if every * period > 0.5:
        pytest.skip("too slow for anybody")
    view = GlobalView(setting("global", control_period=period, pedestrian_period=0.02))
    seen = {"map": np.zeros((8, 8)), "map_resolution": [0.25], "map_origin": np.array([-1.0, -1.0])}
    seen |= {"pose": np.zeros(3), "goal": np.array([5.0, 0.0])}
    for step in range(3):
        view.see({**seen, "people": np.array([[4.0, 1.30 * step * period - 2.0]], np.float32)})
    np.testing.assert_allclose(view.people_velocity, [[0.0, 1.30]], atol=1e-4)

    lidar = Lidar2D(rate=1 / (every * period))
    its = setting(robot=robot, control_period=period, pedestrian_period=0.02, sensor=(lidar,))
    agent = Vfh(its)
    for step in range(round(1.6 / period)):
        person = np.array([3.0, 1.30 * step * period - 1.0])
        if step % every == 0:
            scan = scan_of(person, lidar, Scan(its).place)
        agent({"goal": np.array([9.0, 0.0]), "velocity": np.zeros(2), "lidar": scan})
    ((place,), (velocity,)) = agent.people
    np.testing.assert_allclose(place, person, atol=0.03)
    np.testing.assert_allclose(velocity, [0.0, 1.30], atol=0.13)


def test_between_two_scans_what_stood_is_where_it_stands():
    """Robots that see every fourth control step steer by the same points as those that see each."""
    config = TaskConfig(**EMPTY | {"obstacle_density": 1.0})
    tracks = [make_track("local", (Imu(), Lidar2D(rate=rate))) for rate in (None, 2.5)]
    sessions = [Session(config, track, seeds=[0]) for track in tracks]
    agents = [load_agent("dwa")(Setting.of(config, track)) for track in tracks]
    observations = [session.reset([0], [5]) for session in sessions]
    for _ in range(12):
        for agent, seen in zip(agents, observations, strict=True):
            agent({name: value[0] for name, value in seen.items()})
        one, other = (agent._met for agent in agents)
        near = np.hypot(*one.T) < 1.5
        apart = np.hypot(*(one[near, None] - other).transpose(2, 0, 1)).min(axis=1)
        assert near.any()
        assert np.median(apart) < 0.03
        assert apart.max() < 0.25
        observations = [session.step([0], np.array([[0.3, 0.4]]))[0] for session in sessions]


# --- LIDARs

OTHER_LIDARS = {
    "181 beams": Lidar2D(beams=181, field=math.pi, range_max=8.0),
    "all around": Lidar2D(beams=1001, field=2 * math.pi, yaw=math.pi),
    "slow": Lidar2D(rate=2.5),
    "short": Lidar2D(beams=300, field=4.0, range_max=4.0, position=(0.05, -0.1, 0.35), yaw=0.2),
}


@pytest.mark.parametrize("robot", ["jackal", "diffbot", "courier"])
@pytest.mark.parametrize("lidar", OTHER_LIDARS.values(), ids=OTHER_LIDARS)
def test_a_scans_points_lie_on_the_walls(robot, lidar):
    config = TaskConfig(**EMPTY | {"obstacle_density": 1.0}, robot=robot)
    track = make_track("local", (Imu(), lidar))
    session, scan = Session(config, track, seeds=[0]), Scan(Setting.of(config, track))
    reading = scan.read({name: value[0] for name, value in session.reset([0], [5]).items()})
    x, y, yaw = session.world.pose[0]
    met = np.flatnonzero(reading < lidar.range_max - 1e-3)
    assert len(met) > 50
    points = geometry.rotate(scan.points(reading, met), np.full(len(met), yaw)) + np.array([x, y])
    outline = geometry.point_box_distance(points, session.world.boxes[0]).min(axis=-1)
    assert outline.max() < 2e-3
    for box in session.world.boxes[0]:  # and in none
        assert (np.abs(geometry.in_box_frame(points, box[None])[:, 0]) < box[2:4] - 2e-3).all(axis=-1).sum() == 0


@pytest.mark.parametrize("lidar", OTHER_LIDARS.values(), ids=OTHER_LIDARS)
@pytest.mark.parametrize("name", ["vfh", "dwa", "stop-and-go", "mppi-local"])
def test_reactive_agents_take_other_lidars(name, lidar):
    config, track = TaskConfig(**EMPTY), make_track("local", (Imu(), lidar))
    (episode,) = run_episodes(load_agent(name), config, track, [3], name)
    assert episode.arrived
    assert episode.collisions == 0


@pytest.mark.parametrize(
    ("name", "its", "told"),
    [
        ("vfh", {"sensor": "lidar3d"}, "Agent 'vfh' needs a Lidar2D; the sensors are: Imu, Lidar3D"),
        ("dwa", {"sensor": (Lidar2D(pitch=0.4),)}, "needs a level Lidar2D; 'lidar' is 23 degrees off"),
        ("vfh", {"sensor": (Lidar2D(rate=1.0),)}, "needs a scan every 0.5 s at least; 'lidar' has a rate of 1 Hz"),
        ("stop-and-go", {"sensor": (Lidar2D(field=2.0, yaw=math.pi),)}, "needs a Lidar2D that looks ahead"),
        ("vfh", {"control_period": 1.0}, "needs a control_period of at most 0.5 s, not 1 s"),
        ("mppi", {"control_period": 1.0}, "needs a control_period of at most 0.5 s, not 1 s"),
        ("mppi-policy", {}, "Agent 'mppi-policy' needs the map and people's places: choose --track global"),
        ("sfm-planner", {"control_period": 0.5}, "needs a control_period of at most 0.2 s, not 0.5 s"),
        ("mppi-local", {"sensor": "lidar3d"}, "Agent 'mppi-local' needs a Lidar2D; the sensors are: Imu, Lidar3D"),
        ("astar", {}, "Agent 'astar' needs the map and people's places: choose --track global"),
        (
            "gru-shield",
            {"robot": "diffbot"},
            "Agent 'gru-shield' was trained with robot jackal, not with robot diffbot; ",
        ),
        ("ppo", {"robot": "diffbot"}, "Agent 'ppo' was trained with robot jackal, not with robot diffbot; --untrain"),
        ("ppo", {"control_period": 0.2}, "trained with control_period 0.1 s, not with control_period 0.2 s"),
        ("tac", {"robot": {"max_speed": 1.2}}, "robot jackal's max_speed 2 m/s, not with robot jackal's max_speed 1.2"),
        ("sac", {"sensor": (Lidar2D(beams=360),)}, "LIDAR's beams 720, not with LIDAR's beams 360"),
        ("bc", {"sensor": "camera"}, "Agent 'bc' needs a Lidar2D with the key \"lidar\"; the sensors are: Imu, Rgb"),
    ],
)
def test_what_an_agent_cannot_drive_is_refused_in_one_line(name, its, told):
    with pytest.raises(Unsuited) as caught:
        load_agent(name)(setting(**its))
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


# --- learned ones


@pytest.mark.parametrize("name", learned.names())
def test_a_learned_agent_takes_other_people_maps_and_horizons(name):
    changes = [{"num_pedestrians": 99}, {"map": "doorway"}, {"obstacle_density": 1.0, "horizon": 7}, {"map_size": 20.0}]
    track, sensor = load_agent(name).track, load_agent(name).sensor
    for task in [{}, *changes, {"pedestrian_model": "orca"}, {"pedestrian_period": 0.02}]:
        load_agent(name)(setting(track, sensor, **task))
    load_agent(name)(setting("global", sensor))


def test_a_learned_agent_may_try_in_another_setting_where_shapes_allow():
    its = setting(robot="diffbot", control_period=0.2, sensor=(Lidar2D(beams=360),))
    agent = load_agent("ppo", untrained=True)(its)
    seen = {"goal": np.array([5.0, 1.0]), "velocity": np.zeros(2), "lidar": np.full(360, 30.0)}
    agent.reset(0)
    assert np.abs(agent(seen)).max() <= 1.0
    with pytest.raises(Unsuited, match="a multiple of 36, not 100"):
        load_agent("ppo", untrained=True)(setting(sensor=(Lidar2D(beams=100),)))


def test_a_policy_of_another_robot_says_so_and_measures_motion_in_its_own_speeds(tmp_path):
    weight = np.zeros((FEATURES, 2), np.float32)
    weight[4, 0] = weight[5, 1] = 1.0  # its actions are its velocities, as shares
    recipe = {"output": "clip", "setting": learned.setting_document(setting(robot="diffbot"))}
    write_network(tmp_path / "mine", [(weight, np.zeros(2, np.float32))], json.loads(json.dumps(recipe)))
    factory = load_agent(str(tmp_path / "mine.npz"))
    agent = factory(setting(robot="diffbot"))
    agent.reset(0)
    seen = {"goal": np.array([5.0, 1.0]), "velocity": np.array([0.5, -1.0]), "lidar": np.full(720, 30.0)}
    np.testing.assert_allclose(agent(seen), [0.5, -0.5])  # diffbot's top is 1 m/s and 2 rad/s
    np.testing.assert_allclose(motion(seen, (1.0, 2.0))[-2:], [0.5, -0.5])
    with pytest.raises(Unsuited, match="trained with robot diffbot, not with robot jackal"):
        factory(setting())
    slower = dataclasses.replace(setting(robot="diffbot").robot, max_yaw_rate=1.0)
    with pytest.raises(Unsuited, match="max_yaw_rate 2 rad/s, not with robot diffbot's max_yaw_rate 1 rad/s"):
        factory(setting(robot=slower))


@pytest.mark.parametrize(
    ("recipe", "told"),
    [
        ({"setting": {}}, "key 'setting'"),
        ({"setting": {"control_period": 0.1, "robot": {"max_speed": 0.0}, "lidar": {}}}, "no max_speed above 0"),
        ({"task": {"robot": "gone.toml"}}, "does not tell in what it was trained.*gone.toml"),
    ],
)
def test_a_recipe_that_does_not_tell_the_setting_is_told(tmp_path, recipe, told):
    layers = [(np.zeros((FEATURES, 2), np.float32), np.zeros(2, np.float32))]
    write_network(tmp_path / "mine", layers, {"output": "clip", **recipe})
    with pytest.raises(ValueError, match=told):
        load_agent(str(tmp_path / "mine.npz"))(setting())


# --- one's own

OWN = """
from bson.agents import Unsuited

class Needs:
    def __init__(self, world):
        self.given = world
    def __call__(self, observation):
        return [0.1 * self.given.control_period, self.given.robot.max_speed / 10]

class Named(Needs):
    def __init__(self, speed=1.0, setting=None):
        self.speed, self.given = speed, setting

class Plain:
    given = None
    def __init__(self, speed=1.0):
        self.speed = speed
    def __call__(self, observation):
        return [0.0, 0.0]

class Two(Plain):
    def __init__(self, setting, model):
        pass

class Refuses(Plain):
    def __init__(self, setting):
        raise Unsuited("has no wheels.")

class Fails(Plain):
    def __init__(self, setting):
        setting.nothing
"""


@pytest.fixture
def own(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    return lambda name: load_agent(f"{tmp_path / 'own.py'}:{name}")


def test_a_class_of_ones_own_is_given_the_setting_if_it_takes_one(own):
    its = setting(robot="courier", control_period=0.2)
    assert own("Needs")(its).given is its
    assert own("Named")(its).given is its
    assert own("Named")(its).speed == 1.0 == own("Plain")(its).speed
    assert own("Needs")().given == Setting.default()
    with pytest.raises(AgentError, match="without arguments, or with the Setting alone"):
        own("Two")
    with pytest.raises(Unsuited, match=r"own.py:Refuses' has no wheels\.$"):
        own("Refuses")(its)
    with pytest.raises(AgentError, match=r"raised AttributeError.*own.py, line 31"):
        own("Fails")(its)


def test_the_setting_that_is_given_is_that_of_the_episodes(own):
    made = []

    def make(setting):
        made.append(own("Needs")(setting))
        return made[-1]

    config = TaskConfig(**EMPTY, robot="diffbot", control_period=0.04).replace(horizon=2)
    run_episodes(make, config, make_track("global", "lidar2d"), [1])
    (given,) = [agent.given for agent in made]
    assert (given.control_period, given.robot, given.horizon) == (0.04, config.robot, 2)
    assert given.track == "global"
    assert given.sensors == LOCAL.sensors
    assert (given.map.size, given.map.origin, given.map.resolution) == (14.0, (-7.0, -7.0), 0.25)
    assert given.top.tolist() == [1.0, 2.0]
    assert given.steps(0.3) == 8
    assert given.steps(0.001) == 1
    slow = setting(robot={"max_speed": 1.2})
    assert slow.top.tolist() == [1.2, 2.0]
    assert (slow.built_for == [2.0, 2.0]).all()
    assert slow.robot != JACKAL.config


# --- the commands


def test_a_command_refuses_before_the_first_step_and_a_flag_lets_it_try(tmp_path, capsys):
    out = tmp_path / "out"
    words = ["evaluate", "--suite", "smoke", "--episodes", "1", "--videos", "0", *QUICK, "--out", str(out)]
    words += ["--agent", "ppo", "--set", "robot=diffbot"]
    assert bson.cli.main(words) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "trained with robot jackal, not with robot diffbot; --untrained-setting" in error
    assert not out.exists()
    assert bson.cli.main([*words, "--untrained-setting"]) == 0
    assert json.loads((out / "results.json").read_text())["config"]["robot"]["name"] == "diffbot"
    pytest.importorskip("stable_baselines3")
    words = ["train", "--algo", "bc", "--steps", "16", "--set", "control_period=0.2", "--out", str(tmp_path / "runs")]
    assert bson.cli.main(words) == 2
    assert "not with control_period 0.2 s: BC needs an expert of its setting" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()
    film = tmp_path / "film.png"
    assert bson.cli.main(["render", "--agent", "vfh", "--set", "control_period=1.0", "--out", str(film)]) == 2
    assert "needs a control_period of at most 0.5 s" in capsys.readouterr().err
    assert not film.exists()
