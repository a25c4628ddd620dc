"""ROS 2: a robot behind any link as a robot of ROS, and a policy that drives one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    HostOptions,
    LidarArg,
    RecordOptions,
    RobotArg,
)

RosArgs = Annotated[tuple[str, ...], tyro.conf.arg(metavar="ARGUMENT [ARGUMENT ...]")]


@dataclass(frozen=True)
class NodeOptions:
    """The node."""

    namespace: str = ""
    """Of the node, such as /robot1."""
    ros_args: RosArgs = ()
    """ROS's own arguments, such as -r __node:=name; the last option, as in ROS."""


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
) -> int:
    """Drive a robot, real or simulated, as a node of ROS 2.

    It takes cmd_vel, and publishes odom, tf, joint_states, scan and diagnostics. A simulation
    publishes /clock as well, and is put into a scene by its service reset.

    Args:
        node: namespace and arguments of the node.
        loop: simulated time, priority.
        recording: recording of what the robot does.
        link: serial device, planar, bullet or mujoco; default: the robot's serial_port.
        robot: preset or config file.
        lidar: such as rplidar:///dev/ttyUSB1; simulated, where the link is.
    """
    from acsar_gym.tools.ros import driver  # noqa: PLC0415

    if not loop.realtime > 0.0:
        raise ConfigError(f"--realtime {loop.realtime:g}: must be positive")
    HostOptions(loop.priority, without_estop=loop.without_estop).prepare(link or None)
    driver.drive_node(
        RobotConfig.of(robot),
        link,
        lidar or "",
        node.namespace,
        node.ros_args,
        loop.realtime,
        recording.recorder("ros driver", link=link),
    )
    return 0
