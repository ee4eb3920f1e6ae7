"""An agent as a ROS 2 node: /scan, /odom, /imu/data and a goal make the Local track's observation; commands go to
/cmd_vel.

The node drives BSON's worlds (bson.interfaces.ros_world) and real robots alike. What it hears is held against what the
agent was made for: the LIDAR's angles and ranges, the rate of scans, the robot's top speeds. Where messages stay out,
it stops the robot.
"""

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from bson.agents.contract import Agent, AgentError, AgentFactory, MapFrame, Setting, act, made_for, reset_agent
from bson.episodes.tracks import velocity_limit
from bson.interfaces import ros
from bson.interfaces.messages import BASE, COMMANDS, SENSED, TOPICS, Topic, nanoseconds
from bson.robot import RobotConfig, planar_pose
from bson.sensors import Imu, Lidar2D
from bson.task import TaskConfig
from macid import geometry
from macid.state import GOAL_RADIUS

_BACKLOG, _BACKLOG_LOOK = 20, 0.002  # messages that may be waiting, and how long to wait for one [s]
STALE = 0.5  # age of the last scan or odometry, or two periods if that is more, at which the robot stops [s]
TIMEOUT = 10.0  # without any message, at which the node ends [s]
PATIENCE = 60.0  # until somebody publishes [s]
_LOOK = 0.02  # between two looks at the clock [s]
_SCANS = 5  # intervals between scans whose median is held against the control period
_SLOW = 1.5  # times the control period, above which scans come too rarely
_FAST = 2.0  # times the robot's top speed, above which odometry is not this robot's
_CLOSE = 1e-4  # to which a message's angles and ranges are those of a sensor's configuration [rad], [m]
_AHEAD = 5_000_000_000  # by which a goal's stamp may be ahead of scans that are still on their way [ns]
_BLIND = 0.5  # share of beams that are not a number from which a scan shows nothing

SCAN, IMU = SENSED[Lidar2D][0][0], SENSED[Imu][0][0]
ODOM, GOAL = TOPICS["/odom"], TOPICS["/goal_pose"]


def lidar_of(scan: Any, like: Lidar2D) -> Lidar2D:
    """The Lidar2D whose readings `scan`, a LaserScan, has; at the place of `like`. Raises AgentError for a fan of beams
    that no Lidar2D has."""
    beams = len(scan.ranges)
    ends = scan.angle_min, scan.angle_min + (beams - 1) * scan.angle_increment
    if not (beams >= 2 and scan.angle_increment > 0 and abs(sum(ends)) < 100 * _CLOSE):
        raise AgentError(
            f"{SCAN.name} has {beams} beams from {math.degrees(ends[0]):.1f} to {math.degrees(ends[1]):.1f} degrees: "
            "beams from the right to the left, as far on both sides, are wanted."
        )
    found = {"field": ends[1] - ends[0], "range_min": float(scan.range_min), "range_max": float(scan.range_max)}
    found = {
        name: getattr(like, name) if abs(value - getattr(like, name)) < _CLOSE else value
        for name, value in found.items()
    }
    try:
        return Lidar2D(beams=beams, **found)
    except ValueError as error:
        raise AgentError(f"{SCAN.name}: {error}") from None


def reading_of(scan: Any, lidar: Lidar2D) -> np.ndarray:
    """The observed reading (beams,) float32 [m] of a LaserScan (REP 117): infinity and what is not a number read
    range_max, minus infinity reads range_min."""
    ranges = np.asarray(scan.ranges, np.float32)
    ranges = np.where(np.isnan(ranges), np.float32(np.inf), ranges)
    return np.clip(ranges, np.float32(lidar.range_min), np.float32(lidar.range_max))


class AgentNode:
    """Drives with an agent until it is interrupted."""

    def __init__(
        self,
        wire: ros.Wire,
        factory: AgentFactory,
        name: str,
        robot: RobotConfig,
        period: float,
        stamped: bool = True,
        timeout: float = TIMEOUT,
        goal_frames: Sequence[str] = (),
    ):
        """robot: whose limits the agent's actions are shares of. period: between two decisions [s]. stamped: whether
        commands are TwistStamped. timeout: how long the node waits for messages that stay out [s]. goal_frames:
        frames of goals that are the odometry's, by other names."""
        self._wire, self._factory, self._name, self._robot, self._period = wire, factory, name, robot, period
        self._stamped, self._timeout, self._topic = stamped, timeout, COMMANDS[stamped]
        self._goal_frames = ("", *goal_frames)
        self._top = np.array([robot.max_speed, robot.max_yaw_rate])
        self._carrier = ros.RosCarrier()
        self._made: tuple[Agent, Lidar2D] | None = None  # from the first scan on
        self._last: dict[Topic, Any] = {}
        self._acted, self._decided = -1, np.zeros(2)  # the last decision: its stamp [ns], the command
        self._heard: dict[Topic, float] = {}  # when each topic was heard last, by the machine's clock [s]
        self._intervals: list[float] = []
        self._began = False  # whether the goal is one for which the agent has not been reset
        self._standing = True  # by the last command
        self._ahead = False  # whether it was told that goals' stamps are ahead
        self._publisher = wire.node.create_publisher(
            ros.kind_of(self._topic.kind), self._topic.name, ros.quality(self._topic)
        )

    # --- messages

    def connect(self) -> None:
        """Waits until somebody publishes scans and odometry, and subscribes. Raises AgentError where nobody does, or
        messages have another type."""
        begun = time.monotonic()
        # The goal first: of messages that are there at once, it is taken first. BSON's goals are latched and RViz's are
        # not: each needs a subscription of its own. A goal that comes twice is one.
        for latched in (True, False):
            self._subscribe(GOAL, latched=latched)
        while not all([self._wire.check_publishers(topic) for topic in (SCAN, ODOM)]):
            self._wire.spin(_LOOK)
            if time.monotonic() - begun > max(PATIENCE, self._timeout):
                raise AgentError(f"Nobody publishes {SCAN.name} and {ODOM.name}: is the robot, or bson ros, running?")
        while not self._publisher.get_subscription_count():
            self._wire.spin(_LOOK)
            if time.monotonic() - begun > max(PATIENCE, self._timeout):
                raise AgentError(
                    f"Nobody listens to {self._topic.name} ({self._topic.kind}): is the robot's base running?"
                )
        self._wire.check_publishers(GOAL)
        heard = [ODOM, *([IMU] if self._wire.check_publishers(IMU) else []), SCAN]
        for topic in heard:
            self._subscribe(topic, self._reliable(topic))
        self._needed = [topic for topic in heard if topic != SCAN]
        self._heard = dict.fromkeys(heard, time.monotonic())

    def _reliable(self, topic):
        from rclpy.qos import ReliabilityPolicy

        found = self._wire.node.get_publishers_info_by_topic(topic.name)
        return all(one.qos_profile.reliability == ReliabilityPolicy.RELIABLE for one in found)

    def _subscribe(self, topic, reliable=True, latched=False):
        from rclpy.qos import ReliabilityPolicy

        quality = ros.quality(topic._replace(latched=latched))
        if not reliable:
            quality.reliability = ReliabilityPolicy.BEST_EFFORT
        self._wire.node.create_subscription(
            ros.kind_of(topic.kind), topic.name, lambda message: self._receive(topic, message), quality
        )

    def _receive(self, topic, message):
        self._heard[topic] = time.monotonic()
        stamp, before = ros.stamp_of(message), self._last.get(topic)
        if topic == GOAL:
            if before is None or message != before:
                self._last[topic], self._began = message, True
            return
        if before is not None and stamp < ros.stamp_of(before):
            self._turned_back(topic, stamp, ros.stamp_of(before))
        self._last[topic] = message
        if topic == SCAN and stamp == self._acted:  # the world tells its state again: it did not hear the command
            self._send(self._decided, stamp)
        else:
            self._decide()

    def _turned_back(self, topic, stamp, before):
        ros.warn(
            f"the clock ran backwards, from {before / 1e9:.2f} to {stamp / 1e9:.2f} s on {topic.name}: the robot "
            "stops, and begins anew"
        )
        self.stop()
        goal = self._last.get(GOAL)
        self._last = {} if goal is None else {GOAL: goal}
        self._acted, self._intervals, self._began = -1, [], True

    # --- decisions

    def _decide(self):
        """Decides, if there is a new scan and what goes with it."""
        scan, goal = self._last.get(SCAN), self._last.get(GOAL)
        if scan is None or goal is None:
            return
        now, slack = ros.stamp_of(scan), nanoseconds(self._period / 2)
        if (ahead := ros.stamp_of(goal) - now) > 0:
            if ahead < _AHEAD:  # the scan is of the time before this goal
                return
            if not self._ahead:
                self._ahead = True
                ros.warn(f"the goal's stamp is {ahead / 1e9:.0f} s ahead of {SCAN.name}: their clocks differ")

        def far(topic):
            return topic not in self._last or abs(ros.stamp_of(self._last[topic]) - now) > slack

        if now == self._acted or any(far(topic) for topic in self._needed):
            return
        if self._acted >= 0 and now - self._acted < 2 * slack - nanoseconds(0.1 * self._period) and not self._began:
            return  # scans come more often than decisions
        odometry = self._last[ODOM]
        if goal.header.frame_id not in (odometry.header.frame_id, *self._goal_frames):
            raise AgentError(
                f"The goal is in the frame '{goal.header.frame_id}', the odometry in '{odometry.header.frame_id}': "
                f"give goals in the odometry's frame, or --goal-frame {goal.header.frame_id} where both are the same."
            )
        if self._made is None:
            self._made = self._make(scan)
        agent, lidar = self._made
        self._check(scan, odometry, now, lidar)
        if self._began:
            reset_agent(agent, 0, self._name)
        observation = self._observe(scan, odometry, goal, lidar)
        if np.isnan(np.asarray(scan.ranges, np.float32)).mean() > _BLIND:
            ros.warn(f"most beams of {SCAN.name} are not a number: the robot stops")
            command = np.zeros(2)
        elif float(np.hypot(*observation["goal"])) <= GOAL_RADIUS:
            command = np.zeros(2)
        else:
            command = np.clip(act(agent, observation, self._name), -1.0, 1.0) * self._top
        self._acted, self._decided, self._began = now, command, False
        self._send(command, now)

    def _make(self, scan):
        """The agent for the sensors that the messages show, and its Lidar2D. Raises AgentError, as Unsuited, where they
        are not what it was made for."""
        lidar = lidar_of(scan, Lidar2D())
        sensors = (*([Imu()] if IMU in self._needed else []), lidar)
        config = TaskConfig()
        setting = Setting(self._period, self._robot, "local", sensors, MapFrame(config.map_size), config.horizon)
        return made_for(self._factory, setting), lidar

    def _check(self, scan, odometry, now, lidar):
        """Holds messages against what the agent was made for. Raises AgentError."""
        if len(scan.ranges) != lidar.beams:
            raise AgentError(f"{SCAN.name} changed from {lidar.beams} beams to {len(scan.ranges)}.")
        speed, most = abs(odometry.twist.twist.linear.x), _FAST * self._robot.max_speed
        if not math.isfinite(speed) or speed > most:
            raise AgentError(
                f"{ODOM.name} tells {speed:.2f} m/s, and the robot '{self._robot.name}' drives at "
                f"{self._robot.max_speed:g} m/s at most: give another --robot."
            )
        if self._acted >= 0 and not self._began:
            self._intervals = [*self._intervals, (now - self._acted) / 1e9][-_SCANS:]
            middle = sorted(self._intervals)[len(self._intervals) // 2]
            if len(self._intervals) == _SCANS and middle > _SLOW * self._period:
                raise AgentError(
                    f"{SCAN.name} comes every {middle:.2f} s, and the agent '{self._name}' decides every "
                    f"{self._period:g} s."
                )

    def _observe(self, scan, odometry, goal, lidar):
        """The Local track's observation (bson.episodes.tracks.LocalTrack) of one robot."""
        place, turn = odometry.pose.pose.position, odometry.pose.pose.orientation
        pose = planar_pose(np.array([[place.x, place.y, place.z, turn.w, turn.x, turn.y, turn.z]]))
        aim = np.array([[goal.pose.position.x, goal.pose.position.y]])
        limit, twist = velocity_limit(self._robot), odometry.twist.twist
        observation = {
            "goal": geometry.to_body(aim - pose[:, :2], pose[:, 2]).astype(np.float32)[0],
            "velocity": np.clip(np.array([twist.linear.x, twist.angular.z]), -limit, limit).astype(np.float32),
            "lidar": reading_of(scan, lidar),
        }
        if IMU in self._needed:
            force, rate = self._last[IMU].linear_acceleration, self._last[IMU].angular_velocity
            felt = np.array([force.x, force.y, force.z, rate.x, rate.y, rate.z])
            limit = Imu().limit
            observation["imu"] = np.clip(felt, -limit, limit).astype(np.float32)
        return observation

    def _send(self, command, stamp):
        message = self._carrier.new(self._topic.kind)
        twist = message
        if self._stamped:
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
            message.header.frame_id, twist = BASE, message.twist
        twist.linear.x, twist.angular.z = map(float, command)
        self._standing = not np.any(command)
        self._publisher.publish(message)

    def _silence(self):
        """The topic that was heard longest ago, of those that are needed, and how long ago [s]."""
        late = min((SCAN, *self._needed), key=lambda topic: self._heard[topic])
        return late, time.monotonic() - self._heard[late]

    def stop(self) -> None:
        """Commands the robot to stand, by the last scan's stamp."""
        self._send(np.zeros(2), max(self._acted, 0))

    # --- the run

    def run(self) -> None:
        """Drives. Raises AgentError once messages stay out for the time-out; the robot is stopped before, and at any
        other end."""
        self.connect()
        most = max(STALE, 2 * self._period)
        try:
            while True:
                self._wire.spin(_LOOK)
                late, silent = self._silence()
                for _ in range(_BACKLOG):  # what came while this process was held up is there, and is taken first
                    if silent <= most:
                        break
                    self._wire.spin(_BACKLOG_LOOK)
                    late, silent = self._silence()
                # A world may take long for its first step.
                patience = self._timeout if self._intervals else max(PATIENCE, self._timeout)
                if silent > most and not self._standing:
                    ros.warn(f"no {late.name} for {silent:.1f} s: the robot stops")
                    self.stop()
                if silent > patience:
                    raise AgentError(f"No {late.name} for {patience:g} s: stopped the robot.")
                if silent > most and not self._wire.check_publishers(late):
                    raise AgentError(
                        f"Nobody publishes {late.name} any more: stopped the robot, after {self._acted / 1e9:.2f} s."
                    )
        finally:
            self.stop()
            ros.acknowledged(self._publisher, 0.5)


def drive(
    factory: AgentFactory,
    name: str,
    robot: RobotConfig,
    period: float,
    stamped: bool = True,
    timeout: float = TIMEOUT,
    goal_frames: Sequence[str] = (),
) -> None:
    """Runs the node `bson_agent` until it is interrupted; see AgentNode. Raises AgentError, UsageError."""
    if factory.track != "local":
        raise AgentError(f"Agent '{name}' wants the {factory.track} track, and a robot has the local one only.")
    with ros.wire("bson_agent") as wire:
        AgentNode(wire, factory, name, robot, period, stamped, timeout, goal_frames).run()
