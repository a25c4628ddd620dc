"""The job `calibrate`: runs are driven or read from a file, given readings, checked and fitted."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, show_value
from acsar_gym.links import open_link
from acsar_gym.physics.bodies import BODIES
from acsar_gym.reading import decode_text, read_file
from acsar_gym.recording import Recorder
from acsar_gym.robot import Robot
from acsar_gym.sensors.suite import sensor_factories
from acsar_gym.tools.sysid import calibration_drive, calibration_runs
from acsar_gym.tools.sysid.calibration_fit import GeometryFit, fit_geometry
from acsar_gym.tools.sysid.calibration_runs import CalibrationRun, RunReading
from acsar_gym.tools.sysid.scan_matching import LidarObserver, with_fine_scans
from acsar_gym.worlds import Pose, Scene
from acsar_gym.worlds.pool import Pool, Source
from acsar_gym.worlds.search import footprint_radius, lidar_height

CONTRADICTION_SHARE = 0.3
"""A reading that differs from odometry by more than this share is refused."""
SHORTEST_RUN = 1e-3
"""A straight run that is shorter than this, by odometry, can't be measured [m]."""
SKID_MULTIPLIERS = (1.0, 2.2)
"""Multipliers of skid-steer robots; a turn may contradict odometry by as much as they explain."""
MAX_CORNERS_BYTES = 1_000_000
"""Largest file of corners [bytes]."""
DIVISION_SIGMA = 0.5
"""Standard deviation of a reading, as a share of the scale's divisions: rounding and placement."""
LARGEST_READING = 1e6
ASKED_READINGS = {
    "straight": "straight distance from start to end [m]",
    "turn": "turned angle [degrees], full turns counted",
    "square": "end x y [m], and heading [degrees] if you have it, as the start saw them",
}
"""What a person is asked for after each run."""


@dataclass(frozen=True, slots=True)
class ReadingScales:
    """Divisions of tape and protractor."""

    tape: float = 0.005
    """[m]."""
    protractor: float = 1.0
    """[degrees]."""

    def metres(self, kind: str, value: float) -> RunReading:
        """A reading of the tape [m]."""
        return RunReading(kind, value, DIVISION_SIGMA * self.tape, "tape")

    def degrees(self, value: float) -> RunReading:
        """A reading of the protractor [degrees]."""
        sigma = DIVISION_SIGMA * math.radians(self.protractor)
        return RunReading("heading", math.radians(value), sigma, "tape")


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
                    limits = f"{-LARGEST_READING:g} to {LARGEST_READING:g}"
                    raise ConfigError(f"--{name} {number:g}: must be {limits}")
        if self.aside and len(self.aside) != len(self.measured):
            raise ConfigError(
                f"--aside has {len(self.aside)} readings, --measured {len(self.measured)}: must be "
                "as many"
            )

    def rows(self, manoeuvre: str) -> list[tuple[float, ...]]:
        """The readings of one manoeuvre's runs; clockwise squares come first."""
        if manoeuvre == "straight":
            return list(zip(self.measured, *([self.aside] if self.aside else []), strict=True))
        if manoeuvre == "turn":
            return [(one,) for one in self.degrees]
        return [*self.clockwise, *self.counter]


def read_corners(path: Path) -> list[tuple[float, ...]]:
    """Read where squares ended from a CSV file.

    Args:
        path: one row for each run: x and y [m] in the frame of the start (x ahead, y to the left),
            and optionally the heading [degrees]; a first row of names is skipped.

    Raises:
        ConfigError: the file can't be read, or a row isn't two or three numbers.
    """
    text = decode_text(read_file(path, MAX_CORNERS_BYTES))
    rows = [row for row in csv.reader(text.splitlines()) if any(cell.strip() for cell in row)]
    if rows and _parse_numbers(rows[0][:1]) is None:
        rows = rows[1:]
    found = []
    for number, row in enumerate(rows, start=1):
        numbers = _parse_numbers(row)
        if numbers is None or len(numbers) not in (2, 3):
            raise ConfigError(
                f"{path}: row {number}, {show_value(','.join(row))}: must be x,y or x,y,degrees"
            )
        found.append(tuple(numbers))
    if not found:
        raise ConfigError(f"{path}: no rows: must have x,y of the end of each run [m]")
    return found


def _parse_numbers(cells: Sequence[str]) -> list[float] | None:
    """The finite numbers of cells; None where one isn't."""
    try:
        numbers = [float(cell) for cell in cells]
    except ValueError:
        return None
    return numbers if all(map(math.isfinite, numbers)) else None


def give_readings(
    run: CalibrationRun, row: Sequence[float], scales: ReadingScales
) -> CalibrationRun:
    """Give a run the readings of a row of numbers.

    Straight: distance from start to end, and its offset to the left [m]. Turn: the turned angle
    [degrees], full turns counted, in either sense. Square: where it ended, x and y [m], and its
    heading there [degrees].
    """
    left, right = run.wheels[-1]
    if run.manoeuvre == "straight":  # backwards runs are positive as well
        found = [scales.metres("distance", abs(row[0]))]
        found += [scales.metres("aside", aside) for aside in row[1:]]
    elif run.manoeuvre == "turn":
        found = [scales.degrees(math.copysign(row[0], right - left))]
    else:
        found = [scales.metres("x", row[0]), scales.metres("y", row[1])]
        if len(row) == 3:
            found.append(scales.degrees(row[2] + (-360.0 if right < left else 360.0)))
    return run.read(found)


def parse_readings(run: CalibrationRun, text: str, scales: ReadingScales) -> CalibrationRun:
    """Give a run the readings that a person typed; nothing typed leaves it without.

    Raises:
        ConfigError: these aren't as many numbers as asked for.
    """
    row = _parse_numbers(text.replace(",", " ").split())
    if row == []:
        return run
    most = {"straight": (1, 2), "turn": (1,), "square": (2, 3)}[run.manoeuvre]
    if row is None or len(row) not in most or max(map(abs, row)) > LARGEST_READING:
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
        places = unread if len(unread) == len(rows) else own
        if rows and len(places) != len(rows):
            raise ConfigError(
                f"{len(rows)} readings for {len(own)} {manoeuvre} runs, {len(unread)} of them "
                "without a reading: must be as many"
            )
        for i, row in zip(places, rows, strict=False):
            result[i] = give_readings(result[i], row, scales)
    return result


def check_readings(run: CalibrationRun, config: RobotConfig) -> str:
    """Compare a run's readings with odometry.

    Returns:
        A line to be told about a turn that skidding explains but the config doesn't; else empty.

    Raises:
        ConfigError: a reading contradicts odometry by more than CONTRADICTION_SHARE.
    """
    told, geometry = "", calibration_runs.configured_geometry(config)
    x, y, theta = calibration_runs.integrate_wheels(run.wheels, geometry, config.wheel_separation)
    for reading in run.readings:
        value = reading.value
        if reading.kind == "heading":
            if run.manoeuvre == "turn":
                told = _check_turn(run, value, theta, config)
        elif reading.kind == "distance":
            expected = math.hypot(x, y)
            if expected < SHORTEST_RUN:
                what = "ended where it began, by odometry: not a straight run"
                raise ConfigError(f"{run.name}: {what}")
            if not abs(value - expected) <= CONTRADICTION_SHARE * expected:
                times = value / expected
                hint = "in centimetres?" if 50.0 < times < 200.0 else "another run's?"
                hint = "in millimetres?" if 500.0 < times < 2000.0 else hint
                raise _contradict(run, f"{value:g} m", f"odometry says {expected:.3f} m: {hint}")
        else:
            way = max(calibration_runs.rolled_distance(run, geometry.radius), 0.1)
            if abs(value) > (1.0 + CONTRADICTION_SHARE) * way:
                raise _contradict(run, f"{value:g}", "farther than the robot drove")
    return told


def _check_turn(run: CalibrationRun, value: float, expected: float, config: RobotConfig) -> str:
    """Check the angle of a turn; returns a line where only skidding explains it. ConfigError."""
    if abs(value - expected) <= CONTRADICTION_SHARE * abs(expected):
        return ""
    implied = config.wheel_separation_multiplier * expected / value if value else math.inf
    degrees, odometry = math.degrees(abs(value)), math.degrees(abs(expected))
    what, least = f"odometry says {odometry:.0f} degrees", 1.0 + CONTRADICTION_SHARE
    if SKID_MULTIPLIERS[0] / least <= implied <= SKID_MULTIPLIERS[1] * least:
        return f"{run.name}: read {degrees:.0f}, {what}: a multiplier of {implied:.2f} explains it"
    hint = "counted the full turns?" if degrees < 360.0 < odometry else "units, or another run's?"
    raise _contradict(run, f"{degrees:g} degrees", f"{what}: {hint}")


def _contradict(run: CalibrationRun, read: str, why: str) -> ConfigError:
    """The error for a reading that can't be of this run."""
    return ConfigError(
        f"{run.name}: the reading {read} contradicts the odometry by more than "
        f"{CONTRADICTION_SHARE:.0%}: {why}"
    )


@dataclass(frozen=True, slots=True)
class DrivenRobot:
    """The robot to be driven."""

    url: str
    """A simulated body, such as planar, or a serial device."""
    config: RobotConfig
    """What is known of the robot."""
    twin: RobotConfig
    """The simulated robot; equal to the config where nothing is hidden."""
    lidar: str | None = None
    """URL of a LiDAR; "simulated" in simulation; None for a tape or truth."""
    world: Source | None = None
    """World of a simulation."""
    recorder: Recorder | None = None
    """Records all runs; None: nothing is recorded."""

    @property
    def simulated(self) -> bool:
        """Whether the robot is simulated."""
        return self.url in BODIES

    def make_robot(self) -> Robot:
        """The robot, not active."""
        config = self.twin if self.simulated else self.config
        if self.lidar is None:
            return Robot(open_link(self.url, config), self.config, recorder=self.recorder)
        sensors = sensor_factories(["lidar"], self.lidar)
        link = open_link(self.url, with_fine_scans(config))
        return Robot(link, with_fine_scans(self.config), sensors, recorder=self.recorder)

    def make_scene(self) -> Scene:
        """The scene of a simulation: at the world's start, facing its goal or as the world says."""
        if self.world is None:
            return Scene()
        if not self.simulated:
            raise ConfigError(f"--world is for simulated robots: {' or '.join(BODIES)}")
        radius, height = footprint_radius(self.config), lidar_height(self.config)
        pool = Pool.of(self.world, None, radius, 1, height)
        world = next(iter(pool)) if pool else None
        if world is None:
            return Scene()
        start: Pose = (world.start.x, world.start.y, world.start.theta or 0.0)
        return Scene(start, world=world)


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
        ask: Callable[[str], str] | None = None,
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
        plans: Sequence[calibration_drive.RunPlan],
        space: tuple[float, float] | None,
        before: Callable[[calibration_drive.RunPlan], None],
    ) -> None:
        """Drive runs within the stated space; each is kept as soon as it has ended.

        The link is closed after each run, while people measure.

        Args:
            wire: the robot.
            plans: what to drive.
            space: free floor ahead and to each side [m]; see `make_fence`.
            before: called before each run, such as a countdown.

        Raises:
            ConfigError: the space is too small or not stated, or nobody would measure.
            LinkError: the robot can't be driven, or was stopped.
        """
        given = False
        for manoeuvre in ASKED_READINGS:
            count = sum(plan.manoeuvre == manoeuvre for plan in plans)
            rows = len(self._given.rows(manoeuvre))
            given = given or rows > 0
            if rows not in (0, count):
                raise ConfigError(
                    f"{rows} readings for {count} {manoeuvre} runs: must be one for each run"
                )
        observer: calibration_drive.RunObserver | None = None
        if wire.lidar is not None:
            observer = LidarObserver(with_fine_scans(wire.config))
        elif wire.simulated and not given:
            observer = calibration_drive.TruthObserver()
        if not (observer or given or self._ask or self._kept_in):
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
        space = calibration_drive.check_space(wire.config, plans, space)
        scene, robot = wire.make_scene(), wire.make_robot()
        try:
            for plan in plans:
                own = plan.ahead() if wire.simulated else plan  # begins at its start anyway
                before(own)
                robot.safety.fence(calibration_drive.make_fence(wire.config, own, space))
                run = calibration_drive.drive_run(robot, own, scene, observer)
                if any(run.name == one.name for one in self.found):
                    run = replace(run, name=f"{run.name} ({len(self.found) + 1})")
                self.add([run])
                if observer is None and not given:
                    self._ask_readings(len(self.found) - 1)
        finally:
            robot.close()

    def add(self, new: Sequence[CalibrationRun]) -> None:
        """Add runs, such as those of a recording, and keep them in the file."""
        self.found += new
        self._keep()

    def read(self, manoeuvre: str) -> None:
        """Give readings to runs that have none yet: those of the options, then what a person says.

        Raises:
            ConfigError: their number is another one, or a reading contradicts the odometry.
        """
        self.found = assign_readings(self.found, self._given, self._scales)
        lines = [check_readings(run, self._config) for run in self.found]
        self.notes = [line for line in lines if line]
        self._keep()
        for i, run in enumerate(self.found):
            if manoeuvre in (run.manoeuvre, "all") and not run.readings:
                self._ask_readings(i)

    def fit(self) -> GeometryFit | None:
        """Fit all runs; None where none has a reading. ConfigError as for `fit_geometry`."""
        if not any(run.readings for run in self.found):
            return None
        return fit_geometry(self.found, self._config)

    def _ask_readings(self, i: int) -> None:
        """Ask until the answer is a reading of this run, or empty; not where nobody is there."""
        run = self.found[i]
        question = f"{run.name}: {ASKED_READINGS[run.manoeuvre]} (Enter: none)"
        while self._ask is not None:
            try:
                read = parse_readings(run, self._ask(question), self._scales)
                self.notes += [line for line in [check_readings(read, self._config)] if line]
            except ConfigError as error:
                question = f"{error}; again"
            else:
                self.found[i] = read
                self._keep()
                return

    def _keep(self) -> None:
        """Write the runs to their file."""
        if self._kept_in is not None:
            calibration_runs.write_runs(self._kept_in, self.found, self._config)
