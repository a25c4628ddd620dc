"""Explains wheels whose measured speed isn't the commanded one: encoders in a loop, and units."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from acsar_gym.config import RobotConfig
from acsar_gym.tools.doctor.board import WheelAnswer

RATIO_TOLERANCE = 0.1
"""Ratios that differ by less than this share are the same."""
HIGHEST_SPEED = 99.9
"""Speed above which a line with two digits may have cut a speed off [rad/s]."""
IN_PROGRAM = "in the board's program"
REVERSED_FIX = f"set ENCODER_REVERSED {IN_PROGRAM} (MOTOR_REVERSED, if the wheel turned backward)"
SWAPPED_FIX = "swap the wires, or the encoder's pins in the board's program"
"""What mends a board whose own speed loop meets the wrong sign, or the encoder of another wheel: it
drives its wheel away from the command, whatever the robot's file says."""


def describe_wheel(answer: WheelAnswer) -> str:
    """Say what was measured of a wheel that isn't right."""
    if answer.stopped:
        way = "backward" if answer.sign == -1 else "forward"
        return f"turned {way}, and stood again although the command went on"
    measured = answer.ratio * answer.asked
    speeds = f"{measured:.2f} rad/s, {answer.asked:.2f} commanded"
    return f"measured/commanded {answer.ratio:.2f} ({speeds})"


def explain_wheel(answer: WheelAnswer, answers: Sequence[WheelAnswer], config: RobotConfig) -> str:
    """Say what to do about a wheel that isn't right.

    Args:
        answer: of that wheel.
        answers: of all wheels.
        config: of the robot.
    """
    if answer.encoder != answer.letter:
        return SWAPPED_FIX
    if answer.sign == -1 and not any(_is_same(answer, other) for other in answers):
        return REVERSED_FIX
    if answer.stopped:
        return "check the plugs of motor and encoder, and the motor's driver"
    if units := list(_units(answer, config)):
        return f"{' or '.join(units)}: the wire carries rad/s of the wheel, both ways"
    weak = ", or a motor that is too weak" if abs(answer.ratio) < 1.0 else ""
    return f"likely counts per turn or gear ratio {IN_PROGRAM}{weak}"


def _is_same(answer: WheelAnswer, other: WheelAnswer) -> bool:
    """Return whether a wheel that isn't backward is as wrong as one that is."""
    return other.sign == 1 and math.isclose(other.ratio, abs(answer.ratio), rel_tol=RATIO_TOLERANCE)


def _units(answer: WheelAnswer, config: RobotConfig) -> Iterator[str]:
    """Name the units that a ratio is likely due to."""
    ratio = abs(answer.ratio)
    if ratio * answer.asked > HIGHEST_SPEED:
        yield "likely feedback in deg/s or counts, or that of the motor before its gears"
    for unit, factor in (
        ("feedback in rpm", 30.0 / math.pi),
        ("feedback in rev/s", 0.5 / math.pi),
        ("feedback in deg/s", 180.0 / math.pi),
        ("feedback in m/s", config.wheel_radius),
        ("commands taken as rpm", math.pi / 30.0),
    ):
        if math.isclose(ratio, factor, rel_tol=RATIO_TOLERANCE):
            yield f"likely {unit} (x {factor:.3g})"
