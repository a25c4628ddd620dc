"""Domain randomization: which parameters of a robot are drawn anew for every episode, and how.

This file has the ranges; the numbers that an episode draws from them (`Drawn`), and their effect on
a robot's physics (`varied`), are in `drawing`.

To add a parameter: add a field to `Randomization`, one to the end of `Drawn` (so that existing
seeds still draw the same numbers), and its effect to `varied`. If the physics has no such number,
add a field to `numbers.Physics` and use it in `model`; batches and both bodies need no change.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

from acsar_gym.config import RobotConfig
from acsar_gym.config.units import of_wheel
from acsar_gym.dynamics.drawing import Drawn, Ranges, loops_between, numbers_of
from acsar_gym.dynamics.measured import ranges as measured_or_usual
from acsar_gym.dynamics.model import turn_factor
from acsar_gym.dynamics.timing import substep, wire_loops
from acsar_gym.errors import ConfigError, shown, suggestion

Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Randomization:
    """Ranges (low, high) from which every episode draws; a parameter that is None doesn't vary.

    The same on every simulated link and in a batch. Factors multiply the configured value; other
    values replace it or are added to it. The info of an episode has what was drawn, as applied,
    under "drawn_" and the name.
    """

    mass: Range | None = None
    """Factor on the mass, and so on inertia and wheel loads."""
    friction: Range | None = None
    """Factor on the friction between tyre and ground."""
    motor_gain: Range | None = None
    """Factor on each wheel's speed for its set point; four numbers."""
    motor_lag: Range | None = None
    """Factor on each wheel's time constant; four numbers. No effect on motors without lag."""
    deadband: Range | None = None
    """Set points below this don't turn the wheel [rad/s]."""
    wheel_radius: Range | None = None
    """Factor on the real wheel radius; odometry still assumes the configured one."""
    latency: Range | None = None
    """Delay of commands and feedback on top of the wire's own [s], in whole firmware loops;
    shorter than an env step."""
    feedback_rate: Range | None = None
    """Feedback lines per second [Hz], rounded to whole firmware loops."""
    track_width: Range | None = None
    """Factor on the real distance between left and right wheels; odometry still assumes the
    configured one. Tyres that wear or bulge change where they touch the ground."""
    left_wheel_radius: Range | None = None
    """Factor on the real radius of the left wheels; odometry still assumes the configured one."""
    right_wheel_radius: Range | None = None
    """Factor on the real radius of the right wheels."""
    turn_factor: Range | None = None
    """Factor on the robot's turn factor (see `body.turn_factor`), which depends on the ground."""
    command_delay: Range | None = None
    """Time from the last byte of a command to its effect, after the processing time [s]."""
    delay_samples: tuple[float, ...] | None = None
    """Delays of commands on top of `command_delay` [s]; each episode draws one of them."""
    deadband_offset: Range | None = None
    """Added to each wheel's deadband, which stays at least 0 [rad/s]; four numbers."""

    def __post_init__(self) -> None:
        for name in self.names:
            check = _delays if name == "delay_samples" else _checked
            object.__setattr__(self, name, check(name, getattr(self, name)))

    @classmethod
    def of(
        cls, ranges: Mapping[str, Range] | Self | bool | None, config: RobotConfig | None = None
    ) -> Randomization:
        """Return a Randomization from a mapping of names to ranges.

        Args:
            ranges: a mapping, a Randomization, True for what `acsar-gym train` randomizes
                (`measured`), or None or False for nothing.
            config: the robot, for True.

        Raises:
            ConfigError: a name is unknown, or a range is malformed.
        """
        if isinstance(ranges, Randomization):
            return ranges
        if ranges is True and config is not None:
            return cls.measured(config)
        ranges = None if ranges is False else ranges
        if not isinstance(ranges, Mapping | None):
            raise ConfigError(
                f"randomization = {shown(ranges)}: must be a mapping of names to (low, high), such "
                'as {"friction": (0.7, 1.2)}, or True for what acsar-gym train randomizes'
            )
        known = {field.name for field in fields(cls)}
        for name in ranges or ():
            if name not in known:
                raise ConfigError(
                    f"unknown randomization {shown(name)}{suggestion(str(name)[:40], known)}"
                )
        return cls(**(ranges or {}))

    @classmethod
    def measured(cls, config: RobotConfig) -> Randomization:
        """Return the ranges of a robot's measurements; see `acsar_gym.dynamics.measured`.

        What wasn't measured has a default width. Measured delays (`firmware.delay_samples`, or the
        interval of `firmware.command_delay`) replace the default latency.

        Args:
            config: the robot, with the intervals in its field `measured`.
        """
        return cls.of(measured_or_usual(config))  # type: ignore[arg-type]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that vary."""
        return tuple(f.name for f in fields(self) if getattr(self, f.name) is not None)

    def ranges(self, config: RobotConfig, step: float) -> Ranges:
        """Return the range of every number that an episode draws.

        Args:
            config: the robot.
            step: duration of an env step [s].

        Raises:
            ConfigError: the latency is as long as a step, or the wire or `feedback_timeout` doesn't
                allow the feedback rate.
        """
        if self.feedback_rate is not None:
            _check_feedback(self.feedback_rate, config)
        if self.turn_factor is not None:
            _check_turning(self.turn_factor, config)
        if self.latency is not None:
            _check_latency(self.latency, config, step)
        lags = config.motor.time_constant
        instant = [f"motor_lag_{w}" for i, w in enumerate("abcd") if of_wheel(lags, i) == 0.0]
        pairs = {
            number: (0.0, 1.0) if name == "delay_samples" else getattr(self, name)
            for name in self.names
            for number in numbers_of(name)
            if number not in instant
        }
        low = {number: pair[0] for number, pair in pairs.items()}
        high = {number: pair[1] for number, pair in pairs.items()}
        return Ranges(Drawn(**low), Drawn(**high), self.delay_samples or (0.0,))


LEAST = {
    "deadband": 0.0,
    "latency": 0.0,
    "feedback_rate": 0.1,
    "command_delay": 0.0,
    "deadband_offset": -1e3,
}
MOST = {"latency": 10.0, "feedback_rate": 1e4, "command_delay": 1.0}
"""Limits of parameters that aren't factors from 1e-6 to 1,000. The rate and the latency are
limited because lines on their way are held in memory."""


def _checked(name: str, value: Range) -> Range:
    """Check a range; ConfigError where it is malformed or out of bounds."""
    least, most = LEAST.get(name, 1e-6), MOST.get(name, 1e3)
    try:
        low, high = (float(limit) for limit in value)
    except (TypeError, ValueError, OverflowError):
        low, high = math.nan, math.nan
    if not least <= low <= high <= most:
        text = f"{least:g} <= low <= high <= {most:g}"
        raise ConfigError(f"randomization {name} = {shown(value)}: must be (low, high) with {text}")
    return low, high


def _delays(name: str, value: Any) -> tuple[float, ...]:
    """Check delays [s]; ConfigError where they are malformed or out of bounds."""
    try:
        delays = tuple(float(delay) for delay in value)
    except (TypeError, ValueError, OverflowError):
        delays = ()
    if not delays or not all(0.0 <= delay <= 1.0 for delay in delays):
        raise ConfigError(f"randomization {name} = {shown(value)}: must be delays from 0 to 1 s")
    return delays


def _check_latency(latency: Range, config: RobotConfig, step: float) -> None:
    """ConfigError where feedback can take as long as an env step to reach the driver."""
    dt = substep(config)
    slowest = wire_loops(config) * dt + latency[1]
    if slowest > step - dt / 2.0:
        raise ConfigError(
            f"randomization latency = {latency}: on this wire a line takes up to {slowest:g} s; "
            f"must be shorter than a step of the policy ({step:g} s); a lower policy_rate makes it "
            "longer"
        )


def longest_delay(ranges: Ranges, config: RobotConfig) -> float:
    """Longest `command_delay` that an episode can have [s]."""
    drawn = ranges.high.command_delay
    longest = config.firmware.command_delay if math.isnan(drawn) else drawn
    return longest + max(ranges.delays)


def _check_turning(factors: Range, config: RobotConfig) -> None:
    """ConfigError where a robot would turn as fast as the formula says, or faster."""
    least = factors[0] * turn_factor(config)
    if least <= 1.0:
        raise ConfigError(
            f"randomization turn_factor = {factors}: makes this robot's turn factor {least:g}: "
            "must stay above 1"
        )


def _check_feedback(rates: Range, config: RobotConfig) -> None:
    """ConfigError where lines don't fit on the wire, or come too rarely for `feedback_timeout`."""
    dt = substep(config)
    for rate in rates:
        applied = 1.0 / (loops_between(rate, dt) * dt)
        try:
            config.with_(firmware={"feedback_rate": applied})
        except ConfigError as error:
            raise ConfigError(f"randomization feedback_rate = {rates}: {error}") from None
