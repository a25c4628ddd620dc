"""A policy that drives a robot of ROS 2 to the goals of goal_pose.

ros2 launch acsar_gym policy.launch.py policy:=obstacle_goal
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PARAMS = PathJoinSubstitution([FindPackageShare("acsar_gym"), "config", "policy.yaml"])
ARGUMENTS = [
    DeclareLaunchArgument("params", default_value=PARAMS, description="parameter file"),
    DeclareLaunchArgument("policy", default_value="", description="name or file; else by params"),
    DeclareLaunchArgument("robot", default_value="", description="preset or file; else by params"),
    DeclareLaunchArgument("lidar", default_value="", description="LiDAR's URL; else by params"),
    DeclareLaunchArgument("namespace", default_value="", description="of the robot and the node"),
]


def generate_launch_description() -> LaunchDescription:
    """Return what ros2 launch starts."""
    policy = Node(
        package="acsar_gym",
        executable="policy",
        namespace=LaunchConfiguration("namespace"),
        arguments=[
            [f"--{option}=", LaunchConfiguration(option)] for option in ("policy", "robot", "lidar")
        ],
        parameters=[LaunchConfiguration("params")],
        output="screen",
    )
    return LaunchDescription([*ARGUMENTS, policy])
