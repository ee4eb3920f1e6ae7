"""ROS 2 from Python (extra `ros`): a node of one's own, and messages as rclpy has them.

The extra brings ROS 2 Jazzy as wheels (Linux, x86-64). Somebody with a ROS 2 of their own sources its setup.bash and
uses its Python in place of the extra.
"""

import array
import contextlib
import importlib
import importlib.util
import os
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

from bson.agents.contract import AgentError
from bson.interfaces.messages import Topic
from macid import start
from macid.documents import shown
from macid.files import UsageError

_NEEDED = ("geometry_msgs.msg", "nav_msgs.msg", "rosgraph_msgs.msg", "sensor_msgs.msg", "std_msgs.msg", "std_srvs.srv")
_MOST_DOMAIN = 232  # whose ports are below 65,536
_OPTIONAL = ("tf2_msgs", "visualization_msgs")  # packages without which a node goes on


def _rclpy() -> Any:
    """The package rclpy. Raises UsageError where it, or the messages' packages, are missing."""
    try:
        for name in _NEEDED:
            importlib.import_module(name)
        return importlib.import_module("rclpy")
    except ImportError as error:  # also where a library of ROS is not found
        raise UsageError(
            f"ROS 2 is not here ({error}): pip install 'bson-macid[ros]' (Linux, x86-64), or source the setup.bash of "
            "a ROS 2 whose Python this is."
        ) from None


def check() -> None:
    """Raises UsageError, one line that says what to install, where ROS 2 is missing."""
    _rclpy()


def missing() -> list[str]:
    """The optional packages of messages that are not here."""
    return [name for name in _OPTIONAL if importlib.util.find_spec(name) is None]


def kind_of(name: str) -> Any:
    """The class of the messages of type `name`, such as "sensor_msgs/msg/LaserScan"."""
    package, _, message = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), message)


class RosCarrier:
    """Makes messages as rclpy has them (see messages.Carrier)."""

    def new(self, kind: str) -> Any:
        """A message all of whose numbers are 0."""
        return kind_of(kind)()

    def numbers(self, values: np.ndarray) -> array.array:
        """The numbers as an array.array."""
        return array.array(values.dtype.char.replace("l", "q"), np.ascontiguousarray(values).tobytes())


def quality(topic: Topic) -> Any:
    """A topic's quality of service as rclpy has it."""
    _rclpy()
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    latched = DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE
    return QoSProfile(depth=topic.depth, reliability=ReliabilityPolicy.RELIABLE, durability=latched)


def stamp_of(message: Any) -> int:
    """The stamp [ns] of a message with a header."""
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def warn(told: str) -> None:
    """Says `told` on stderr, as one line."""
    print(f"warning: {told}", file=sys.stderr, flush=True)


def acknowledged(publisher: Any, seconds: float) -> None:
    """Waits until everybody who listens has got what `publisher` sent, for at most `seconds` [s]."""
    from rclpy.duration import Duration

    publisher.wait_for_all_acked(Duration(seconds=seconds))


class Wire:
    """A node, and the executor that runs its callbacks, in this thread, while `spin` is called."""

    def __init__(self, node: Any, executor: Any):
        self.node, self._executor = node, executor

    def spin(self, seconds: float) -> None:
        """Runs the next callback that is ready, waiting for it for at most `seconds` [s]."""
        self._executor.spin_once(timeout_sec=max(0.0, seconds))

    def check_publishers(self, topic: Topic) -> bool:
        """Whether somebody else publishes on `topic`. Raises AgentError where they publish messages of another type."""
        found = [
            one
            for one in self.node.get_publishers_info_by_topic(topic.name)
            if (one.node_namespace, one.node_name) != (self.node.get_namespace(), self.node.get_name())
        ]
        for one in found:
            if one.topic_type != topic.kind:
                known = {"geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"}
                hint = " (--twist changes it)" if {one.topic_type, topic.kind} == known else ""
                raise AgentError(
                    f"The node '{one.node_name}' publishes {one.topic_type} on {topic.name}, where {topic.kind} is "
                    f"wanted{hint}."
                )
        return bool(found)


def _check_domain():
    """Raises UsageError for a domain that DDS has no ports for, which would end the process."""
    given = os.environ.get("ROS_DOMAIN_ID", "")
    if given and not (given.isascii() and given.isdigit() and int(given) <= _MOST_DOMAIN):
        raise UsageError(f"ROS_DOMAIN_ID must be a whole number from 0 to {_MOST_DOMAIN}, not {shown(given)}.")


@contextlib.contextmanager
def wire(name: str) -> Iterator[Wire]:
    """A Wire of a new node `name`, in a `with`. Raises UsageError where ROS 2 is missing or can't start."""
    # Shared memory would leave files behind where a process is killed. (With ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST,
    # rmw_fastrtps takes it all the same.)
    os.environ.setdefault("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    rclpy = _rclpy()
    _check_domain()
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    start.cleaning_up()
    context = rclpy.Context()
    with contextlib.ExitStack() as held:
        try:
            rclpy.init(
                args=["--ros-args", "--disable-external-lib-logs"],
                context=context,
                signal_handler_options=SignalHandlerOptions.NO,  # Ctrl-C and signals are Python's
            )
            held.callback(context.try_shutdown)
            node = rclpy.create_node(name, context=context, enable_rosout=False)
            held.callback(node.destroy_node)
            executor = SingleThreadedExecutor(context=context)
            held.callback(executor.shutdown)
            executor.add_node(node)
        except Exception as error:  # rclpy raises errors of many kinds
            reason = " ".join(str(error).split())[:300] or type(error).__name__
            raise UsageError(f"ROS 2 can't start: {reason}.") from None
        yield Wire(node, executor)
