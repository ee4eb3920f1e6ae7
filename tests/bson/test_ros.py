"""Worlds and agents as ROS 2 nodes: over the wire everything is as it is without, and what goes wrong is told."""

import contextlib
import os
import pathlib
import re
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from bags import by_topic, equal, timeless

pytest.importorskip("rclpy", reason="needs the extra ros: wheels of ROS 2 for Linux on x86-64")

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from bson import benchmark
from bson.agents import load_agent
from bson.agents.contract import AgentError
from bson.episodes.session import Session
from bson.episodes.tracks import make_track
from bson.interfaces import messages, ros, ros_agent, ros_world
from bson.robot import robot_config
from bson.sensors import Lidar2D
from bson.task import TaskConfig
from macid.files import UsageError

DOMAIN = str(1 + os.getpid() % 100)
SETS = {"horizon": 25, "map_size": 20.0, "goal_distance": (6.0, 12.0), "num_pedestrians": 3, "pedestrian_model": "orca"}
WORDS = [word for key, value in SETS.items() for word in ("--set", f"{key}={value}")]
CONFIG = TaskConfig().replace(**SETS)
TRACK = make_track("local", "lidar2d")


@pytest.fixture(autouse=True, scope="module")
def domain():
    """A domain of this test's own, on this machine alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", DOMAIN)
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield


@contextlib.contextmanager
def running(*words, cwd=None):
    """`bson` with these words as another process, which is killed at the end if it still runs."""
    process = subprocess.Popen(
        [sys.executable, "-m", "bson.cli", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(pathlib.Path(__file__).parents[2])},
    )  # fmt: skip
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


class Peer:
    """A node on the other side, whose callbacks run in a thread of their own while the `with` goes on.

    publish: {topic: type}; hear: {topic: type}. heard: {topic: [message, ...]}."""

    def __init__(self, publish, hear, latched=()):
        self.heard, self._over = {name: [] for name in hear}, threading.Event()
        self.told = {}
        self._plan = publish, hear, latched
        self._thread = threading.Thread(target=self._run)
        self._ready = threading.Event()

    def _run(self):
        publish, hear, latched = self._plan
        with ros.wire("peer") as wire:
            self.wire = wire
            for name, kind in publish.items():
                self.told[name] = wire.node.create_publisher(ros.kind_of(kind), name, quality(name in latched))
            for name, kind in hear.items():
                wire.node.create_subscription(
                    ros.kind_of(kind), name, self.heard[name].append, quality(name in latched)
                )  # fmt: skip
            self._ready.set()
            while not self._over.is_set():
                wire.spin(0.02)

    def __enter__(self):
        self._thread.start()
        self._ready.wait()
        return self

    def __exit__(self, *_):
        self._over.set()
        self._thread.join()


def quality(latched):
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=durability)


def command(speed, yaw_rate=0.0, stamp=0):
    message = ros.kind_of("geometry_msgs/msg/TwistStamped")()
    message.twist.linear.x, message.twist.angular.z = speed, yaw_rate
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
    return message


# --- two processes


def test_in_lockstep_a_suite_scores_exactly_as_without_ros_and_says_what_a_bag_says(tmp_path):
    """A node that wraps vfh drives `bson evaluate --agent ros`; a third node hears what is said."""
    patient = ["--timeout", "300"]  # where the machine is busy, the first step takes long
    task = ["--suite", "smoke", "--episodes", "2", *WORDS, *patient, "--videos", "0"]
    wanted = benchmark.evaluate("vfh", "smoke", episodes=2, overrides=SETS, quiet=True)
    topics = {
        name: topic for name, topic in messages.topics(TRACK.sensors).items() if name not in ("/tf", "/tf_static")
    }
    latched = {name for name, topic in topics.items() if topic.latched}
    with (
        Peer({}, {name: topic.kind for name, topic in topics.items()}, latched) as peer,
        running("evaluate", "--agent", "ros", *task, "--out", "scored", cwd=tmp_path) as scoring,
        contextlib.ExitStack() as driving,
    ):
        # This node is no part of the lockstep, so it has to be there before the node that drives.
        until(lambda: all(peer.heard[name] for name in topics if name != "/cmd_vel") or scoring.poll(), 400.0)
        deployed = driving.enter_context(running("deploy", "--agent", "vfh", "--goal-frame", "map", *patient))
        offered = {}
        while scoring.poll() is None:
            for name in topics:
                for one in peer.wire.node.get_publishers_info_by_topic(name):
                    offered[name] = one
            time.sleep(0.05)
        told = scoring.communicate(), deployed.communicate()
        assert scoring.returncode == 0, told
    scored = benchmark.Results.load(tmp_path / "scored")
    assert scored.rows == wanted.rows and scored.agent == "ros"  # all metrics, to the last bit
    for name, topic in topics.items():
        assert offered[name].topic_type == topic.kind
        assert offered[name].qos_profile.reliability == ReliabilityPolicy.RELIABLE
        late = DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE
        assert name == "/cmd_vel" or offered[name].qos_profile.durability == late
    stamps = [ros.stamp_of(message) for message in peer.heard["/odom"]]
    assert stamps[0] == 1_000_000_000 and stamps == sorted(stamps)  # over both episodes
    times = [message.clock.sec * 10**9 + message.clock.nanosec for message in peer.heard["/clock"]]
    assert sorted(set(times)) == sorted(set(stamps))
    pytest.importorskip("rosbags", reason="needs the extra record")
    benchmark.record("vfh", tmp_path / "bags", suite="smoke", episodes=1, overrides=SETS, quiet=True)
    told = by_topic(tmp_path / "bags" / f"seed-{scored.seed[0]}")
    for name in topics:
        once = {}  # a state may be told twice to somebody who was late
        for number, message in enumerate(peer.heard[name]):
            key = ros.stamp_of(message) if hasattr(message, "header") else number
            once.setdefault(key, message)
        said = list(once.values())[: len(told[name])]
        if name in latched | {"/odom", "/scan", "/imu/data", "/people/poses", "/people/states", "/cmd_vel"}:
            for (_, one), other in zip(told[name], said, strict=True):
                assert equal(timeless(one), timeless(other)), name
    for name in ("/people/markers", "/collisions", "/episode"):
        assert any(equal(timeless(told[name][-1][1]), timeless(message)) for message in peer.heard[name]), name


@pytest.mark.parametrize("killed", ["world", "agent"])
def test_killing_either_side_ends_the_other_in_one_line(killed, tmp_path):
    command = ["ros", "--lockstep"] if killed == "world" else ["record", "--agent", "ros", "--out", "bags"]
    endless = ["--suite", "smoke", "--episodes", "1", *WORDS, "--set", "horizon=1000000", "--set", "goal_distance=12"]
    with (
        Peer({}, {"/odom": "nav_msgs/msg/Odometry"}) as peer,
        running("deploy", "--agent", "stop", "--goal-frame", "map", "--timeout", "20") as agent,
        running(*command, *endless, "--timeout", "20", cwd=tmp_path) as world,
    ):
        until(lambda: len(peer.heard["/odom"]) >= 20 or world.poll() or agent.poll(), 400.0)
        assert world.poll() is None and agent.poll() is None, (world.communicate(), agent.communicate())
        first, other = (world, agent) if killed == "world" else (agent, world)
        first.send_signal(signal.SIGKILL)
        _, err = other.communicate(timeout=120)
    (line,) = [line for line in err.splitlines() if "error" in line]
    topic = "/(scan|odom|imu/data)" if killed == "world" else "/cmd_vel"  # of those that are missed, the first
    assert other.returncode == 2 and re.search(topic, line) and "Traceback" not in err
    if killed == "agent":
        assert not (tmp_path / "bags").exists()


@contextlib.contextmanager
def deployed(agent, **more):
    """`bson deploy` in another thread of this process, which ends by itself once nobody publishes scans."""

    def drive():
        with pytest.raises(AgentError, match="/(scan|odom|imu/data)"):
            benchmark.deploy(agent, goal_frames=["map"], timeout=20.0, **more)

    thread = threading.Thread(target=drive)
    thread.start()
    yield
    thread.join()


def test_bson_ros_plays_a_suite_in_lockstep_and_tells_each_score():
    said, config = [], {**SETS, "horizon": 8}
    wanted = benchmark.evaluate("goal", "smoke", episodes=2, overrides=config, quiet=True)
    with deployed("goal"):
        benchmark.ros(suite="smoke", episodes=2, overrides=config, lockstep=True, told=said.append)
    assert said == [
        f"seed {row['seed']}: SNS {row['SNS']:.1f}, timed out after 0.8 s, {row['Coll']:.0f} collisions"
        for row in wanted.content["episodes"]
    ]


def test_in_lockstep_commands_without_stamps_answer_the_state_that_they_were_given_for():
    config = {**SETS, "horizon": 8}
    wanted = benchmark.evaluate("vfh", "smoke", episodes=3, overrides=config, quiet=True)
    with deployed("vfh", stamped=False):
        found = benchmark.evaluate("ros", "smoke", episodes=3, overrides=config, stamped=False, quiet=True)
    assert found.rows == wanted.rows


@pytest.mark.parametrize("slow", ["reset", "step"])
def test_a_stop_of_an_agent_that_waits_for_a_slow_world_is_no_answer_to_its_next_state(slow, monkeypatch):
    config, once, calls = {**SETS, "horizon": 4}, getattr(Session, slow), []
    wanted = benchmark.evaluate("goal", "smoke", episodes=2, overrides=config, quiet=True)

    def slowly(self, *arguments, **more):
        calls.append(1)
        if len(calls) in (2, 3):
            time.sleep(2 * ros_agent.STALE)
        return once(self, *arguments, **more)

    monkeypatch.setattr(Session, slow, slowly)
    with deployed("goal", stamped=False):
        found = benchmark.evaluate("ros", "smoke", episodes=2, overrides=config, stamped=False, quiet=True)
    assert found.rows == wanted.rows


def test_in_real_time_an_evaluation_takes_the_time_that_it_takes():
    config, begun = {**SETS, "horizon": 10}, time.monotonic()
    with deployed("goal"):
        found = benchmark.evaluate("ros", "smoke", episodes=1, overrides=config, real_time=True, quiet=True)
    assert time.monotonic() - begun > 1.0 and found.content["real_time"]
    assert found.metrics["time"].tolist() == [1.0] and found.metrics["path_length"][0] > 0.1


# --- a world, alone


@contextlib.contextmanager
def world(**more):
    """A WorldNode whose episode has begun."""
    with ros.wire("bson") as wire:
        node, session = ros_world.WorldNode(wire, **more), Session(CONFIG, TRACK, 1)
        session.reset([0], [7])
        node.begin(session)
        yield node, session
        session.close()


CMD = {"/cmd_vel": "geometry_msgs/msg/TwistStamped"}


def until(true, seconds=20.0):
    begun = time.monotonic()
    while not true():
        assert time.monotonic() - begun < seconds
        time.sleep(0.01)


def test_a_command_that_is_no_number_stops_the_robot_and_a_late_one_is_not_obeyed(capsys):
    with world() as (node, session), Peer(CMD, {}) as peer:
        until(lambda: peer.told["/cmd_vel"].get_subscription_count())
        peer.told["/cmd_vel"].publish(command(1.0, -0.3))
        action = node.wait()
        assert (action * 2.0).tolist() == [1.0, -0.3]
        session.step([0], action[None])
        node.snap()
        peer.told["/cmd_vel"].publish(command(1.5, stamp=1_000_000_000))  # for the state before
        peer.told["/cmd_vel"].publish(command(float("nan"), stamp=1_100_000_000))
        assert node.wait().tolist() == [0.0, 0.0]
    told = capsys.readouterr().err
    assert "a command for 1.00 s came at 1.10 s: not obeyed" in told and "not finite: the robot stops" in told


@pytest.mark.parametrize("lockstep", [True, False])
def test_who_drives_gets_the_first_state_though_it_commands_before_it_listens(lockstep):
    with world(lockstep=lockstep) as (node, session), Peer(CMD, {}) as peer:
        over, odometry = threading.Event(), []

        def drive():
            for count in range(10_000):
                if count == 5:
                    kind = ros.kind_of("nav_msgs/msg/Odometry")
                    peer.wire.node.create_subscription(kind, "/odom", odometry.append, quality(False))
                peer.told["/cmd_vel"].publish(command(1.0))
                if over.wait(0.02):
                    return

        driver = threading.Thread(target=drive)
        driver.start()
        try:
            for _ in range(3):
                session.step([0], node.wait()[None])
                node.snap()
            until(lambda: len({ros.stamp_of(message) for message in odometry}) >= 4)
        finally:
            over.set()
            driver.join()
        assert ros.stamp_of(odometry[0]) == 1_000_000_000


def test_in_lockstep_a_command_that_stays_out_is_an_error_that_names_the_topic(monkeypatch):
    monkeypatch.setattr(ros_world, "PATIENCE", 0.3)
    with (
        world(timeout=0.3) as (node, _),
        pytest.raises(AgentError, match="No geometry_msgs/msg/TwistStamped on /cmd_vel"),
    ):
        node.wait()


def test_a_command_of_another_type_is_told():
    told = r"'peer' publishes geometry_msgs/msg/Twist on /cmd_vel.*--twist"
    with world() as (node, _), Peer({"/cmd_vel": "geometry_msgs/msg/Twist"}, {}), pytest.raises(AgentError, match=told):
        node.wait()
    with world(stamped=False) as (node, _), Peer({"/cmd_vel": "geometry_msgs/msg/Twist"}, {}) as peer:
        until(lambda: peer.told["/cmd_vel"].get_subscription_count())
        peer.told["/cmd_vel"].publish(command(0.5).twist)
        assert node.wait().tolist() == [0.25, 0.0]


def test_in_real_time_each_period_takes_a_period_and_an_old_command_is_a_stop(capsys, monkeypatch):
    monkeypatch.setattr(ros_world, "STALE", 0.05)
    with world(lockstep=False, driven=True) as (node, _), Peer(CMD, {}) as peer:
        until(lambda: peer.told["/cmd_vel"].get_subscription_count())
        assert node.wait().tolist() == [0.0, 0.0]  # no command yet
        peer.told["/cmd_vel"].publish(command(1.0))
        begun = time.monotonic()
        actions = [node.wait().tolist() for _ in range(6)]
        assert 0.45 < time.monotonic() - begun < 2.0
    assert [0.5, 0.0] in actions and actions[-1] == [0.0, 0.0]
    assert "no command on /cmd_vel for" in capsys.readouterr().err


@pytest.mark.parametrize("limit", [2.0, 1.2, 0.7, 1.0])
def test_a_command_is_the_same_after_it_became_an_action(limit):
    top = np.array([limit, 1.7 * limit])
    for action in np.random.default_rng(0).uniform(-1, 1, (500, 2)):
        assert np.array_equal(ros_world.shares(action * top, top) * top, action * top)
    assert ros_world.shares(np.array([9.0, -9.0]), top).tolist() == [1.0, -1.0]


def test_services_reset_with_a_seed_and_pause_and_parameters_change_the_task():
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParameters
    from std_srvs.srv import SetBool, Trigger

    with ros.wire("bson") as wire, Peer(CMD, {"/odom": "nav_msgs/msg/Odometry"}) as peer:
        node = ros_world.WorldNode(wire)
        server = ros_world.Server(wire, node, CONFIG, TRACK, 7, fixed=False)
        clients = {
            name: peer.wire.node.create_client(kind, name)
            for name, kind in (
                ("/bson/reset", Trigger),
                ("/bson/pause", SetBool),
                ("/bson/set_parameters", SetParameters),
            )
        }

        def ask(name, request):
            """What the service answers; None while it doesn't."""
            asked = clients[name].call_async(request)
            until(asked.done)
            return asked.result()

        def number(name, value):
            return Parameter(name=name, value=ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=value))

        answers = []

        def drive():
            until(lambda: all(client.service_is_ready() for client in clients.values()))
            answers.append(ask("/bson/pause", SetBool.Request(data=True)))
            peer.told["/cmd_vel"].publish(command(1.0))
            time.sleep(0.3)
            answers.append(len(peer.heard["/odom"]))
            changes = [number("seed", 8), number("num_pedestrians", 5), number("horizon", 0)]
            answers.append(ask("/bson/set_parameters", SetParameters.Request(parameters=changes)))
            answers.append(ask("/bson/reset", Trigger.Request()))

        driver = threading.Thread(target=drive)
        driver.start()
        with pytest.raises(ros_world.Restarted):
            server.play()
        until(lambda: (wire.spin(0.01), len(answers) == 4)[1])
        driver.join()
        paused, told, changed, reset = answers
        assert paused.success and told <= 2  # the state of the start, told again at most
        assert [one.successful for one in changed.results] == [True, True, False]
        assert "horizon must be a whole number" in changed.results[2].reason
        assert reset.success and reset.message == "seed 8"
        assert (server.seed, server.config.people, server.config.horizon) == (8, 5, 25)
        server.close()


# --- an agent, alone


DRIVES = float(np.float32(0.8)) * 2.0  # the agent `goal` where its goal is straight ahead [m/s]


class Robot(Peer):
    """A robot that stands at the origin, with a goal 5 m ahead; its scans see nothing."""

    def __init__(self, latched=("/goal_pose",), **scan):
        kinds = {topic.name: topic.kind for topic in (ros_agent.SCAN, ros_agent.ODOM, ros_agent.GOAL)}
        super().__init__(kinds, CMD, latched)
        self.scan = {"beams": 720, "half": Lidar2D().field / 2, "range_max": 30.0, **scan}
        self.speed, self.frame = 0.0, "odom"

    def tell(self, stamp, goal=True, reading=float("inf"), blind=False):
        """Tells scan, odometry and goal at `stamp` [s]; no scan, if it is `blind`."""
        scan, odometry, aim = (
            ros.kind_of(topic.kind)() for topic in (ros_agent.SCAN, ros_agent.ODOM, ros_agent.GOAL)
        )  # fmt: skip
        beams, half = self.scan["beams"], self.scan["half"]
        scan.angle_min, scan.angle_max, scan.angle_increment = -half, half, 2 * half / (beams - 1)
        scan.range_min, scan.range_max = 0.1, self.scan["range_max"]
        scan.ranges = ros.RosCarrier().numbers(np.full(beams, reading, np.float32))
        odometry.header.frame_id, odometry.child_frame_id = "odom", "base_link"
        odometry.pose.pose.orientation.w, odometry.twist.twist.linear.x = 1.0, self.speed
        aim.header.frame_id, aim.pose.position.x, aim.pose.orientation.w = self.frame, 5.0, 1.0
        for message in (scan, odometry):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(round(stamp * 1e9), 1_000_000_000)
        if goal:
            self.told["/goal_pose"].publish(aim)
        self.told["/odom"].publish(odometry)
        if not blind:
            self.told["/scan"].publish(scan)

    @property
    def commands(self):
        return [message.twist.linear.x for message in self.heard["/cmd_vel"]]


def driven(robot, script, agent="goal", timeout=60.0, period=0.1, name="jackal"):
    """The error with which the node ends, while `script(robot)` runs in another thread. After that a scan of other
    beams ends the node."""
    with robot, ros.wire("bson_agent") as wire:
        node = ros_agent.AgentNode(wire, load_agent(agent), agent, robot_config(name), period, timeout=timeout)

        def act():
            until(lambda: robot.told["/scan"].get_subscription_count() and robot.told["/odom"].get_subscription_count())
            script(robot)
            robot.scan["beams"] = 10
            if timeout > 10.0:
                robot.tell(1000.0)

        thread = threading.Thread(target=act)
        thread.start()
        with pytest.raises(AgentError) as error:
            node.run()
        thread.join()
        until(lambda: robot.commands and robot.commands[-1] == 0.0)
    return str(error.value)


@pytest.fixture
def patient(monkeypatch):
    """A node that takes a busy machine for what it is: nothing is stale."""
    monkeypatch.setattr(ros_agent, "STALE", 60.0)


def steps(robot, number, period=0.1, first=1.0, pause=0.03, **more):
    for step in range(number):
        robot.tell(first + step * period, **more)
        time.sleep(pause)


def heard(robot, number):
    """Waits until the robot has got so many commands."""
    until(lambda: len(robot.commands) >= number, 60.0)


def test_stale_messages_stop_the_robot_and_then_end_the_node(capsys):
    robot = Robot()
    told = driven(robot, lambda robot: steps(robot, 5), timeout=1.0)
    assert re.search("No /(scan|odom) for 1 s: stopped the robot", told)
    assert any(robot.commands) and robot.commands[-1] == 0.0
    assert re.search("no /(scan|odom) for .* s: the robot stops", capsys.readouterr().err)


def test_a_lidar_that_is_silent_stops_the_robot_though_odometry_goes_on(capsys):
    robot = Robot()

    def script(robot):
        steps(robot, 3)
        steps(robot, 12, first=1.3, pause=0.1, blind=True)

    assert "No /scan for 1 s" in driven(robot, script, timeout=1.0)
    assert any(robot.commands) and not any(robot.commands[3:])
    assert "no /scan for" in capsys.readouterr().err


def test_a_goal_that_is_not_latched_is_obeyed_too(patient):
    robot = Robot(latched=())  # as RViz gives goals

    def script(robot):
        until(lambda: robot.told["/goal_pose"].get_subscription_count())
        steps(robot, 3)
        heard(robot, 3)

    assert "from 720 beams to 10" in driven(robot, script)
    assert robot.commands == [*[DRIVES] * 3, 0.0]


def test_a_clock_that_runs_backwards_stops_the_robot_and_it_begins_anew(capsys, patient):
    robot = Robot()

    def script(robot):
        steps(robot, 3, first=50.0)
        heard(robot, 3)
        steps(robot, 3, first=1.0)
        heard(robot, 7)

    driven(robot, script)
    assert robot.commands == [*[DRIVES] * 3, 0.0, *[DRIVES] * 3, 0.0]
    assert "the clock ran backwards, from 50.20 to 1.00 s" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("agent", "changed", "told"),
    [
        ("tac", {"beams": 360}, r"'tac' was trained with LIDAR's beams 720, not with LIDAR's beams 360"),
        ("tac", {"half": 1.5}, r"was trained with LIDAR's field 4.71239 rad, not with LIDAR's field 3 rad"),
        ("tac", {"range_max": 10.0}, r"was trained with LIDAR's range_max 30 m, not with LIDAR's range_max 10 m"),
        ("tac", {"beams": 1}, r"/scan has 1 beams"),
    ],
)
def test_a_scan_that_the_policy_was_not_trained_with_is_refused(agent, changed, told, patient):
    robot = Robot(**changed)
    if changed.get("beams") == 1:
        robot.scan["beams"] = 2
        robot.scan["half"] = -1.0  # from left to right
        told = "/scan has 2 beams from 57.3 to -57.3 degrees"
    assert re.search(told, driven(robot, lambda robot: steps(robot, 3), agent))
    assert set(robot.commands) == {0.0}


def test_the_rate_the_speed_and_the_goals_frame_are_held_against_the_robot(patient):
    told = driven(Robot(), lambda robot: steps(robot, 8, period=0.3))
    assert "/scan comes every 0.30 s, and the agent 'goal' decides every 0.1 s" in told
    robot = Robot()
    driven(robot, lambda robot: (steps(robot, 8, period=0.025, pause=0.02), heard(robot, 2)))
    assert robot.commands == [DRIVES, DRIVES, 0.0]  # at 1.0 and 1.1 s
    fast = Robot()
    fast.speed = 5.0
    assert "/odom tells 5.00 m/s, and the robot 'jackal' drives at 2 m/s at most" in driven(fast, lambda r: steps(r, 2))
    other = Robot()
    other.frame = "map"
    assert "--goal-frame map" in driven(other, lambda robot: steps(robot, 2))
    slow = Robot()
    driven(slow, lambda robot: (steps(robot, 3), heard(robot, 3)), name="diffbot")
    assert max(slow.commands) == pytest.approx(DRIVES / 2.0 * robot_config("diffbot").max_speed)


def test_beams_that_are_no_numbers_show_nothing_and_a_wrong_type_is_told(capsys, patient):
    blind = Robot()
    driven(blind, lambda robot: (steps(robot, 3, reading=float("nan")), heard(robot, 3)))
    assert set(blind.commands) == {0.0} and "not a number: the robot stops" in capsys.readouterr().err
    with Peer({"/scan": "sensor_msgs/msg/Imu"}, {}), ros.wire("bson_agent") as wire:
        node = ros_agent.AgentNode(wire, load_agent("goal"), "goal", robot_config("jackal"), 0.1)
        with pytest.raises(AgentError, match="publishes sensor_msgs/msg/Imu on /scan"):
            node.connect()


def test_what_is_out_of_range_reads_as_a_world_reads_it():
    """REP 117: infinity is no hit, minus infinity too close."""
    scan = ros.kind_of("sensor_msgs/msg/LaserScan")()
    scan.ranges = ros.RosCarrier().numbers(np.array([np.inf, -np.inf, np.nan, 5.0, 50.0, 0.01], np.float32))
    lidar = Lidar2D(beams=6)
    assert ros_agent.reading_of(scan, lidar).tolist() == pytest.approx([30.0, 0.1, 30.0, 5.0, 30.0, 0.1])


@pytest.mark.parametrize("domain", ["233", "-1", "one", "1.0"])
def test_a_domain_that_there_is_not_is_told(domain, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    with pytest.raises(UsageError, match="ROS_DOMAIN_ID must be a whole number from 0 to 232"), ros.wire("peer"):
        pass


def test_agents_that_can_not_be_deployed_and_executors_that_can_not_wait_are_refused():
    with pytest.raises(AgentError, match="global track"):
        benchmark.deploy("orca-oracle")
    with pytest.raises(UsageError, match="leave --executor"):
        benchmark.evaluate("ros", "smoke", executor="ray", quiet=True)
