"""ROS 2: a robot behind any link as a robot of ROS, and a policy that drives one."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from acsar_gym.errors import ConfigError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.commands.evaluate import report_run
from acsar_gym.tools.cli.options import (
    EnvArg,
    HostOptions,
    LidarArg,
    RecordOptions,
    ResultOptions,
    RobotArg,
    RosArgs,
    countdown,
)

if TYPE_CHECKING:
    from acsar_gym.tools.policies import FilePolicy


@dataclass(frozen=True)
class NodeOptions:
    """The node."""

    namespace: str = ""
    """Of the node, such as /robot1."""
    ros_args: RosArgs = ()
    """ROS's own, up to the end or to --, such as -p wheel_radius:=0.06."""


@dataclass(frozen=True)
class LoopOptions:
    """The control loop."""

    realtime: float = 1.0
    """How fast simulated time passes, in parts of real time."""
    priority: Annotated[int | None, tyro.conf.arg(metavar="PRIORITY")] = None
    """Real-time priority (SCHED_FIFO), 1 to 98."""
    without_estop: bool = False
    """Drive real wheels even where 'acsar-gym estop' couldn't stop them."""


@command("ros driver", "robots", drives=True)
def drive_ros_robot(
    node: NodeOptions,
    loop: LoopOptions,
    recording: RecordOptions,
    link: str = "",
    robot: RobotArg = None,
    lidar: LidarArg = None,
    scene: str = "",
) -> int:
    """Drive a robot, real or simulated, as a node of ROS 2.

    It takes cmd_vel, and publishes odom, tf, joint_states, scan and diagnostics. A simulation
    publishes /clock as well, and is put into a scene by its service reset. Parameters of the node
    that have the names of options count less.

    Args:
        node: namespace and arguments of the node.
        loop: simulated time, priority.
        recording: recording of what the robot does.
        link: serial device, planar, bullet or mujoco; default: the robot's serial_port.
        robot: preset or config file.
        lidar: such as rplidar:///dev/ttyUSB1; simulated, where the link is.
        scene: of a simulated robot, such as clutter:7, or a world's file.
    """
    from acsar_gym.tools.ros import driver  # noqa: PLC0415

    if not loop.realtime > 0.0:
        raise ConfigError(f"--realtime {loop.realtime:g}: must be positive")
    options = {"robot": robot, "link": link, "lidar": lidar, "scene": scene}
    with contextlib.closing(driver.RobotNode(options, node.namespace, node.ros_args)) as driven:
        HostOptions(loop.priority, without_estop=loop.without_estop).prepare(
            driven.link or "serial"
        )
        recorder = recording.recorder("ros driver", link=driven.link)
        driver.DrivenRobot(driven, loop.realtime, recorder).run()
    return 0


@dataclass(frozen=True)
class RosPolicyOptions:
    """The policy."""

    policy: str = ""
    """ONNX file, name of a packaged policy, or a Python function such as mine.py:act; default: that
    of the node's parameter policy, or point_goal."""
    trust: bool = False
    """Allow a stable-baselines3 zip, which can run code: only zips from people you trust."""
    env: EnvArg = ""
    """Overrides the env that the policy names: point_goal, ..., or mine.module:mine/Task-v0."""
    anyway: bool = False
    """Drive a real robot of another size or speed than the robots of the training."""


@dataclass(frozen=True)
class RosRobotOptions(RecordOptions):
    """The robot, recording, and which drives count."""

    robot: RobotArg = None
    """Preset or config file; default: that of the node's parameter robot, or acsar."""
    lidar: LidarArg = None
    """If the policy needs a LiDAR; default: ros2, the robot's topic scan."""
    late_share: float = 1.0
    """Largest share of late ticks in a valid episode; default: any."""


@dataclass(frozen=True)
class RosGoalOptions:
    """The goals."""

    goal: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="X Y")] = None
    """A first goal, from where the robot stands [m]: x forward, y to the left."""
    goal_distance: Annotated[
        tuple[float, float] | None, tyro.conf.arg(metavar="NEAREST FARTHEST")
    ] = None
    """How near and how far goals may be [m]; default: as in training."""
    episodes: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """End after so many goals; default: never."""
    once: bool = False
    """End after one goal."""
    yes: bool = False
    """Drive to --goal without a countdown."""

    @property
    def count(self) -> int | None:
        """How many goals there are; None for no end. ConfigError for less than one."""
        if self.episodes is not None and self.episodes < 1:
            raise ConfigError(f"--episodes {self.episodes}: must be at least 1")
        if self.once and self.episodes not in (None, 1):
            raise ConfigError(f"--once, --episodes {self.episodes}: leave out one of them")
        return 1 if self.once else self.episodes


@command("ros policy", "robots", drives=True)
def drive_ros_policy(
    policy: RosPolicyOptions,
    robot: RosRobotOptions,
    goals: RosGoalOptions,
    node: NodeOptions,
    host: HostOptions,
    output: ResultOptions,
) -> int:
    """Drive a robot of ROS 2 with a policy to the goals of goal_pose, one after the other.

    A new goal replaces the previous one, and the service ~/cancel ends it. The yaw of a goal isn't
    used. It publishes plan.

    Args:
        policy: the policy.
        robot: robot, LiDAR, and recording.
        goals: the goals.
        node: namespace and arguments of the node; the robot is in the same namespace.
        host: process priority and cores; whether the emergency stop may be missing.
        output: results in a file.
    """
    from acsar_gym.tools.evaluation.episodes import check_late_share  # noqa: PLC0415
    from acsar_gym.tools.ros import policy as ros_policy  # noqa: PLC0415

    count = goals.count
    check_late_share(robot.late_share)
    if goals.goal is not None and not all(map(math.isfinite, goals.goal)):
        raise ConfigError(f"--goal {goals.goal[0]:g} {goals.goal[1]:g}: must be finite numbers")
    output.check()

    def ready(loaded: FilePolicy, link: str) -> dict[str, Any]:
        loaded.anyway = policy.anyway
        host.prepare(link)
        if goals.goal is not None:
            countdown(f"the robot on {link} will drive", yes=goals.yes)
        recorder = robot.recorder("ros policy", link=link, policy=loaded.about)
        return {"record": recorder, "goal_distance": goals.goal_distance}

    options = {
        "policy": policy.policy,
        "env": policy.env,
        "robot": robot.robot or "",
        "lidar": robot.lidar or "",
    }
    name, link, done = ros_policy.drive_policy(
        options,
        ready,
        namespace=node.namespace,
        arguments=node.ros_args,
        goal=goals.goal,
        count=count,
        how={"late_share": robot.late_share},
        trust=policy.trust,
    )
    title = f"{name} to goals, worlds: {done.worlds}"
    return report_run(title, link, done, output.json, to_goal=True)
