"""Episodes as rosbag2 folders with MCAP storage (extra `record`): written while they are played, and read back.

A bag has the messages of bson.interfaces.messages. What does not change in an episode stands in the bag's metadata as
JSON, under custom data's key `bson` (_About). From both, `read` makes the Episode again, so that it can be scored. The
metadata has digests of itself and of the messages from which the score follows, so that damage does not pass for an
episode.
"""

import contextlib
import dataclasses
import functools
import hashlib
import json
import math
import pathlib
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from bson import robot
from bson.episodes.record import Episode
from bson.interfaces.messages import COUNTERS, PROGRESS, Reporter, Topic
from bson.simulation.data import QUANTITIES
from macid.documents import convert, shown_path
from macid.files import UsageError, check_folder, named, remove_leftover_folders, whole_folder
from macid.state import RADIUS

if TYPE_CHECKING:
    from bson.episodes.session import Session

FORMAT = 1
_KEY = "bson"
_STATIC = ("seed", "goal", "fault", "lcf", "boxes", "shortest", "timed_out", "period", "robot_radius", "person_radius")
_MOST_STEPS = 10_000_000  # of a bag that is read
_SCORED = ("/odom", "/people/poses", "/people/states", "/collisions", "/episode")  # the score follows from these
_SIGNED = (*_SCORED, "/cmd_vel")  # topics that have a digest


def _digest(content=b""):
    return hashlib.blake2b(content, digest_size=16)


def _signed(content):
    """The digest of a bag's metadata, but for the digest itself."""
    plain = {key: value for key, value in content.items() if key != "digest"}
    return _digest(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def _rosbags() -> Any:
    """The package rosbags. Raises UsageError where it is missing."""
    try:
        import rosbags.interfaces
        import rosbags.rosbag2
        import rosbags.typesys
        import rosbags.typesys.base
    except ModuleNotFoundError as error:
        raise UsageError(f"Bags need {error.name}: pip install 'bson-macid[record]'.") from None
    return rosbags


def check() -> None:
    """Raises UsageError, one line that says what to install, where the extra `record` is missing."""
    _rosbags()


@functools.cache
def _store():
    """The messages' types in ROS 2 Jazzy."""
    types = _rosbags().typesys
    return types.get_typestore(types.Stores.ROS2_JAZZY)


class BagCarrier:
    """Makes messages as rosbags has them (see messages.Carrier)."""

    def __init__(self):
        self.store, self._kinds = _store(), _rosbags().interfaces.Nodetype

    def new(self, kind: str) -> Any:
        """A message all of whose numbers are 0."""
        fields = {name: self._zero(field) for name, field in self.store.fielddefs[kind][1]}
        return self.store.types[kind](**fields)

    def _zero(self, field):
        node, of = field
        if node == self._kinds.NAME:
            return self.new(of)
        if node == self._kinds.BASE:
            return {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}.get(of[0], 0)
        (inner, kind), size = of
        if inner == self._kinds.BASE and kind[0] != "string":
            return np.zeros(size if node == self._kinds.ARRAY else 0, kind[0])
        return [self._zero(of[0]) for _ in range(size if node == self._kinds.ARRAY else 0)]

    def numbers(self, values: np.ndarray) -> np.ndarray:
        """The array itself."""
        return values


def quality(topic: Topic) -> Any:
    """A topic's quality of service as rosbags has it."""
    of = _rosbags().interfaces
    forever = of.QosTime(2147483647, 4294967295)
    return of.Qos(
        history=of.QosHistory.KEEP_LAST,
        depth=topic.depth,
        reliability=of.QosReliability.RELIABLE,
        durability=of.QosDurability.TRANSIENT_LOCAL if topic.latched else of.QosDurability.VOLATILE,
        deadline=forever,
        lifespan=forever,
        liveliness=of.QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )


class Recording:
    """A bag that is being written: one episode of one world, from its reset on."""

    def __init__(
        self, path: pathlib.Path, session: "Session", index: int, about: Callable[[], dict], stamped: bool = True
    ):
        """path: the bag's folder, new or empty, which appears at the `end`. about: gives what the bag's metadata tells
        beside the episode. stamped: whether commands are TwistStamped."""
        bags = _rosbags().rosbag2
        self._carrier, self._about, self._held = BagCarrier(), about, contextlib.ExitStack()
        self._folder = self._held.enter_context(whole_folder(path))
        self._reporter = Reporter(self._carrier, session.world, index, stamped)
        self._world, self._index, self._steps = session.world, index, 0
        self._writer = bags.Writer(
            self._folder / path.name, version=bags.Writer.VERSION_LATEST, storage_plugin=bags.StoragePlugin.MCAP
        )
        self._writer.set_compression(bags.CompressionMode.STORAGE, bags.CompressionFormat.ZSTD)
        self._writer.open()
        store = self._carrier.store
        self._connections = {
            name: self._writer.add_connection(name, topic.kind, typestore=store, offered_qos_profiles=[quality(topic)])
            for name, topic in self._reporter.topics.items()
        }
        self._digests = {name: _digest() for name in _SIGNED}
        self._write(self._reporter.begin())

    def _write(self, said):
        for topic, stamp, message in said:
            data = self._carrier.store.serialize_cdr(message, topic.kind)
            if topic.name in self._digests:
                self._digests[topic.name].update(data)
            self._writer.write(self._connections[topic.name], stamp, data)

    def snap(self, action: np.ndarray, *_: Any) -> None:
        """Writes the world's state after the control step of `action` (2,)."""
        self._steps += 1
        self._write(self._reporter.step(action))

    def end(self, episode: Episode) -> None:
        """Writes what only the Episode tells, and puts the bag in its place."""
        statics = {name: getattr(episode, name) for name in _STATIC}
        content = {
            "format": FORMAT,
            **self._about(),
            **{name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in statics.items()},
            "people_goals": None if episode.people_goals is None else episode.people_goals.tolist(),
            "steps": self._steps,
            "nq": episode.qpos.shape[-1],
            "messages": {name: digest.hexdigest() for name, digest in self._digests.items()},
        }
        content["digest"] = _signed(content)
        self._writer.set_custom_data(_KEY, json.dumps(content))
        self._writer.close()
        for file in self._writer.path.iterdir():
            file.rename(self._folder / file.name)
        self._writer.path.rmdir()
        self._held.close()

    def discard(self) -> None:
        """Removes what was written, after an error."""
        if self._writer.storage is not None:
            self._writer.storage.abort()
        error = sys.exc_info()[1] or RuntimeError("discarded")
        with contextlib.suppress(type(error)):
            self._held.__exit__(type(error), error, error.__traceback__)


@contextlib.contextmanager
def recordings(
    out: str | pathlib.Path, called: Callable[[int], str], about: dict[str, Any], stamped: bool = True
) -> Iterator[Callable[["Session", int], "Recording"]]:
    """In a `with`: a function that begins the Recording of a world's episode in the folder `out`, for the argument
    `watch` of bson.evaluation.play.run_episodes. Where the work in the `with` fails, the bags of the episodes that
    have not ended are removed, and so are those that a recorder that was killed left there.

    called: gives the name of an episode's bag from its seed. about: what the bags' metadata tells beside episodes.
    """
    check()
    if pathlib.Path(out).is_dir():
        remove_leftover_folders(out, _unfinished)
    open_bags: dict[int, Recording] = {}

    def begin(session, index):
        seed = int(session.world.seed[index])
        begun = open_bags[index] = Recording(pathlib.Path(out) / called(seed), session, index, lambda: about, stamped)
        return begun

    try:
        yield begin
    except BaseException:
        for each in open_bags.values():
            each.discard()
        raise


def _unfinished(path, name):
    """Whether the temporary folder `path` holds what a recorder that was killed left of the bag `name`."""
    files = {str(file.relative_to(path)) for file in path.rglob("*")}
    own = {f"{name}/{name}.mcap", f"{name}.mcap", f"{name}/metadata.yaml", "metadata.yaml"}
    return path.is_dir() and bool(files & own) and files <= {name, *own}


class _About(msgspec.Struct):
    """What a bag's metadata tells of its episode; other keys are notes for people."""

    format: int
    agent: str
    suite: str
    cell: str
    grades: list[tuple[str, str]]
    config: dict[str, Any]
    seed: int
    goal: tuple[float, float]
    fault: str
    lcf: list[float]
    boxes: list[tuple[float, float, float, float, float]]
    shortest: float
    timed_out: bool
    period: float
    robot_radius: float
    steps: int
    nq: int
    person_radius: float = RADIUS
    people_goals: list[tuple[float, float]] | None = None
    suite_digest: str | None = None
    task_digest: str | None = None
    track: list[str] | None = None
    sensors: list[dict[str, Any]] = []
    overrides: dict[str, str] = {}
    frozen_seeds: bool = True
    messages: dict[str, str] = {}  # digests; none in bags of earlier versions
    digest: str | None = None


def bags_in(paths: Sequence[str | pathlib.Path]) -> list[pathlib.Path]:
    """The bags that `paths` name: each a bag's folder, or a folder of bags, which come in the order of their names.
    Raises UsageError."""
    found = []
    for path in map(pathlib.Path, paths):
        if (path / "metadata.yaml").is_file():
            found.append(path)
            continue
        inside = sorted(file.parent for file in path.glob("*/metadata.yaml")) if path.is_dir() else []
        for part in sorted([path, *(file.parent for file in path.glob("*/*.mcap"))]):
            if any(part.glob("*.mcap")) and part not in inside:
                raise UsageError(f"The bag {shown_path(part)} has no metadata.yaml: it was cut short. Record it anew.")
        if not inside:
            raise UsageError(f"There is no bag in {named(path)}: name a folder that bson record wrote.")
        found += inside
    return found


def read(path: str | pathlib.Path) -> tuple[Any, Episode]:
    """What the bag `path` tells of its episode (_About), and the Episode, equal to the one that was recorded but for
    the wheels' angles in `qpos`, which are 0.

    Raises UsageError for a bag that is damaged, cut short, or not of `bson record`.
    """
    bags, path = _rosbags().rosbag2, pathlib.Path(path)
    where = f"bag {shown_path(path)}"
    try:
        with bags.Reader(path) as reader:
            about = _read_about(reader, where)
            rows, digests = _read_rows(reader, where)
    except UsageError:
        raise
    except Exception as error:  # rosbags raises errors of many kinds for damaged files
        reason = " ".join(str(error).split())[:300].rstrip(".") or type(error).__name__
        raise UsageError(f"Can't read the {where}: {reason}. It is damaged or was cut short: record it anew.") from None
    for name, values in rows.items():
        if len(values) != about.steps + 1:
            found = f"{len(values)} of {about.steps + 1} messages of {name}"
            raise UsageError(f"The {where} has {found}: it was cut short, or filtered. Record it anew.")
    for name, digest in digests.items():
        if about.messages.get(name, digest) != digest:
            raise UsageError(
                f"The {where} has other messages on {name} than were recorded: it is damaged, or was changed."
            )
    _check(about, rows, where)
    return about, _episode(about, rows, where)


def _read_about(reader, where):
    """The bag's _About. Raises UsageError."""
    told = (reader.storage.metadata.custom or {}).get(_KEY)
    if told is None:
        raise UsageError(f"The {where} tells of no episode: it is not of bson record, or its metadata was made anew.")
    content = json.loads(told)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise UsageError(f"The {where} is of another version: this one reads format {FORMAT}.")
    about = convert(content, _About, where)
    if about.digest not in (None, _signed(content)):
        raise UsageError(f"The {where} has other metadata than were recorded: it is damaged, or was changed.")
    if not 0 <= about.steps <= _MOST_STEPS:
        raise UsageError(f"{where}, key 'steps': a number from 0 to {_MOST_STEPS} is wanted, not {about.steps}.")
    return about


def _read_rows(reader, where):
    """{topic: the numbers of each of its messages}, and {topic: the digest of its messages}. Raises UsageError for a
    topic that is missing or of another type."""
    readers = {  # of _SCORED
        "/odom": ("nav_msgs/msg/Odometry", _of_odometry),
        "/people/poses": ("geometry_msgs/msg/PoseArray", _of_poses),
        "/people/states": ("sensor_msgs/msg/PointCloud2", _of_states),
        "/collisions": ("std_msgs/msg/Int64MultiArray", lambda message: _of_row(message, COUNTERS, where)),
        "/episode": ("std_msgs/msg/Float64MultiArray", lambda message: _of_row(message, PROGRESS, where)),
    }
    store = BagCarrier().store
    there = {connection.topic: connection for connection in reader.connections}
    for name, (kind, _) in readers.items():
        if name not in there:
            raise UsageError(f"The {where} has no topic {name}, from which its score follows.")
        if there[name].msgtype != kind:
            raise UsageError(f"The {where} has {there[name].msgtype} on {name}, not {kind}.")
    rows: dict[str, list] = {name: [] for name in readers}
    digests = {name: _digest() for name in _SIGNED if name in there}
    for connection, _, data in reader.messages(connections=[there[name] for name in digests]):
        digests[connection.topic].update(data)
        if connection.topic in readers:
            kind, of = readers[connection.topic]
            rows[connection.topic].append(of(store.deserialize_cdr(data, kind)))
    return rows, {name: digest.hexdigest() for name, digest in digests.items()}


def _check(about, rows, where):
    """Raises UsageError for numbers of which no episode is made."""
    people = {len(row) for name in ("/people/poses", "/people/states") for row in rows[name]} | {len(about.lcf)}
    if len(people) > 1:
        raise UsageError(f"The {where} has different numbers of people: {', '.join(map(str, sorted(people)))}.")
    free = PROGRESS.index("nearest_person")  # infinity without people
    for name, values in rows.items():
        found = np.array(values, float)
        if name == "/episode":
            found[np.isposinf(found[:, free]), free] = 0.0
        if not np.isfinite(found).all():
            raise UsageError(f"The {where} has a number on {name} that is not finite.")
    for key in ("period", "robot_radius", "person_radius"):
        if not (value := getattr(about, key)) > 0 or not math.isfinite(value):
            raise UsageError(f"{where}, key '{key}': a number above 0 is wanted, not {value}.")


def _of_odometry(message):
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    twist = message.twist.twist
    return place.x, place.y, place.z, turn.w, turn.x, turn.y, turn.z, twist.linear.x, twist.angular.z


def _of_poses(message):
    return np.array([(pose.position.x, pose.position.y) for pose in message.poses]).reshape(-1, 2)


def _of_states(message):
    kinds = {7: np.float32, 8: np.float64}
    names = [field.name for field in message.fields]
    kind = np.dtype(
        {
            "names": names,
            "formats": [kinds[field.datatype] for field in message.fields],
            "offsets": [field.offset for field in message.fields],
            "itemsize": message.point_step,
        }
    )
    points = np.frombuffer(message.data.tobytes(), kind)
    return np.stack([points[name] for name in ("yaw", "vx", "vy")], axis=-1)


def _of_row(message, names, where):
    told = message.layout.dim[0].label.split(",") if message.layout.dim else []
    if told != list(names):
        raise UsageError(f"The {where} has rows of {', '.join(told) or 'nothing'}, not of {', '.join(names)}.")
    if len(message.data) != len(names):
        raise UsageError(f"The {where} has a row of {len(message.data)} numbers, not {len(names)}: {', '.join(names)}.")
    return message.data


def _episode(about, rows, where):
    odometry, poses = np.array(rows["/odom"]), np.array(rows["/people/poses"])
    states, progress = np.array(rows["/people/states"]), np.array(rows["/episode"])
    counters = np.array(rows["/collisions"])
    progress = {name: progress[:, column] for column, name in enumerate(PROGRESS)}
    counted = {name: counters[:, column] for column, name in enumerate(COUNTERS)}
    if about.nq < 3 * poses.shape[1] + 7:
        raise UsageError(f"{where}, key 'nq': {about.nq} is less than people and robot have.")
    people = np.concatenate([poses, states[..., :1]], axis=-1)
    qpos = np.zeros((len(poses), about.nq))
    qpos[:, : 3 * people.shape[1]] = people.reshape(len(people), -1)
    qpos[:, 3 * people.shape[1] :][:, :7] = odometry[:, :7]
    world = {
        **{name: values[-1] for name, values in {**progress, **counted}.items()},
        **{name: getattr(about, name) for name in ("seed", "fault")},
        "goal": np.array(about.goal),
        "lcf": np.array(about.lcf),
        "boxes": np.array(about.boxes).reshape(-1, 5),
    }
    last = {quantity.last: (quantity, world[quantity.name]) for quantity in QUANTITIES if quantity.last}
    return Episode(
        **{name: value if quantity.shape else quantity.kind(value) for name, (quantity, value) in last.items()},
        pose=robot.planar_pose(odometry[:, :7]),
        velocity=odometry[:, 7:],
        collisions_so_far=counted["collisions"],
        nearest_person=progress["nearest_person"],
        people=people,
        people_velocity=states[..., 1:],
        qpos=qpos,
        shortest=about.shortest,
        timed_out=about.timed_out,
        period=about.period,
        robot_radius=about.robot_radius,
        person_radius=about.person_radius,
        people_goals=None if about.people_goals is None else np.array(about.people_goals).reshape(-1, 2),
    )


def remove_bags(folder: str | pathlib.Path) -> None:
    """Removes the bags in `folder` that an earlier run left there, and `folder` itself once it is empty."""
    folder = pathlib.Path(folder)
    if not folder.is_dir():
        return
    for bag in sorted(folder.iterdir()):
        files = list(bag.iterdir()) if bag.is_dir() and not bag.is_symlink() else []
        if {file.name for file in files} == {"metadata.yaml", f"{bag.name}.mcap"}:
            for file in files:
                file.unlink()
            bag.rmdir()
    if not any(folder.iterdir()):
        folder.rmdir()


def about(agent: str, suite: str, cell: Any, track: Any, sensors: list[dict], **more: Any) -> dict[str, Any]:
    """What a bag's metadata tells beside its episode, ready for JSON. cell: a bson.evaluation.suites.Cell. track:
    [track, sensor], as results.json has them. more: further keys of results.json."""
    content = {
        "agent": agent,
        "suite": suite,
        "cell": cell.name,
        "grades": cell.grades,
        "config": dataclasses.asdict(cell.config),
        "track": track,
        "sensors": sensors,
        **more,
    }
    return json.loads(json.dumps(content, default=np.ndarray.tolist))


def check_new(out: str | pathlib.Path, names: Sequence[str]) -> pathlib.Path:
    """`out` as a Path, if bags of these `names` can be written there. Raises UsageError."""
    folder = check_folder(out)
    for name in names:
        if (folder / name).exists():
            raise UsageError(f"There is {named(folder / name)} already. Name a new folder for --out.")
    return folder
