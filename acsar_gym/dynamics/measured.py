"""Ranges of domain randomization for one robot: what was measured of it, else default widths.

A measured interval becomes the range of the parameter that it is about; factors are relative to the
configured value. Where wheels have intervals of their own, the range holds all of them, and the
default width for wheels without one.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from acsar_gym.config import Measured, RobotConfig
from acsar_gym.config.units import PerWheel, of_wheel
from acsar_gym.dynamics.model import turn_factor

Range = tuple[float, float]

DEFAULT: dict[str, Range] = {
    "friction": (0.7, 1.2),
    "motor_gain": (0.95, 1.05),
    "motor_lag": (0.6, 1.5),
    "wheel_radius": (0.98, 1.02),
    "turn_factor": (0.9, 1.1),
    "latency": (0.0, 0.02),
}
"""Ranges of what wasn't measured: factors, and latency [s]. Robots of the same parts differ by so
much, and so do floors; the rest isn't randomized."""
FACTORS = {
    "friction": "body.friction",
    "mass": "body.mass",
    "wheel_radius": "wheel_radius",
    "left_wheel_radius": "left_wheel_radius_multiplier",
    "right_wheel_radius": "right_wheel_radius_multiplier",
}
"""Parameters that are factors on one value, and the field whose interval they follow."""
TURNING = ("body.turn_factor", "wheel_separation_multiplier")
"""Fields whose intervals the turn factor follows, the first that was measured: a multiplier that is
right for a robot is the factor by which it turns slower."""
LEAST_TURN = 1.001
"""Least turn factor of a range; one of 1 would be a tyre without sideways friction."""
SMALLEST, LARGEST = 1e-6, 1e3
"""Factors that a range can have."""
WHEEL_FACTORS = {"motor_gain": "gain", "motor_lag": "time_constant"}
"""Parameters that are factors on a value of each wheel, and the field of `motor`."""


def measured_ranges(config: RobotConfig) -> dict[str, tuple[float, ...]]:
    """Return the randomization parameters that follow from a robot's measurements, with ranges."""
    found: dict[str, tuple[float, ...]] = {
        name: _relative(config.measured[path], _value(config, path))
        for name, path in FACTORS.items()
        if path in config.measured
    }
    turning = next((path for path in TURNING if path in config.measured), None)
    if turning is not None:
        found["turn_factor"] = _turning(config.measured[turning], turn_factor(config))
    return found | _of_wheels(config) | _of_delays(config)


def _of_wheels(config: RobotConfig) -> dict[str, tuple[float, ...]]:
    """Ranges of what is measured for each wheel."""
    found: dict[str, tuple[float, ...]] = {}
    for name, field in WHEEL_FACTORS.items():
        ends = list(_wheel_ends(config, field, DEFAULT[name]))
        if ends:
            found[name] = (min(ends), max(ends))
    offsets = list(_deadband_ends(config))
    if offsets:
        found["deadband_offset"] = (min(offsets), max(offsets))
    return found


def _of_delays(config: RobotConfig) -> dict[str, tuple[float, ...]]:
    """Ranges of delays."""
    found: dict[str, tuple[float, ...]] = {}
    if "firmware.command_delay" in config.measured:
        delay = config.measured["firmware.command_delay"]
        found["command_delay"] = (max(delay.low, 0.0), max(delay.high, 0.0))
    if config.firmware.delay_samples:
        found["delay_samples"] = config.firmware.delay_samples
    return found


def ranges(config: RobotConfig) -> dict[str, tuple[float, ...]]:
    """Return the measured ranges of a robot, and the default ones of what wasn't measured."""
    found, usual, factor = measured_ranges(config), dict(DEFAULT), turn_factor(config)
    low, high = usual["turn_factor"]
    usual["turn_factor"] = (max(low, (1.0 + factor) / 2.0 / factor), high)  # stays above 1
    if "command_delay" in found or "delay_samples" in found:
        del usual["latency"]
    return usual | found


def told(config: RobotConfig) -> str:
    """Describe which ranges of a robot were measured; nothing where none were."""
    measured = measured_ranges(config)
    if not measured:
        return ""
    usual = [name for name in ranges(config) if name not in measured]
    found = ", ".join(f"{name} {_shown(name, width)}" for name, width in measured.items())
    return f"randomized as measured: {found}; by default widths: {', '.join(usual)}"


def _shown(name: str, width: tuple[float, ...]) -> str:
    """Format a range, or how many delays there are."""
    if name == "delay_samples":
        return f"({len(width)} delays up to {max(width):.3g} s)"
    return f"{width[0]:.3g} to {width[1]:.3g}"


def _relative(interval: Measured, value: float) -> Range:
    """An interval as a range of factors on a value."""
    low, high = interval.low / value, interval.high / value
    return min(max(low, SMALLEST), LARGEST), min(max(high, SMALLEST), LARGEST)


def _turning(interval: Measured, value: float) -> Range:
    """An interval of turn factors as a range of factors on one, clipped to what tyres can do."""
    return max(interval.low, LEAST_TURN) / value, max(interval.high, LEAST_TURN) / value


def _value(config: RobotConfig, path: str) -> float:
    """The number of a dotted field."""
    value: Any = config
    for name in path.split("."):
        value = getattr(value, name)
    return float(value)


def _interval(config: RobotConfig, field: str, wheel: int) -> Measured | None:
    """The interval of a wheel's value: its own, or that of all wheels."""
    path = f"motor.{field}"
    return config.measured.get(f"{path}.{'abcd'[wheel]}", config.measured.get(path))


def _wheel_ends(config: RobotConfig, field: str, usual: Range) -> Iterator[float]:
    """Factors at the ends of all wheels' intervals; nothing where no wheel has one."""
    values: PerWheel = getattr(config.motor, field)
    intervals = [_interval(config, field, wheel) for wheel in range(4)]
    if any(intervals):
        for wheel, interval in enumerate(intervals):
            value = of_wheel(values, wheel)
            if value > 0.0:
                yield from usual if interval is None else _relative(interval, value)


def _deadband_ends(config: RobotConfig) -> Iterator[float]:
    """Ends of all wheels' measured deadbands, relative to the configured ones [rad/s]."""
    for wheel in range(4):
        interval = _interval(config, "deadband", wheel)
        if interval is not None:
            value = of_wheel(config.motor.deadband, wheel)
            yield from (interval.low - value, interval.high - value)
