"""Runs of a calibration: wheel angles, readings, what odometry says of them, and their file."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, show_value
from acsar_gym.reading import decode_text, parse_json, read_file, write_atomically
from acsar_gym.recording import read
from acsar_gym.tools.sysid.delays import Floats

MAX_RUNS_BYTES = 20_000_000
"""Largest file of runs that is read [bytes]; a turn of one minute takes 150 kB."""
MAX_WHEEL_ANGLE = 1e6
"""Largest wheel angle of a run [rad]."""
READING_KINDS = ("distance", "aside", "x", "y", "heading")
"""What can be measured of a run's end, in the frame of its start: straight distance [m], offset to
the left [m], position ahead and to the left [m], and turned angle [rad], full turns included."""
SAME_ROBOT_FIELDS = ("wheel_separation", "wheelbase")
"""Fields of the config that tell robots apart."""
RUNS_FORMAT = "acsar_gym calibration runs 1"
ODOMETRY_ROUGHNESS = 2e-4
"""Standard deviation of odometry, as a share of the way of each side: encoders, printed digits."""
SKID_SPREAD = 1e-3
"""Standard deviation of the multiplier from run to run, as a share: it depends a little on speed
and turn radius."""


@dataclass(frozen=True, slots=True)
class RunReading:
    """One measured number of a run."""

    kind: str
    """One of READING_KINDS."""
    value: float
    """[m] or [rad]."""
    sigma: float
    """Standard deviation [m] or [rad]."""
    source: str
    """tape, lidar or truth."""


@dataclass(frozen=True, eq=False, slots=True)
class CalibrationRun:
    """One drive from standstill to standstill."""

    name: str
    """Such as "turn 2, left"."""
    manoeuvre: str
    """straight, turn or square."""
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
    values = {"distance": math.hypot(x, y), "aside": y, "x": x, "y": y, "heading": theta}
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


def write_runs(path: Path, runs: Sequence[CalibrationRun], config: RobotConfig) -> None:
    """Write runs to a JSON file; ConfigError if it can't be written."""
    text = json.dumps(format_runs(runs, config), allow_nan=False)
    write_atomically(path, f"{text}\n".encode())


def format_runs(runs: Sequence[CalibrationRun], config: RobotConfig) -> dict[str, Any]:
    """Return runs and what tells their robot from others, for JSON."""
    return {
        "format": RUNS_FORMAT,
        "robot": {name: getattr(config, name) for name in SAME_ROBOT_FIELDS},
        "config": config.model_dump(mode="json"),
        "runs": [
            {
                "name": run.name,
                "manoeuvre": run.manoeuvre,
                "wheels": np.round(run.wheels, 6).tolist(),
                "readings": [asdict(reading) for reading in run.readings],
            }
            for run in runs
        ],
    }


def hash_runs(runs: Sequence[CalibrationRun], config: RobotConfig) -> str:
    """Return the first 16 hex digits of the SHA-256 of the runs as they are written."""
    told = format_runs(runs, config)
    del told["config"]
    data = json.dumps(told, allow_nan=False).encode()
    return hashlib.sha256(data).hexdigest()[:16]


def read_runs(path: Path, config: RobotConfig) -> list[CalibrationRun]:
    """Read a file that `write_runs` made.

    Raises:
        ConfigError: it is missing, cut or foreign, or its runs are of another robot.
    """
    found = _read_file(path)
    with _name_errors(path):
        check_same_geometry("it", found.get("robot"), config)
        return [_parse_run(entry) for entry in found["runs"]]


def read_robot(path: Path) -> RobotConfig | None:
    """The robot whose runs a file keeps; None where it doesn't tell. ConfigError as `read_runs`."""
    told = _read_file(path).get("config")
    with _name_errors(path):
        return None if told is None else RobotConfig.of(told)


def _read_file(path: Path) -> dict[str, Any]:
    """The content of a file of runs; ConfigError names a file that isn't one."""
    data = read_file(path, MAX_RUNS_BYTES)
    with _name_errors(path):
        found = parse_json(decode_text(data))
        if isinstance(found, dict) and found.get("format") == RUNS_FORMAT:
            return found
        raise ConfigError("isn't a file of calibration runs: make one with --runs")


@contextmanager
def _name_errors(path: Path) -> Iterator[None]:
    """Raise ConfigError with the file's name for whatever is wrong with its content."""
    try:
        yield
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        what = " ".join(str(error).split())[:100]
        raise ConfigError(f"{path}: broken calibration runs ({what})") from error
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _parse_run(entry: Any) -> CalibrationRun:
    """Check and convert one run of a file; ValueError and TypeError say what is wrong."""
    wheels = np.array(entry["wheels"], np.float64)
    if wheels.ndim != 2 or wheels.shape[1] != 2 or len(wheels) < 2:
        raise ValueError(f"wheels of shape {wheels.shape}, not (n, 2)")
    if not (np.abs(wheels) <= MAX_WHEEL_ANGLE).all():
        raise ValueError("a wheel angle is too large")
    if entry["manoeuvre"] not in ("straight", "turn", "square"):
        raise ValueError(f"unknown manoeuvre {show_value(entry['manoeuvre'])}")
    readings = []
    for one in entry["readings"]:
        kind, value, sigma = one["kind"], float(one["value"]), float(one["sigma"])
        if kind not in READING_KINDS or not (math.isfinite(value) and 0.0 < sigma < math.inf):
            raise ValueError(f"bad reading {show_value(one)}")
        readings.append(RunReading(kind, value, sigma, str(one["source"])[:20]))
    return CalibrationRun(str(entry["name"])[:100], entry["manoeuvre"], wheels, tuple(readings))


def check_same_geometry(where: str, robot: Any, config: RobotConfig) -> None:
    """Raise ConfigError where the runs are of a robot with another geometry.

    Args:
        where: what holds the runs, for the message.
        robot: fields of that robot.
        config: of the robot that is calibrated.
    """
    told = robot if isinstance(robot, Mapping) else {}
    for name in SAME_ROBOT_FIELDS:
        there, here = told.get(name), getattr(config, name)
        if there != here:
            raise ConfigError(
                f"{where} holds runs of another robot: {name} is {show_value(there)} there and "
                f"{here:g} here; use --robot with that robot's file, or another file of runs"
            )


def read_recorded_runs(path: Path, manoeuvre: str, config: RobotConfig) -> list[CalibrationRun]:
    """Make a run of each episode of a recording.

    Args:
        path: the recording, such as one of `calibrate --record`.
        manoeuvre: what it recorded: straight, turn or square.
        config: of the robot.

    Raises:
        ConfigError: the file can't be read, nothing turned, it is of another robot, or the
            manoeuvre isn't named.
    """
    if manoeuvre == "all":
        raise ConfigError(f"{path}: say what was recorded: straight, turn or square")
    recording = read(path)
    check_same_geometry(str(path), recording.config.model_dump(), config)
    found: list[CalibrationRun] = []
    for episode in recording.episodes:
        if not np.abs(episode.speeds).max(initial=0.0):
            continue
        dt = np.diff(episode.stamps, prepend=episode.start)
        dt[0] = min(dt[0], np.median(dt))  # the reset's wait for standstill is before the first
        a, b, c, d = episode.speeds.T
        turned = np.column_stack([(b + c) / 2.0, (a + d) / 2.0]) * dt[:, None]
        wheels = np.concatenate([np.zeros((1, 2)), np.cumsum(turned, axis=0)])
        name = f"{manoeuvre} {len(found) + 1} of {path.name}"
        found.append(CalibrationRun(name, manoeuvre, wheels))
    if not found:
        raise ConfigError(f"{path}: no episode in which a wheel turned")
    return found
