"""Commands that measure a robot: identify, calibrate, gap, compare."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, escape_unprintable
from acsar_gym.tools.cli.options import (
    File,
    LidarArg,
    RecordOptions,
    RobotArg,
    Worlds,
    check_writable,
    countdown,
    print_results,
    say,
)
from acsar_gym.tools.sysid.calibration_options import Manoeuvres, RunOptions

if TYPE_CHECKING:
    from rich.table import Table

    from acsar_gym.recording import Recording
    from acsar_gym.tools.sysid.calibrate import CalibrationJob, DrivenRobot
    from acsar_gym.tools.sysid.calibration_drive import RunPlan

Device = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE|FILE")]
Manoeuvre = Annotated[
    Literal["straight", "turn", "square", "all"],
    tyro.conf.Positional,
    tyro.conf.arg(metavar="straight|turn|square|all"),
]
Sources = Annotated[
    tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE | LOG [LOG ...]")
]
Logs = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG [LOG ...]")]
Files = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE [FILE ...]")]
Limits = Annotated[tuple[str, ...], tyro.conf.arg(metavar="METRIC=VALUE [...]")]
First = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SIM")]
Second = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="REAL")]
UnfittedRobot = Annotated[str, tyro.conf.arg(metavar="PRESET|FILE|recorded")]
RobotFile = Annotated[str, tyro.conf.arg(metavar="PRESET|FILE")]
LATE_MANOEUVRE = 1.1
"""A manoeuvre that takes longer than this, as a share of its length, is worth a warning."""


@dataclass(frozen=True)
class IdentifySetup(RecordOptions):
    """The robot, and recording of the manoeuvre."""

    robot: RobotArg = None
    """Preset or config file: what is known so far. Default: the one recorded, or acsar."""
    twin: RobotArg = None
    """Simulation: the robot that is driven, a hidden one to be found."""
    quirk: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME [NAME ...]")] = ()
    """Simulation: how its board differs, as for emulate, such as backward-gain=0.85."""


@dataclass(frozen=True)
class IdentifyOutputs:
    """Results."""

    out: File = None
    """Write the robot's file with what was found, to be used as --robot."""
    anyway: bool = False
    """Write it even where the model doesn't fit: without intervals, and the file says so."""
    json: File = None
    """Also write the findings to this file."""


def identify_robot(
    sources: Sources,
    setup: IdentifySetup,
    output: IdentifyOutputs,
    duration: float = 20.0,
    yes: bool = False,
) -> int:
    """Find how motors and board answer, from what the wire carries, and write it to a robot's file.

    With a device, the wheels turn for 20 s with steps, slow staircases and a pause without
    commands: lift the robot! With recordings, whatever they hold is used. Either way it says
    first which parameters the log can't tell, and which manoeuvre is missing. Where the model of
    motors and board doesn't describe what was recorded, it says in which way, and writes no file.

    Args:
        sources: serial device, planar, bullet; or recordings of one robot, made with --record.
        setup: robot and recording.
        output: results.
        duration: of the manoeuvre [s].
        yes: don't ask before the wheels turn.
    """
    from acsar_gym.links import open_link  # noqa: PLC0415
    from acsar_gym.physics.bodies import BODIES  # noqa: PLC0415
    from acsar_gym.tools.emulation import quirks  # noqa: PLC0415
    from acsar_gym.tools.sysid import identify  # noqa: PLC0415

    check_writable(output.json, robot=output.out)
    if not sources:
        raise ConfigError("identify needs a device, or recordings made with --record")
    files = [Path(source).suffix == ".mcap" or Path(source).is_file() for source in sources]
    device, robot = sources[0], setup.robot
    if any(files) or len(sources) > 1:
        if not all(files):
            other = sources[files.index(False)]
            raise ConfigError(f"{other}: isn't a recording; give one device, or recordings only")
        known = None if robot is None else RobotConfig.of(robot)
        found = identify.identify_files([Path(source) for source in sources], known)
    else:
        config, simulated = RobotConfig.of(robot), device in BODIES
        if (setup.twin is not None or setup.quirk) and not simulated:
            raise ConfigError(f"--twin and --quirk are for simulated robots: {' or '.join(BODIES)}")
        if simulated:
            odd = quirks.parse_quirks(setup.quirk)
            twin = config if setup.twin is None else RobotConfig.of(setup.twin)
            link = quirks.make_link(device, quirks.apply_to_config(odd, twin), odd)
        else:
            link = open_link(device, config)
            what = f"{device}: the wheels will turn for {duration:g} s in both directions"
            countdown(f"{what}; lift the robot, so that they turn freely", yes=yes)
        recorder = setup.recorder("identify")
        found = identify.identify_device(link, config, duration, recorder)
        if late := describe_lateness(found.duration, duration, device):
            print(f"acsar-gym: {escape_unprintable(late)}", file=sys.stderr)
    print_results(identify.identification_table(found), json=output.json, data=found.as_dict())
    found.check(anyway=output.anyway)
    if found.dead:
        names = ", ".join(found.dead)
        say(f"{names} never turned: nothing of it was found; check motor and encoder")
    if output.out is not None:
        written = found.robot()
        written.save(output.out)
        say(f"written: {output.out}; use it with --robot {output.out}")
        if written.misfit:
            say(written.misfit)
    return 0


def describe_lateness(took: float, asked: float, device: str) -> str:
    """Say that a manoeuvre took longer than it should have, as this computer was too busy.

    Args:
        took: length of the log [s].
        asked: length of the manoeuvre [s].
        device: that was driven.

    Returns:
        One line; empty where it was in time.
    """
    if took <= LATE_MANOEUVRE * asked:
        return ""
    return (
        f"the manoeuvre took {took:.1f} s instead of {asked:g}: this computer was late, and the "
        f"figures are worse for it; stop other programs, see 'acsar-gym doctor {device} --timing', "
        "and drive again"
    )


@dataclass(frozen=True)
class CalibrationSetup(RecordOptions):
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
class CalibrationOutputs:
    """Results."""

    runs: File = None
    """Keep the runs in this file, and fit all runs in it together; readings may be given later
    with this file as DEVICE. With --yes nobody waits for a reading between runs: drive one run at
    a time (--repeats 1), measure, then drive the next."""
    out: File = None
    """Write the robot's file with what was found, to be used as --robot; only where runs have
    readings."""
    json: File = None
    """Also write the result and all runs to this file."""


def calibrate_robot(
    device: Device,
    manoeuvre: Manoeuvre,
    what: Manoeuvres,
    run: RunOptions,
    wire: CalibrationSetup,
    output: CalibrationOutputs,
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
    from acsar_gym.tools.sysid import calibrate, calibration_runs  # noqa: PLC0415

    check_writable(output.json, output.runs, robot=output.out)
    of_file, of_recording = device.endswith(".json"), device.endswith(".mcap")
    kept_in = Path(device) if of_file else output.runs
    if not (0.0 < wire.tape <= 1.0 and 0.0 < wire.protractor <= 90.0):
        raise ConfigError("--tape must be 0 to 1 m, --protractor 0 to 90 degrees, both above 0")
    config, given = _find_known_robot(device, wire.robot, kept_in), what.given()
    scales = calibrate.ReadingScales(wire.tape, wire.protractor)
    ask = _ask_reading if sys.stdin.isatty() else None
    job = calibrate.CalibrationJob(config, given, scales, kept_in, ask, known=of_file)
    if of_recording:
        job.add(calibration_runs.read_recorded_runs(Path(device), manoeuvre, config))
    elif not of_file:
        twin = config if wire.twin is None else RobotConfig.of(wire.twin)
        recorder = wire.recorder("calibrate", link=device)
        robot = calibrate.DrivenRobot(device, config, twin, wire.lidar, wire.world, recorder)
        for option, value in (("--twin", wire.twin), ("--world", wire.world)):
            if value is not None and not robot.simulated:
                raise ConfigError(f"{option} is for simulated robots: planar or bullet")
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
        calibration_fit.make_calibrated_config(fit, config).save(output.out)
        say(f"written: {output.out}; use it with --robot {output.out}")
    return 0


def _find_known_robot(device: str, robot: str | None, kept: Path | None) -> RobotConfig:
    """The robot that is named; else that of the runs, which a file keeps."""
    from acsar_gym.recording import read  # noqa: PLC0415
    from acsar_gym.tools.sysid import calibration_runs  # noqa: PLC0415

    if robot is not None:
        return RobotConfig.of(robot)
    if device.endswith(".mcap"):
        return read(Path(device)).config
    known = calibration_runs.read_robot(kept) if kept is not None and kept.exists() else None
    return RobotConfig.of(None) if known is None else known


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


@dataclass(frozen=True)
class GapOutputs:
    """What is written, and the limits that must be kept."""

    fail_over: Limits = ()
    """Limits in SI units; exit code 1 where one isn't kept. For gap such as wheel_speed_rms=0.5
    end_pose=0.05, for compare of the paired differences, such as success_rate=0.05."""
    json: File = None
    """Also write the figures to this file."""
    html: File = None
    """Also write a report with plots to this file."""

    def prepare(self, metrics: Sequence[str]) -> Any:
        """Check before the work begins that all can be written; returns the limits of metrics."""
        from acsar_gym.tools.evaluation import page  # noqa: PLC0415
        from acsar_gym.tools.sysid import twin_gap  # noqa: PLC0415

        limits = twin_gap.parse_limits(self.fail_over, metrics)
        check_writable(self.json, self.html)
        if self.html is not None:
            page.check_report_extra()
        return limits

    def write(self, table: Sequence[Table], lines: Sequence[str], data: Any, page: Any) -> None:
        """Print tables and lines, and write what is asked for; `page` makes the report."""
        print_results(*table, json=self.json, data=data)
        for line in lines:
            say(line)
        if self.html is not None:
            page().write(self.html)


def measure_gap(
    logs: Logs,
    robot: RobotFile,
    outputs: GapOutputs,
    before: UnfittedRobot = "acsar",
    body: str = "planar",
    truth: File = None,
) -> int:
    """Replay recorded commands through the twin, before and after fitting, and measure its gap.

    Figures are over the logs that the robot wasn't fitted to, if there are any.

    Args:
        logs: recordings of one robot, made with --record.
        robot: the fitted robot, such as the file that identify wrote.
        outputs: files and limits.
        before: the unfitted robot; a preset gets the wiring, the baud rate and the comma of the
            first recording; "recorded" is the robot in each recording.
        body: physics of the twins, planar or bullet.
        truth: log of the emulator that was recorded (emulate --log), with its true poses.
    """
    from acsar_gym.tools.sysid import pages, tracks, twin_gap  # noqa: PLC0415

    limits = outputs.prepare(twin_gap.LIMIT_NAMES)
    after = Path(robot).name, RobotConfig.of(robot)
    recordings = _read_logs(logs)
    if truth is not None:
        recordings = [(name, tracks.add_truth(log, truth)) for name, log in recordings]
    recorded, unfitted = recordings[0][1].config, None
    if before != "recorded":
        unfitted = RobotConfig.of(before)
        if not (Path(before).suffix or "/" in before):  # a preset
            wire = "wheels", "baud_rate", "trailing_comma"
            unfitted = unfitted.with_(**{field: getattr(recorded, field) for field in wire})
    found = twin_gap.measure_gap(recordings, after, (Path(before).name, unfitted), body)
    lines = [*twin_gap.conclude_gap(found), *found.notes]
    lines += [f"{after[0]}: {after[1].misfit}"] if after[1].misfit else []
    tables, data = twin_gap.gap_tables(found), twin_gap.format_gap(found)
    outputs.write(tables, lines, data, lambda: pages.gap_page(found))
    return _judge_limits(twin_gap.find_exceeded(limits, twin_gap.limit_sizes(found)))


def compare_runs(
    first: First,
    second: Second,
    outputs: GapOutputs,
    sim: Files = (),
    real: Files = (),
) -> int:
    """Compare recordings of a task in simulation and on hardware, episodes paired by seed.

    Args:
        first: recording of the simulation.
        second: recording of the robot.
        outputs: files and limits.
        sim: more recordings of the simulation.
        real: more recordings of the robot.
    """
    from acsar_gym.tools.sysid import pages, sim_real, twin_gap  # noqa: PLC0415

    limits = outputs.prepare((*sim_real.EPISODE_METRICS, "delay"))
    found = sim_real.compare_sides(_read_logs((first, *sim)), _read_logs((second, *real)))
    lines = [*sim_real.conclude_comparison(found), *found.notes]
    tables, data = [sim_real.comparison_table(found)], sim_real.format_comparison(found)
    outputs.write(tables, lines, data, lambda: pages.compare_page(found))
    return _judge_limits(twin_gap.find_exceeded(limits, sim_real.difference_sizes(found)))


def _read_logs(paths: Sequence[Path]) -> list[tuple[str, Recording]]:
    """Read recordings; ConfigError if one can't be read, or is named twice."""
    from acsar_gym.recording import read  # noqa: PLC0415

    if not paths:
        raise ConfigError("no recording is named: make one with --record FILE")
    logs = [(path.name, read(path)) for path in paths]
    seen: dict[str, str] = {}
    for name, log in logs:
        begun = str(log.header["created"])  # tells a cut copy, too
        if begun in seen:
            raise ConfigError(f"{name}: is the same recording as {seen[begun]}")
        seen[begun] = name
    return logs


def _judge_limits(failures: Sequence[str]) -> int:
    """Print limits that aren't kept; returns the exit code."""
    for line in failures:
        print(f"acsar-gym: {line}", file=sys.stderr)
    return 1 if failures else 0
