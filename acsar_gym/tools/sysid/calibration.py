"""Runs of a calibration, the readings at their ends, and what odometry predicts for them.

A run is a drive from standstill to standstill, straight or in turns. Odometry computed
from its wheel angles is compared with readings of a tape or a protractor, or in simulation with the
truth.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.recording import read
from acsar_gym.recording.types import Floats

MANOEUVRES = ("straight", "turn")
ODOMETRY_ROUGHNESS = 2e-4
"""Standard deviation of odometry, as a share of the way of each side: encoders, printed digits."""
SKID_SPREAD = 1e-3
"""Standard deviation of the multiplier from run to run, as a share. It depends a little on speed
and turn radius."""
CONTRADICTION_SHARE = 0.3
"""A reading that differs from odometry by more than this share is refused."""
SKID_MULTIPLIERS = (1.0, 2.2)
"""Multipliers of skid-steer robots. A turn may contradict odometry by as much as they explain."""
SHORTEST_RUN = 1e-3
"""A straight run that is shorter than this by odometry can't be measured [m]."""
TAPE_SIGMA = 0.0025
"""Standard deviation of a tape's reading [m]: half of its division, for rounding and placement."""
PROTRACTOR_SIGMA = math.radians(0.5)
"""Standard deviation of a protractor's reading [rad], likewise."""


class RunReading(NamedTuple):
    """A measured number of a run's end, in the frame of its start."""

    kind: str
    """Straight `distance`, offset to the left (`aside`), or `heading` with full turns included."""
    value: float
    """Value [m] or [rad]."""
    sigma: float
    """Standard deviation [m] or [rad]."""
    source: str
    """tape or truth."""

    def format(self, value: float) -> str:
        """Format a value of this kind with its unit."""
        return f"{math.degrees(value):.1f} deg" if self.kind == "heading" else f"{value:.3f} m"


@dataclass(frozen=True, eq=False, slots=True)
class CalibrationRun:
    """A drive from standstill to standstill."""

    name: str
    """Name such as "turn 2, left"."""
    manoeuvre: str
    """straight or turn."""
    wheels: Floats
    """Angles turned since the start by the left and by the right wheels [rad], (n, 2)."""
    readings: tuple[RunReading, ...] = ()


class Geometry(NamedTuple):
    """The three numbers that odometry needs."""

    radius: float
    """Mean of the left and right wheels' radii [m]."""
    ratio: float
    """Right radius less left radius, as a share of the mean."""
    multiplier: float
    """wheel_separation_multiplier."""

    @classmethod
    def of(cls, config: RobotConfig) -> Geometry:
        """Return the geometry that a robot is configured with."""
        sides = (config.left_wheel_radius_multiplier, config.right_wheel_radius_multiplier)
        # Both multipliers together are a radius, and their difference is the ratio.
        mean = fmean(sides)
        ratio = (sides[1] - sides[0]) / mean
        return cls(config.wheel_radius * mean, ratio, config.wheel_separation_multiplier)

    @property
    def radii(self) -> tuple[float, float]:
        """Radii of the left and right wheels [m]."""
        half = self.ratio / 2.0
        return self.radius * (1.0 - half), self.radius * (1.0 + half)


def integrate_wheels(
    wheels: Floats, geometry: Geometry, separation: float
) -> tuple[float, float, float]:
    """Integrate wheel angles exactly, as arcs.

    Args:
        wheels: Angles of the left and right wheels since the start [rad], (n, 2).
        geometry: Radii and multiplier.
        separation: wheel_separation [m].

    Returns:
        x [m], y [m] and theta [rad] in the frame of the start, with full turns included.
    """
    # The way of each side in each step, and what the robot turned by their difference.
    moved = np.diff(wheels, axis=0, prepend=0.0) * geometry.radii
    way = (moved[:, 0] + moved[:, 1]) / 2.0
    turned = (moved[:, 1] - moved[:, 0]) / (separation * geometry.multiplier)

    # Each step is an arc, whose chord points to its middle heading.
    middle = np.cumsum(turned) - turned / 2.0
    chord = way * np.sinc(turned / (2.0 * math.pi))
    x = (chord * np.cos(middle)).sum()
    y = (chord * np.sin(middle)).sum()
    return float(x), float(y), float(turned.sum())


def predict_readings(
    run: CalibrationRun, geometry: Geometry, separation: float
) -> tuple[list[float], list[float]]:
    """Return what each reading of a run should be by odometry [m, rad].

    Returns:
        The readings, and the standard deviations of reading less odometry.
    """
    x, y, theta = integrate_wheels(run.wheels, geometry, separation)
    values = {"distance": math.hypot(x, y), "aside": y, "heading": theta}

    # Errors of both sides add up along the way, and turn the robot by the lever of the track.
    rough = ODOMETRY_ROUGHNESS * rolled_distance(run, geometry.radius)
    arm = separation * geometry.multiplier / 2.0
    turning = math.hypot(rough / arm, SKID_SPREAD * abs(theta))
    sigmas = [
        math.hypot(reading.sigma, turning if reading.kind == "heading" else rough)
        for reading in run.readings
    ]
    return [values[reading.kind] for reading in run.readings], sigmas


def rolled_distance(run: CalibrationRun, radius: float) -> float:
    """Return the mean distance that the left and the right wheels rolled in a run [m]."""
    return float(np.abs(np.diff(run.wheels, axis=0)).sum()) * radius / 2.0


def side_angles(wheels: Floats) -> Floats:
    """Return the mean angle of the left and of the right wheels [rad], (n, 2), from all four."""
    a, b, c, d = wheels.T
    return np.column_stack((b + c, a + d)) / 2.0


def hash_runs(runs: Sequence[CalibrationRun]) -> str:
    """Return the first 16 hex digits of the SHA-256 of runs and their readings."""
    # Rounded, so that another computer finds the same hash.
    pieces = [np.round(run.wheels, 6).tobytes() + repr(run.readings).encode() for run in runs]
    return hashlib.sha256(b"".join(pieces)).hexdigest()[:16]


def read_recorded_runs(path: Path, manoeuvre: str, config: RobotConfig) -> list[CalibrationRun]:
    """Return a run for each episode of a recording.

    Args:
        path: Recording, such as that of `calibrate --record`.
        manoeuvre: straight, turn, or all. A recording that doesn't name its manoeuvres must be of
            one kind.
        config: Robot configuration.

    Raises:
        ConfigError: The file can't be read, nothing turned, it is of another robot, or the
            manoeuvre isn't known.
    """
    recording = read(path)

    # Angles of wheels mean other turns on another robot.
    for name in ("wheel_separation", "wheelbase"):
        recorded = getattr(recording.config, name)
        configured = getattr(config, name)
        if recorded != configured:
            raise ConfigError(
                f"{path}: is of another robot: {name} is {recorded:g} there and {configured:g} "
                "here; use --robot with that robot's file"
            )

    runs: list[CalibrationRun] = []
    for episode in recording.episodes:
        # Runs of `calibrate` are named. Other drives are of the kind that the user names.
        driven = str(episode.info.get("manoeuvre") or manoeuvre)
        if driven not in MANOEUVRES:
            raise ConfigError(f"{path}: say what was recorded: {' or '.join(MANOEUVRES)}")
        if manoeuvre not in (driven, "all") or not np.abs(episode.speeds).max(initial=0.0):
            continue

        # Speeds of ticks add up to the angles of a run.
        dt = np.diff(episode.stamps, prepend=episode.start)
        dt[0] = min(dt[0], np.median(dt))  # the reset's wait for standstill is before the first
        turned = np.cumsum(side_angles(episode.speeds) * dt[:, None], axis=0)
        name = str(episode.info.get("run") or f"{driven} {len(runs) + 1} of {path.name}")[:100]
        runs.append(CalibrationRun(name, driven, np.vstack((np.zeros(2), turned))))
    if not runs:
        raise ConfigError(f"{path}: no {manoeuvre} episode in which a wheel turned")
    return runs


def read_tape(kind: str, value: float) -> RunReading:
    """Return a reading of the tape [m]."""
    return RunReading(kind, value, TAPE_SIGMA, "tape")


def read_protractor(degrees: float) -> RunReading:
    """Return a reading of the protractor [degrees]."""
    return RunReading("heading", math.radians(degrees), PROTRACTOR_SIGMA, "tape")


class GivenReadings(NamedTuple):
    """Readings that options give for the runs of each manoeuvre, in their order."""

    measured: Sequence[float] = ()
    """Distances from start to end [m]."""
    aside: Sequence[float] = ()
    """Offsets to the left [m]."""
    degrees: Sequence[float] = ()
    """Turned angles [degrees], with full turns counted."""

    def check(self, manoeuvres: Sequence[str]) -> bool:
        """Return whether there are readings.

        Args:
            manoeuvres: straight or turn, for each run.

        Raises:
            ConfigError: There isn't a reading for each run, or a reading isn't a finite number.
        """
        options = {"measured": "straight", "aside": "straight", "measured-deg": "turn"}
        for (option, manoeuvre), numbers in zip(options.items(), self, strict=True):
            if not all(map(math.isfinite, numbers)):
                raise ConfigError(
                    f"--{option} {' '.join(map(str, numbers))}: must be finite numbers"
                )

            # Each option has a reading for each run of its manoeuvre, or none.
            runs = manoeuvres.count(manoeuvre)
            if len(numbers) not in (0, runs):
                raise ConfigError(
                    f"--{option}: {len(numbers)} readings for {runs} {manoeuvre} runs: must be one "
                    "for each run"
                )
        if self.aside and not self.measured:
            raise ConfigError("--aside needs --measured")
        return any(map(len, self))

    def give(self, runs: Sequence[CalibrationRun]) -> list[CalibrationRun]:
        """Return the runs with these readings. If a drive failed, there are fewer runs."""
        distances, offsets, angles = map(iter, self)
        measured_runs = []

        for run in runs:
            if run.manoeuvre == "turn":
                turned = np.diff(run.wheels[-1])[0]  # right less left: positive to the left
                readings = [read_protractor(math.copysign(x, turned)) for x in islice(angles, 1)]
            else:
                # Backward runs have positive readings as well.
                readings = [read_tape("distance", abs(x)) for x in islice(distances, 1)]
                readings += [read_tape("aside", y) for y in islice(offsets, 1)]
            measured_runs.append(replace(run, readings=tuple(readings) or run.readings))
        return measured_runs


def check_readings(run: CalibrationRun, config: RobotConfig) -> None:
    """Compare a run's readings with odometry. A turn may differ by what skidding explains.

    Raises:
        ConfigError: A reading contradicts odometry by more than `CONTRADICTION_SHARE`.
    """
    geometry = Geometry.of(config)
    odometry, _ = predict_readings(run, geometry, config.wheel_separation)

    for reading, expected in zip(run.readings, odometry, strict=True):
        low = 1.0 - CONTRADICTION_SHARE
        high = 1.0 + CONTRADICTION_SHARE

        # Wrong units and forgotten turns are off by far more than a wrong radius.
        share = reading.value / (expected or math.inf)
        if reading.kind == "distance" and expected < SHORTEST_RUN:
            raise ConfigError(f"{run.name}: ended where it began, by odometry: not a straight run")
        if reading.kind == "aside":
            low = -high
            share = reading.value / rolled_distance(run, geometry.radius)
        elif run.manoeuvre == "turn":
            low *= min(1.0, geometry.multiplier / SKID_MULTIPLIERS[1])
            high *= max(1.0, geometry.multiplier / SKID_MULTIPLIERS[0])
        elif reading.kind == "heading":
            continue
        if not low <= share <= high:
            raise ConfigError(
                f"{run.name}: the reading {reading.format(reading.value)} contradicts the odometry "
                f"by more than {CONTRADICTION_SHARE:.0%}, which says {reading.format(expected)}: "
                "is it in metres, or degrees with full turns counted, and of this run?"
            )
