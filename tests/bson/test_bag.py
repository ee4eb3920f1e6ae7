"""Recorded episodes: each field of each message is the episode's, as two readers find it, and the score is the same."""

import dataclasses
import json
import math
import pathlib
import shutil
import sys

import numpy as np
import pytest
import yaml
from bags import by_topic, equal, plain

pytest.importorskip("rosbags", reason="needs the extra record")

from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from bson import benchmark, cli
from bson.agents import load_agent
from bson.episodes.tracks import LocalTrack
from bson.evaluation.play import replayed, run_episodes
from bson.evaluation.suites import Cell
from bson.interfaces import bag, messages
from bson.robot import planar_pose
from bson.sensors import Imu, Lidar2D, Lidar3D, Sensor
from bson.simulation.data import MAP_RESOLUTION
from bson.task import TaskConfig
from macid.drawing import gl
from macid.drawing.colours import lcf_colour
from macid.files import UsageError
from macid.state import HEIGHT, RADIUS

CONFIG = TaskConfig(
    num_pedestrians=3, map_size=20.0, goal_distance=(4.0, 9.0), horizon=9, pedestrian_model="orca", obstacle_density=1.0
)
SENSORS = (
    Imu(noise=1.0),
    Lidar2D(beams=90, range_max=6.0),
    Lidar3D(rows=4, columns=36, rate=5.0),
    Lidar2D(key="rear", beams=30, yaw=math.pi, position=(-0.2, 0.0, 0.3), rate=2.5),
)
SETS = ["--set", "horizon=6", "--set", "map_size=20.0", "--set", "goal_distance=(6,12)", "--set", "num_pedestrians=2",
        "--set", "pedestrian_model=orca"]  # fmt: skip
STORE = get_typestore(Stores.ROS2_JAZZY)


class Noted:
    """What a world is like at the reset and after each control step, noted beside the bag by another hand."""

    def __init__(self, session, index, held):
        self.session, self.index, self.held = session, index, held
        self.rows, self.actions = [], []
        self._note()

    def _note(self):
        world, index = self.session.world, self.index
        kept = {name: np.array(getattr(world, name)[index]) for name in ("time", "pose", "velocity", "lcf", "qpos")}
        seen = {name: value[0].copy() for name, value in self.session.observe([index]).items()}
        self.occupied, self.boxes, self.model = world.occupancy(index), world.boxes[index].copy(), world.model
        people = world.people[index].copy(), world.people_velocity[index].copy()
        counted = [int(getattr(world, name)[index]) for name in messages.COUNTERS]
        told = [float(getattr(world, name)[index]) for name in messages.PROGRESS]
        self.rows.append(
            {**kept, "seen": seen, "people": people[0], "moving": people[1], "counted": counted, "told": told}
        )

    def snap(self, action, *more):
        self.held.snap(action, *more)
        self.actions.append(action)
        self._note()

    def end(self, episode):
        self.held.end(episode)
        self.episode = episode


def record(folder, config, sensors, agent="goal", stamped=True, seed=7):
    """Records an episode into `folder`/seed-N: what was Noted."""
    track, kept = LocalTrack(sensors), []
    told = bag.about(agent, "none", Cell((), config), ["local", "own"], [])

    with bag.recordings(folder, "seed-{}".format, told, stamped) as begin:

        def watch(session, index):
            kept.append(Noted(session, index, begin(session, index)))
            return kept[-1]

        run_episodes(load_agent(agent), config, track, [seed], watch=watch)
    kept[0].path = pathlib.Path(folder) / f"seed-{seed}"
    return kept[0]


@pytest.fixture(scope="module")
def noted(tmp_path_factory):
    return record(tmp_path_factory.mktemp("bags"), CONFIG, SENSORS)


@pytest.fixture(scope="module")
def path(noted):
    return noted.path


@pytest.fixture(scope="module")
def told(path):
    return by_topic(path)


def stamp(message):
    time = message.header.stamp
    return time.sec * 1_000_000_000 + time.nanosec


def nanoseconds(row):
    return round(float(row["time"]) * 1e9)


def test_every_topic_has_its_messages_at_simulated_time(noted, told):
    times = [nanoseconds(row) for row in noted.rows]
    assert times[:3] == [0, 100_000_000, 200_000_000] and len(times) == 10
    once = {"/tf_static", "/map", "/goal_pose"}
    rare = {"/points": 2, "/rear/scan": 4}
    assert set(told) == set(messages.topics(SENSORS))
    for topic, said in told.items():
        wanted = times[:1] if topic in once else times[:: rare.get(topic, 1)]
        wanted = times[:-1] if topic == "/cmd_vel" else wanted
        if topic == "/people/markers":  # those of an earlier episode are deleted first
            wanted = [0, *wanted]
        assert [time for time, _ in said] == wanted, topic
        assert all(stamp(message) == time for time, message in said if hasattr(message, "header"))
    assert [message.clock.sec * 10**9 + message.clock.nanosec for _, message in told["/clock"]] == times


def test_pose_twist_and_command_are_the_episodes(noted, told):
    assert noted.episode.collisions_so_far[0] == 0
    for row, (_, odometry), (_, transforms) in zip(noted.rows, told["/odom"], told["/tf"], strict=True):
        assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
        place, turn = odometry.pose.pose.position, odometry.pose.pose.orientation
        qpos = np.array([place.x, place.y, place.z, turn.w, turn.x, turn.y, turn.z])
        assert np.array_equal(qpos, row["qpos"][9:16])
        assert np.array_equal(planar_pose(qpos), row["pose"])
        twist = odometry.twist.twist
        assert (twist.linear.x, twist.angular.z) == tuple(row["velocity"])
        assert np.array_equal(odometry.pose.covariance.reshape(6, 6), 1e-9 * np.eye(6))
        assert np.array_equal(np.diag(odometry.twist.covariance.reshape(6, 6)), [1e-9, 1e6, 1e6, 1e6, 1e6, 1e-9])
        (transform,) = transforms.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_link")
        assert transform.transform.translation.y == place.y and transform.transform.rotation == turn
    top = np.array([2.0, 2.0])
    for action, (_, command) in zip(noted.actions, told["/cmd_vel"], strict=True):
        assert command.header.frame_id == "base_link"
        assert [command.twist.linear.x, command.twist.angular.z] == (np.clip(action, -1, 1) * top).tolist()


def test_readings_are_the_observations(noted, told):
    imu = Imu()
    for row, (_, message), (_, scan) in zip(noted.rows, told["/imu/data"], told["/scan"], strict=True):
        force, rate = message.linear_acceleration, message.angular_velocity
        assert [force.x, force.y, force.z, rate.x, rate.y, rate.z] == row["seen"]["imu"].tolist()
        assert message.header.frame_id == "imu_link"
        assert np.allclose(np.diag(message.linear_acceleration_covariance.reshape(3, 3)), imu.sigma_force**2)
        assert np.allclose(np.diag(message.angular_velocity_covariance.reshape(3, 3)), imu.sigma_rate**2)
        turn = message.orientation
        assert [turn.w, turn.x, turn.y, turn.z] == row["qpos"][12:16].tolist()
        lidar = SENSORS[1]
        assert scan.header.frame_id == "laser" and len(scan.intensities) == 0
        assert np.allclose(
            [scan.angle_min, scan.angle_max, scan.angle_increment], [*lidar.angles[[0, -1]], np.diff(lidar.angles)[0]]
        )
        assert (
            np.allclose([scan.range_min, scan.range_max, scan.scan_time], [0.1, 6.0, 0.1]) and not scan.time_increment
        )
        far = row["seen"]["lidar"] == 6.0
        assert scan.ranges.dtype == np.float32 and np.array_equal(scan.ranges[~far], row["seen"]["lidar"][~far])
        assert (scan.ranges[far] == np.inf).all()  # REP 117
    assert any(np.isinf(scan.ranges).any() for _, scan in told["/scan"])
    for row, (_, cloud) in zip(noted.rows[::2], told["/points"], strict=True):
        assert (cloud.height, cloud.width, cloud.point_step, cloud.row_step) == (4, 36, 12, 432)
        assert [(field.name, field.offset, field.datatype) for field in cloud.fields] == [
            ("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]  # fmt: skip
        points = np.frombuffer(cloud.data.tobytes(), np.float32).reshape(-1, 3)
        wanted = SENSORS[2].points(row["seen"]["lidar3d"]).astype(np.float32)
        assert np.array_equal(points[~np.isnan(points).any(axis=-1)], wanted)
        assert cloud.header.frame_id == "velodyne" and cloud.is_dense == (len(wanted) == 4 * 36)
    for row, (_, scan) in zip(noted.rows[::4], told["/rear/scan"], strict=True):
        assert scan.header.frame_id == "rear_laser" and np.isclose(scan.scan_time, 0.4)
        assert np.array_equal(np.minimum(scan.ranges, np.float32(30.0)), row["seen"]["rear"])


def test_people_and_the_score_so_far_are_the_episodes(noted, told):
    (_, gone), *markers = told["/people/markers"]
    assert [marker.action for marker in gone.markers] == [3]
    for index, (row, (_, said)) in enumerate(zip(noted.rows, markers, strict=True)):
        bodies, texts = said.markers[:3], said.markers[3:]
        for person in range(3):
            body, text, (x, y, yaw) = bodies[person], texts[person], row["people"][person]
            assert (body.ns, body.id, body.type, body.action) == ("people", person, 3, 0)
            assert (text.ns, text.id, text.type, text.action) == ("lcf", person, 9, 0)
            for marker in (body, text):
                assert (marker.pose.position.x, marker.pose.position.y) == (x, y)
                assert marker.text == f"{row['lcf'][person]:+.2f}" and stamp(marker) == nanoseconds(row)
                colour = [marker.color.r, marker.color.g, marker.color.b]
                assert np.allclose(colour, lcf_colour(row["lcf"][person])) and marker.color.a == 1.0
            assert (body.scale.x, body.scale.y, body.scale.z) == (2 * RADIUS, 2 * RADIUS, HEIGHT)
            assert body.pose.position.z == HEIGHT / 2 and text.pose.position.z > HEIGHT
            pose = told["/people/poses"][index][1].poses[person]
            assert (pose.position.x, pose.position.y) == (x, y)
            assert np.isclose(math.remainder(2 * math.atan2(pose.orientation.z, pose.orientation.w) - yaw, math.tau), 0)
        cloud = told["/people/states"][index][1]
        kinds = {7: "<f4", 8: "<f8"}
        kind = np.dtype([(field.name, kinds[field.datatype]) for field in cloud.fields])
        points = np.frombuffer(cloud.data.tobytes(), kind)
        assert kind.itemsize == cloud.point_step and cloud.is_dense and len(points) == 3
        assert np.array_equal(points["x"], row["people"][:, 0].astype(np.float32))
        assert np.array_equal(np.stack([points["vx"], points["vy"]], axis=-1), row["moving"])
        assert np.array_equal(points["yaw"], row["people"][:, 2]) and np.array_equal(points["lcf"], row["lcf"])
        collisions, episode = told["/collisions"][index][1], told["/episode"][index][1]
        assert collisions.layout.dim[0].label.split(",")[0] == "collisions"
        assert collisions.data.tolist() == row["counted"] and episode.data.tolist() == row["told"]
    (goal,) = (message for _, message in told["/goal_pose"])
    assert [goal.pose.position.x, goal.pose.position.y] == noted.episode.goal.tolist()
    assert goal.header.frame_id == "map" and goal.pose.orientation.w == 1.0
    (grid,) = (message for _, message in told["/map"])
    assert np.isclose(grid.info.resolution, MAP_RESOLUTION) and grid.header.frame_id == "map"
    assert (grid.info.origin.position.x, grid.info.origin.position.y) == (-10.0, -10.0)
    occupied = grid.data.reshape(grid.info.height, grid.info.width)
    assert set(np.unique(occupied)) == {0, 100} and np.array_equal(occupied == 100, noted.occupied)


def frames(told, index):
    """{frame: the transform (4, 4) from it to map} at the message `index` of /tf."""
    edges = {
        transform.child_frame_id: (transform.header.frame_id, matrix(transform.transform))
        for said in (told["/tf_static"][0][1], told["/tf"][index][1])
        for transform in said.transforms
    }
    found = {"map": np.eye(4)}
    while len(found) <= len(edges):
        for child, (parent, turned) in edges.items():
            if parent in found:
                found[child] = found[parent] @ turned
    return found


def matrix(transform):
    w, x, y, z = (getattr(transform.rotation, axis) for axis in "wxyz")
    move = transform.translation
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), move.x],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), move.y],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), move.z],
            [0, 0, 0, 1],
        ]
    )


def off_surfaces(points, row, boxes):
    """Distances (N,) [m] of points (N, 3), map frame, from the nearest side of a person or box, or the floor."""
    people = np.abs(np.hypot(*(points[:, None, :2] - row["people"][:, :2]).T).T - RADIUS)
    offset = points[:, None, :2] - boxes[:, :2]
    cos, sin = np.cos(boxes[:, 4]), np.sin(boxes[:, 4])
    inside = np.abs(
        np.stack([cos * offset[..., 0] + sin * offset[..., 1], cos * offset[..., 1] - sin * offset[..., 0]])
    )
    beyond = inside - boxes[:, 2:4].T[:, None]
    box = np.abs(np.where((beyond > 0).any(axis=0), np.hypot(*np.maximum(beyond, 0)), beyond.max(axis=0)))
    return np.concatenate([people, box, np.abs(points[:, 2:])], axis=-1).min(axis=-1)


def test_points_seen_lie_on_people_walls_and_floor_by_way_of_the_frames(noted, told):
    """The tree of frames is whole, and each sensor's points, taken through it, are where solid things are."""
    for topic, every in (("/scan", 1), ("/points", 2), ("/rear/scan", 4)):
        for index, (_, message) in enumerate(told[topic]):
            if topic == "/points":
                points = np.frombuffer(message.data.tobytes(), np.float32).reshape(-1, 3)
            else:
                angles = message.angle_min + message.angle_increment * np.arange(len(message.ranges))
                reach = np.where(np.isinf(message.ranges), np.nan, message.ranges)
                points = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=-1) * reach[:, None]
            points = points[np.isfinite(points).all(axis=-1)].astype(float)
            place = frames(told, index * every)[message.header.frame_id]
            there = points @ place[:3, :3].T + place[:3, 3]
            assert len(there) and off_surfaces(there, noted.rows[index * every], noted.boxes).max() < 2e-3


def test_a_depth_picture_lies_on_surfaces_by_its_camera_info(tmp_path):
    if problem := gl.gl_problem():
        pytest.skip(problem)
    from bson.sensors import DepthCamera, RgbCamera

    small = {"width": 32, "height": 24}
    config = CONFIG.replace(horizon=2)
    noted = record(tmp_path, config, (RgbCamera(**small), DepthCamera(**small, range_max=5.0)))
    told = by_topic(tmp_path / "seed-7")
    for index, row in enumerate(noted.rows):
        colour, depth = told["/camera/image_raw"][index][1], told["/camera/depth/image_raw"][index][1]
        assert (colour.encoding, colour.height, colour.width, colour.step) == ("rgb8", 24, 32, 96)
        assert np.array_equal(colour.data.reshape(24, 32, 3), row["seen"]["rgb"]) and not colour.is_bigendian
        assert (depth.encoding, depth.height, depth.width, depth.step) == ("32FC1", 24, 32, 128)
        picture = np.frombuffer(depth.data.tobytes(), np.float32).reshape(24, 32)
        assert np.array_equal(np.minimum(picture, np.float32(5.0)), row["seen"]["depth"])
        info = told["/camera/depth/camera_info"][index][1]
        assert info.header.frame_id == depth.header.frame_id == "camera_depth_optical_frame"
        assert told["/camera/camera_info"][index][1].header.frame_id == "camera_color_optical_frame"
        v, u = np.nonzero(np.isfinite(picture))
        fx, _, cx, _, fy, cy, *_ = info.k
        z = picture[v, u].astype(float)
        place = frames(told, index)[depth.header.frame_id]
        there = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1) @ place[:3, :3].T + place[:3, 3]
        assert len(there) > 50 and np.quantile(off_surfaces(there, row, noted.boxes), 0.95) < 0.02


def test_another_reader_of_mcap_finds_the_same(path, told):
    pytest.importorskip("mcap_ros2", reason="needs mcap-ros2-support")
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    found = {}
    with open(path / "seed-7.mcap", "rb") as file:
        for schema, channel, said, message in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            assert schema.name == messages.topics(SENSORS)[channel.topic].kind
            assert said.log_time == said.publish_time
            found.setdefault(channel.topic, []).append((said.log_time, message))
    assert set(found) == set(told)
    for topic, said in told.items():
        assert [time for time, _ in said] == [time for time, _ in found[topic]]
        for (_, one), (_, other) in zip(said[:3], found[topic][:3], strict=True):
            assert equal(plain(one), plain(other)), topic


def test_the_metadata_names_each_topics_quality_of_service(path):
    information = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert information["storage_identifier"] == "mcap" and information["duration"]["nanoseconds"] == 900_000_000
    topics = {each["topic_metadata"]["name"]: each for each in information["topics_with_message_count"]}
    for name, topic in messages.topics(SENSORS).items():
        assert topics[name]["topic_metadata"]["type"] == topic.kind
        (quality,) = topics[name]["topic_metadata"]["offered_qos_profiles"]
        assert quality["reliability"] == "reliable" and quality["history"] == "keep_last"
        assert quality["depth"] == topic.depth
        assert quality["durability"] == ("transient_local" if topic.latched else "volatile")
    assert {name for name, topic in messages.TOPICS.items() if topic.latched} == {"/tf_static", "/map", "/goal_pose"}


def same(one, other):
    return (
        type(one) is type(other)
        and np.array_equal(one, other)
        and getattr(one, "dtype", 0) == getattr(other, "dtype", 0)
    )


def test_a_bag_gives_the_episode_back(noted, path):
    about, episode = bag.read(path)
    assert TaskConfig(**about.config) == CONFIG and about.agent == "goal"
    for field in dataclasses.fields(episode):
        one, other = getattr(episode, field.name), getattr(noted.episode, field.name)
        if field.name == "qpos":  # without the wheels
            one, other = one[:, :16], other[:, :16]
        if field.name != "actions":
            assert same(one, other), field.name


def test_an_episode_played_again_by_its_actions_is_the_same(noted):
    class Nobody:
        def snap(self, *told):
            pass

        end = snap

    again = replayed(noted.episode, CONFIG, LocalTrack(SENSORS), lambda session, index: Nobody())
    assert all(same(getattr(again, f.name), getattr(noted.episode, f.name)) for f in dataclasses.fields(again))


def run(capsys, *words):
    code = cli.main(list(words))
    return code, capsys.readouterr()


def test_what_is_recorded_scores_as_what_is_evaluated_bit_for_bit(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    task = ["--agent", "goal", "--suite", "smoke", "--episodes", "3", *SETS]
    assert run(capsys, "evaluate", *task, "--videos", "0", "--record", "--out", "scored")[0] == 0
    assert run(capsys, "record", *task, "--twist", "--out", "bags")[0] == 0
    scored = benchmark.Results.load("scored")
    assert {path.name for path in pathlib.Path("bags").iterdir()} == {f"seed-{seed}" for seed in scored.seed}
    code, said = run(capsys, "replay", "bags", "--out", "again")
    again = benchmark.Results.load("again")
    assert code == 0 and all(f"SNS {row['SNS']!r}" in said.out for row in scored.content["episodes"])
    assert again.rows == scored.rows and again.summary == scored.summary
    assert again.content["suite_digest"] == scored.content["suite_digest"]
    assert again.content["task_digest"] == scored.content["task_digest"]
    order = scored.seed[np.argsort(scored.metrics["SNS"], kind="stable")]
    ends = sorted(f"seed-{seed}" for seed in (order[0], order[-1]))
    assert sorted(path.name for path in pathlib.Path("scored/bags").iterdir()) == ends
    part = benchmark.replay(["scored/bags"])
    assert part.rows == {key: scored.rows[key] for key in part.rows} and len(part.rows) == 2
    command = by_topic(pathlib.Path("bags", ends[0]))["/cmd_vel"][0][1]
    assert type(command).__name__.endswith("geometry_msgs__msg__Twist")
    (pathlib.Path("scored/bags") / "mine").mkdir()
    assert run(capsys, "evaluate", *task[:5], "1", *SETS, "--videos", "0", "--out", "scored")[0] == 0
    assert [path.name for path in pathlib.Path("scored/bags").iterdir()] == ["mine"]  # the old ones belong to nothing


def refused(capsys, *words):
    """The one line with which a command is refused."""
    code, said = run(capsys, *words)
    (line,) = [line for line in said.err.splitlines() if "error" in line]
    assert code == 2
    return line


def test_a_damaged_bag_is_refused_in_one_line(tmp_path, path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def copied(name, change):
        shutil.copytree(path, name)
        change(pathlib.Path(name))
        return refused(capsys, "replay", name)

    def cut(folder):
        content = (folder / "seed-7.mcap").read_bytes()
        (folder / "seed-7.mcap").write_bytes(content[: len(content) // 2])

    def foreign(folder):
        text = (folder / "metadata.yaml").read_text()
        (folder / "metadata.yaml").write_text(text.replace("bson:", "other:"))

    def newer(folder):
        text = (folder / "metadata.yaml").read_text()
        (folder / "metadata.yaml").write_text(text.replace('"format": 1', '"format": 2'))

    def edited(folder):
        text = (folder / "metadata.yaml").read_text()
        (folder / "metadata.yaml").write_text(text.replace('"agent": "goal"', '"agent": "vfh"'))

    def unsigned(key, value):
        """As of an earlier version, without digests, and by another hand."""

        def change(folder):
            content = yaml.safe_load((folder / "metadata.yaml").read_text())
            custom = content["rosbag2_bagfile_information"]["custom_data"]
            about = {**json.loads(custom["bson"]), key: value}
            custom["bson"] = json.dumps({k: v for k, v in about.items() if k not in ("digest", "messages")})
            (folder / "metadata.yaml").write_text(yaml.safe_dump(content))

        return change

    assert "other metadata" in copied("edited", edited)
    assert "key 'period': a number above 0" in copied("still", unsigned("period", 0.0))
    assert "different numbers of people: 2, 3" in copied("fewer", unsigned("lcf", [0.0, 0.0]))
    assert "'cut'" in (line := copied("cut", cut)) and "cut short" in line
    assert "no episode" in copied("foreign", foreign) and "format 1" in copied("newer", newer)
    assert "cut short" in copied("gone", lambda folder: (folder / "seed-7.mcap").unlink())
    assert "cut short" in copied("garbled", lambda folder: (folder / "metadata.yaml").write_text("[["))
    assert "no bag" in refused(capsys, "replay", "nothing")
    shutil.copytree(path, "several/seed-7")
    shutil.copytree(path, "several/seed-8")
    pathlib.Path("several/seed-8/metadata.yaml").unlink()  # as of a recorder that was killed
    for given in ("several", "several/seed-8"):
        assert "seed-8' has no metadata.yaml: it was cut short" in refused(capsys, "replay", given)
    assert "two bags" in refused(capsys, "replay", str(path), str(path))


def test_a_topic_of_another_type_or_with_messages_missing_is_refused(tmp_path, path, monkeypatch):
    from rosbags.rosbag2 import StoragePlugin, Writer

    def filtered(name, keep, kinds=None, change=None):
        """A copy of the bag without what `keep` refuses, with the other types `kinds`, and messages of the topic
        change[0] changed by change[1]."""
        target = tmp_path / name
        with Reader(path) as reader, Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            for key, value in reader.storage.metadata.custom.items():
                writer.set_custom_data(key, value)
            there = {
                one.topic: writer.add_connection(one.topic, (kinds or {}).get(one.topic, one.msgtype), typestore=STORE)
                for one in reader.connections
                if keep(one.topic, None)
            }
            for connection, time, data in reader.messages():
                if change and connection.topic == change[0]:
                    message = STORE.deserialize_cdr(data, connection.msgtype)
                    change[1](message)
                    data = STORE.serialize_cdr(message, connection.msgtype)
                if keep(connection.topic, time):
                    writer.write(there[connection.topic], time, data)
        return target

    def changed(topic, change):
        return filtered(f"changed{topic.replace('/', '-')}", lambda topic, _: True, None, (topic, change))

    cases = [
        (filtered("typed", lambda topic, _: True, {"/odom": "sensor_msgs/msg/Imu"}), "sensor_msgs/msg/Imu on /odom"),
        (filtered("poor", lambda topic, _: topic != "/episode"), "no topic /episode"),
        (filtered("early", lambda topic, time: time is None or time < 500_000_000), "5 of 10 messages of"),
        (changed("/odom", lambda said: setattr(said.pose.pose.position, "x", 1.0)), "other messages on /odom"),
        (changed("/cmd_vel", lambda said: setattr(said.twist.linear, "x", 1.0)), "other messages on /cmd_vel"),
    ]
    for target, said in cases:
        with pytest.raises(UsageError, match=said):
            bag.read(target)
    assert bag.read(filtered("small", lambda topic, _: topic in bag._SCORED))[1].seed == 7


def test_a_missing_extra_and_a_full_folder_are_refused_before_anything_is_played(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there" / "seed-7").mkdir(parents=True)
    assert "there is" in refused(capsys, "record", "--seed", "7", "--out", "there").lower()
    assert "--suite" in refused(capsys, "record", "--episodes", "1", "--out", "new")
    with monkeypatch.context() as patch:
        for name in [name for name in sys.modules if name.split(".")[0] == "rosbags"]:
            patch.delitem(sys.modules, name)
        patch.setitem(sys.modules, "rosbags", None)
        for words in (["record", "--out", "new"], ["evaluate", "--record", "--out", "new"], ["replay", "there"]):
            assert "pip install 'bson-macid[record]'" in refused(capsys, *words) or words[0] == "replay"
    assert not (tmp_path / "new").exists()


def test_an_agent_that_fails_leaves_no_bag(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "late.py").write_text(
        "class agent:\n    def __init__(self):\n        self.steps = 0\n    def __call__(self, observation):\n"
        "        self.steps += 1\n        return [1.0, 0.0] if self.steps < 4 else 1 / 0\n"
    )
    assert "ZeroDivisionError" in refused(capsys, "record", "--agent", "late.py", *SETS, "--out", "new")
    assert [file.name for file in tmp_path.iterdir() if file.name != "__pycache__"] == ["late.py"]


def test_what_a_killed_recorder_left_goes_with_the_next_recording_and_nothing_else_does(tmp_path):
    for name in (".seed-3.381def3a/seed-3/seed-3.mcap", ".seed-4.381def3a/seed-4.mcap", ".mine.381def3a/seed-3.mcap"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_bytes(b"half a bag")
    record(tmp_path, CONFIG.replace(horizon=1), (Imu(),))
    assert {path.name for path in tmp_path.iterdir()} == {"seed-7", ".mine.381def3a"}


def test_a_sensor_without_a_message_is_told(tmp_path, capsys):
    class Odd(Sensor):
        pass

    assert messages.unknown([Odd(key="odd"), Imu()]) == ["odd"]
