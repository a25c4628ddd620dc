"""ROS 2: a robot behind any link as a robot of ROS, and a policy that drives a robot of ROS."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from acsar_gym.errors import ConfigError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.commands.policies import PolicyOptions, report_run
from acsar_gym.tools.cli.options import (
    Count,
    Goal,
    GoalDistance,
    LidarArg,
    RecordOptions,
    ResultOptions,
    RobotArg,
    RosArgs,
    check_stoppable,
    countdown,
)

if TYPE_CHECKING:
    from acsar_gym.tools.policies import FilePolicy


@dataclass(frozen=True)
class NodeOptions:
    """The node."""

    namespace: str = ""
    """Namespace of the node, such as /robot1."""
    ros_args: RosArgs = ()
    """Arguments of ROS, up to the end or to --, such as -p wheel_radius:=0.06."""


@command("ros driver", drives=True)
def drive_ros_robot(
    node: NodeOptions,
    recording: RecordOptions,
    link: str = "",
    robot: RobotArg = None,
    lidar: LidarArg = None,
    scene: str = "",
    realtime: float = 1.0,
) -> int:
    """Drive a robot, real or simulated, as a node of ROS 2.

    It takes cmd_vel, and publishes odom, tf, joint_states, scan and diagnostics. A simulation
    publishes /clock as well, and is put into a scene by its service reset. Parameters of the node
    that have the names of options count less.

    Args:
        node: Namespace and arguments of the node.
        recording: Recording of what the robot does.
        link: Serial device, planar, bullet or mujoco. Default: the robot's serial_port.
        robot: Preset or config file.
        lidar: LiDAR such as rplidar:///dev/ttyUSB1, or simulated if the link is.
        scene: Scene of a simulated robot, such as clutter:7, or a world's file.
        realtime: How fast simulated time passes, as a factor of real time.
    """
    from acsar_gym.tools.ros import driver

    if not realtime > 0.0:
        raise ConfigError(f"--realtime {realtime:g}: must be positive")
    # Empty options leave it to the node's parameters.
    options = {"robot": robot, "link": link, "lidar": lidar, "scene": scene}
    with contextlib.closing(driver.RobotNode(options, node.namespace, node.ros_args)) as driven:
        check_stoppable(driven.link or "serial")
        recorder = recording.recorder(link=driven.link)
        driver.DrivenRobot(driven, realtime, recorder).run()
    return 0


@dataclass(frozen=True)
class RosPolicyOptions(PolicyOptions):
    """The policy."""

    policy: str = ""
    """ONNX file, name of a packaged policy, or a Python function such as mine.py:act. Default: that
    of the node's parameter policy, or point_goal."""


@dataclass(frozen=True)
class RosGoalOptions:
    """The goals."""

    goal: Goal = None
    """A first goal, from the robot's place [m]: x forward, y to the left."""
    goal_distance: GoalDistance = None
    """How near and how far goals may be [m]. Default: as in training."""
    episodes: Count = None
    """End after this number of goals. Default: never."""
    yes: bool = False
    """Drive to --goal without a countdown."""

    def check(self) -> None:
        """Raise ConfigError for values that can't be."""
        if self.episodes is not None and self.episodes < 1:
            raise ConfigError(f"--episodes {self.episodes}: must be at least 1")
        if self.goal is not None and not all(map(math.isfinite, self.goal)):
            raise ConfigError(f"--goal {self.goal[0]:g} {self.goal[1]:g}: must be finite numbers")


@command("ros policy", drives=True)
def drive_ros_policy(
    policy: RosPolicyOptions,
    goals: RosGoalOptions,
    node: NodeOptions,
    recording: RecordOptions,
    output: ResultOptions,
    robot: RobotArg = None,
    lidar: LidarArg = None,
) -> int:
    """Drive a robot of ROS 2 with a policy to the goals of goal_pose, one after the other.

    A new goal replaces the previous goal, and the service ~/cancel ends it. The yaw of a goal isn't
    used. It publishes plan.

    Args:
        policy: The policy.
        goals: The goals.
        node: Namespace and arguments of the node. The robot is in the same namespace.
        recording: Recording and viewer.
        output: Results in a file.
        robot: Preset or config file. Default: that of the node's parameter robot, or acsar.
        lidar: if the policy needs a LiDAR. Default: ros2, the robot's topic scan.
    """
    from acsar_gym.tools.ros import policy as ros_policy

    goals.check()
    output.check()

    def ready(loaded: FilePolicy, link: str) -> dict[str, Any]:
        loaded.anyway = policy.anyway
        check_stoppable(link)
        if goals.goal is not None:
            countdown(f"the robot on {link} will drive", yes=goals.yes)
        recorder = recording.recorder(link=link, policy=loaded.about)
        return {"record": recorder, "goal_distance": goals.goal_distance}

    options = {
        "policy": policy.policy,
        "env": policy.env,
        "robot": robot or "",
        "lidar": lidar or "",
    }
    name, link, run = ros_policy.drive_policy(
        options,
        ready,
        namespace=node.namespace,
        arguments=node.ros_args,
        goal=goals.goal,
        count=goals.episodes,
        how={"late_share": 1.0},
        trust=policy.trust,
    )
    title = f"{name} to goals, worlds: {run.worlds}"
    return report_run(title, link, run, output, to_goal=True)
