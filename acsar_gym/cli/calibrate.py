"""Command calibrate: wheel radii and multiplier, measured on the floor."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from acsar_gym.calibration.options import Manoeuvres, RunOptions
from acsar_gym.cli import asking
from acsar_gym.cli.options import File, Json, LidarArg, RobotArg, Worlds, check_out
from acsar_gym.cli.recording import RecordOptions
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, printable

if TYPE_CHECKING:
    from acsar_gym.calibration.manoeuvres import Plan
    from acsar_gym.calibration.readings import Scales
    from acsar_gym.calibration.session import Given, Wire
    from acsar_gym.calibration.sitting import Sitting

Device = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE|FILE")]
Manoeuvre = Annotated[
    Literal["straight", "turn", "square", "all"],
    tyro.conf.Positional,
    tyro.conf.arg(metavar="straight|turn|square|all"),
]
_flat = tyro.conf.arg(name="")


@dataclass(frozen=True)
class DeviceOptions(RecordOptions):
    """The robot, who measures, and recording."""

    robot: RobotArg = None
    """Preset or config file: what is known so far; default: the robot of the runs in the file, else
    acsar."""
    twin: RobotArg = None
    """Simulation: the robot that is driven, where it isn't --robot: a hidden one to be found."""
    world: Worlds = None
    """Simulation: world around the robot, for --lidar."""
    lidar: LidarArg = None
    """Measure by scan matching instead of a tape: rplidar:///dev/ttyUSB1, or simulated."""
    tape: float = 0.005
    """Divisions of the tape [m]."""
    protractor: float = 1.0
    """Divisions of the protractor [degrees]."""


@dataclass(frozen=True)
class OutputOptions:
    """Results."""

    runs: File = None
    """Keep the runs in this file, and fit all runs in it together; readings may be given later
    with this file as DEVICE. With --yes nobody waits for a reading between runs: drive one run at
    a time (--repeats 1), measure, then drive the next."""
    out: File = None
    """Write the robot's file with what was found, to be used as --robot; only where runs have
    readings."""
    json: Json = None
    """Also write the result and all runs to this file."""


def calibrate(
    device: Device,
    manoeuvre: Manoeuvre,
    what: Annotated[Manoeuvres, _flat],
    run: Annotated[RunOptions, _flat],
    wire: Annotated[DeviceOptions, _flat],
    output: Annotated[OutputOptions, _flat],
) -> int:
    """Measure wheel radii and turning on the floor, and write them into the robot's file.

    The robot drives within --space, and you measure with a tape where the point below its centre
    ended: it asks after each run (in scripts: --measured, --measured-deg, --corners). Lengths are
    positive; right turns are positive or negative. A LiDAR, or
    in simulation the truth, can measure instead. With --runs FILE, straight lines, turns and
    squares are fitted together, as robots with unequal wheels need.

    Args:
        device: serial device, planar, bullet; or runs that were driven before, to give readings
            to: a .json file of --runs, or an .mcap file of --record.
        manoeuvre: what to drive.
        what: manoeuvres.
        run: driving.
        wire: robot and measuring.
        output: results.
    """
    from acsar_gym.evaluation import report  # noqa: PLC0415

    check_out(output.out)
    for path in (output.json, output.runs):
        report.check_writable(path)
    config, given = _robot(device, wire.robot, output.runs), what.given()
    kept_in = Path(device) if device.endswith(".json") else output.runs
    sitting = _sitting(device, manoeuvre, config, given, _scales(wire), kept_in)
    if not device.endswith((".json", ".mcap")):
        robot = _wire(device, config, wire)
        plans = what.plans(manoeuvre, config, run, given)
        sitting.drive(robot, plans, run.space, partial(_before, robot, run))
    sitting.read(manoeuvre)
    return _finish(sitting, config, kept_in, output)


def _robot(device: str, robot: str | None, kept: Path | None) -> RobotConfig:
    """The robot that is named; else that of the runs, which a file keeps."""
    from acsar_gym.calibration import runs  # noqa: PLC0415
    from acsar_gym.recording import read  # noqa: PLC0415

    if robot is not None:
        return RobotConfig.of(robot)
    if device.endswith(".mcap"):
        return read(Path(device)).config
    path = Path(device) if device.endswith(".json") else kept
    known = runs.robot_of(path) if path is not None and path.exists() else None
    return RobotConfig.of(None) if known is None else known


def _sitting(
    device: str,
    manoeuvre: str,
    config: RobotConfig,
    given: Given,
    scales: Scales,
    kept_in: Path | None,
) -> Sitting:
    """Begin, with the runs of files."""
    from acsar_gym.calibration.recorded import runs_of  # noqa: PLC0415
    from acsar_gym.calibration.sitting import Sitting  # noqa: PLC0415

    ask = _ask if sys.stdin.isatty() else None
    sitting = Sitting(config, given, scales, kept_in, ask, known=device.endswith(".json"))
    if device.endswith(".mcap"):
        sitting.add(runs_of(Path(device), manoeuvre, config))
    return sitting


def _scales(wire: DeviceOptions) -> Scales:
    """The divisions of tape and protractor. ConfigError unless they are positive."""
    from acsar_gym.calibration.readings import Scales  # noqa: PLC0415

    if not (0.0 < wire.tape <= 1.0 and 0.0 < wire.protractor <= 90.0):
        raise ConfigError("--tape must be 0 to 1 m, --protractor 0 to 90 degrees, both above 0")
    return Scales(wire.tape, wire.protractor)


def _wire(device: str, config: RobotConfig, options: DeviceOptions) -> Wire:
    """The robot that is driven. ConfigError for options of a simulation on a real one."""
    from acsar_gym.calibration.session import Wire  # noqa: PLC0415

    twin = config if options.twin is None else RobotConfig.of(options.twin)
    recorder = options.recorder("calibrate", link=device)
    wire = Wire(device, config, twin, options.lidar, options.world, recorder)
    for option, value in (("--twin", options.twin), ("--world", options.world)):
        if value is not None and not wire.simulated:
            raise ConfigError(f"{option} is for simulated robots: planar or bullet")
    return wire


def _before(wire: Wire, run: RunOptions, plan: Plan) -> None:
    """Ask before a real robot drives; say what is driven."""
    if not (wire.simulated or run.yes or sys.stdin.isatty()):
        asking.countdown(f"{wire.url}: the robot would drive", yes=False)  # says to add --yes
    print(printable(f"{plan.name} ..."), flush=True)
    if not wire.simulated:
        x, y = run.space or (0.0, 0.0)
        start = "leave the robot where it is" if plan.back else "put the robot on its start mark"
        if sys.stdin.isatty() and not run.yes:
            _ask(f"{start}, with {x:g} m free ahead and {y:g} m to each side, then press Enter")
        asking.countdown(f"{wire.url}: the robot will drive: {plan.name}", yes=run.yes)


def _ask(question: str) -> str:
    """Ask on the terminal; an end of the input is an empty answer."""
    try:
        return input(f"{printable(question)}: ")
    except EOFError:
        return ""


def _finish(
    sitting: Sitting, config: RobotConfig, kept_in: Path | None, output: OutputOptions
) -> int:
    """Fit, print and write; returns the exit code."""
    from acsar_gym.calibration import result  # noqa: PLC0415
    from acsar_gym.evaluation import report  # noqa: PLC0415

    for line in sitting.notes:
        print(printable(line))
    fit = sitting.fit()
    report.write_json(output.json, result.as_dict(fit, sitting.found, config))
    if fit is None:
        print(printable(_waiting(sitting, kept_in)))
        if output.out is not None:
            print(printable(f"{output.out} isn't written: there are no readings yet"))
        return 0
    report.show(result.runs_table(sitting.found, fit, config), result.table(fit, config))
    if output.out is not None:
        result.calibrated(fit, config).save(output.out)
        print(printable(f"written: {output.out}; use it with --robot {output.out}"))
    return 0


def _waiting(sitting: Sitting, kept_in: Path | None) -> str:
    """What to do where no run has a reading yet."""
    if kept_in is None:
        return "no run has a reading: nothing was found"
    counts: Sequence[str] = sorted({run.manoeuvre for run in sitting.found})
    option = {"straight": "--measured", "turn": "--measured-deg", "square": "--corners"}
    hints = " or ".join(f"acsar-gym calibrate {kept_in} {m} {option[m]} ..." for m in counts)
    return f"{len(sitting.found)} runs kept in {kept_in}; readings: {hints}"
