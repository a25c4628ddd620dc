"""Readings of tape measure and protractor, from options, files and prompts, and their checks."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from acsar_gym.calibration.model import configured, end_pose, way
from acsar_gym.calibration.runs import Reading, Run
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, shown
from acsar_gym.reading import bounded, structured

CONTRADICTION = 0.3
"""A reading that differs from odometry by more than this share is refused."""
NOWHERE = 1e-3
"""A straight run that is shorter than this, by odometry, can't be measured [m]."""
SKIDS = (1.0, 2.2)
"""Multipliers of skid-steer robots; a turn may contradict odometry by as much as they explain."""
MOST_BYTES = 1_000_000
"""Largest file of corners [bytes]."""
TAPE = "tape"
"""Source of readings of a person."""
SHARE = 0.5
"""Standard deviation of a reading, as a share of the scale's divisions: rounding and placement."""


@dataclass(frozen=True, slots=True)
class Scales:
    """Divisions of tape and protractor."""

    tape: float = 0.005
    """[m]."""
    protractor: float = 1.0
    """[degrees]."""

    def metres(self, kind: str, value: float) -> Reading:
        """A reading of the tape [m]."""
        return Reading(kind, value, SHARE * self.tape, TAPE)

    def degrees(self, value: float) -> Reading:
        """A reading of the protractor [degrees]."""
        return Reading("heading", math.radians(value), SHARE * math.radians(self.protractor), TAPE)


def of_line(numbers: Sequence[float], scales: Scales) -> list[Reading]:
    """Readings of a straight run: distance from start to end, and its offset to the left [m]."""
    found = [scales.metres("distance", abs(numbers[0]))]  # backwards runs as well
    return found + [scales.metres("aside", aside) for aside in numbers[1:]]


def of_turn(degrees: float, run: Run, scales: Scales) -> list[Reading]:
    """The reading of a turn: the turned angle [degrees], full turns counted, in either sense."""
    right, left = run.wheels[-1, 1], run.wheels[-1, 0]
    return [scales.degrees(math.copysign(degrees, right - left))]


def of_corner(numbers: Sequence[float], run: Run, scales: Scales) -> list[Reading]:
    """Readings of a square: where it ended, x and y [m], and its heading there [degrees]."""
    found = [scales.metres("x", numbers[0]), scales.metres("y", numbers[1])]
    if len(numbers) == 3:
        clockwise = run.wheels[-1, 1] < run.wheels[-1, 0]
        found.append(scales.degrees(numbers[2] + (-360.0 if clockwise else 360.0)))
    return found


def corners(path: Path) -> list[tuple[float, ...]]:
    """Read where squares ended from a CSV file.

    Args:
        path: one row for each run: x and y [m] in the frame of the start (x ahead, y to the left),
            and optionally the heading [degrees]; a first row of names is skipped.

    Raises:
        ConfigError: the file can't be read, or a row isn't two or three numbers.
    """
    text = structured.decoded(bounded.read(path, MOST_BYTES))
    rows = [row for row in csv.reader(text.splitlines()) if any(cell.strip() for cell in row)]
    if rows and not _is_number(rows[0][0]):
        rows = rows[1:]
    found = []
    for number, row in enumerate(rows, start=1):
        if len(row) not in (2, 3) or not all(map(_is_number, row)):
            raise ConfigError(
                f"{path}: row {number}, {shown(','.join(row))}: must be x,y or x,y,degrees"
            )
        found.append(tuple(map(float, row)))
    if not found:
        raise ConfigError(f"{path}: no rows: must have x,y of the end of each run [m]")
    return found


def check(run: Run, config: RobotConfig) -> str:
    """Compare a run's readings with odometry.

    Returns:
        A line to be told about a turn that skidding explains but the config doesn't; else empty.

    Raises:
        ConfigError: a reading contradicts odometry by more than CONTRADICTION.
    """
    told = ""
    for reading in run.readings:
        if reading.kind == "heading":
            told = _check_turn(run, reading.value, config) if run.manoeuvre == "turn" else ""
        elif reading.kind == "distance":
            _check_distance(run, reading.value, config)
        elif abs(reading.value) > (1.0 + CONTRADICTION) * max(way(run, _radius(config)), 0.1):
            raise _contradiction(run, f"{reading.value:g}", "farther than the robot drove")
    return told


def _check_distance(run: Run, value: float, config: RobotConfig) -> None:
    """Check the length of a straight run; ConfigError."""
    x, y, _ = end_pose(run.wheels, configured(config), config.wheel_separation)
    expected = math.hypot(x, y)
    if expected < NOWHERE:
        raise ConfigError(f"{run.name}: ended where it began, by odometry: not a straight run")
    if not abs(value - expected) <= CONTRADICTION * expected:
        times = value / expected
        hint = "in centimetres?" if 50.0 < times < 200.0 else "another run's?"
        hint = "in millimetres?" if 500.0 < times < 2000.0 else hint
        raise _contradiction(run, f"{value:g} m", f"odometry says {expected:.3f} m: {hint}")


def _check_turn(run: Run, value: float, config: RobotConfig) -> str:
    """Check the angle of a turn; returns a line where only skidding explains it. ConfigError."""
    expected = end_pose(run.wheels, configured(config), config.wheel_separation)[2]
    implied = config.wheel_separation_multiplier * expected / value if value else math.inf
    degrees, odometry = math.degrees(abs(value)), math.degrees(abs(expected))
    if abs(value - expected) <= CONTRADICTION * abs(expected):
        return ""
    what = f"odometry says {odometry:.0f} degrees"
    if SKIDS[0] / (1.0 + CONTRADICTION) <= implied <= SKIDS[1] * (1.0 + CONTRADICTION):
        return f"{run.name}: read {degrees:.0f}, {what}: a multiplier of {implied:.2f} explains it"
    hint = "counted the full turns?" if degrees < 360.0 < odometry else "units, or another run's?"
    raise _contradiction(run, f"{degrees:g} degrees", f"{what}: {hint}")


def _contradiction(run: Run, read: str, why: str) -> ConfigError:
    """The error for a reading that can't be of this run."""
    return ConfigError(
        f"{run.name}: the reading {read} contradicts the odometry by more than "
        f"{CONTRADICTION:.0%}: {why}"
    )


def _radius(config: RobotConfig) -> float:
    """Mean wheel radius [m]."""
    return configured(config).radius


def _is_number(text: str) -> bool:
    """Whether a cell holds a finite number."""
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
