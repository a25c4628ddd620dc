"""The commands `drive`, and `estop`, which `acsar_gym.__main__` runs without this file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import CommandError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    HostOptions,
    LidarArg,
    RecordOptions,
    RobotArg,
    Seconds,
)


@dataclass(frozen=True)
class DriverOptions:
    """Who drives; default: the keyboard."""

    linear: float | None = None
    """Fixed linear speed, at most the robot's max_linear [m/s]."""
    angular: float | None = None
    """Fixed angular speed, at most the robot's max_angular [rad/s]."""
    duration: Seconds = None
    """Seconds to drive with the fixed twist; default: until Ctrl-C."""
    gamepad: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="[DEVICE]")] = None
    """A gamepad (Linux), while LB is held: the first one found, or that event device, such as a
    name of /dev/input/by-id."""

    def check(self) -> None:
        """Raise CommandError where there are two drivers."""
        if self.gamepad is None:
            return
        if len(self.gamepad) > 1 or (self.linear, self.angular, self.duration) != (None,) * 3:
            raise CommandError(
                "--gamepad takes one device, and no --linear, --angular or --duration beside it"
            )


@command("drive", "robots", drives=True)
def drive_robot(
    driver: DriverOptions,
    host: HostOptions,
    recording: RecordOptions,
    link: str = "bullet",
    robot: RobotArg = None,
    lidar: LidarArg = None,
    window: bool = False,
) -> int:
    """Drive with the keyboard, a gamepad, or a fixed twist, on any link.

    Args:
        driver: who drives.
        host: process priority and cores; whether the emergency stop may be missing.
        recording: recording of what the robot does.
        link: bullet, planar, mujoco, or a serial device.
        robot: preset or config file.
        lidar: a LiDAR to record, such as rplidar:///dev/ttyUSB1; simulated, where the link is.
        window: open PyBullet's window.
    """
    from acsar_gym.links import open_link  # noqa: PLC0415
    from acsar_gym.robot import Robot  # noqa: PLC0415
    from acsar_gym.sensors.suite import sensor_factories  # noqa: PLC0415
    from acsar_gym.tools import teleop  # noqa: PLC0415

    driver.check()
    host.prepare(link)
    config = RobotConfig.of(robot)
    opened = open_link(link, config, window=window, realtime=True)
    sensors = sensor_factories(["lidar"], lidar) if lidar else ()
    driven = Robot(opened, config, sensors, recorder=recording.recorder("drive", link=link))
    if driver.gamepad is not None:
        teleop.drive_gamepad(driven, *driver.gamepad)
    elif driver.linear is None and driver.angular is None:
        teleop.drive_keyboard(driven)
    else:
        teleop.drive_twist(driven, driver.linear or 0.0, driver.angular or 0.0, driver.duration)
    return 0


@command("estop", "robots")
def stop_robots(release: bool = False) -> int:
    """Stop all real robots that your programs on this computer are driving.

    They stay stopped, whatever their programs do, until --release.

    Args:
        release: let them drive again, after their programs' next reset.
    """
    from acsar_gym.guard import estop  # noqa: PLC0415

    return estop.run_command(release=release)
