"""Commands for one robot, real or emulated: emulate, doctor, drive, estop."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, EmergencyStopError
from acsar_gym.tools.cli.options import (
    BoardOptions,
    File,
    HostOptions,
    RecordOptions,
    RobotArg,
    Seconds,
    SpinOptions,
    TimingOptions,
    Worlds,
    ask_user,
    check_writable,
    countdown,
    print_results,
)

if TYPE_CHECKING:
    from acsar_gym.tools.emulation.board import Emulator

Device = Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE")]


def emulate_board(
    board: BoardOptions,
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
        body: physics, planar, bullet or mujoco.
        log: write commands and true poses to this file, one JSON line each.
        duration: seconds to run; default: until Ctrl-C.
        world: world with the robot at its start: a file, or a generated world like clutter:7-7.
        lidar: also emulate an RPLIDAR, on a pseudo-terminal of its own.
        name: symbolic link that always points to the current device.
    """
    from acsar_gym.tools.emulation.board import Emulator  # noqa: PLC0415
    from acsar_gym.worlds.pool import Pool  # noqa: PLC0415
    from acsar_gym.worlds.search import footprint_radius  # noqa: PLC0415

    config, place = RobotConfig.of(robot), None
    if world is not None:
        place = next(iter(Pool.of(world, None, footprint_radius(config), 1) or ()), None)
    with Emulator(
        config,
        body=body,
        log=log,
        silent=board.silent,
        world=place,
        sees=lidar,
        name=name,
        quirks=board.quirk,
    ) as emulator:
        ended = _handle_signals(emulator)
        print(f"serving a robot on {emulator.device}", flush=True)
        if emulator.lidar_device:
            print(f"serving a LiDAR on {emulator.lidar_device}", flush=True)
        emulator.run(duration, until=lambda: bool(ended))
        if emulator.lost:
            print(f"stood still for {emulator.lost:.1f} s in all: this computer was too busy")
    return 0


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
    timing: TimingOptions,
    spinning: SpinOptions,
    host: HostOptions,
    device: Device = None,
    robot: RobotArg = None,
    baud_rate: int | None = None,
    json: File = None,
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

    config = RobotConfig.of(robot)
    if baud_rate is not None:
        config = wire.at_baud_rate(config, baud_rate)
    device = device or config.serial_port
    check_writable(json)
    host.prepare()
    if timing.timing:
        from acsar_gym.tools.doctor import timing as timings  # noqa: PLC0415

        timed = timings.examine_timing(device, config, timing.duration)
        print_results(*timed.tables(), json=json, data=timed.as_dict())
        return 0
    return _run_checks(device, config, json, spinning)


def _run_checks(
    device: str | None, config: RobotConfig, json: Path | None, spinning: SpinOptions
) -> int:
    """Run the checks of the serial port; returns the exit code."""
    from acsar_gym.tools.doctor import checks, commission, wire  # noqa: PLC0415

    turning, stop = None, None
    if spinning.spin:
        if device is None:
            raise ConfigError("--spin needs a device, such as /dev/ttyUSB0")
        check_writable(robot=spinning.out)
        eyes = None if spinning.saw is None else commission.parse_all_seen(spinning.saw)
        what = f"the wheels of the robot on {device} will turn: lift it"
        countdown(what, yes=spinning.yes)
        asks = eyes is None and not spinning.yes
        turning = commission.Commission(eyes=eyes, ask=ask_user if asks else None)
    elif spinning.out is not None or spinning.saw is not None:
        raise ConfigError("--out and --saw need --spin, which turns the wheels")
    found = [checks.check_ports(device), checks.check_estop()]
    if device is not None:
        recorder = spinning.recorder("doctor", link=device)
        try:
            found.extend(wire.examine_device(device, config, turning, recorder))
        except EmergencyStopError as error:
            stop = error
    if turning is not None and spinning.out is not None:
        if turning.finished:
            found.append(turning.save(config, spinning.out))
        else:
            said = f"{spinning.out} isn't written: not all was found"
            fix = "mend what failed, and start again"
            found.append(checks.Check("robot file", "skip", said, fix))
    print_results(checks.draw_checks(found), json=json, data=checks.checks_as_json(found))
    if stop is not None:
        raise stop
    return 1 if any(check.status == "fail" for check in found) else 0


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
