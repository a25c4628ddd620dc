"""Whether two configs are of one robot, as far as the recordings of its wire are concerned."""

from __future__ import annotations

from collections.abc import Sequence

from acsar_gym.config import RobotConfig
from acsar_gym.config.wheels import LETTERS
from acsar_gym.errors import ConfigError
from acsar_gym.recording.types import Recording

LENGTHS = ("wheel_radius", "wheel_separation", "wheelbase")
ALIKE = 0.1
"""Lengths of one robot differ by less than this share: a calibration changes them a little."""


def differing(one: RobotConfig, other: RobotConfig, *, wire: bool) -> tuple[str, str, str] | None:
    """Return the first field in which two robots differ, and both values; None if they don't.

    Args:
        one: a robot.
        other: another one, or the same one before or after it was calibrated.
        wire: whether name, baud rate and wiring count, too.
    """
    for field in LENGTHS:
        first, second = getattr(one, field), getattr(other, field)
        if abs(first - second) > ALIKE * max(first, second):
            return field, f"{first:g} m", f"{second:g} m"
    return _differing_wire(one, other) if wire else None


def _differing_wire(one: RobotConfig, other: RobotConfig) -> tuple[str, str, str] | None:
    """The first difference in name, baud rate and wiring."""
    for field in ("name", "baud_rate"):
        first, second = getattr(one, field), getattr(other, field)
        if first != second:
            return field, repr(first), repr(second)
    for letter in LETTERS:
        wirings = [_wiring(config, letter) for config in (one, other)]
        if wirings[0] != wirings[1]:
            return f"wheels.{letter}", wirings[0], wirings[1]
    return None


def _wiring(config: RobotConfig, letter: str) -> str:
    """The wiring of one wheel in a few words."""
    wheel = getattr(config.wheels, letter)
    motor, encoder = ("-" if sign < 0 else "" for sign in (wheel.motor_sign, wheel.sign))
    return f"motor {motor}{wheel.motor}, encoder {encoder}{wheel.encoder}"


def check_same(logs: Sequence[tuple[str, Recording]], doing: str, *, wire: bool = True) -> None:
    """Check that recordings are of one robot.

    Args:
        logs: names and recordings.
        doing: verb for the message, such as "identify".
        wire: whether name, baud rate and wiring count, too.

    Raises:
        ConfigError: the message names the first file of another robot, and the field.
    """
    first_name, first = logs[0]
    for name, recording in logs[1:]:
        found = differing(recording.config, first.config, wire=wire)
        if found is not None:
            field, theirs, own = found
            raise ConfigError(
                f"{name}: is of another robot: {field} is {theirs}, but {own} in {first_name}; "
                f"{doing} one robot at a time"
            )
