"""ROS 2: a robot behind any link as a robot of ROS, and a policy that drives one."""

from __future__ import annotations

import contextlib
import shlex
from dataclasses import dataclass
from typing import Annotated

import tyro

from acsar_gym.errors import ConfigError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    HostOptions,
    LidarArg,
    RecordOptions,
    RobotArg,
)

RosArgs = Annotated[
    tuple[str, ...],
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="ARGUMENT [ARGUMENT ...]",
        instance_from_str=lambda words: tuple(shlex.split(words[0])),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [shlex.join(value)],
    ),
]
"""ROS's own arguments, which `app.join_ros_arguments` has made one word."""


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
        scene: of a simulated robot, such as clutter:7-7, a world's file, or JSON.
    """
    from acsar_gym.tools.ros import driver  # noqa: PLC0415

    if not loop.realtime > 0.0:
        raise ConfigError(f"--realtime {loop.realtime:g}: must be positive")
    given = {"robot": robot, "link": link, "lidar": lidar, "scene": scene}
    with contextlib.closing(driver.RobotNode(given, node.namespace, node.ros_args)) as driven:
        HostOptions(loop.priority, without_estop=loop.without_estop).prepare(
            driven.link or "serial"
        )
        recorder = recording.recorder("ros driver", link=driven.link)
        driver.DrivenRobot(driven, loop.realtime, recorder).run()
    return 0
