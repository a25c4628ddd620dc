"""The commands `emulate`, `doctor` and `drive`, and `estop`, which `acsar_gym.__main__` runs."""

from __future__ import annotations

import signal
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import CommandError, ConfigError, EmergencyStopError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    File,
    LidarArg,
    RecordOptions,
    ResultOptions,
    RobotArg,
    Seconds,
    check_stoppable,
    check_writable,
    countdown,
)

if TYPE_CHECKING:
    from acsar_gym.tools.commission.board_checks import BoardExamination
    from acsar_gym.tools.emulation.board import Emulator


@command("emulate")
def emulate_board(
    robot: RobotArg = None,
    body: str = "planar",
    world: Annotated[str | None, tyro.conf.arg(metavar="KIND|PATH")] = None,
    key: float = 0.0,
    duration: Seconds = None,
    lidar: bool = False,
    silent: bool = False,
    log: File = None,
    name: File = None,
) -> int:
    """Run an emulated board on a pseudo-terminal and print its device path.

    SIGUSR1 unplugs the cable, SIGUSR2 plugs it in again as another device.

    Args:
        robot: Preset or config file of the emulated robot.
        body: Physics, planar, bullet or mujoco.
        world: World with the robot at its start: a file, or a generated world like clutter:7-7.
        key: The episode's draw, 0 to 1, on which the world's movers depend.
        duration: Seconds to run. Default: until Ctrl-C.
        lidar: Also emulate an RPLIDAR, on its own pseudo-terminal.
        silent: Never answer, as a board without power.
        log: Write commands and true poses to this file, one JSON line each.
        name: Symbolic link that always points to the current device.
    """
    from acsar_gym.tools.emulation.board import LOG_MARK, Emulator
    from acsar_gym.worlds import Scene
    from acsar_gym.worlds.pool import Pool
    from acsar_gym.worlds.search import footprint_radius, lidar_height

    check_writable(log, mark=LOG_MARK)
    # The robot's LiDAR sees a world of a file at its own height.
    config = RobotConfig.of(robot)
    scene = None
    if world is not None:
        height = lidar_height(config)
        pool = Pool.of(world, None, footprint_radius(config), alone="1", height=height)
        place = next(iter(pool))
        start = (place.start.x, place.start.y, place.start.theta or 0.0)
        scene = Scene(start, world=place, key=key)

    with Emulator(
        config, body=body, log=log, silent=silent, scene=scene, sees=lidar, name=name
    ) as emulator:
        _serve(emulator, duration)
    return 0


def _serve(emulator: Emulator, duration: float | None) -> None:
    """Run a board until a signal ends it."""
    # A list, because an exception that is raised in a signal handler can be lost.
    signals: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: signals.append(number))
    # Shells let background programs of a script ignore SIGINT, but an emulator obeys it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number, plugged in ((signal.SIGUSR1, False), (signal.SIGUSR2, True)):
        signal.signal(number, lambda *_, to=plugged: setattr(emulator, "plugged", to))

    print(f"serving a robot on {emulator.device}", flush=True)
    if emulator.lidar_device:
        print(f"serving a LiDAR on {emulator.lidar_device}", flush=True)
    emulator.run(duration, until=lambda: bool(signals))
    if emulator.lost:
        print(f"stood still for {emulator.lost:.1f} s in all: this computer was too busy")


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

        # Only turning wheels show how they are wired, so nothing is written without.
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
    """List the serial ports, examine a port, and report what to fix.

    With ros2 or ros2:/NAMESPACE as device it examines a robot in ROS 2: its topics and clock.

    Args:
        spinning: Turning of the wheels, and recording.
        output: Results in a file.
        device: Serial device to examine, or ros2. Without it, ports are only listed.
        robot: Preset or config file.
        baud_rate: Overrides the robot's baud rate. A slow rate lowers its control_rate as well.
    """
    from acsar_gym.tools.commission import board_checks, checks
    from acsar_gym.tools.commission import device as serial_device
    from acsar_gym.tools.commission.ros_robot import examine_ros

    output.check()
    config = RobotConfig.of(robot)
    if baud_rate is not None:
        config = serial_device.at_baud_rate(config, baud_rate)
    # A robot in ROS has topics instead of a port: the rows about ports don't apply.
    device = device or config.serial_port
    in_ros = (device or "").partition(":")[0] == "ros2"
    if in_ros and (spinning.spin or baud_rate is not None):
        raise ConfigError("--spin, --baud-rate: not of a robot in ROS, only of serial devices")
    # Nothing is opened before the countdown, so a cancelled command leaves the board as it was.
    board = board_checks.BoardExamination(config, spin=spinning.spin)
    spinning.prepare(board, device)

    rows = [checks.check_estop()] if in_ros else [checks.check_ports(device), checks.check_estop()]
    # An emergency stop ends the examination, but the rows so far are printed.
    stop = None
    if device is not None:
        recorder = spinning.recorder(link=device)
        try:
            if in_ros:
                rows.extend(examine_ros(device, config, recorder))
            else:
                rows.extend(serial_device.examine_device(device, config, board.run, recorder))
        except EmergencyStopError as error:
            stop = error
    # Whether the file was written is a row as well, with what is missing.
    if spinning.out is not None:
        rows.append(board.save(spinning.out))

    data = {"checks": [asdict(check) for check in rows]}
    output.print(checks.draw_checks(rows), data=data)
    if stop is not None:
        raise stop
    return int(any(check.status == "fail" for check in rows))


@command("drive", drives=True)
def drive_robot(
    recording: RecordOptions,
    link: str = "bullet",
    robot: RobotArg = None,
    lidar: LidarArg = None,
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

    # LB of the gamepad decides when it drives, so a fixed twist would contradict it.
    fixed = (linear, angular, duration)
    if gamepad is not None and (len(gamepad) > 1 or fixed != (None, None, None)):
        raise CommandError("--gamepad takes one device, and no --linear, --angular or --duration")
    check_stoppable(link)
    config = RobotConfig.of(robot)
    opened = open_link(link, config, realtime=True)
    sensors = sensor_factories(["lidar"], lidar) if lidar else ()
    driven = Robot(opened, config, sensors, recorder=recording.recorder(link=link))
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
