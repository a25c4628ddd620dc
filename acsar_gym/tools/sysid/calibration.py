"""The job `calibrate`: runs are driven or read from recordings, given readings, checked and fitted.

A run is one drive from standstill to standstill, straight or in turns. What odometry says of its
wheel angles is compared with what a person read from a tape or a protractor; in simulation, with
the truth.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, show_value
from acsar_gym.recording import read
from acsar_gym.tools.sysid.board_log import Floats

MANOEUVRES = ("straight", "turn")
ODOMETRY_ROUGHNESS = 2e-4
"""Standard deviation of odometry, as a share of the way of each side: encoders, printed digits."""
SKID_SPREAD = 1e-3
"""Standard deviation of the multiplier from run to run, as a share: it depends a little on speed
and turn radius."""
CONTRADICTION_SHARE = 0.3
"""A reading that differs from odometry by more than this share is refused."""
SHORTEST_RUN = 1e-3
"""A straight run that is shorter than this, by odometry, can't be measured [m]."""
SKID_MULTIPLIERS = (1.0, 2.2)
"""Multipliers of skid-steer robots; a turn may contradict odometry by as much as they explain."""
TAPE_DIVISION, PROTRACTOR_DIVISION = 0.005, 1.0
"""Divisions of the scales [m], [degrees]."""
DIVISION_SIGMA = 0.5
"""Standard deviation of a reading, as a share of the scale's divisions: rounding and placement."""
LARGEST_READING = 1e6
ASKED_READINGS = {
    "straight": "straight distance from start to end [m], and how far to the left it ended [m] if "
    "you have it",
    "turn": "turned angle [degrees], full turns counted",
}
"""What a person is asked for after each run."""


class RunReading(NamedTuple):
    """One measured number of a run's end, in the frame of its start."""

    kind: str
    """Straight `distance`, offset to the left (`aside`), or `heading`, full turns included."""
    value: float
    """[m] or [rad]."""
    sigma: float
    """Standard deviation [m] or [rad]."""
    source: str
    """tape or truth."""


@dataclass(frozen=True, eq=False, slots=True)
class CalibrationRun:
    """One drive from standstill to standstill."""

    name: str
    """Such as "turn 2, left"."""
    manoeuvre: str
    """straight or turn."""
    wheels: Floats
    """(n, 2): angles turned since the start by the left and by the right wheels [rad]."""
    readings: tuple[RunReading, ...] = ()

    def read(self, readings: Sequence[RunReading]) -> CalibrationRun:
        """Return a copy with these readings."""
        return replace(self, readings=tuple(readings))


class Geometry(NamedTuple):
    """The three numbers that odometry needs."""

    radius: float
    """Mean of the left and right wheels' radii [m]."""
    ratio: float
    """Right radius less left radius, as a share of the mean."""
    multiplier: float
    """wheel_separation_multiplier."""

    @property
    def left(self) -> float:
        """Radius of the left wheels [m]."""
        return self.radius * (1.0 - self.ratio / 2.0)

    @property
    def right(self) -> float:
        """Radius of the right wheels [m]."""
        return self.radius * (1.0 + self.ratio / 2.0)


def configured_geometry(config: RobotConfig) -> Geometry:
    """The geometry that a robot is configured with."""
    left, right = config.left_wheel_radius_multiplier, config.right_wheel_radius_multiplier
    mean = (left + right) / 2.0
    return Geometry(
        config.wheel_radius * mean, (right - left) / mean, config.wheel_separation_multiplier
    )


def integrate_wheels(
    wheels: Floats, geometry: Geometry, separation: float
) -> tuple[float, float, float]:
    """Integrate wheel angles exactly, as arcs.

    Args:
        wheels: (n, 2), angles of the left and right wheels since the start [rad].
        geometry: radii and multiplier.
        separation: wheel_separation [m].

    Returns:
        x [m], y [m] and theta [rad], full turns included, in the frame of the start.
    """
    moved = np.diff(wheels, axis=0, prepend=0.0) * (geometry.left, geometry.right)
    way = (moved[:, 0] + moved[:, 1]) / 2.0
    turned = (moved[:, 1] - moved[:, 0]) / (separation * geometry.multiplier)
    middle = np.cumsum(turned) - turned / 2.0
    chord = way * np.sinc(turned / (2.0 * math.pi))
    x, y = (chord * np.cos(middle)).sum(), (chord * np.sin(middle)).sum()
    return float(x), float(y), float(turned.sum())


def predict_readings(run: CalibrationRun, geometry: Geometry, separation: float) -> list[float]:
    """What each reading of a run should be by odometry [m, rad]."""
    x, y, theta = integrate_wheels(run.wheels, geometry, separation)
    values = {"distance": math.hypot(x, y), "aside": y, "heading": theta}
    return [values[reading.kind] for reading in run.readings]


def rolled_distance(run: CalibrationRun, radius: float) -> float:
    """Mean of the distances that the left and the right wheels rolled in a run [m]."""
    return float(np.abs(np.diff(run.wheels, axis=0)).sum()) * radius / 2.0


def reading_sigmas(run: CalibrationRun, geometry: Geometry, separation: float) -> list[float]:
    """Standard deviation of reading less odometry for each reading of a run [m, rad]."""
    rough = ODOMETRY_ROUGHNESS * rolled_distance(run, geometry.radius)
    arm = separation * geometry.multiplier / 2.0
    skid = SKID_SPREAD * abs(integrate_wheels(run.wheels, geometry, separation)[2])
    return [
        math.hypot(reading.sigma, rough / arm, skid)
        if reading.kind == "heading"
        else math.hypot(reading.sigma, rough)
        for reading in run.readings
    ]


def hash_runs(runs: Sequence[CalibrationRun]) -> str:
    """Return the first 16 hex digits of the SHA-256 of runs and their readings."""
    whole = hashlib.sha256()
    for run in runs:
        whole.update(np.round(run.wheels, 6).tobytes() + repr(run.readings).encode())
    return whole.hexdigest()[:16]


def read_recorded_runs(path: Path, manoeuvre: str, config: RobotConfig) -> list[CalibrationRun]:
    """Make a run of each episode of a recording.

    Args:
        path: the recording, such as one of `calibrate --record`.
        manoeuvre: straight, turn, or all; one that doesn't say it itself must be of one kind.
        config: of the robot.

    Raises:
        ConfigError: the file can't be read, nothing turned, it is of another robot, or the
            manoeuvre isn't known.
    """
    recording = read(path)
    for name in ("wheel_separation", "wheelbase"):
        there, here = getattr(recording.config, name), getattr(config, name)
        if there != here:
            raise ConfigError(
                f"{path}: is of another robot: {name} is {there:g} there and {here:g} here; use "
                "--robot with that robot's file"
            )
    runs: list[CalibrationRun] = []
    for episode in recording.episodes:
        own = str(episode.info.get("manoeuvre") or manoeuvre)
        if own not in MANOEUVRES:
            raise ConfigError(f"{path}: say what was recorded: {' or '.join(MANOEUVRES)}")
        if manoeuvre not in (own, "all") or not np.abs(episode.speeds).max(initial=0.0):
            continue
        dt = np.diff(episode.stamps, prepend=episode.start)
        dt[0] = min(dt[0], np.median(dt))  # the reset's wait for standstill is before the first
        a, b, c, d = episode.speeds.T
        turned = np.column_stack([(b + c) / 2.0, (a + d) / 2.0]) * dt[:, None]
        wheels = np.concatenate([np.zeros((1, 2)), np.cumsum(turned, axis=0)])
        name = str(episode.info.get("run") or f"{own} {len(runs) + 1} of {path.name}")[:100]
        runs.append(CalibrationRun(name, own, wheels))
    if not runs:
        raise ConfigError(f"{path}: no {manoeuvre} episode in which a wheel turned")
    return runs


def read_tape(kind: str, value: float) -> RunReading:
    """A reading of the tape [m]."""
    return RunReading(kind, value, DIVISION_SIGMA * TAPE_DIVISION, "tape")


def read_protractor(degrees: float) -> RunReading:
    """A reading of the protractor [degrees]."""
    sigma = DIVISION_SIGMA * math.radians(PROTRACTOR_DIVISION)
    return RunReading("heading", math.radians(degrees), sigma, "tape")


GivenReadings = dict[str, list[tuple[float, ...]]]
"""Rows of numbers that options give, for the runs of each manoeuvre in their order."""


def check_given_readings(
    measured: Sequence[float], aside: Sequence[float], degrees: Sequence[float]
) -> GivenReadings:
    """Check readings of options: distances and offsets of lines [m], angles of turns [degrees].

    Raises:
        ConfigError: a number is too large, or there isn't an offset for each distance.
    """
    options = {"measured": measured, "aside": aside, "measured-deg": degrees}
    for option, numbers in options.items():
        for number in numbers:
            if not abs(number) <= LARGEST_READING:
                limits = f"{-LARGEST_READING:g} to {LARGEST_READING:g}"
                raise ConfigError(f"--{option} {number:g}: must be {limits}")
    if aside and len(aside) != len(measured):
        raise ConfigError(
            f"--aside has {len(aside)} readings, --measured {len(measured)}: must be as many"
        )
    lines = zip(measured, *([aside] if aside else []), strict=True)
    return {"straight": list(lines), "turn": [(angle,) for angle in degrees]}


def give_readings(run: CalibrationRun, row: Sequence[float]) -> CalibrationRun:
    """Give a run the readings of a row of numbers.

    Straight: distance from start to end, and its offset to the left [m]. Turn: the turned angle
    [degrees], full turns counted, in either sense.
    """
    if run.manoeuvre == "turn":
        left, right = run.wheels[-1]
        return run.read([read_protractor(math.copysign(row[0], right - left))])
    readings = [read_tape("distance", abs(row[0]))]  # backwards runs are positive as well
    return run.read(readings + [read_tape("aside", aside) for aside in row[1:]])


def parse_readings(run: CalibrationRun, text: str) -> CalibrationRun:
    """Give a run the readings that a person typed; nothing typed leaves it without.

    Raises:
        ConfigError: these aren't as many numbers as asked for.
    """
    if not text.strip():
        return run
    try:
        row = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        row = []
    counts = (1, 2) if run.manoeuvre == "straight" else (1,)
    if len(row) not in counts or not all(abs(number) <= LARGEST_READING for number in row):
        asked = ASKED_READINGS[run.manoeuvre]
        raise ConfigError(f"{show_value(text.strip())}: must be the {asked}")
    return give_readings(run, row)


def check_readings(run: CalibrationRun, config: RobotConfig) -> None:
    """Compare a run's readings with odometry; a turn may differ by what skidding explains.

    Raises:
        ConfigError: a reading contradicts odometry by more than CONTRADICTION_SHARE.
    """
    geometry = configured_geometry(config)
    expected = predict_readings(run, geometry, config.wheel_separation)
    most = 1.0 + CONTRADICTION_SHARE
    for (kind, value, *_), odometry in zip(run.readings, expected, strict=True):
        shown, said = f"{value:g} m", f"{odometry:.3f} m"
        fits = abs(value - odometry) <= CONTRADICTION_SHARE * abs(odometry)
        if kind == "distance" and odometry < SHORTEST_RUN:
            what = "ended where it began, by odometry: not a straight run"
            raise ConfigError(f"{run.name}: {what}")
        if kind == "aside":
            farthest = rolled_distance(run, geometry.radius)
            fits, said = abs(value) <= most * farthest, f"that it drove {farthest:.3f} m in all"
        elif kind == "heading":
            shown, said = (f"{math.degrees(abs(angle)):.0f} degrees" for angle in (value, odometry))
            multiplier = config.wheel_separation_multiplier * odometry / (value or math.inf)
            skids = SKID_MULTIPLIERS[0] / most <= multiplier <= SKID_MULTIPLIERS[1] * most
            fits = fits or skids or run.manoeuvre != "turn"
        if not fits:
            raise ConfigError(
                f"{run.name}: the reading {shown} contradicts the odometry by more than "
                f"{CONTRADICTION_SHARE:.0%}, which says {said}: is it in metres, or degrees with "
                "full turns counted, and of this run?"
            )


class CalibrationJob:
    """Collects runs and their readings.

    Attributes: `config`, of the robot; `runs`, all so far; `in_ros`, whether the robot is in ROS 2.

    Args:
        config: of the robot.
        given: readings of the options.
        ask: asks a person, who can answer; None where nobody is there.
    """

    def __init__(
        self,
        config: RobotConfig,
        given: GivenReadings,
        ask: Callable[[str], str] | None = None,
    ) -> None:
        self.runs: list[CalibrationRun] = []
        self.config = config
        self.in_ros = False
        self._given = given
        self._ask = ask

    @property
    def asks(self) -> bool:
        """Whether somebody is there who can be asked."""
        return self._ask is not None

    def check_given(self, counts: Counter[str]) -> bool:
        """Return whether the options give readings; ConfigError unless each run of a kind has one.

        Args:
            counts: how many runs of each manoeuvre there are, or are to be driven.
        """
        for manoeuvre, rows in self._given.items():
            if len(rows) not in (0, counts[manoeuvre]):
                raise ConfigError(
                    f"{len(rows)} readings for {counts[manoeuvre]} {manoeuvre} runs: must be one "
                    "for each run"
                )
        return any(self._given.values())

    def finish(self) -> None:
        """Give readings to runs that have none yet: those of the options, then what a person says.

        Where the drive failed there are fewer runs than readings.

        Raises:
            ConfigError: a reading contradicts the odometry.
        """
        for manoeuvre, rows in self._given.items():
            places = [i for i, run in enumerate(self.runs) if run.manoeuvre == manoeuvre]
            for i, row in zip(places, rows, strict=False):
                self.runs[i] = give_readings(self.runs[i], row)
        for place, run in enumerate(self.runs):
            check_readings(run, self.config)
            if not run.readings:
                self.ask_readings(place)

    def ask_readings(self, place: int) -> None:
        """Ask until the answer is a reading of this run, or empty; not where nobody is there."""
        run = self.runs[place]
        question = f"{run.name}: {ASKED_READINGS[run.manoeuvre]} (Enter: none)"
        while self._ask is not None:
            try:
                answered = parse_readings(run, self._ask(question))
                check_readings(answered, self.config)
            except ConfigError as error:
                question = f"{error}; again"
            else:
                self.runs[place] = answered
                return
