"""Commands that measure a robot: identify, calibrate, gap, compare."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, escape_unprintable
from acsar_gym.tools.cli import options
from acsar_gym.tools.cli.options import File, Json, LidarArg, RobotArg, Worlds, check_out
from acsar_gym.tools.cli.recording import RecordArgs, RecordOptions
from acsar_gym.tools.sysid.calibration_options import Manoeuvres, RunOptions

if TYPE_CHECKING:
    from acsar_gym.tools.sysid.calibrate import (
        CalibrationJob,
        DrivenRobot,
        GivenReadings,
        ReadingScales,
    )
    from acsar_gym.tools.sysid.calibration_drive import RunPlan

CalibrationDevice = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE|FILE")]
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


def calibrate_robot(
    device: CalibrationDevice,
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
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    check_out(output.out)
    for path in (output.json, output.runs):
        report.check_writable(path)
    config, given = _known_robot(device, wire.robot, output.runs), what.given()
    kept_in = Path(device) if device.endswith(".json") else output.runs
    sitting = _begin_sitting(device, manoeuvre, config, given, _scales(wire), kept_in)
    if not device.endswith((".json", ".mcap")):
        robot = _make_wire(device, config, wire)
        plans = what.plans(manoeuvre, config, run, given)
        sitting.drive(robot, plans, run.space, partial(_before, robot, run))
    sitting.read(manoeuvre)
    return _finish_calibrate(sitting, config, kept_in, output)


def _known_robot(device: str, robot: str | None, kept: Path | None) -> RobotConfig:
    """The robot that is named; else that of the runs, which a file keeps."""
    from acsar_gym.recording import read  # noqa: PLC0415
    from acsar_gym.tools.sysid import calibration_runs  # noqa: PLC0415

    if robot is not None:
        return RobotConfig.of(robot)
    if device.endswith(".mcap"):
        return read(Path(device)).config
    path = Path(device) if device.endswith(".json") else kept
    known = calibration_runs.read_robot(path) if path is not None and path.exists() else None
    return RobotConfig.of(None) if known is None else known


def _begin_sitting(
    device: str,
    manoeuvre: str,
    config: RobotConfig,
    given: GivenReadings,
    scales: ReadingScales,
    kept_in: Path | None,
) -> CalibrationJob:
    """Begin, with the runs of files."""
    from acsar_gym.tools.sysid.calibrate import CalibrationJob  # noqa: PLC0415
    from acsar_gym.tools.sysid.calibration_runs import read_recorded_runs  # noqa: PLC0415

    ask = _ask_reading if sys.stdin.isatty() else None
    sitting = CalibrationJob(config, given, scales, kept_in, ask, known=device.endswith(".json"))
    if device.endswith(".mcap"):
        sitting.add(read_recorded_runs(Path(device), manoeuvre, config))
    return sitting


def _scales(wire: DeviceOptions) -> ReadingScales:
    """The divisions of tape and protractor. ConfigError unless they are positive."""
    from acsar_gym.tools.sysid.calibrate import ReadingScales  # noqa: PLC0415

    if not (0.0 < wire.tape <= 1.0 and 0.0 < wire.protractor <= 90.0):
        raise ConfigError("--tape must be 0 to 1 m, --protractor 0 to 90 degrees, both above 0")
    return ReadingScales(wire.tape, wire.protractor)


def _make_wire(device: str, config: RobotConfig, options: DeviceOptions) -> DrivenRobot:
    """The robot that is driven. ConfigError for options of a simulation on a real one."""
    from acsar_gym.tools.sysid.calibrate import DrivenRobot  # noqa: PLC0415

    twin = config if options.twin is None else RobotConfig.of(options.twin)
    recorder = options.recorder("calibrate", link=device)
    wire = DrivenRobot(device, config, twin, options.lidar, options.world, recorder)
    for option, value in (("--twin", options.twin), ("--world", options.world)):
        if value is not None and not wire.simulated:
            raise ConfigError(f"{option} is for simulated robots: planar or bullet")
    return wire


def _before(wire: DrivenRobot, run: RunOptions, plan: RunPlan) -> None:
    """Ask before a real robot drives; say what is driven."""
    if not (wire.simulated or run.yes or sys.stdin.isatty()):
        options.countdown(f"{wire.url}: the robot would drive", yes=False)  # says to add --yes
    print(escape_unprintable(f"{plan.name} ..."), flush=True)
    if not wire.simulated:
        x, y = run.space or (0.0, 0.0)
        start = "leave the robot where it is" if plan.back else "put the robot on its start mark"
        if sys.stdin.isatty() and not run.yes:
            _ask_reading(
                f"{start}, with {x:g} m free ahead and {y:g} m to each side, then press Enter"
            )
        options.countdown(f"{wire.url}: the robot will drive: {plan.name}", yes=run.yes)


def _ask_reading(question: str) -> str:
    """Ask on the terminal; an end of the input is an empty answer."""
    try:
        return input(f"{escape_unprintable(question)}: ")
    except EOFError:
        return ""


def _finish_calibrate(
    sitting: CalibrationJob, config: RobotConfig, kept_in: Path | None, output: OutputOptions
) -> int:
    """Fit, print and write; returns the exit code."""
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415
    from acsar_gym.tools.sysid import calibration_fit  # noqa: PLC0415

    for line in sitting.notes:
        print(escape_unprintable(line))
    fit = sitting.fit()
    report.write_json(output.json, calibration_fit.format_calibration(fit, sitting.found, config))
    if fit is None:
        print(escape_unprintable(_waiting(sitting, kept_in)))
        if output.out is not None:
            print(escape_unprintable(f"{output.out} isn't written: there are no readings yet"))
        return 0
    report.print_tables(
        calibration_fit.runs_table(sitting.found, fit, config),
        calibration_fit.calibration_table(fit, config),
    )
    if output.out is not None:
        calibration_fit.make_calibrated_config(fit, config).save(output.out)
        print(escape_unprintable(f"written: {output.out}; use it with --robot {output.out}"))
    return 0


def _waiting(sitting: CalibrationJob, kept_in: Path | None) -> str:
    """What to do where no run has a reading yet."""
    if kept_in is None:
        return "no run has a reading: nothing was found"
    counts: Sequence[str] = sorted({run.manoeuvre for run in sitting.found})
    option = {"straight": "--measured", "turn": "--measured-deg", "square": "--corners"}
    hints = " or ".join(f"acsar-gym calibrate {kept_in} {m} {option[m]} ..." for m in counts)
    return f"{len(sitting.found)} runs kept in {kept_in}; readings: {hints}"


if TYPE_CHECKING:
    from rich.table import Table

    from acsar_gym.recording.types import Recording

Logs = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG [LOG ...]")]
Files = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE [FILE ...]")]
Limits = Annotated[tuple[str, ...], tyro.conf.arg(metavar="METRIC=VALUE [...]")]
First = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SIM")]
Second = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="REAL")]
UnfittedRobot = Annotated[str, tyro.conf.arg(metavar="PRESET|FILE|recorded")]
RobotFile = Annotated[str, tyro.conf.arg(metavar="PRESET|FILE")]
RECORDED_ROBOT = "recorded"


@dataclass(frozen=True)
class GapOutputs:
    """What is written, and the limits that must be kept."""

    fail_over: Limits = ()
    """Limits in SI units; exit code 1 where one isn't kept. For gap such as wheel_speed_rms=0.5
    end_pose=0.05, for compare of the paired differences, such as success_rate=0.05."""
    json: Json = None
    """Also write the figures to this file."""
    html: File = None
    """Also write a report with plots to this file."""

    def check(self) -> None:
        """Check that everything can be written, before the work begins."""
        from acsar_gym.tools.evaluation import (  # noqa: PLC0415
            page,
            report,
        )

        report.check_writable(self.json)
        report.check_writable(self.html)
        if self.html is not None:
            page.check_report_extra()


OutputArgs = Annotated[GapOutputs, tyro.conf.arg(name="")]


def measure_gap(
    logs: Logs,
    robot: RobotFile,
    outputs: OutputArgs,
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
    from acsar_gym.tools.sysid import (  # noqa: PLC0415
        pages,
        twin_gap,
    )

    known = twin_gap.parse_limits(outputs.fail_over, twin_gap.LIMIT_NAMES)
    outputs.check()
    after = Path(robot).name, RobotConfig.of(robot)
    recordings = _with_truth(_read_logs(logs), truth)
    unfitted = Path(before).name, _unfitted(before, recordings[0][1].config)
    found = twin_gap.measure_gap(recordings, after, unfitted, body)
    _show_tables(twin_gap.gap_tables(found), [*twin_gap.conclude_gap(found), *found.notes])
    _write_figures(outputs.json, twin_gap.format_gap(found))
    if outputs.html is not None:
        pages.gap_page(found).write(outputs.html)
    return _judge_limits(twin_gap.find_exceeded(known, twin_gap.limit_sizes(found)))


def compare_runs(
    first: First,
    second: Second,
    outputs: OutputArgs,
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
    from acsar_gym.tools.sysid import (  # noqa: PLC0415
        pages,
        sim_real,
        twin_gap,
    )

    known = twin_gap.parse_limits(outputs.fail_over, (*sim_real.EPISODE_METRICS, "delay"))
    outputs.check()
    found = sim_real.compare_sides(_read_logs((first, *sim)), _read_logs((second, *real)))
    _show_tables(
        [sim_real.comparison_table(found)], [*sim_real.conclude_comparison(found), *found.notes]
    )
    _write_figures(outputs.json, sim_real.format_comparison(found))
    if outputs.html is not None:
        pages.compare_page(found).write(outputs.html)
    return _judge_limits(twin_gap.find_exceeded(known, sim_real.difference_sizes(found)))


def _unfitted(name: str, recorded: RobotConfig) -> RobotConfig | None:
    """The robot before fitting, a preset on the recorded wire; None for the recorded one."""
    if name == RECORDED_ROBOT:
        return None
    config = RobotConfig.of(name)
    if Path(name).suffix or "/" in name:  # a file
        return config
    wire = {field: getattr(recorded, field) for field in ("wheels", "baud_rate", "trailing_comma")}
    return config.with_(**wire)


def _with_truth(
    logs: list[tuple[str, Recording]], truth: Path | None
) -> list[tuple[str, Recording]]:
    """Add the true poses of an emulator's log."""
    from acsar_gym.tools.sysid.tracks import add_truth  # noqa: PLC0415

    return logs if truth is None else [(name, add_truth(log, truth)) for name, log in logs]


def _read_logs(paths: Sequence[Path]) -> list[tuple[str, Recording]]:
    """Read recordings; ConfigError if one can't be read, or is named twice."""
    from acsar_gym.errors import ConfigError  # noqa: PLC0415
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


def _show_tables(tables: Sequence[Table], lines: Sequence[str]) -> None:
    """Print tables, then lines."""
    from acsar_gym.errors import escape_unprintable  # noqa: PLC0415
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    report.print_tables(*tables)
    for line in lines:
        print(escape_unprintable(line))


def _write_figures(path: Path | None, data: Mapping[str, Any]) -> None:
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    report.write_json(path, data)


def _judge_limits(failures: Sequence[str]) -> int:
    """Print limits that aren't kept; returns the exit code."""
    for line in failures:
        print(f"acsar-gym: {line}", file=sys.stderr)
    return 1 if failures else 0


if TYPE_CHECKING:
    from acsar_gym.tools.sysid.identify import Identification

Sources = Annotated[
    tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE | LOG [LOG ...]")
]
SIMULATED_LINKS = ("planar", "bullet")
LATE_MANOEUVRE = 1.1
"""A manoeuvre that takes longer than this, as a share of its length, is worth a warning."""


def identify_robot(
    sources: Sources,
    recording: RecordArgs,
    robot: RobotArg = None,
    out: File = None,
    duration: float = 20.0,
    yes: bool = False,
    twin: RobotArg = None,
    json: Json = None,
) -> int:
    """Find how motors and board answer, from what the wire carries, and write it to a robot's file.

    With a device, the wheels turn for 20 s with steps, slow staircases and a pause without
    commands: lift the robot! With recordings, whatever they hold is used. Either way it says
    first which parameters the log can't tell, and which manoeuvre is missing.

    Args:
        sources: serial device, planar, bullet; or recordings of one robot, made with --record.
        recording: recording of the manoeuvre.
        robot: preset or config file: what is known so far. Default: the one recorded, or acsar.
        out: write the robot's file with what was found, to be used as --robot.
        duration: of the manoeuvre [s].
        yes: don't ask before the wheels turn.
        twin: simulation only: the robot that is driven, a hidden one to be found.
        json: also write the findings to this file.
    """
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    check_out(out)
    report.check_writable(json)
    if not sources:
        raise ConfigError("identify needs a device, or recordings made with --record")
    if _are_files(sources):
        found = _from_files(sources, robot)
    else:
        found = _from_device(sources[0], robot, twin, duration, recording, yes=yes)
        _warn(describe_lateness(found.duration, duration, sources[0]))
    return _finish_identify(found, out, json)


def _are_files(sources: tuple[str, ...]) -> bool:
    """Whether recordings are given, instead of one device."""
    files = [Path(source).suffix == ".mcap" or Path(source).is_file() for source in sources]
    if not any(files) and len(sources) == 1:
        return False
    if not all(files):
        other = sources[files.index(False)]
        raise ConfigError(f"{other}: isn't a recording; give one device, or recordings only")
    return True


def _from_files(sources: tuple[str, ...], robot: str | None) -> Identification:
    """Identify from recordings."""
    from acsar_gym.tools.sysid import identify as logs  # noqa: PLC0415

    config = None if robot is None else RobotConfig.of(robot)
    return logs.identify_files([Path(source) for source in sources], config)


def _from_device(
    device: str,
    robot: str | None,
    twin: str | None,
    duration: float,
    recording: RecordArgs,
    *,
    yes: bool,
) -> Identification:
    """Ask, drive the manoeuvre, and identify."""
    from acsar_gym.links import open_link  # noqa: PLC0415
    from acsar_gym.tools.sysid import identify as logs  # noqa: PLC0415

    config, simulated = RobotConfig.of(robot), device in SIMULATED_LINKS
    if twin is not None and not simulated:
        raise ConfigError("--twin is for simulated robots: planar or bullet")
    link = open_link(device, config if twin is None else RobotConfig.of(twin))
    if not simulated:
        what = f"{device}: the wheels will turn for {duration:g} s in both directions"
        options.countdown(f"{what}; lift the robot, so that they turn freely", yes=yes)
    return logs.identify_device(link, config, duration, recording.recorder("identify"))


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


def _warn(line: str) -> None:
    """Print a warning, if there is one."""
    if line:
        print(f"acsar-gym: {escape_unprintable(line)}", file=sys.stderr)


def _finish_identify(found: Identification, out: Path | None, json: Path | None) -> int:
    """Print and write; returns the exit code."""
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415
    from acsar_gym.tools.sysid.identify import identification_table  # noqa: PLC0415

    report.print_tables(identification_table(found))
    report.write_json(json, found.as_dict())
    found.check()
    if found.dead:
        names = ", ".join(found.dead)
        print(f"{names} never turned: nothing of it was found; check motor and encoder")
    if out is not None:
        found.robot().save(out)
        print(escape_unprintable(f"written: {out}; use it with --robot {out}"))
    return 0
