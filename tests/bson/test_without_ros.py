"""What can be told of ROS 2 where it is missing, and of the example for Nav2, which can't be run here."""

import ast
import pathlib
import sys

import yaml

from bson import cli
from bson.interfaces import messages
from bson.robot import load_robot
from bson.sensors import Imu, Lidar2D
from macid.state import GOAL_RADIUS

NAV2 = pathlib.Path(__file__).parents[1] / "examples" / "nav2"


def test_commands_that_need_ros_say_what_to_install(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "rclpy", None)
    for words in (["ros"], ["deploy"], ["evaluate", "--agent", "ros"], ["record", "--agent", "ros", "--out", "o"]):
        assert cli.main(words) == 2
        (line,) = capsys.readouterr().err.splitlines()[-1:]
        assert "rosbags" in line or ("pip install 'bson-macid[ros]'" in line and "setup.bash" in line), line
    assert not list(tmp_path.iterdir())


def values(content, name):
    """All values of the key `name` in nested dicts."""
    if not isinstance(content, dict):
        return []
    return [
        found
        for key, value in content.items()
        for found in ([value] if key == name else values(value, name))
    ]  # fmt: skip


def test_the_example_for_nav2_names_the_worlds_topics_frames_and_the_jackals_limits():
    content, robot = yaml.safe_load((NAV2 / "nav2_params.yaml").read_text()), load_robot("jackal").config
    topics = messages.topics((Imu(), Lidar2D()))
    for key in ("odom_topic", "topic", "map_topic", "cmd_vel_out_topic"):
        assert values(content, key) and set(values(content, key)) <= set(topics)
    frames = {messages.MAP, messages.ODOM, messages.BASE}
    for key in ("global_frame", "robot_base_frame", "local_frame", "base_frame_id", "odom_frame_id"):
        assert values(content, key) and set(values(content, key)) <= frames
    assert all(values(content, "use_sim_time")) and all(values(content, "enable_stamped_cmd_vel"))
    for footprint in map(ast.literal_eval, values(content, "footprint")):
        assert {tuple(map(abs, corner)) for corner in footprint} == {(robot.half_length, robot.half_width)}
    assert values(content, "vx_max") == [robot.max_speed] and values(content, "wz_max") == [robot.max_yaw_rate]
    assert values(content, "max_velocity") == [[robot.max_speed, 0.0, robot.max_yaw_rate]]
    assert values(content, "xy_goal_tolerance")[0] < GOAL_RADIUS
    launch = ast.parse((NAV2 / "bson_nav2.launch.py").read_text())
    words = [node.value for node in ast.walk(launch) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    assert "nav2_params.yaml" in words and "generate_launch_description" in {
        node.name for node in ast.walk(launch) if isinstance(node, ast.FunctionDef)
    }
    told = ["ros", "--real-time", "--seed", "7"]  # what it runs
    assert set(told[:-1]) <= set(words) and cli.parser().parse_args(told).seed == 7
