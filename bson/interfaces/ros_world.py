"""A world as a ROS 2 node: it tells its state in the messages of bson.interfaces.messages and obeys /cmd_vel.

In lockstep the world waits for one command in each control step, so that a run is as exact as one without ROS. In real
time it takes one control step each period, with the last command.
"""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from bson.agents.contract import AgentError
from bson.episodes.record import Episode, Recorder
from bson.episodes.session import Session
from bson.episodes.tracks import LocalTrack
from bson.interfaces import ros
from bson.interfaces.messages import COMMANDS, Reporter
from bson.robot import RobotConfig
from bson.task import TaskConfig

PATIENCE = 60.0  # until the first command [s]
TIMEOUT = 10.0  # until each later command [s]
STALE = 0.5  # in real time, the age from which a command is no longer obeyed [s]
_REPEAT = 1.0  # the state is told again to somebody who came late [s]
_SETTLED = 0.3  # who commands and listens is known once nobody has come or gone for so long [s]
_HEARD = 1.0  # until listeners have acknowledged what they were told [s]
_WAITING, _MOST_WAITING = 0.002, 100  # within which a command that was on its way comes [s]; how many may have come
_LAST = 0.5  # until the answer to an episode's last state, where answers have no stamps [s]
_LOOK = 0.02  # between two looks at the clock while waiting [s]
_GAP = 1.0  # of simulated time between two episodes: the clock never runs backwards [s]


class Restarted(Exception):
    """The service `reset` was called."""


def shares(command: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """The action (2,) in [-1, 1] that stands for `command` (2,) at the top speeds `limit` (2,): multiplied by the
    limit, it is the command again to the last bit, where there is such an action."""
    action = np.clip(command / limit, -1.0, 1.0)
    for column in np.flatnonzero(action * limit != command):
        for near in (np.nextafter(action[column], -2.0), np.nextafter(action[column], 2.0)):
            if near * limit[column] == command[column]:
                action[column] = near
    return action


class WorldNode:
    """One world on the wire. `begin(session, index)` tells an episode's start; `wait()` gives the next action; `snap`
    tells the state after it. So it is both the agent and the Watch of bson.evaluation.play.run_episodes.
    """

    takes_setting = False

    def __init__(
        self,
        wire: ros.Wire,
        stamped: bool = True,
        lockstep: bool = True,
        timeout: float = TIMEOUT,
        driven: bool = False,
        track: str = "local",
        sensor: Any = "lidar2d",
    ):
        """stamped: whether commands are TwistStamped. timeout: of a command in lockstep [s]. driven: whether the world
        goes on in real time even where nobody publishes commands. track, sensor: what the agent on the other side wants
        to be given."""
        self.track, self.sensor, self._driven = track, sensor, driven
        self._wire, self._stamped, self._lockstep, self._timeout = wire, stamped, lockstep, timeout
        self._carrier, self._missing = ros.RosCarrier(), ros.missing()
        self._publishers: dict[str, Any] = {}
        self._topic = COMMANDS[stamped]
        self._command: np.ndarray | None = None
        self._came = -np.inf  # when the last command came, by the machine's clock [s]
        self._since, self._now, self._next = 0, 0, 1.0  # stamps of the reset and the state [ns]; of the next reset [s]
        self._answered = False
        self._told, self._told_to, self._came_or_went = -np.inf, [], -np.inf  # see _tell; by the machine's clock [s]
        self._introduced = True  # whether all who listen got the state of the episode's start
        self._warned: set[tuple[str, int]] = set()
        self.paused = self.restart = False
        self._reporter: Reporter | None = None
        self._subscription = wire.node.create_subscription(
            ros.kind_of(self._topic.kind), self._topic.name, self._receive, ros.quality(self._topic)
        )
        if self._missing:
            ros.warn(f"not published, as these packages of ROS are missing: {', '.join(self._missing)}")

    # --- the agent of run_episodes

    def __call__(self) -> "Callable[[Any], np.ndarray]":
        """An agent that gives what comes on /cmd_vel."""
        return lambda observation: self.wait()

    def told_by(self, session: Session, index: int) -> "WorldNode":
        """Tells the start of the episode in the world `index`; gives its Watch."""
        self.begin(session, index)
        return self

    def end(self, episode: Episode) -> None:
        """Nothing is told at the end: the last state says it."""

    # --- what is told

    def begin(self, session: Session, index: int = 0) -> None:
        """Tells the start of an episode, after its reset."""
        if self._lockstep and not self._stamped and self._answered:
            self._wait_for_last_answer()
        world = session.world
        without = [topic.kind for topic in _all_topics(world) if topic.kind.split("/")[0] in self._missing]
        self._session, self._world, self._index = session, world, index
        self._reporter = Reporter(self._carrier, world, index, self._stamped, self._next, without)
        for name, topic in self._reporter.topics.items():
            if name not in self._publishers and topic != self._topic:
                self._publishers[name] = self._wire.node.create_publisher(
                    ros.kind_of(topic.kind), name, ros.quality(topic)
                )
        self._since = self._now = self._reporter.now
        self._forget()
        self._answered = False
        self._period = world.config.control_period
        self._due = time.monotonic() + self._period
        self._introduced = False
        self._tell(self._reporter.begin())

    def snap(self, *_: Any) -> None:
        """Tells the state after a control step."""
        assert self._reporter is not None
        self._now = self._reporter.now
        if self._lockstep:
            self._forget()
        self._next = self._now / 1e9 + _GAP
        self._tell(self._reporter.step())

    def _forget(self):
        """Forgets what came before the state that is told next. In lockstep without stamps it may still be on its way:
        an agent that had to wait for long commands the robot to stand, which is no answer to this state."""
        self._command = None
        for _ in range(_MOST_WAITING if self._lockstep and not self._stamped else 0):
            self._wire.spin(_WAITING)
            if self._command is None:
                return
            self._command = None

    def _tell(self, said):
        self._told, there = time.monotonic(), self._others()
        if there != self._told_to:
            self._told_to, self._came_or_went = there, self._told
        for topic, _, message in said:
            publisher = self._publishers[topic.name]
            publisher.publish(message)
            if topic.latched and self._lockstep and publisher.get_subscription_count():
                ros.acknowledged(publisher, _HEARD)  # before what follows from it

    def _others(self):
        """How many command, and how many listen to each topic."""
        listeners = [publisher.get_subscription_count() for publisher in self._publishers.values()]
        return [self._wire.node.count_publishers(self._topic.name), *listeners]

    def _tell_again(self):
        """Tells the present state again, if it was told more than _REPEAT ago. Where commands have no stamps, only to
        somebody who came since: a second answer to this state would pass for one to the next."""
        late = time.monotonic() - self._told >= _REPEAT
        if late and (self._stamped or not self._lockstep or self._others() != self._told_to):
            assert self._reporter is not None
            self._tell(self._reporter.step())

    def _introduce(self):
        """Whether all who listen got the state of the episode's start; it is told again to those who came since.

        DDS finds a node's subscriptions one by one, and perhaps after its first command: so the node that has to answer
        the first state does not miss it.
        """
        if not self._introduced:
            assert self._reporter is not None
            if self._others() != self._told_to:
                self._tell(self._reporter.step())
            if time.monotonic() - self._came_or_went < _SETTLED:
                return False
            latest = time.monotonic() + _HEARD
            for publisher in self._publishers.values():
                if publisher.get_subscription_count():
                    ros.acknowledged(publisher, max(0.0, latest - time.monotonic()))
            self._introduced = True
        return True

    # --- what comes

    def _receive(self, message):
        """A command that came."""
        twist = message.twist if self._stamped else message
        command = np.array([twist.linear.x, twist.angular.z])
        if self._lockstep and self._stamped and 0 < (stamp := ros.stamp_of(message)) < self._now:
            if stamp >= self._since and command.any():
                self._warn("late", f"a command for {stamp / 1e9:.2f} s came at {self._now / 1e9:.2f} s: not obeyed")
            return
        if not np.isfinite(command).all():
            self._warn("nan", f"the command {command.tolist()} on {self._topic.name} is not finite: the robot stops")
            command = np.zeros(2)
        self._command, self._came, self._answered = command, time.monotonic(), True

    def _warn(self, what, told):
        """Says `told` once an episode."""
        if (what, self._since) not in self._warned:
            self._warned.add((what, self._since))
            ros.warn(told)

    # --- the next action

    def wait(self) -> np.ndarray:
        """The next action (2,) in [-1, 1]. Raises AgentError where no command comes in time in lockstep, or of another
        type; Restarted once the reset was called."""
        command = self._wait_for_command() if self._lockstep else self._wait_for_period()
        config = self._world.config.robot
        return shares(command, np.array([config.max_speed, config.max_yaw_rate]))

    def _spin(self, seconds):
        self._wire.spin(seconds)
        if self.restart:
            self.restart = False
            raise Restarted

    def _wait_for_command(self):
        patience = self._timeout if self._answered else max(PATIENCE, self._timeout)
        begun = looked = time.monotonic()
        while self._command is None or self.paused or not self._introduce():
            self._spin(_LOOK)
            now = time.monotonic()
            if self.paused:
                begun = now
            elif now - begun > patience:
                raise AgentError(
                    f"No {self._topic.kind} on {self._topic.name} for {patience:g} s, at {self._now / 1e9:.2f} s of "
                    "simulated time: in lockstep each control step waits for one."
                )
            if now - looked > _REPEAT / 4:
                looked = now
                there = self._wire.check_publishers(self._topic)
                if self._answered and not there:
                    raise AgentError(
                        f"Nobody publishes on {self._topic.name} any more, at {self._now / 1e9:.2f} s of simulated "
                        "time: in lockstep each control step waits for a command."
                    )
            self._tell_again()
        return self._command

    def _wait_for_last_answer(self):
        """Waits until the last state's answer is there: without a stamp it would pass for one to the next episode's
        first state."""
        latest = time.monotonic() + _LAST
        while self._command is None and time.monotonic() < latest:
            self._wire.spin(_LOOK)

    def stand(self) -> None:
        """Waits, while nothing moves, until the reset is called: raises Restarted."""
        while True:
            self._spin(_LOOK)
            self._tell_again()

    def _wait_for_somebody(self):
        """Waits until somebody publishes commands, before the first step."""
        begun = time.monotonic()
        while not (self._wire.check_publishers(self._topic) and self._introduce()):
            self._spin(_LOOK)
            self._tell_again()
            if time.monotonic() - begun > PATIENCE:
                raise AgentError(f"Nobody publishes {self._topic.kind} on {self._topic.name}: what is to drive?")
        self._driven, self._due = True, time.monotonic() + self._period

    def _wait_for_period(self):
        if not self._driven:
            self._wait_for_somebody()
        while (left := self._due - time.monotonic()) > 0 or self.paused:
            self._spin(_LOOK if self.paused else min(left, _LOOK))
            if self.paused:
                self._tell_again()
                self._due = time.monotonic() + self._period
        self._wire.check_publishers(self._topic)
        now = time.monotonic()
        self._due = max(self._due, now - self._period) + self._period  # a machine that is too slow does not catch up
        if self._command is None:
            return np.zeros(2)
        if now - self._came > max(STALE, 2 * self._period):
            self._warn("stale", f"no command on {self._topic.name} for {now - self._came:.1f} s: the robot stops")
            return np.zeros(2)
        return self._command


def _all_topics(world):
    from bson.interfaces.messages import topics

    return topics(world.sensors).values()


@contextlib.contextmanager
def agent(stamped: bool = True, lockstep: bool = True, timeout: float = TIMEOUT) -> Iterator[WorldNode]:
    """In a `with`: the agent `ros`, whatever drives on the other side of the wire; see WorldNode."""
    with ros.wire("bson") as wire:
        yield WorldNode(wire, stamped, lockstep, timeout)


_PARAMETERS = tuple(  # fields of the task
    field.name for field in dataclasses.fields(TaskConfig) if field.name not in ("reward", "lcf_each")
)


class Server:
    """`bson ros`: episodes of one world on the wire, with services and parameters.

    Services: /bson/reset (std_srvs/srv/Trigger) begins the episode of the parameter `seed`, /bson/pause
    (std_srvs/srv/SetBool) stops and goes on. Parameters: `seed` and fields of the task, which hold from the next reset.
    """

    def __init__(self, wire: ros.Wire, node: WorldNode, config: TaskConfig, track: LocalTrack, seed: int, fixed: bool):
        """fixed: whether episodes follow from a suite, so that nobody may change them."""
        from rcl_interfaces.msg import ParameterDescriptor
        from rclpy.parameter import Parameter
        from std_srvs.srv import SetBool, Trigger

        self._node, self.config, self.seed, self._fixed = node, config, seed, fixed
        self.session = Session(config, track, 1)
        own = wire.node
        any_type = ParameterDescriptor(dynamic_typing=True, read_only=fixed)
        for name in ("seed", *_PARAMETERS):
            value = seed if name == "seed" else _plain(getattr(config, name))
            own.declare_parameter(name, value, any_type)
        own.add_on_set_parameters_callback(self._change)
        self._unset = Parameter.Type.NOT_SET
        self._services = (
            own.create_service(Trigger, "/bson/reset", self._reset),
            own.create_service(SetBool, "/bson/pause", self._pause),
        )

    def _change(self, parameters):
        from rcl_interfaces.msg import SetParametersResult

        changes = {one.name: one.value for one in parameters if one.name in ("seed", *_PARAMETERS)}
        changes = {name: list(value) if hasattr(value, "tolist") else value for name, value in changes.items()}
        seed = changes.pop("seed", self.seed)
        try:
            if not (isinstance(seed, int) and 0 <= seed < 2**62):
                raise ValueError(f"seed must be a whole number from 0 to 2**62 - 1, not {seed!r}.")
            config = self.config.replace(**changes)
        except (ValueError, TypeError) as error:
            return SetParametersResult(successful=False, reason=" ".join(str(error).split()))
        self.config, self.seed = config, seed
        return SetParametersResult(successful=True)

    def _reset(self, _, response):
        response.success = not self._fixed
        response.message = "the suite's episodes are played" if self._fixed else f"seed {self.seed}"
        self._node.restart = not self._fixed
        return response

    def _pause(self, request, response):
        self._node.paused = request.data
        response.success, response.message = True, "paused" if request.data else "goes on"
        return response

    def play(self) -> Episode:
        """Plays the episode of the present seed and task. Raises Restarted, AgentError."""
        if self.session.config != self.config:
            self.session.configure(self.config)
        self.session.reset([0], [self.seed])
        recorder = Recorder(self.session, 0)
        self._node.begin(self.session)
        over = False
        while not over:
            action = self._node.wait()
            _, _, terminated, truncated = self.session.step([0], action[None])
            recorder.snap(action)
            self._node.snap()
            over = bool(terminated[0] or truncated[0])
        return recorder.episode()

    def close(self) -> None:
        """Frees the world."""
        self.session.close()


def _plain(value):
    """A field of TaskConfig as a parameter's value."""
    if isinstance(value, RobotConfig):
        return value.name
    if isinstance(value, tuple):
        return [float(one) for one in value] if all(isinstance(one, int | float) for one in value) else None
    return value


def serve(
    plan: Sequence[tuple[TaskConfig, int]] | None,
    config: TaskConfig,
    track: LocalTrack,
    seed: int,
    stamped: bool,
    lockstep: bool,
    timeout: float,
    ended: Callable[[Episode], None],
) -> None:
    """Runs the node `bson`. plan: (task, seed) of the episodes that are played one after another; None: the episode
    `seed` of `config`, and then those that the service reset begins, until the process is interrupted.

    ended: called with each Episode.
    """
    with ros.wire("bson") as wire:
        node = WorldNode(wire, stamped, lockstep, timeout, driven=True)
        first = plan[0] if plan else (config, seed)
        server = Server(wire, node, first[0], track, first[1], plan is not None)
        with contextlib.closing(server):
            for server.config, server.seed in plan or ():
                ended(server.play())
            while plan is None:
                try:
                    ended(server.play())
                    node.stand()
                except Restarted:
                    continue
