"""Commands for one robot, real or emulated: emulate, doctor, drive, estop."""

from __future__ import annotations

import signal
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, EmergencyStopError
from acsar_gym.tools.cli.options import (
    BoardArgs,
    File,
    HostArgs,
    Json,
    RobotArg,
    Seconds,
    SpinArgs,
    SpinOptions,
    TimingArgs,
    TimingOptions,
    Worlds,
    ask_user,
    check_out,
    countdown,
)
from acsar_gym.tools.cli.recording import RecordArgs

if TYPE_CHECKING:
    from acsar_gym.tools.doctor.checks import Check
    from acsar_gym.tools.doctor.commission import Commission
    from acsar_gym.tools.emulation.board import Emulator
    from acsar_gym.worlds import World

Device = Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE")]


def emulate_board(
    board: BoardArgs,
    robot: RobotArg = None,
    body: str = "planar",
    log: File = None,
    duration: Seconds = None,
    world: Worlds = None,
    lidar: bool = False,
    name: File = None,
) -> int:
    """Run an emulated board on a pseudo-terminal and print its device path.

    SIGUSR1 unplugs the cable, SIGUSR2 plugs it in again as another device.

    Args:
        board: how the board behaves.
        robot: preset or config file of the emulated robot.
        body: physics, planar or bullet.
        log: write commands and true poses to this file, one JSON line each.
        duration: seconds to run; default: until Ctrl-C.
        world: world with the robot at its start: a file, or a generated world like clutter:7-7.
        lidar: also emulate an RPLIDAR, on a pseudo-terminal of its own.
        name: symbolic link that always points to the current device.
    """
    from acsar_gym.tools.emulation.board import Emulator  # noqa: PLC0415

    config = RobotConfig.of(robot)
    with Emulator(
        config,
        body=body,
        log=log,
        silent=board.silent,
        world=_first(world, config),
        sees=lidar,
        name=name,
        quirks=board.quirk,
    ) as emulator:
        _serve(emulator, duration)
    return 0


def _serve(emulator: Emulator, duration: float | None) -> None:
    """Run an emulator for a while [s], or until a signal ends it, and say where it is."""
    ended = _handle_signals(emulator)
    print(f"serving a robot on {emulator.device}", flush=True)
    if emulator.lidar_device:
        print(f"serving a LiDAR on {emulator.lidar_device}", flush=True)
    emulator.run(duration, until=lambda: bool(ended))
    if emulator.lost:
        print(f"stood still for {emulator.lost:.1f} s in all: this computer was too busy")


def _first(worlds: str | None, config: RobotConfig) -> World | None:
    """Return the first of some worlds, None for none."""
    from acsar_gym.worlds.pool import Pool  # noqa: PLC0415
    from acsar_gym.worlds.search import footprint_radius  # noqa: PLC0415

    if worlds is None:
        return None
    pool = Pool.of(worlds, None, footprint_radius(config), 1)
    return next(iter(pool)) if pool else None


def _handle_signals(emulator: Emulator) -> list[int]:
    """Install the signal handlers of `emulate`; the list receives SIGTERM's number.

    A list, because an exception raised in a signal handler can be lost. Shells let background
    programs of a script ignore SIGINT; an emulator obeys it there, too.
    """
    ended: list[int] = []
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, lambda number, _: ended.append(number))
    for number, plugged in ((signal.SIGUSR1, False), (signal.SIGUSR2, True)):
        signal.signal(number, lambda *_, to=plugged: setattr(emulator, "plugged", to))
    return ended


def examine_robot(
    timing: TimingArgs,
    spinning: SpinArgs,
    host: HostArgs,
    device: Device = None,
    robot: RobotArg = None,
    baud_rate: int | None = None,
    json: Json = None,
) -> int:
    """List the serial ports, examine one, and say what to fix.

    Args:
        timing: timing of the control loop.
        spinning: turning of the wheels, and recording.
        host: process priority and cores.
        device: serial device to examine; without it, ports are only listed.
        robot: preset or config file.
        baud_rate: overrides the baud rate of the robot; a slow one lowers its control_rate, too.
        json: also write the findings to this file.
    """
    from acsar_gym.tools.doctor import wire  # noqa: PLC0415
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    config = RobotConfig.of(robot)
    if baud_rate is not None:
        config = wire.at_baud_rate(config, baud_rate)
    device = device or config.serial_port
    report.check_writable(json)
    host.prepare()
    if timing.timing:
        return _timing(device, config, timing, json)
    return _checks(device, config, json, spinning)


def _checks(
    device: str | None, config: RobotConfig, json: Path | None, spinning: SpinOptions
) -> int:
    """Run the checks of the serial port; returns the exit code."""
    from acsar_gym.tools.doctor import checks, wire  # noqa: PLC0415
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    commission, stop = _commission(device, spinning), None
    found = [checks.check_ports(device), checks.check_estop()]
    if device is not None:
        recorder = spinning.recorder("doctor", link=device)
        stop = _extend(found, wire.examine_device(device, config, commission, recorder))
    if commission is not None and spinning.out is not None:
        if commission.finished:
            found.append(commission.save(config, spinning.out))
        else:
            said = f"{spinning.out} isn't written: not all was found"
            found.append(
                checks.Check("robot file", "skip", said, "mend what failed, and start again")
            )
    report.print_tables(checks.draw_checks(found))
    report.write_json(json, checks.checks_as_json(found))
    if stop is not None:
        raise stop
    return 1 if any(check.status == "fail" for check in found) else 0


def _extend(found: list[Check], more: Iterable[Check]) -> EmergencyStopError | None:
    """Collect results; returns the emergency stop that ended them, None for none."""
    try:
        found.extend(more)
    except EmergencyStopError as error:
        return error
    return None


def _commission(device: str | None, options: SpinOptions) -> Commission | None:
    """Count down, and return what is to be found by turning wheels; None without --spin."""
    from acsar_gym.tools.doctor.commission import (  # noqa: PLC0415
        Commission,
        parse_all_seen,
    )

    if not options.spin:
        if options.out is not None or options.saw is not None:
            raise ConfigError("--out and --saw need --spin, which turns the wheels")
        return None
    if device is None:
        raise ConfigError("--spin needs a device, such as /dev/ttyUSB0")
    check_out(options.out)
    eyes = None if options.saw is None else parse_all_seen(options.saw)
    asks = eyes is None and not options.yes
    countdown(f"the wheels of the robot on {device} will turn: lift it", yes=options.yes)
    return Commission(eyes=eyes, ask=ask_user if asks else None)


def _timing(
    device: str | None, config: RobotConfig, options: TimingOptions, json: Path | None
) -> int:
    """Run --timing; returns the exit code."""
    from acsar_gym.tools.doctor import timing  # noqa: PLC0415
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    found = timing.examine_timing(device, config, options.duration)
    report.print_tables(*found.tables())
    report.write_json(json, found.as_dict())
    return 0


def drive_robot(
    host: HostArgs,
    recording: RecordArgs,
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
        link: bullet, planar, or a serial device.
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
