"""The job `calibrate`: runs are driven or read from a file, given readings, checked and fitted."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, show_value
from acsar_gym.links import open_link
from acsar_gym.recording import Recorder
from acsar_gym.robot import Robot
from acsar_gym.sensors.lidar import sensor_factories
from acsar_gym.tools.sysid import calibration_drive, calibration_runs, scan_matching
from acsar_gym.tools.sysid.calibration_drive import RunObserver, RunPlan, TruthObserver, drive_run
from acsar_gym.tools.sysid.calibration_fit import GeometryFit, fit_geometry
from acsar_gym.tools.sysid.calibration_runs import (
    CalibrationRun,
    RunReading,
    configured_geometry,
    integrate_wheels,
    rolled_distance,
)
from acsar_gym.worlds import Pose, Scene
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius

CONTRADICTION_SHARE = 0.3
"""A reading that differs from odometry by more than this share is refused."""
SHORTEST_RUN = 1e-3
"""A straight run that is shorter than this, by odometry, can't be measured [m]."""
SKID_MULTIPLIERS = (1.0, 2.2)
"""Multipliers of skid-steer robots; a turn may contradict odometry by as much as they explain."""
MAX_CORNERS_BYTES = 1_000_000
"""Largest file of corners [bytes]."""
TAPE_SOURCE = "tape"
"""Source of readings of a person."""
DIVISION_SIGMA = 0.5
"""Standard deviation of a reading, as a share of the scale's divisions: rounding and placement."""


@dataclass(frozen=True, slots=True)
class ReadingScales:
    """Divisions of tape and protractor."""

    tape: float = 0.005
    """[m]."""
    protractor: float = 1.0
    """[degrees]."""

    def metres(self, kind: str, value: float) -> RunReading:
        """A reading of the tape [m]."""
        return RunReading(kind, value, DIVISION_SIGMA * self.tape, TAPE_SOURCE)

    def degrees(self, value: float) -> RunReading:
        """A reading of the protractor [degrees]."""
        return RunReading(
            "heading",
            math.radians(value),
            DIVISION_SIGMA * math.radians(self.protractor),
            TAPE_SOURCE,
        )


def read_straight(numbers: Sequence[float], scales: ReadingScales) -> list[RunReading]:
    """Readings of a straight run: distance from start to end, and its offset to the left [m]."""
    found = [scales.metres("distance", abs(numbers[0]))]  # backwards runs as well
    return found + [scales.metres("aside", aside) for aside in numbers[1:]]


def read_turn(degrees: float, run: CalibrationRun, scales: ReadingScales) -> list[RunReading]:
    """The reading of a turn: the turned angle [degrees], full turns counted, in either sense."""
    right, left = run.wheels[-1, 1], run.wheels[-1, 0]
    return [scales.degrees(math.copysign(degrees, right - left))]


def read_square(
    numbers: Sequence[float], run: CalibrationRun, scales: ReadingScales
) -> list[RunReading]:
    """Readings of a square: where it ended, x and y [m], and its heading there [degrees]."""
    found = [scales.metres("x", numbers[0]), scales.metres("y", numbers[1])]
    if len(numbers) == 3:
        clockwise = run.wheels[-1, 1] < run.wheels[-1, 0]
        found.append(scales.degrees(numbers[2] + (-360.0 if clockwise else 360.0)))
    return found


def read_corners(path: Path) -> list[tuple[float, ...]]:
    """Read where squares ended from a CSV file.

    Args:
        path: one row for each run: x and y [m] in the frame of the start (x ahead, y to the left),
            and optionally the heading [degrees]; a first row of names is skipped.

    Raises:
        ConfigError: the file can't be read, or a row isn't two or three numbers.
    """
    text = reading.decode_text(reading.read_file(path, MAX_CORNERS_BYTES))
    rows = [row for row in csv.reader(text.splitlines()) if any(cell.strip() for cell in row)]
    if rows and not _is_number(rows[0][0]):
        rows = rows[1:]
    found = []
    for number, row in enumerate(rows, start=1):
        if len(row) not in (2, 3) or not all(map(_is_number, row)):
            raise ConfigError(
                f"{path}: row {number}, {show_value(','.join(row))}: must be x,y or x,y,degrees"
            )
        found.append(tuple(map(float, row)))
    if not found:
        raise ConfigError(f"{path}: no rows: must have x,y of the end of each run [m]")
    return found


def check_readings(run: CalibrationRun, config: RobotConfig) -> str:
    """Compare a run's readings with odometry.

    Returns:
        A line to be told about a turn that skidding explains but the config doesn't; else empty.

    Raises:
        ConfigError: a reading contradicts odometry by more than CONTRADICTION.
    """
    told = ""
    for read in run.readings:
        if read.kind == "heading":
            told = _check_turn(run, read.value, config) if run.manoeuvre == "turn" else ""
        elif read.kind == "distance":
            _check_distance(run, read.value, config)
        elif abs(read.value) > (1.0 + CONTRADICTION_SHARE) * max(
            rolled_distance(run, _radius(config)), 0.1
        ):
            raise _contradiction(run, f"{read.value:g}", "farther than the robot drove")
    return told


def _check_distance(run: CalibrationRun, value: float, config: RobotConfig) -> None:
    """Check the length of a straight run; ConfigError."""
    x, y, _ = integrate_wheels(run.wheels, configured_geometry(config), config.wheel_separation)
    expected = math.hypot(x, y)
    if expected < SHORTEST_RUN:
        raise ConfigError(f"{run.name}: ended where it began, by odometry: not a straight run")
    if not abs(value - expected) <= CONTRADICTION_SHARE * expected:
        times = value / expected
        hint = "in centimetres?" if 50.0 < times < 200.0 else "another run's?"
        hint = "in millimetres?" if 500.0 < times < 2000.0 else hint
        raise _contradiction(run, f"{value:g} m", f"odometry says {expected:.3f} m: {hint}")


def _check_turn(run: CalibrationRun, value: float, config: RobotConfig) -> str:
    """Check the angle of a turn; returns a line where only skidding explains it. ConfigError."""
    expected = integrate_wheels(run.wheels, configured_geometry(config), config.wheel_separation)[2]
    implied = config.wheel_separation_multiplier * expected / value if value else math.inf
    degrees, odometry = math.degrees(abs(value)), math.degrees(abs(expected))
    if abs(value - expected) <= CONTRADICTION_SHARE * abs(expected):
        return ""
    what = f"odometry says {odometry:.0f} degrees"
    if (
        SKID_MULTIPLIERS[0] / (1.0 + CONTRADICTION_SHARE)
        <= implied
        <= SKID_MULTIPLIERS[1] * (1.0 + CONTRADICTION_SHARE)
    ):
        return f"{run.name}: read {degrees:.0f}, {what}: a multiplier of {implied:.2f} explains it"
    hint = "counted the full turns?" if degrees < 360.0 < odometry else "units, or another run's?"
    raise _contradiction(run, f"{degrees:g} degrees", f"{what}: {hint}")


def _contradiction(run: CalibrationRun, read: str, why: str) -> ConfigError:
    """The error for a reading that can't be of this run."""
    return ConfigError(
        f"{run.name}: the reading {read} contradicts the odometry by more than "
        f"{CONTRADICTION_SHARE:.0%}: {why}"
    )


def _radius(config: RobotConfig) -> float:
    """Mean wheel radius [m]."""
    return configured_geometry(config).radius


def _is_number(text: str) -> bool:
    """Whether a cell holds a finite number."""
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


SIMULATED_LINKS = ("planar", "bullet")
"""Links that have ground truth."""
ASKED_READINGS = {
    "straight": "straight distance from start to end [m]",
    "turn": "turned angle [degrees], full turns counted",
    "square": "end x y [m], and heading [degrees] if you have it, as the start saw them",
}
"""What a person is asked for after each run."""
LARGEST_READING = 1e6
"""Largest reading."""


@dataclass(frozen=True, slots=True)
class DrivenRobot:
    """The robot to be driven."""

    url: str
    """planar, bullet, or a serial device."""
    config: RobotConfig
    """What is known of the robot."""
    twin: RobotConfig
    """The simulated robot; equal to the config where nothing is hidden."""
    lidar: str | None = None
    """URL of a LiDAR; "simulated" in simulation; None for a tape or truth."""
    world: str | None = None
    """World of a simulation."""
    recorder: Recorder | None = None
    """Records all runs; None: nothing is recorded."""

    @property
    def simulated(self) -> bool:
        """Whether the robot is simulated."""
        return self.url in SIMULATED_LINKS


def drive_runs(
    wire: DrivenRobot,
    plans: Sequence[RunPlan],
    space: tuple[float, float] | None,
    before: Callable[[RunPlan], None],
    after: Callable[[CalibrationRun], CalibrationRun],
    *,
    truth: bool,
) -> list[CalibrationRun]:
    """Drive runs within the stated space; the link is closed after each run, while people measure.

    Args:
        wire: the robot.
        plans: what to drive.
        space: free floor ahead and to each side [m]; see `manoeuvres.fenced`.
        before: called before each run, such as a countdown.
        after: called after each run; may add readings.
        truth: whether ground truth measures a simulated robot.

    Raises:
        ConfigError: the space is too small.
        LinkError: the robot can't be driven, or was stopped.
    """
    space = calibration_drive.check_space(wire.config, plans, space)
    if wire.simulated:  # begins every run at its start anyway
        plans = [plan.ahead() for plan in plans]
    scene = _scene(wire)
    observer = _observer(wire, truth=truth)
    found = []
    robot = _robot(wire)
    try:
        for plan in plans:
            before(plan)
            robot.safety.fence(calibration_drive.make_fence(wire.config, plan, space))
            found.append(after(drive_run(robot, plan, scene, observer)))
    finally:
        robot.close()
    return found


def _robot(wire: DrivenRobot) -> Robot:
    """The robot, not active."""
    config, twin = wire.config, wire.twin
    if wire.lidar is not None:
        config, twin = scan_matching.with_fine_scans(config), scan_matching.with_fine_scans(twin)
    sensors = sensor_factories(["lidar"], wire.lidar) if wire.lidar is not None else ()
    link = open_link(wire.url, twin if wire.simulated else config)
    return Robot(link, config, sensors, recorder=wire.recorder)


def _observer(wire: DrivenRobot, *, truth: bool) -> RunObserver | None:
    """What measures a run; None where a person does."""
    if wire.lidar is not None:
        return scan_matching.LidarObserver(scan_matching.with_fine_scans(wire.config))
    return TruthObserver() if truth else None


def _scene(wire: DrivenRobot) -> Scene:
    """The scene of a simulation: at the world's start, facing its goal or as the world says."""
    if wire.world is None:
        return Scene()
    if not wire.simulated:
        raise ConfigError("--world is for simulated robots: planar or bullet")
    pool = Pool.of(wire.world, None, footprint_radius(wire.config), 1)
    world = next(iter(pool)) if pool else None
    if world is None:
        return Scene()
    start: Pose = (world.start.x, world.start.y, world.start.theta or 0.0)
    return Scene(start, world=world)


@dataclass(frozen=True, slots=True)
class GivenReadings:
    """Readings that options give, in the order of the runs."""

    measured: tuple[float, ...] = ()
    """Distances of straight runs [m]."""
    aside: tuple[float, ...] = ()
    """Offsets to the left of straight runs' ends [m]; as many as distances, or none."""
    degrees: tuple[float, ...] = ()
    """Angles of turns [degrees]."""
    clockwise: tuple[tuple[float, ...], ...] = ()
    """Ends of clockwise squares: x, y [m] and perhaps heading [degrees]."""
    counter: tuple[tuple[float, ...], ...] = ()
    """Ends of counter-clockwise squares."""

    def __post_init__(self) -> None:
        for option in ("measured", "aside", "degrees"):
            for number in getattr(self, option):
                if not -LARGEST_READING <= number <= LARGEST_READING:
                    name = "measured-deg" if option == "degrees" else option
                    raise ConfigError(
                        f"--{name} {number:g}: must be {-LARGEST_READING:g} to {LARGEST_READING:g}"
                    )
        if self.aside and len(self.aside) != len(self.measured):
            raise ConfigError(
                f"--aside has {len(self.aside)} readings, --measured {len(self.measured)}: must be "
                "as many"
            )

    @property
    def any(self) -> bool:
        """Whether there are readings."""
        return bool(self.measured or self.degrees or self.clockwise or self.counter)

    def rows(self, manoeuvre: str) -> list[tuple[float, ...]]:
        """The readings of one manoeuvre's runs; clockwise squares come first."""
        if manoeuvre == "straight":
            if not self.aside:
                return [(one,) for one in self.measured]
            return list(zip(self.measured, self.aside, strict=True))
        if manoeuvre == "turn":
            return [(one,) for one in self.degrees]
        return [*self.clockwise, *self.counter]


def check_reading_counts(plans: Sequence[RunPlan], given: GivenReadings) -> None:
    """Check before driving that there is a reading for each run, or none; ConfigError."""
    for manoeuvre in ASKED_READINGS:
        count = sum(plan.manoeuvre == manoeuvre for plan in plans)
        rows = len(given.rows(manoeuvre))
        if rows not in (0, count):
            raise ConfigError(
                f"{rows} readings for {count} {manoeuvre} runs: must be one for each run"
            )


def give_readings(
    run: CalibrationRun, row: Sequence[float], scales: ReadingScales
) -> CalibrationRun:
    """Give a run the readings of a row of numbers."""
    if run.manoeuvre == "straight":
        return run.read(read_straight(row, scales))
    if run.manoeuvre == "turn":
        return run.read(read_turn(row[0], run, scales))
    return run.read(read_square(row, run, scales))


def parse_readings(run: CalibrationRun, text: str, scales: ReadingScales) -> CalibrationRun:
    """Give a run the readings that a person typed; nothing typed leaves it without.

    Raises:
        ConfigError: these aren't as many numbers as asked for.
    """
    try:
        row = [float(part) for part in text.replace(",", " ").split()]
    except ValueError:
        row = [float("nan")]
    if not row:
        return run
    most = {"straight": (1, 2), "turn": (1,), "square": (2, 3)}[run.manoeuvre]
    if len(row) not in most or not all(
        -LARGEST_READING <= number <= LARGEST_READING for number in row
    ):
        raise ConfigError(f"{text.strip()[:60]!r}: must be the {ASKED_READINGS[run.manoeuvre]}")
    return give_readings(run, row, scales)


def assign_readings(
    found: Sequence[CalibrationRun], given: GivenReadings, scales: ReadingScales
) -> list[CalibrationRun]:
    """Give runs the readings of the options, manoeuvre by manoeuvre, in order.

    Where there are as many readings as runs without any, they are for those; otherwise they are
    for all runs of the manoeuvre.

    Raises:
        ConfigError: there are neither as many.
    """
    result = list(found)
    for manoeuvre in ASKED_READINGS:
        rows = given.rows(manoeuvre)
        own = [i for i, run in enumerate(result) if run.manoeuvre == manoeuvre]
        unread = [i for i in own if not result[i].readings]
        for places in (unread, own):
            if len(places) == len(rows):
                for i, row in zip(places, rows, strict=True):
                    result[i] = give_readings(result[i], row, scales)
                break
        else:
            if rows:
                raise ConfigError(
                    f"{len(rows)} readings for {len(own)} {manoeuvre} runs, {len(unread)} of them "
                    "without a reading: must be as many"
                )
    return result


def check_all_readings(found: Iterable[CalibrationRun], config: RobotConfig) -> list[str]:
    """Check all readings against odometry; returns lines to be told. ConfigError."""
    return [line for run in found if (line := check_readings(run, config))]


Ask = Callable[[str], str]


class CalibrationJob:
    """Collects runs and their readings.

    Attributes: `found`, all runs so far; `notes`, lines to be told.

    Args:
        config: of the robot.
        given: readings of the options.
        scales: of the readings that a person takes.
        kept_in: file that keeps the runs; existing ones are fitted, too. None: not kept.
        ask: asks a person, who can answer; None where nobody is there.
        known: whether the file must be there already, with runs; ConfigError if not.
    """

    def __init__(
        self,
        config: RobotConfig,
        given: GivenReadings,
        scales: ReadingScales,
        kept_in: Path | None = None,
        ask: Ask | None = None,
        *,
        known: bool = False,
    ) -> None:
        self.found: list[CalibrationRun] = []
        self.notes: list[str] = []
        self._config, self._given, self._scales = config, given, scales
        self._kept_in, self._ask = kept_in, ask
        if kept_in is not None and (known or kept_in.exists()):
            self.found = calibration_runs.read_runs(kept_in, config)
        if known and not self.found:
            raise ConfigError(f"{kept_in}: holds no runs: drive some with --runs {kept_in}")

    def drive(
        self,
        wire: DrivenRobot,
        plans: Sequence[RunPlan],
        space: tuple[float, float] | None,
        before: Callable[[RunPlan], None],
    ) -> None:
        """Drive runs; each is kept as soon as it has ended.

        Raises:
            ConfigError: the space is too small or not stated, or nobody would measure.
            LinkError: the robot can't be driven, or was stopped.
        """
        check_reading_counts(plans, self._given)
        told = self._given.any
        truth = wire.simulated and wire.lidar is None and not told
        if not (truth or told or wire.lidar or self._ask or self._kept_in):
            raise ConfigError(
                "nobody would measure: give --measured, --measured-deg or --corners, --lidar, or "
                "--runs FILE to measure now and give the readings later"
            )
        if not wire.simulated and space is None:
            ahead, aside = calibration_drive.find_needed_space(plans, wire.config)
            raise ConfigError(
                f"--space is missing: say how much floor is free ahead and to each side; this "
                f"needs --space {ahead + 0.005:.2f} {aside + 0.005:.2f}"
            )
        asks = not (truth or told or wire.lidar)
        drive_runs(wire, plans, space, before, lambda run: self._ended(run, asks=asks), truth=truth)

    def add(self, new: Sequence[CalibrationRun]) -> None:
        """Add runs of a recording."""
        self.found += new
        self._keep()

    def _ended(self, run: CalibrationRun, *, asks: bool) -> CalibrationRun:
        """Keep a run that has ended; ask for its readings if `asks`."""
        if any(run.name == one.name for one in self.found):
            run = replace(run, name=f"{run.name} ({len(self.found) + 1})")
        self.found.append(run)
        self._keep()
        if asks and self._ask is not None:
            self.found[-1] = self._asked(run)
            self._keep()
        return run

    def read(self, manoeuvre: str) -> None:
        """Give readings to runs that have none yet: those of the options, then what a person says.

        Raises:
            ConfigError: their number is another one, or a reading contradicts the odometry.
        """
        self.found = assign_readings(self.found, self._given, self._scales)
        self.notes = check_all_readings(self.found, self._config)
        self._keep()
        for i, run in enumerate(self.found):
            wanted = manoeuvre in (run.manoeuvre, "all")
            if wanted and not run.readings and self._ask is not None:
                self.found[i] = self._asked(run)
                self._keep()

    def fit(self) -> GeometryFit | None:
        """Fit all runs together; None where none has a reading. ConfigError as for `fit.fit`."""
        if not any(run.readings for run in self.found):
            return None
        return fit_geometry(self.found, self._config)

    def _asked(self, run: CalibrationRun) -> CalibrationRun:
        """Ask until the answer is a reading of this run, or empty."""
        question = f"{run.name}: {ASKED_READINGS[run.manoeuvre]} (Enter: none)"
        while self._ask is not None:
            try:
                read = parse_readings(run, self._ask(question), self._scales)
                self.notes += [line for line in [check_readings(read, self._config)] if line]
            except ConfigError as error:
                question = f"{error}; again"
            else:
                return read
        return run

    def _keep(self) -> None:
        """Write the runs to their file."""
        if self._kept_in is not None:
            calibration_runs.write_runs(self._kept_in, self.found, self._config)
