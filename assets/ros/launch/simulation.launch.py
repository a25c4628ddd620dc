"""A simulated robot as a robot of ROS 2, and RViz.

ros2 launch acsar_gym simulation.launch.py link:=bullet scene:=clutter:7
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare("acsar_gym")
PARAMS = PathJoinSubstitution([SHARE, "config", "simulation.yaml"])
RVIZ = PathJoinSubstitution([SHARE, "rviz", "acsar.rviz"])
RVIZ_TOPICS = ("odom", "scan", "plan", "goal_pose")
ARGUMENTS = [
    DeclareLaunchArgument("params", default_value=PARAMS, description="parameter file"),
    DeclareLaunchArgument("link", default_value="", description="bullet, mujoco or planar"),
    DeclareLaunchArgument("robot", default_value="", description="preset or file; else by params"),
    DeclareLaunchArgument("lidar", default_value="", description="else by params"),
    DeclareLaunchArgument("scene", default_value="", description="clutter:7, or a file"),
    DeclareLaunchArgument("realtime", default_value="1.0", description="speed, 1.0 is real time"),
    DeclareLaunchArgument("namespace", default_value="", description="of the driver"),
    DeclareLaunchArgument("rviz", default_value="true", description="whether RViz starts"),
]


def generate_launch_description() -> LaunchDescription:
    """Return what ros2 launch starts."""
    driver = Node(
        package="acsar_gym",
        executable="driver",
        namespace=LaunchConfiguration("namespace"),
        arguments=[
            [f"--{option}=", LaunchConfiguration(option)]
            for option in ("link", "robot", "lidar", "scene", "realtime")
        ],
        parameters=[LaunchConfiguration("params")],
        output="screen",
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        namespace=LaunchConfiguration("namespace"),
        arguments=["-d", RVIZ],
        parameters=[{"use_sim_time": True}],
        remappings=[(f"/{topic}", topic) for topic in RVIZ_TOPICS],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([*ARGUMENTS, driver, rviz])
