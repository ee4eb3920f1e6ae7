"""Nav2 drives a robot among BSON's people: ros2 launch bson_nav2.launch.py seed:=7

It needs a ROS 2 Jazzy with Nav2, and this project in the Python of that ROS (python3 -m venv --system-site-packages).
BSON's world takes the place of the robot, its sensors, the map server and the localisation. A Nav2 stack can't be run
in this project's tests: they hold only that the topics, frames, footprint and limits beside this file are BSON's. To
score Nav2 on a suite, launch it with world:=false, beside `bson evaluate --agent ros --real-time --suite smoke`: Nav2
sends commands at its own pace.
"""

import pathlib

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription, Shutdown
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

HERE = pathlib.Path(__file__).parent


def generate_launch_description():
    """The world, and Nav2 without its own map server and localisation."""
    seed, world = LaunchConfiguration("seed"), LaunchConfiguration("world")
    navigation = pathlib.Path(get_package_share_directory("nav2_bringup"), "launch", "navigation_launch.py")
    return LaunchDescription(
        [
            DeclareLaunchArgument("seed", default_value="7", description="the episode"),
            DeclareLaunchArgument("world", default_value="true", description="whether to run BSON's world, too"),
            ExecuteProcess(
                cmd=["bson", "ros", "--real-time", "--seed", seed],
                output="screen",
                condition=IfCondition(world),
                on_exit=Shutdown(),
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(str(navigation)),
                launch_arguments={"use_sim_time": "true", "params_file": str(HERE / "nav2_params.yaml")}.items(),
            ),
            # Nav2 hears no goal before it is active: the reset tells the goal again.
            # ros2 service call /bson/reset std_srvs/srv/Trigger
        ]
    )
