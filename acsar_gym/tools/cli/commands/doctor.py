"""The command `doctor`: examines ports, board and computer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, EmergencyStopError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    File,
    HostOptions,
    RecordOptions,
    ResultOptions,
    RobotArg,
    check_writable,
    countdown,
    print_results,
)

if TYPE_CHECKING:
    from acsar_gym.tools.commission.checks import Check

Device = Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE")]


@dataclass(frozen=True)
class SpinOptions(RecordOptions):
    """Turning of the wheels, and recording."""

    spin: bool = False
    """Turn the wheels, one after the other and together, to find how they are wired: lift the
    robot!"""
    yes: bool = False
    """Turn them without a countdown."""
    saw: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="A B C D")] = None
    """The wheel that was seen to turn (a front right, b front left, c rear left, d rear right) when
    the board's wheel letters a, b, c, d were commanded forward, such as b a d c; with an n behind
    one that turned backward, none if none did. It counts where the robot's file says otherwise:
    --out writes it."""
    out: File = None
    """Write what was found to differ into this robot's file; if it exists, its comments stay."""


@command("doctor", "robots", drives=True)
def examine_robot(
    spinning: SpinOptions,
    host: HostOptions,
    output: ResultOptions,
    device: Device = None,
    robot: RobotArg = None,
    baud_rate: int | None = None,
) -> int:
    """List the serial ports, examine one, and say what to fix.

    With ros2 or ros2:/NAMESPACE as device it examines a robot in ROS 2: its topics and clock.

    Args:
        spinning: turning of the wheels, and recording.
        host: process priority and cores; whether the emergency stop may be missing.
        output: results in a file.
        device: serial device to examine, or ros2; without it, ports are only listed.
        robot: preset or config file.
        baud_rate: overrides the baud rate of the robot; a slow one lowers its control_rate, too.
    """
    from acsar_gym.tools.commission import device as serial_device  # noqa: PLC0415

    config = RobotConfig.of(robot)
    if baud_rate is not None:
        config = serial_device.at_baud_rate(config, baud_rate)
    device = device or config.serial_port
    output.check()
    if device is not None and (device == "ros2" or device.startswith("ros2:")):
        serial = (
            ("--spin", spinning.spin),
            ("--saw", spinning.saw),
            ("--out", spinning.out),
            ("--baud-rate", baud_rate),
        )
        if given := [option for option, value in serial if value]:
            raise ConfigError(f"{', '.join(given)}: not of a robot in ROS, only of serial devices")
        host.prepare()
        return _examine_ros(device, config, output, spinning)
    host.prepare(device if spinning.spin else None)
    return _run_checks(device, config, output, spinning)


def _examine_ros(
    device: str, config: RobotConfig, output: ResultOptions, spinning: SpinOptions
) -> int:
    """Run the checks of a robot in ROS; returns the exit code."""
    from acsar_gym.tools.commission import checks, ros_robot  # noqa: PLC0415

    found = [checks.check_estop()]
    found.extend(ros_robot.examine_ros(device, config, spinning.recorder("doctor", link=device)))
    return _print_checks(found, output)


def _run_checks(
    device: str | None, config: RobotConfig, output: ResultOptions, spinning: SpinOptions
) -> int:
    """Run the checks of the serial port; returns the exit code."""
    from acsar_gym.tools.commission import board_checks, checks, wiring  # noqa: PLC0415
    from acsar_gym.tools.commission.device import examine_device  # noqa: PLC0415

    board = board_checks.BoardExamination(config, spin=spinning.spin)
    if spinning.spin:
        if device is None:
            raise ConfigError("--spin needs a device, such as /dev/ttyUSB0")
        check_writable(robot=spinning.out, force=output.force)
        if spinning.saw is not None:
            board.seen = wiring.parse_seen(spinning.saw)
        countdown(
            f"the wheels a, b, c, d of the robot on {device} will turn one after the other, then "
            "all together: lift it, and note which wheel turns for each letter",
            yes=spinning.yes,
        )
    elif spinning.out is not None or spinning.saw is not None:
        raise ConfigError("--out and --saw need --spin, which turns the wheels")

    stop = None
    rows = [checks.check_ports(device), checks.check_estop()]
    if device is not None:
        recorder = spinning.recorder("doctor", link=device)
        try:
            rows.extend(examine_device(device, config, board.run, recorder))
        except EmergencyStopError as error:
            stop = error
    if spinning.out is not None:
        rows.append(board.save(spinning.out, force=output.force))
    code = _print_checks(rows, output)
    if stop is not None:
        raise stop
    return code


def _print_checks(found: Sequence[Check], output: ResultOptions) -> int:
    """Print what was found; returns the exit code."""
    from acsar_gym.tools.commission import checks  # noqa: PLC0415

    print_results(
        checks.draw_checks(found),
        json=output.json,
        data={"checks": [asdict(check) for check in found]},
    )
    return 1 if any(check.status == "fail" for check in found) else 0
