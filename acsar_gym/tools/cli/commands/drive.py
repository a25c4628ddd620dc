"""The commands `drive`, and `estop`, which `acsar_gym.__main__` runs without this file."""

from __future__ import annotations

from typing import Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import CommandError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    LidarArg,
    RecordOptions,
    RobotArg,
    Seconds,
    check_stoppable,
)


@command("drive", drives=True)
def drive_robot(
    recording: RecordOptions,
    link: str = "bullet",
    robot: RobotArg = None,
    lidar: LidarArg = None,
    window: bool = False,
    linear: float | None = None,
    angular: float | None = None,
    duration: Seconds = None,
    gamepad: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="[DEVICE]")] = None,
) -> int:
    """Drive with the keyboard, a gamepad, or a fixed twist, on any link.

    Args:
        recording: Recording and viewer.
        link: bullet, planar, mujoco, or a serial device.
        robot: Preset or config file.
        lidar: A LiDAR to record, such as rplidar:///dev/ttyUSB1, or simulated if the link is.
        window: Open PyBullet's window.
        linear: Fixed linear speed, at most the robot's max_linear [m/s].
        angular: Fixed angular speed, at most the robot's max_angular [rad/s].
        duration: Seconds to drive with the fixed twist. Default: until Ctrl-C.
        gamepad: A gamepad (Linux), while LB is held: the first gamepad, or an event device, such
            as a name of /dev/input/by-id.
    """
    from acsar_gym.links import open_link
    from acsar_gym.robot import Robot
    from acsar_gym.sensors.suite import sensor_factories
    from acsar_gym.tools import teleop

    fixed = (linear, angular, duration)
    if gamepad is not None and (len(gamepad) > 1 or fixed != (None, None, None)):
        raise CommandError("--gamepad takes one device, and no --linear, --angular or --duration")
    check_stoppable(link)
    config = RobotConfig.of(robot)
    opened = open_link(link, config, window=window, realtime=True)
    sensors = sensor_factories(["lidar"], lidar) if lidar else ()
    driven = Robot(opened, config, sensors, recorder=recording.recorder("drive", link=link))
    if gamepad is not None:
        teleop.drive_gamepad(driven, *gamepad)
    elif linear is None and angular is None:
        teleop.drive_keyboard(driven)
    else:
        teleop.drive_twist(driven, linear or 0.0, angular or 0.0, duration)
    return 0


@command("estop")
def stop_robots(release: bool = False) -> int:
    """Stop all real robots that your programs on this computer are driving.

    They stay stopped, whatever their programs do, until --release.

    Args:
        release: Let them drive again, after their programs' next reset.
    """
    from acsar_gym.guard import estop

    return estop.run_command(release=release)
