"""Checks whether recordings are of the same robot."""

from __future__ import annotations

from collections.abc import Sequence

from acsar_gym.config import RobotConfig
from acsar_gym.config.sections import WIRE_LETTERS
from acsar_gym.errors import ConfigError
from acsar_gym.recording.types import Recording

ROBOT_LENGTHS = ("wheel_radius", "wheel_separation", "wheelbase")
LENGTH_TOLERANCE = 0.1  # lengths of one robot differ by less (a calibration changes them a little)


def find_difference(
    one: RobotConfig, other: RobotConfig, *, wire: bool
) -> tuple[str, str, str] | None:
    """Return the first field in which two robots differ, and both values. None if they don't."""
    for field in ROBOT_LENGTHS:
        first = getattr(one, field)
        second = getattr(other, field)
        if abs(first - second) > LENGTH_TOLERANCE * max(first, second):
            return field, f"{first:g} m", f"{second:g} m"
    if not wire:
        return None

    for field in ("name", "baud_rate"):
        first = getattr(one, field)
        second = getattr(other, field)
        if first != second:
            return field, repr(first), repr(second)
    for letter in WIRE_LETTERS:
        wheels = [getattr(config.wheels, letter) for config in (one, other)]
        wirings = [
            f"motor {'-' if wheel.motor_sign < 0 else ''}{wheel.motor}, "
            f"encoder {'-' if wheel.sign < 0 else ''}{wheel.encoder}"
            for wheel in wheels
        ]
        if wirings[0] != wirings[1]:
            return f"wheels.{letter}", wirings[0], wirings[1]
    return None


def check_same_robot(
    logs: Sequence[tuple[str, Recording]], doing: str, *, wire: bool = True
) -> None:
    """Raise ConfigError, with file and field, where recordings are of several robots."""
    first_name, first = logs[0]
    for name, recording in logs[1:]:
        difference = find_difference(recording.config, first.config, wire=wire)
        if difference is not None:
            field, theirs, expected = difference
            raise ConfigError(
                f"{name}: is of another robot: {field} is {theirs}, but {expected} in "
                f"{first_name}; {doing} one robot at a time"
            )
