"""What the robots of a training were like, and where another robot lies outside of that."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from acsar_gym.policies.bundle import Bundle, Value

Range = tuple[float, float]
SLACK = 0.01
"""Relative width by which a range of the training is widened."""


@dataclass(frozen=True, slots=True)
class Varied:
    """How a randomization changes one value of a robot."""

    factor: str = ""
    """Parameter of the randomization that it is multiplied by."""
    inverse: bool = False
    """Whether it is divided by it instead."""
    replaced: str = ""
    """Parameter that replaces it."""
    added: tuple[str, ...] = ()
    """Parameters that are added to it."""
    least: bool = True
    """Whether less than in the training is worse, too."""
    most: bool = True
    """Whether more than in the training is worse."""
    source: str = ""
    """Where a robot's number comes from, if its name doesn't say that."""


TURNING = (
    "body.turn_factor of the robot's file, measured by 'acsar-gym calibrate DEVICE turn'; "
    "without it 1 + (wheelbase / wheel_separation)^2"
)
VARIED: Mapping[str, Varied] = {
    "body.mass": Varied("mass"),
    "body.friction": Varied("friction"),
    "turn_factor": Varied("turn_factor", source=TURNING),
    "wheel_separation_multiplier": Varied("turn_factor", inverse=True),
    "motor.gain": Varied("motor_gain"),
    "motor.time_constant": Varied("motor_lag"),
    "motor.deadband": Varied(replaced="deadband", added=("deadband_offset",), least=False),
    "firmware.command_delay": Varied(
        replaced="command_delay", added=("latency", "delay_samples"), least=False
    ),
    "feedback_rate": Varied(replaced="feedback_rate", most=False),
}
"""Values of a robot that are compared with the training's ranges. The multiplier and the turn
factor decide together how far the robot turns, so the multiplier has the range of that one."""


def outside(bundle: Bundle, own: Mapping[str, Value]) -> Iterator[str]:
    """Yield a line for each value of a robot that lies outside of the training's ranges.

    Args:
        bundle: of the policy; without known ranges nothing is outside.
        own: values of the robot by name.
    """
    if bundle.randomization is None:
        return
    for name, varied in VARIED.items():
        values, trained = numbers(own.get(name)), numbers(bundle.robot.values.get(name))
        if values and trained:
            low, high = trained_range(varied, trained, bundle.randomization)
            slack = SLACK * max(abs(low), abs(high))
            under = varied.least and min(values) < low - slack
            if under or (varied.most and max(values) > high + slack):
                was = f"{low:.4g} to {high:.4g}" if high > low else f"{low:.4g}"
                source = f" ({varied.source})" if varied.source else ""
                now = f"{shown(own[name])} on this robot{source}"
                yield f"{name} was {was} in the training and is {now}"


def trained_range(
    varied: Varied, values: Sequence[float], ranges: Mapping[str, Sequence[float]]
) -> Range:
    """Return the least and the largest number that a value had in the training.

    Args:
        varied: how the randomization changes it.
        values: of the robot of the training: one, or one for each wheel.
        ranges: of the randomization, by name.
    """
    low, high = _ends(ranges.get(varied.replaced, values))
    least, most = _ends(ranges.get(varied.factor, (1.0,)))
    if varied.inverse:
        least, most = 1.0 / most, 1.0 / least
    low, high = low * least, high * most
    for name in varied.added:
        least, most = _ends(ranges.get(name, (0.0,)))
        low, high = low + least, high + most
    return low, high


def numbers(value: Value) -> tuple[float, ...]:
    """Return a value as numbers: none, one, or one for each wheel."""
    if value is None:
        return ()
    return value if isinstance(value, tuple) else (value,)


def shown(value: Value) -> str:
    """Format a value in a few digits."""
    return ", ".join(f"{one:.4g}" for one in numbers(value)) or "none"


def equal(one: Value, other: Value, length: float = 0.0) -> bool:
    """Return whether two values are the same but for rounding, or differ by `length` at most."""
    pairs = numbers(one), numbers(other)
    return len(pairs[0]) == len(pairs[1]) and all(
        math.isclose(a, b, rel_tol=1e-6, abs_tol=max(length, 1e-9))
        for a, b in zip(*pairs, strict=True)
    )


def _ends(values: Sequence[float]) -> Range:
    return min(values), max(values)
