"""Messages in bags, and of any reader, for tests to compare."""

import numpy as np

_TIMES = ("stamp", "map_load_time", "clock")


def by_topic(path):
    """{topic: [(time [ns], message), ...]} of the bag `path`, by rosbags."""
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    found, store = {}, get_typestore(Stores.ROS2_JAZZY)
    with Reader(path) as reader:
        for connection, time, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((time, message))
    return found


def plain(message, without=()):
    """A message of rosbags, mcap or rclpy as nested dicts, lists and numbers; without fields of the names `without`."""
    if isinstance(message, np.generic):
        return message.item()
    if isinstance(message, str | bool | int | float):
        return message
    if hasattr(message, "get_fields_and_field_types"):
        names = message.get_fields_and_field_types()
    elif hasattr(message, "__slots__") or hasattr(message, "__dataclass_fields__"):
        names = getattr(message, "__slots__", None) or vars(message)
    else:
        return [plain(each, without) for each in message]
    kept = [name for name in names if name[0] != "_" and name.islower() and name not in without]  # no constants
    return {name: plain(getattr(message, name), without) for name in kept}


def timeless(message):
    """As `plain`, without any time."""
    return plain(message, _TIMES)


def equal(one, other):
    """Whether two messages, as `plain` has them, are equal to the last bit; two that are not a number are."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[key], other[key]) for key in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(equal, one, other))
    return one == other or (one != one and other != other)
