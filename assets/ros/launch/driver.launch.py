"""A real robot as a robot of ROS 2.

ros2 launch acsar_gym driver.launch.py link:=/dev/ttyUSB0 robot:=/home/me/my_robot.yaml
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PARAMS = PathJoinSubstitution([FindPackageShare("acsar_gym"), "config", "driver.yaml"])
ARGUMENTS = [
    DeclareLaunchArgument("params", default_value=PARAMS, description="parameter file"),
    DeclareLaunchArgument("link", default_value="", description="serial device; else by params"),
    DeclareLaunchArgument("robot", default_value="", description="preset or file; else by params"),
    DeclareLaunchArgument("lidar", default_value="", description="LiDAR's URL; else by params"),
    DeclareLaunchArgument("namespace", default_value="", description="of the node"),
]


def generate_launch_description() -> LaunchDescription:
    """Return what ros2 launch starts."""
    driver = Node(
        package="acsar_gym",
        executable="driver",
        namespace=LaunchConfiguration("namespace"),
        arguments=[
            [f"--{option}=", LaunchConfiguration(option)] for option in ("link", "robot", "lidar")
        ],
        parameters=[LaunchConfiguration("params")],
        output="screen",
    )
    return LaunchDescription([*ARGUMENTS, driver])
