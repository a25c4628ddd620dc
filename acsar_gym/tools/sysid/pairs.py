"""Checks whether recordings are of the same robot."""

from __future__ import annotations

import math
from collections.abc import Sequence

from acsar_gym.config import RobotConfig
from acsar_gym.config.sections import WIRE_LETTERS
from acsar_gym.errors import ConfigError
from acsar_gym.recording.types import Recording

ROBOT_LENGTHS = ("wheel_radius", "wheel_separation", "wheelbase")
LENGTH_TOLERANCE = 0.1
"""Lengths of a robot differ by less than this share, also after a calibration."""


def find_difference(config: RobotConfig, reference: RobotConfig) -> tuple[str, str, str] | None:
    """Return the first field in which two robots differ, and both values. None if they don't."""
    for field in ROBOT_LENGTHS:
        length = getattr(config, field)
        expected = getattr(reference, field)
        if not math.isclose(length, expected, rel_tol=LENGTH_TOLERANCE):
            return field, f"{length:g} m", f"{expected:g} m"

    values, expected_values = (
        {"name": robot.name, "baud_rate": robot.baud_rate}
        | {f"wheels.{letter}": getattr(robot.wheels, letter) for letter in WIRE_LETTERS}
        for robot in (config, reference)
    )
    for field, value in values.items():
        if value != expected_values[field]:
            return field, str(value), str(expected_values[field])
    return None


def check_same_robot(logs: Sequence[tuple[str, Recording]], doing: str) -> None:
    """Raise ConfigError, with file and field, if recordings are of several robots."""
    first_name, first = logs[0]
    for name, recording in logs[1:]:
        difference = find_difference(recording.config, first.config)
        if difference is not None:
            field, value, expected = difference
            raise ConfigError(
                f"{name}: is of another robot: {field} is {value}, but {expected} in "
                f"{first_name}; {doing} one robot at a time"
            )
