"""The commands `drive`, and `estop`, which `acsar_gym.__main__` runs without this file."""

from __future__ import annotations

from typing import Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    HostOptions,
    RecordOptions,
    RobotArg,
    Seconds,
)


@command("drive", "robots", drives=True)
def drive_robot(
    host: HostOptions,
    recording: RecordOptions,
    link: str = "bullet",
    robot: RobotArg = None,
    linear: float | None = None,
    angular: float | None = None,
    duration: Seconds = None,
    window: bool = False,
) -> int:
    """Drive with the keyboard, or with a fixed twist, on any link.

    Args:
        host: process priority and cores.
        recording: recording of what the robot does.
        link: bullet, planar, mujoco, or a serial device.
        robot: preset or config file.
        linear: fixed linear speed, at most the robot's max_linear [m/s].
        angular: fixed angular speed, at most the robot's max_angular [rad/s].
        duration: seconds to drive with the fixed twist; default: until Ctrl-C.
        window: open PyBullet's window.
    """
    from acsar_gym.links import open_link  # noqa: PLC0415
    from acsar_gym.robot import Robot  # noqa: PLC0415
    from acsar_gym.tools import teleop  # noqa: PLC0415

    config = RobotConfig.of(robot)
    opened = open_link(link, config, window=window, realtime=True)
    driver = Robot(opened, config, recorder=recording.recorder("drive", link=link))
    host.prepare()
    if linear is None and angular is None:
        teleop.drive_keyboard(driver)
    else:
        teleop.drive_twist(driver, linear or 0.0, angular or 0.0, duration)
    return 0


@command("estop", "robots")
def stop_robots(
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[NAME]")] = "",
    list: bool = False,  # noqa: A002 - the option's name
    release: bool = False,
) -> int:
    """Stop the real robots that programs of yours on this computer are driving, or one of them.

    They stay stopped, whatever their programs do, until --release.

    Args:
        name: device (/dev/ttyUSB0 or ttyUSB0), name in the robot's file, or process id; default:
            all robots.
        list: only list who drives which robot, and since when.
        release: let them drive again, after their programs' next reset.
    """
    from acsar_gym.safety import estop  # noqa: PLC0415

    return estop.run_command(name, listing=list, release=release)
