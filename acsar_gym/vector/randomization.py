"""Domain randomization: what varies from robot to robot, and from episode to episode."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, shown, suggestion

Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Randomization:
    """Ranges (low, high) from which every robot draws with every episode; None varies nothing.

    Factors multiply the configured value; the others replace it or come on top.
    """

    mass: Range | None = None
    """Factor on the mass, and with it on inertia and wheel loads."""
    friction: Range | None = None
    """Factor on the friction of tyre on ground."""
    motor_gain: Range | None = None
    """Factor on each wheel's speed for its set point."""
    motor_lag: Range | None = None
    """Factor on each wheel's time constant."""
    deadband: Range | None = None
    """Set points below this don't turn the wheel [rad/s]."""
    wheel_radius: Range | None = None
    """Factor on the real radius; odometry goes on with the configured one."""
    latency: Range | None = None
    """Delay that commands and feedback have on top of the wire's own [s]."""
    feedback_rate: Range | None = None
    """Feedback lines per second [Hz], rounded to whole loops of the firmware."""
    dropped_lines: Range | None = None
    """Share of lines lost, of commands and of feedback; at most 0.5."""

    @classmethod
    def of(cls, ranges: Mapping[str, Range] | Self | None) -> Randomization:
        """From a mapping of keys to ranges. ConfigError for an unknown key or a bad range."""
        if isinstance(ranges, Randomization):
            return ranges
        known = {field.name for field in fields(cls)}
        for key, value in (ranges or {}).items():
            if key not in known:
                raise ConfigError(f"unknown randomization {key!r}{suggestion(key, known)}")
            _check(key, value)
        return cls(**dict(ranges or {}))

    def table(self) -> NDArray[np.float64]:
        """9 x 2: low and high of each key in the order above, (1, 0) where nothing varies."""
        ranges = [getattr(self, field.name) or (1.0, 0.0) for field in fields(self)]
        return np.array(ranges, np.float64)


LEAST = {"deadband": 0.0, "latency": 0.0, "dropped_lines": 0.0, "feedback_rate": 0.1}
MOST = {"latency": 10.0, "dropped_lines": 0.5, "feedback_rate": 1e4}
"""Of what isn't a factor from 1e-6 to 1,000; slow feedback and late lines are held in memory."""


def _check(key: str, value: Range) -> None:
    least, most = LEAST.get(key, 1e-6), MOST.get(key, 1e3)
    try:
        low, high = (float(limit) for limit in value)
    except (TypeError, ValueError, OverflowError):
        low, high = math.nan, math.nan
    if not least <= low <= high <= most:
        text = f"{least:g} <= low <= high <= {most:g}"
        raise ConfigError(f"randomization {key} = {shown(value)}: must be (low, high) with {text}")
