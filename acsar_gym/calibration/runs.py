"""Runs of a calibration: the wheels' angles of each, what was measured of it, and their file."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, shown
from acsar_gym.reading import bounded, structured

Floats = NDArray[np.float64]
MOST_BYTES = 20_000_000
"""Largest file of runs that is read [bytes]; a turn of one minute takes 150 kB."""
MOST_ANGLE = 1e6
"""Largest wheel angle of a run [rad]."""
KINDS = ("distance", "aside", "x", "y", "heading")
"""What can be measured of a run's end, in the frame of its start: straight distance [m], offset to
the left [m], position ahead and to the left [m], and turned angle [rad], full turns included."""
SAME_ROBOT = ("wheel_separation", "wheelbase")
"""Fields of the config that tell robots apart."""
FORMAT = "acsar_gym calibration runs 1"


@dataclass(frozen=True, slots=True)
class Reading:
    """One measured number of a run."""

    kind: str
    """One of KINDS."""
    value: float
    """[m] or [rad]."""
    sigma: float
    """Standard deviation [m] or [rad]."""
    source: str
    """tape, lidar or truth."""


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """One drive from standstill to standstill."""

    name: str
    """Such as "turn 2, left"."""
    manoeuvre: str
    """straight, turn or square."""
    wheels: Floats
    """(n, 2): angles turned since the start by the left and by the right wheels [rad]."""
    readings: tuple[Reading, ...] = ()

    def read(self, readings: Sequence[Reading]) -> Run:
        """Return a copy with these readings."""
        return replace(self, readings=tuple(readings))


def write(path: Path, runs: Sequence[Run], config: RobotConfig) -> None:
    """Write runs to a JSON file; ConfigError if it can't be written."""
    text = json.dumps(as_dict(runs, config), allow_nan=False)
    bounded.write_atomically(path, f"{text}\n".encode())


def as_dict(runs: Sequence[Run], config: RobotConfig) -> dict[str, Any]:
    """Return runs and what tells their robot from others, for JSON."""
    return {
        "format": FORMAT,
        "robot": {name: getattr(config, name) for name in SAME_ROBOT},
        "config": config.model_dump(mode="json"),
        "runs": [
            {
                "name": run.name,
                "manoeuvre": run.manoeuvre,
                "wheels": np.round(run.wheels, 6).tolist(),
                "readings": [
                    {"kind": r.kind, "value": r.value, "sigma": r.sigma, "source": r.source}
                    for r in run.readings
                ],
            }
            for run in runs
        ],
    }


def sha256(runs: Sequence[Run], config: RobotConfig) -> str:
    """Return the first 16 hex digits of the SHA-256 of the runs as they are written."""
    told = as_dict(runs, config)
    del told["config"]
    data = json.dumps(told, allow_nan=False).encode()
    return hashlib.sha256(data).hexdigest()[:16]


def load(path: Path, config: RobotConfig) -> list[Run]:
    """Read a file that `write` made.

    Raises:
        ConfigError: it is missing, cut or foreign, or its runs are of another robot.
    """
    return _read(path, lambda found: _parsed(found, config))


def robot_of(path: Path) -> RobotConfig | None:
    """The robot whose runs a file keeps; None where it doesn't tell. ConfigError as for `load`."""
    return _read(path, _robot)


def _robot(found: Any) -> RobotConfig | None:
    """The config in a file's content; ConfigError."""
    _check_format(found)
    told = found.get("config")
    return None if told is None else RobotConfig.of(told)


T = TypeVar("T")


def _read(path: Path, parse: Callable[[Any], T]) -> T:
    """Read a file; ConfigError names it."""
    data = bounded.read(path, MOST_BYTES)
    try:
        return parse(structured.from_json(structured.decoded(data)))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        what = " ".join(str(error).split())[:100]
        raise ConfigError(f"{path}: broken calibration runs ({what})") from None
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def _parsed(found: Any, config: RobotConfig) -> list[Run]:
    """Check and convert a file's content; ConfigError, KeyError, TypeError, ValueError."""
    _check_format(found)
    check_robot("it", found.get("robot"), config)
    return [_run(entry) for entry in found["runs"]]


def _check_format(found: Any) -> None:
    """Raise ConfigError for another file."""
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise ConfigError("isn't a file of calibration runs: make one with --runs")


def check_robot(where: str, robot: Any, config: RobotConfig) -> None:
    """Raise ConfigError where the runs are of a robot with another geometry.

    Args:
        where: what holds the runs, for the message.
        robot: fields of that robot.
        config: of the robot that is calibrated.
    """
    told = robot if isinstance(robot, Mapping) else {}
    for name in SAME_ROBOT:
        if told.get(name) != getattr(config, name):
            raise ConfigError(
                f"{where} holds runs of another robot: {name} is {shown(told.get(name))} there and "
                f"{getattr(config, name):g} here; use --robot with that robot's file, or another "
                "file of runs"
            )


def _run(entry: Any) -> Run:
    """Check and convert one run of a file; ValueError and TypeError say what is wrong."""
    wheels = np.array(entry["wheels"], np.float64)
    if wheels.ndim != 2 or wheels.shape[1] != 2 or len(wheels) < 2:
        raise ValueError(f"wheels of shape {wheels.shape}, not (n, 2)")
    if not (np.abs(wheels) <= MOST_ANGLE).all():
        raise ValueError("a wheel angle is too large")
    if entry["manoeuvre"] not in ("straight", "turn", "square"):
        raise ValueError(f"unknown manoeuvre {shown(entry['manoeuvre'])}")
    readings = tuple(_reading(one) for one in entry["readings"])
    return Run(str(entry["name"])[:100], entry["manoeuvre"], wheels, readings)


def _reading(entry: Any) -> Reading:
    """Check and convert one reading of a file."""
    value, sigma = float(entry["value"]), float(entry["sigma"])
    if entry["kind"] not in KINDS or not (math.isfinite(value) and 0.0 < sigma < math.inf):
        raise ValueError(f"bad reading {shown(entry)}")
    return Reading(entry["kind"], value, sigma, str(entry["source"])[:20])
