"""The commands `identify`, `calibrate` and `gap`: a robot's file from what was measured."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import BUSY_HINT, ConfigError, LinkError
from acsar_gym.streams import print_error
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    BagOptions,
    File,
    RecordOptions,
    ResultOptions,
    RobotArg,
    check_stoppable,
    check_writable,
    countdown,
    say,
)

if TYPE_CHECKING:
    from acsar_gym.recording import Recording
    from acsar_gym.tools.sysid.calibration import CalibrationRun
    from acsar_gym.tools.sysid.calibration_drive import RunPlan
    from acsar_gym.tools.sysid.identify import Identification

Sources = Annotated[
    tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE | LOG [LOG ...]")
]
DURATION = 20.0
"""Usual duration of the manoeuvre [s]."""
LATE_MANOEUVRE = 1.1
"""A manoeuvre that takes longer than this, as a share of its length, is worth a warning."""


@dataclass(frozen=True)
class FoundRobotOptions(RecordOptions):
    """The robot of which something is found, and recording."""

    robot: RobotArg = None
    """Preset or config file with what is known. Default: that of the recording, or acsar."""
    twin: RobotArg = None
    """Simulation: the robot that is driven, a hidden robot to be found."""

    def driven(self, config: RobotConfig, device: str) -> RobotConfig:
        """Return the robot that is driven, which is the twin in a simulation that has one."""
        if self.twin is None:
            return config
        from acsar_gym.physics.bodies import BODIES

        if device not in BODIES:
            raise ConfigError(f"--twin is for simulated robots: {' or '.join(BODIES)}")
        return RobotConfig.of(self.twin)

    def check_recorded(self, *, has_duration: bool = False) -> None:
        """Refuse options for driving a robot, because recordings are read."""
        options = {
            "twin": self.twin,
            "record": self.record,
            "view": self.view,
            "duration": has_duration,
        }
        for name, value in options.items():
            if value:
                raise ConfigError(f"--{name} is for driving a robot; recordings are only read")


@dataclass(frozen=True)
class FoundRobotOutputs(ResultOptions):
    """Results."""

    out: File = None
    """Write what was found into this robot's file, to be used as --robot. If it exists, its
    comments stay, and what was not found."""

    def check(self) -> None:
        """Check before the work that the files can be written."""
        check_writable(self.json, robot=self.out)

    def write(self, robot: RobotConfig) -> None:
        """Write a robot to `out`, if a file is named."""
        if self.out is not None:
            robot.save(self.out)
            say(f"written: {self.out}; use it with --robot {self.out}")


@command("identify", drives=True)
def identify_robot(
    sources: Sources,
    setup: FoundRobotOptions,
    output: FoundRobotOutputs,
    bag: BagOptions,
    logs: Annotated[tuple[str, ...], tyro.conf.arg(name="from", metavar="LOG [LOG ...]")] = (),
    duration: float = DURATION,
    yes: bool = False,
    anyway: bool = False,
) -> int:
    """Find how motors and board respond, by the wire only, and write it to a robot's file.

    With a device, the wheels turn for 20 s with steps, slow staircases and a pause without
    commands: lift the robot! With recordings, all their drives are used. A parameter that the log
    doesn't narrow keeps its value, and the table names the missing manoeuvre. If the model of
    motors and board doesn't describe what was recorded, a file is written only with --anyway.

    Args:
        sources: Serial device, planar, bullet, mujoco, or recordings of one robot, made with
            --record, or ROS 2 bags of it.
        setup: Robot and recording.
        output: Results.
        bag: Options of ROS 2 bags.
        logs: Recordings or ROS 2 bags, instead of a device.
        duration: Duration of the manoeuvre [s].
        yes: Don't ask before the wheels turn.
        anyway: Write the file even if the model doesn't fit: without intervals, and with a remark.
    """
    from acsar_gym.tools.sysid import identify

    output.check()
    if recordings := _list_logs(sources, logs):
        setup.check_recorded(has_duration=duration != DURATION)
        config = None if setup.robot is None else RobotConfig.of(setup.robot)
        paths = [bag.open(path, setup.robot) for path in recordings]
        result = identify.identify_files(paths, config)
    else:
        result = _drive_and_identify(sources[0], setup, duration, yes=yes)

    # The table is printed also if the model doesn't fit, as it shows why.
    output.print(identify.identification_table(result), data=result.as_dict())
    result.check(anyway=anyway)
    if result.dead:
        names = ", ".join(result.dead)
        say(f"{names} never turned: nothing of it was found; check motor and encoder")
    if output.out is not None:
        robot = result.robot()
        output.write(robot)
        if robot.misfit:
            say(robot.misfit)
    return 0


def _drive_and_identify(
    device: str, setup: FoundRobotOptions, duration: float, *, yes: bool
) -> Identification:
    from acsar_gym.links import open_link
    from acsar_gym.tools.sysid import identify

    config = RobotConfig.of(setup.robot)
    link = open_link(device, setup.driven(config, device))
    if link.is_real:
        check_stoppable(device)
        motion = f"{device}: the wheels will turn for {duration:g} s in both directions"
        countdown(f"{motion}; lift the robot, so that they turn freely", yes=yes)

    result = identify.identify_device(link, config, duration, setup.recorder())
    # A late computer sends commands late: the fit knows when, but has fewer samples of each step.
    if result.duration > LATE_MANOEUVRE * duration:
        print_error(
            f"acsar-gym: the manoeuvre took {result.duration:.1f} s instead of {duration:g}: this "
            f"computer was late, and the figures are worse for it; {BUSY_HINT}, and drive again"
        )
    return result


def _list_logs(sources: Sequence[str], logs: Sequence[str]) -> list[Path]:
    """List the recordings and bags that are named. Empty if a device is named."""
    if logs and sources:
        raise ConfigError("--from: give a device, or recordings with --from, not both")
    paths = [Path(source) for source in (*sources, *logs)]
    if not paths:
        raise ConfigError("identify needs a device, or recordings made with --record")

    # A name with the suffix of a recording is a recording, even if the file doesn't exist.
    are_files = [
        path.suffix in (".mcap", ".db3") or path.is_file() or path.is_dir() for path in paths
    ]
    if not (logs or any(are_files) or len(sources) > 1):
        return []
    if not all(are_files):
        device = paths[are_files.index(False)]
        raise ConfigError(f"{device}: isn't a recording; give one device, or recordings only")
    return paths


Device = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE|FILE")]
Manoeuvre = Annotated[
    Literal["straight", "turn", "all"],
    tyro.conf.Positional,
    tyro.conf.arg(metavar="straight|turn|all"),
]
Numbers = Annotated[tuple[float, ...], tyro.conf.arg(metavar="N [N ...]")]
SPEED_SHARE = 0.6
"""Usual speed, as a share of the robot's largest."""
TURN_RATE_SHARES = (0.4, 0.8)
"""Usual turn rates without readings, as shares of the robot's largest."""


@dataclass(frozen=True)
class RunOptions:
    """What is driven, on which floor, and what was measured.

    Straight lines determine the wheels' mean radius, turns wheel_separation_multiplier and
    body.turn_factor.
    """

    distance: float = 2.0
    """Length of each straight run, by odometry [m]."""
    measured: Numbers = ()
    """Measured distances from start to end, one for each straight run, all positive [m]."""
    aside: Numbers = ()
    """How far to the left of its line each straight run ended [m], for the radii of both sides."""
    turns: float = 5.0
    """Full turns of each turning run, by odometry. Left and right alternate."""
    measured_deg: Numbers = ()
    """Measured angles, one for each turning run [degrees], with full turns. Right turns
    may be positive or negative."""
    speeds: Numbers = ()
    """Turn rates [rad/s]. Default: 40 % and 80 % of what max_angular and max_linear allow, or 60 %
    if readings are given."""
    radii: Numbers = (0.0,)
    """Radii of the circles that the robot's centre drives [m]. 0 turns in place. Circles to both
    sides also determine left against right radius."""
    space: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="X Y")] = None
    """Free floor ahead of the robot's centre, and to each of its sides [m]. Needed for a real
    robot, which is stopped at its edge."""
    repeats: int | None = None
    """Runs of each kind. Default: as many as readings, else 3 straight lines, 1 turn of each speed
    and radius."""
    yes: bool = False
    """Don't ask before driving, for scripts."""

    def plan(self, manoeuvre: Manoeuvre, config: RobotConfig) -> list[RunPlan]:
        """Plan the runs: as many as there are readings, or `repeats`."""
        from acsar_gym.tools.sysid.calibration_drive import plan_straights, plan_turns

        plans = []
        if self.repeats is not None:
            _check_number("--repeats", self.repeats, 1000.0)
        if manoeuvre != "turn":
            repeats = self.repeats or len(self.measured) or 3
            plans += plan_straights(self.distance, SPEED_SHARE * config.max_linear, repeats)
        if manoeuvre == "straight":
            return plans

        if not self.radii:
            raise ConfigError("--radii: name a radius, 0 to turn in place")

        # On the largest circle the centre must not be faster than the robot can drive.
        largest = max(*self.radii, 1e-9)
        fastest = min(config.max_angular, config.max_linear / largest)
        shares = (SPEED_SHARE,) if self.measured_deg else TURN_RATE_SHARES
        speeds = self.speeds or tuple(share * fastest for share in shares)
        for speed in speeds:
            _check_number("--speeds", speed, config.max_angular, "max_angular = ")
            _check_number("--speeds times --radii", speed * largest, config.max_linear)
        kinds = max(1, len(speeds) * len(self.radii))
        repeats = self.repeats or max(1, len(self.measured_deg) // kinds)
        return plans + plan_turns(self.turns, speeds, self.radii, repeats)


def _check_number(option: str, value: float, limit: float, field: str = "") -> None:
    if not 0.0 < value <= limit:
        raise ConfigError(f"{option} {value:g}: must be more than 0, at most {field}{limit:g}")


@command("calibrate", drives=True)
def calibrate_robot(
    device: Device,
    manoeuvre: Manoeuvre,
    runs: RunOptions,
    setup: FoundRobotOptions,
    output: FoundRobotOutputs,
) -> int:
    """Measure wheel radii and turning on the floor, and write them into the robot's file.

    The robot drives within --space, and you measure with a tape how far the point below its centre
    went. Record the runs with --record FILE, then give FILE as DEVICE with the readings:
    --measured, --aside, --measured-deg. In simulation the truth measures.

    Args:
        device: Serial device, planar, bullet, mujoco, or a recording of runs that were driven
            before, to give readings to.
        manoeuvre: What to drive.
        runs: How it is driven, and readings.
        setup: The robot, and recording.
        output: Results.
    """
    from acsar_gym.recording import read
    from acsar_gym.tools.sysid import calibration

    output.check()
    readings = calibration.GivenReadings(runs.measured, runs.aside, runs.measured_deg)
    if not device.endswith(".mcap"):
        return _drive_and_finish(device, manoeuvre, runs, readings, setup=setup, output=output)

    setup.check_recorded()
    recording = read(Path(device))
    config = recording.config if setup.robot is None else RobotConfig.of(setup.robot)
    recorded = calibration.read_recorded_runs(Path(device), manoeuvre, config)
    readings.check([run.manoeuvre for run in recorded])
    in_ros = any(episode.wire.stamped for episode in recording.episodes)
    return _finish_calibration(readings.give(recorded), config, output, device, in_ros=in_ros)


def _drive_and_finish(
    device: str,
    manoeuvre: Manoeuvre,
    options: RunOptions,
    readings: Any,
    *,
    setup: FoundRobotOptions,
    output: FoundRobotOutputs,
) -> int:
    """Drive the runs. Returns the exit code."""
    from acsar_gym.links import open_link
    from acsar_gym.robot import Robot
    from acsar_gym.tools.sysid.calibration_drive import drive_plans

    config = RobotConfig.of(setup.robot)
    plans = options.plan(manoeuvre, config)
    link = open_link(device, setup.driven(config, device))
    # Wrong numbers of readings are reported before anything moves.
    has_readings = readings.check([plan.manoeuvre for plan in plans])
    if not (has_readings or setup.record or not link.is_real):
        raise ConfigError(
            "nobody would measure: add --record FILE and give the readings later, or give "
            "--measured or --measured-deg"
        )
    check_stoppable(device)
    recorder = setup.recorder(link=device)
    runs: list[CalibrationRun] = []

    def finish() -> int:
        measured = readings.give(runs)
        return _finish_calibration(measured, config, output, setup.record, in_ros=link.stamped)

    try:
        drive_plans(
            Robot(link, config, recorder=recorder),
            plans,
            options.space,
            runs=runs,
            announce=lambda plan: _announce_run(device, options, plan, is_real=link.is_real),
            recorder=recorder,
            reads_truth=not link.is_real and not has_readings,
        )
    except LinkError:
        if runs:
            say(f"{len(runs)} finished runs are used")
            with contextlib.suppress(ConfigError):  # too few runs: the LinkError is reported
                finish()
        raise
    return finish()


def _finish_calibration(
    runs: Sequence[CalibrationRun],
    config: RobotConfig,
    output: FoundRobotOutputs,
    record: Path | str | None,
    *,
    in_ros: bool,
) -> int:
    """Fit, print and write. Returns the exit code."""
    from acsar_gym.tools.sysid import calibration_fit

    if not any(run.readings for run in runs):
        output.print(data=calibration_fit.format_calibration(None, runs, config))
        message = "no run has a reading: nothing was found and no robot's file written"
        # Runs that weren't recorded can't get readings later.
        if record is not None:
            later = f"acsar-gym calibrate {record} all --measured ..."
            message += f". Give readings later: {later}"
        say(message)
        return 0

    fit = calibration_fit.fit_geometry(runs, config)
    output.print(
        calibration_fit.runs_table(fit, config),
        calibration_fit.calibration_table(fit, config),
        data=calibration_fit.format_calibration(fit, runs, config),
    )
    if output.out is not None:
        output.write(calibration_fit.make_calibrated_config(fit, config, in_ros=in_ros))
    if output.out is not None and in_ros:
        say(
            "its controller converts twists with its own radii and separation, which are in ros2 "
            "of the file. Better set the found values in its parameters and delete wheel_radii "
            "and wheel_separation from ros2"
        )
    return 0


def _announce_run(device: str, options: RunOptions, plan: RunPlan, *, is_real: bool) -> None:
    """Announce a run, and wait until a real robot is in its place."""
    say(f"{plan.name} ...")
    # A simulated robot needs no person who moves it back.
    if not is_real:
        return
    if sys.stdin.isatty() and not options.yes:
        x, y = options.space or (0.0, 0.0)
        place = "leave the robot where it is" if plan.back else "put the robot on its start mark"
        room = f"with {x:g} m free ahead and {y:g} m to each side"
        with contextlib.suppress(EOFError):
            input(f"note where it ended, {place}, {room}, then press Enter: ")
    countdown(f"{device}: the robot will drive: {plan.name}", yes=options.yes)


Logs = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG [LOG ...]")]
RobotFile = Annotated[str, tyro.conf.arg(metavar="PRESET|FILE")]


@command("gap")
def measure_gap(
    logs: Logs,
    robot: RobotFile,
    bag: BagOptions,
    output: ResultOptions,
    before: RobotFile = "acsar",
    body: str = "planar",
    truth: File = None,
) -> int:
    """Replay recorded commands through the twin, before and after fitting, and measure its gap.

    Figures are over the logs that the robot wasn't fitted to, if there are any.

    Args:
        logs: Recordings of one robot, made with --record, or ROS 2 bags of it.
        robot: The fitted robot, such as the file that identify wrote.
        bag: Options of ROS 2 bags.
        output: Results in a file.
        before: The unfitted robot. A preset gets the wiring, the baud rate and the comma of the
            first recording.
        body: Physics of the twins, planar, bullet or mujoco.
        truth: Log of the emulator that was recorded (emulate --log), with its true poses.
    """
    from acsar_gym.tools.sysid import tracks, twin_gap

    output.check()
    fitted = (Path(robot).name, RobotConfig.of(robot))
    recordings = _read_logs([bag.open(log, robot) for log in logs])
    if truth is not None:
        recordings = [(name, tracks.add_truth(log, truth)) for name, log in recordings]

    unfitted = RobotConfig.of(before)
    if not (Path(before).suffix or "/" in before):  # a preset
        recorded = recordings[0][1].config
        wire = ("wheels", "baud_rate", "trailing_comma")
        unfitted = unfitted.with_(**{field: getattr(recorded, field) for field in wire})
    gap = twin_gap.measure_gap(recordings, fitted, (Path(before).name, unfitted), body)
    output.print(*twin_gap.gap_tables(gap), data=twin_gap.format_gap(gap))
    for line in (twin_gap.conclude_gap(gap), *gap.notes):
        say(line)
    return 0


def _read_logs(paths: Sequence[Path]) -> list[tuple[str, Recording]]:
    """Read recordings. ConfigError if a recording can't be read, or is named twice."""
    from acsar_gym.recording import read

    if not paths:
        raise ConfigError("no recording is named: make one with --record FILE")
    logs = [(path.name, read(path)) for path in paths]
    names: dict[str, str] = {}
    for name, log in logs:
        # A copied file has the same time of its start.
        created = str(log.header["created"])
        if created in names:
            raise ConfigError(f"{name}: is the same recording as {names[created]}")
        names[created] = name
    return logs
