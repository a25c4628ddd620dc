"""The command `doctor`: examines ports, board and computer."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, EmergencyStopError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    File,
    RecordOptions,
    ResultOptions,
    RobotArg,
    check_stoppable,
    check_writable,
    countdown,
    print_results,
)

if TYPE_CHECKING:
    from acsar_gym.tools.commission.board_checks import BoardExamination

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
    the board's wheel letters a, b, c, d were commanded forward, such as b a d c, with an n behind
    a wheel that turned backward, none if none did. It counts if the robot's file differs: --out
    writes it."""
    out: File = None
    """Write differences that were found into this robot's file. If it exists, its comments stay."""

    def prepare(self, board: BoardExamination, device: str | None) -> None:
        """Check that wheels may turn, and count down, if they shall turn."""
        from acsar_gym.tools.commission.wiring import parse_seen

        if not self.spin:
            if self.out is not None or self.saw is not None:
                raise ConfigError("--out and --saw need --spin, which turns the wheels")
            return
        if device is None:
            raise ConfigError("--spin needs a device, such as /dev/ttyUSB0")
        check_stoppable(device)
        check_writable(robot=self.out)
        if self.saw is not None:
            board.seen = parse_seen(self.saw)
        countdown(
            f"the wheels a, b, c, d of the robot on {device} will turn one after the other, then "
            "all together: lift it, and note which wheel turns for each letter",
            yes=self.yes,
        )


@command("doctor", drives=True)
def examine_robot(
    spinning: SpinOptions,
    output: ResultOptions,
    device: Device = None,
    robot: RobotArg = None,
    baud_rate: int | None = None,
) -> int:
    """List the serial ports, examine one, and report what to fix.

    With ros2 or ros2:/NAMESPACE as device it examines a robot in ROS 2: its topics and clock.

    Args:
        spinning: Turning of the wheels, and recording.
        output: Results in a file.
        device: Serial device to examine, or ros2. Without it, ports are only listed.
        robot: Preset or config file.
        baud_rate: Overrides the baud rate of the robot. A slow one lowers its control_rate as well.
    """
    from acsar_gym.tools.commission import board_checks, checks
    from acsar_gym.tools.commission import device as serial_device
    from acsar_gym.tools.commission.ros_robot import examine_ros

    output.check()
    config = RobotConfig.of(robot)
    if baud_rate is not None:
        config = serial_device.at_baud_rate(config, baud_rate)
    device = device or config.serial_port
    in_ros = (device or "").partition(":")[0] == "ros2"
    if in_ros and (spinning.spin or baud_rate is not None):
        raise ConfigError("--spin, --baud-rate: not of a robot in ROS, only of serial devices")
    board = board_checks.BoardExamination(config, spin=spinning.spin)
    spinning.prepare(board, device)

    rows = [checks.check_estop()] if in_ros else [checks.check_ports(device), checks.check_estop()]
    stop = None
    if device is not None:
        recorder = spinning.recorder("doctor", link=device)
        try:
            if in_ros:
                rows.extend(examine_ros(device, config, recorder))
            else:
                rows.extend(serial_device.examine_device(device, config, board.run, recorder))
        except EmergencyStopError as error:
            stop = error
    if spinning.out is not None:
        rows.append(board.save(spinning.out))

    data = {"checks": [asdict(check) for check in rows]}
    print_results(checks.draw_checks(rows), json=output.json, data=data)
    if stop is not None:
        raise stop
    return int(any(check.status == "fail" for check in rows))
