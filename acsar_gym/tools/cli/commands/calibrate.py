"""The command `calibrate`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, escape_unprintable
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    File,
    Force,
    HostOptions,
    LidarArg,
    RecordOptions,
    RobotArg,
    WorldFileOptions,
    Worlds,
    check_not_given,
    check_writable,
    countdown,
    print_results,
    say,
)
from acsar_gym.tools.sysid.calibration_options import Manoeuvres, RunOptions

if TYPE_CHECKING:
    from acsar_gym.tools.sysid.calibrate import CalibrationJob, DrivenRobot
    from acsar_gym.tools.sysid.calibration_drive import RunPlan

Device = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE|FILE")]
Manoeuvre = Annotated[
    Literal["straight", "turn", "square", "all"],
    tyro.conf.Positional,
    tyro.conf.arg(metavar="straight|turn|square|all"),
]


@dataclass(frozen=True)
class CalibrationSetup(RecordOptions, WorldFileOptions):
    """The robot, who measures, and recording."""

    robot: RobotArg = None
    """Preset or config file: what is known so far; default: the robot of the runs in the file, else
    acsar."""
    twin: RobotArg = None
    """Simulation: the robot that is driven, where it isn't --robot: a hidden one to be found."""
    world: Worlds = None
    """Simulation: world around the robot, for --lidar."""
    lidar: LidarArg = None
    """Measure by scan matching instead of a tape: MODEL:///dev/ttyUSB1, or simulated."""
    tape: float = 0.005
    """Divisions of the tape [m]."""
    protractor: float = 1.0
    """Divisions of the protractor [degrees]."""


@dataclass(frozen=True)
class CalibrationOutputs:
    """Results."""

    runs: File = None
    """Keep the runs in this file, and fit all runs in it together; readings may be given later
    with this file as DEVICE. With --yes nobody waits for a reading between runs: drive one run at
    a time (--repeats 1), measure, then drive the next."""
    out: File = None
    """Write what was found into this robot's file, to be used as --robot; if it exists, its
    comments stay, and what was not found. Only where runs have readings."""
    json: File = None
    """Also write the result and all runs to this file."""
    force: Force = False


@command("calibrate", "robots", drives=True)
def calibrate_robot(
    device: Device,
    manoeuvre: Manoeuvre,
    what: Manoeuvres,
    run: RunOptions,
    wire: CalibrationSetup,
    host: HostOptions,
    output: CalibrationOutputs,
) -> int:
    """Measure wheel radii and turning on the floor, and write them into the robot's file.

    The robot drives within --space, and you measure with a tape where the point below its centre
    ended: it asks after each run (in scripts: --measured, --measured-deg, --corners). Lengths are
    positive; right turns are positive or negative. A LiDAR, or
    in simulation the truth, can measure instead. With --runs FILE, straight lines, turns and
    squares are fitted together, as robots with unequal wheels need.

    Args:
        device: serial device, planar, bullet, mujoco; or runs that were driven before, to give
            readings to: a .json file of --runs, or an .mcap file of --record.
        manoeuvre: what to drive.
        what: manoeuvres.
        run: driving.
        wire: robot and measuring.
        host: process priority and cores; whether the emergency stop may be missing.
        output: results.
    """
    from acsar_gym.physics.bodies import BODIES  # noqa: PLC0415
    from acsar_gym.recording import read  # noqa: PLC0415
    from acsar_gym.tools.sysid import calibrate, calibration_runs  # noqa: PLC0415

    check_writable(output.json, robot=output.out, force=output.force)
    check_writable(output.runs, force=True)  # runs are added to it
    of_file, of_recording = device.endswith(".json"), device.endswith(".mcap")
    kept_in = Path(device) if of_file else output.runs
    if not (0.0 < wire.tape <= 1.0 and 0.0 < wire.protractor <= 90.0):
        raise ConfigError("--tape must be 0 to 1 m, --protractor 0 to 90 degrees, both above 0")
    if of_file or of_recording:
        driving = (wire.twin, wire.world, wire.lidar, wire.record, wire.view)
        options = ("--twin", "--world", "--lidar", "--record", "--view")
        check_not_given(zip(options, driving, strict=True))
    known = None
    if wire.robot is None and of_recording:
        known = read(Path(device)).config
    elif wire.robot is None and kept_in is not None and kept_in.exists():
        known = calibration_runs.read_robot(kept_in)
    config, given = known or RobotConfig.of(wire.robot), what.given()
    scales = calibrate.ReadingScales(wire.tape, wire.protractor)
    ask = _ask_reading if sys.stdin.isatty() else None
    job = calibrate.CalibrationJob(config, given, scales, kept_in, ask, known=of_file)
    if of_recording:
        job.add(calibration_runs.read_recorded_runs(Path(device), manoeuvre, config))
    elif not of_file:
        twin = config if wire.twin is None else RobotConfig.of(wire.twin)
        host.prepare(device)
        recorder = wire.recorder("calibrate", link=device)
        world = wire.place(wire.world)
        robot = calibrate.DrivenRobot(device, config, twin, wire.lidar, world, recorder)
        for option, value in (("--twin", wire.twin), ("--world", wire.world)):
            if value is not None and not robot.simulated:
                raise ConfigError(f"{option} is for simulated robots: {' or '.join(BODIES)}")
        plans = what.plans(manoeuvre, config, run, given)
        job.drive(robot, plans, run.space, lambda plan: _announce_run(robot, run, plan))
    job.read(manoeuvre)
    return _finish_calibration(job, config, kept_in, output)


def _finish_calibration(
    job: CalibrationJob, config: RobotConfig, kept_in: Path | None, output: CalibrationOutputs
) -> int:
    """Fit, print and write; returns the exit code."""
    from acsar_gym.tools.sysid import calibration_fit  # noqa: PLC0415

    for line in job.notes:
        say(line)
    fit = job.fit()
    data = calibration_fit.format_calibration(fit, job.found, config)
    if fit is None:
        print_results(json=output.json, data=data)
        hint = "no run has a reading: nothing was found"
        if kept_in is not None:
            option = {"straight": "--measured", "turn": "--measured-deg", "square": "--corners"}
            names = sorted({run.manoeuvre for run in job.found})
            hints = (f"acsar-gym calibrate {kept_in} {name} {option[name]} ..." for name in names)
            hint = f"{len(job.found)} runs kept in {kept_in}; readings: {' or '.join(hints)}"
        say(hint)
        if output.out is not None:
            say(f"{output.out} isn't written: there are no readings yet")
        return 0
    tables = (
        calibration_fit.runs_table(job.found, fit, config),
        calibration_fit.calibration_table(fit, config),
    )
    print_results(*tables, json=output.json, data=data)
    if output.out is not None:
        calibration_fit.make_calibrated_config(fit, config).save(output.out, force=output.force)
        say(f"written: {output.out}; use it with --robot {output.out}")
    return 0


def _announce_run(robot: DrivenRobot, run: RunOptions, plan: RunPlan) -> None:
    """Ask before a real robot drives; say what is driven."""
    asks = sys.stdin.isatty() and not run.yes
    if not (robot.simulated or run.yes or asks):
        countdown(f"{robot.url}: the robot would drive", yes=False)  # says to add --yes
    say(f"{plan.name} ...")
    if not robot.simulated:
        x, y = run.space or (0.0, 0.0)
        start = "leave the robot where it is" if plan.back else "put the robot on its start mark"
        if asks:
            room = f"with {x:g} m free ahead and {y:g} m to each side"
            _ask_reading(f"{start}, {room}, then press Enter")
        countdown(f"{robot.url}: the robot will drive: {plan.name}", yes=run.yes)


def _ask_reading(question: str) -> str:
    """Ask on the terminal; an end of the input is an empty answer."""
    try:
        return input(f"{escape_unprintable(question)}: ")
    except EOFError:
        return ""
