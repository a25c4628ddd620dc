"""Domain randomization: which parameters of a robot are drawn anew for every episode, and how.

This file defines everything that can vary: the ranges (`Randomization`), the numbers that an
episode draws (`Drawn`), and their effect on a robot's physics (`varied`). The single env and the
batch both draw with `draw`, so that the same seed gives the same robot.

To add a parameter: add a field to `Randomization`, one to the end of `Drawn` (so that existing
seeds still draw the same numbers), and its effect to `varied`. If the physics has no such number,
add a field to `model.Physics` and use it there; batches and both bodies need no change.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.dynamics.model import Physics, physics_of, substep, wire_loops
from acsar_gym.errors import ConfigError, shown, suggestion
from acsar_gym.jit import jit, leading, loop

Range = tuple[float, float]
Floats = NDArray[np.float64]


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

    def __post_init__(self) -> None:
        for name in self.names:
            object.__setattr__(self, name, _checked(name, getattr(self, name)))

    @classmethod
    def of(cls, ranges: Mapping[str, Range] | Self | None) -> Randomization:
        """Make a Randomization from a mapping of names to ranges.

        Args:
            ranges: a mapping, a Randomization, or None for nothing.

        Raises:
            ConfigError: A name is unknown, or a range is malformed.
        """
        if isinstance(ranges, Randomization):
            return ranges
        if not isinstance(ranges, Mapping | None):
            raise ConfigError(
                f"randomization = {shown(ranges)}: must be a mapping of names to (low, high)"
            )
        known = {field.name for field in fields(cls)}
        for name in ranges or ():
            if name not in known:
                raise ConfigError(
                    f"unknown randomization {shown(name)}{suggestion(str(name)[:40], known)}"
                )
        return cls(**(ranges or {}))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that vary."""
        return tuple(f.name for f in fields(self) if getattr(self, f.name) is not None)

    def ranges(self, config: RobotConfig, step: float) -> Ranges:
        """Compute the range of every number that an episode draws.

        Args:
            config: The robot.
            step: Duration of an env step [s].

        Raises:
            ConfigError: The latency is as long as a step, or the wire or `feedback_timeout` doesn't
                allow the feedback rate.
        """
        if self.feedback_rate is not None:
            _check_feedback(self.feedback_rate, config)
        if self.latency is not None:
            _check_latency(self.latency, config, step)
        instant = () if config.motor.of_wheel(0).time_constant > 0.0 else ("motor_lag",)
        pairs = {
            number: getattr(self, name)
            for name in self.names
            if name not in instant
            for number in _numbers(name)
        }
        low = {number: pair[0] for number, pair in pairs.items()}
        high = {number: pair[1] for number, pair in pairs.items()}
        return Ranges(Drawn(**low), Drawn(**high))


class Drawn(NamedTuple):
    """The numbers that an episode draws, in the order of drawing; defaults change nothing.

    Names that end in _a to _d are for one wheel each.
    """

    mass: float = 1.0
    friction: float = 1.0
    motor_gain_a: float = 1.0
    motor_lag_a: float = 1.0
    motor_gain_b: float = 1.0
    motor_lag_b: float = 1.0
    motor_gain_c: float = 1.0
    motor_lag_c: float = 1.0
    motor_gain_d: float = 1.0
    motor_lag_d: float = 1.0
    deadband: float = math.nan
    wheel_radius: float = 1.0
    latency: float = 0.0
    feedback_rate: float = math.nan
    track_width: float = 1.0


class Ranges(NamedTuple):
    """Least and largest value of each number; both are the default where it doesn't vary."""

    low: Drawn
    high: Drawn


SIZE = len(Drawn._fields)
LATENCY, FEEDBACK_RATE = Drawn._fields.index("latency"), Drawn._fields.index("feedback_rate")


@jit
def loops_between(rate: float, dt: float) -> float:
    """Whole firmware loops between lines at this rate [Hz], at least one; NaN for NaN."""
    loops: float = np.rint(1.0 / (rate * dt))
    return 1.0 if loops < 1.0 else loops


@jit
def replaced(configured: float, value: float) -> float:
    """The value, or the configured one where the value is NaN."""
    return configured if np.isnan(value) else value


@jit
def lagging(blend: float, factor: float, dt: float) -> float:
    """A wheel's `blend` after its time constant is multiplied by a factor."""
    if factor == 1.0 or blend >= 1.0:
        return blend
    return 1.0 - math.exp(math.log(1.0 - blend) / factor)


@jit
def varied(nominal: Physics, drawn: Drawn, dt: float) -> Physics:
    """Apply what was drawn to a robot's physics.

    Args:
        nominal: physics of the configured robot.
        drawn: numbers of the episode.
        dt: firmware loop period [s].
    """
    return Physics(
        radius=nominal.radius * drawn.wheel_radius,
        half_wheelbase=nominal.half_wheelbase,
        half_track=nominal.half_track * drawn.track_width,
        mass=nominal.mass * drawn.mass,
        yaw_inertia=nominal.yaw_inertia * drawn.mass,
        grip=nominal.grip * drawn.mass * drawn.friction,
        slip_speed=nominal.slip_speed,
        max_speed=nominal.max_speed,
        deadband=replaced(nominal.deadband, drawn.deadband),
        blend_a=lagging(nominal.blend_a, drawn.motor_lag_a, dt),
        blend_b=lagging(nominal.blend_b, drawn.motor_lag_b, dt),
        blend_c=lagging(nominal.blend_c, drawn.motor_lag_c, dt),
        blend_d=lagging(nominal.blend_d, drawn.motor_lag_d, dt),
        gain_a=nominal.gain_a * drawn.motor_gain_a,
        gain_b=nominal.gain_b * drawn.motor_gain_b,
        gain_c=nominal.gain_c * drawn.motor_gain_c,
        gain_d=nominal.gain_d * drawn.motor_gain_d,
        latency_loops=nominal.latency_loops + np.rint(drawn.latency / dt),
        feedback_loops=replaced(nominal.feedback_loops, loops_between(drawn.feedback_rate, dt)),
    )


@loop
def draw(
    nominal: Floats, low: Floats, high: Floats, samples: Floats, dt: float
) -> tuple[Physics, Drawn]:
    """Draw a robot's physics for one episode.

    Args:
        nominal: Numbers of the configured `Physics`.
        low: Least value of each number of `Drawn`.
        high: Largest value of each.
        samples: A uniform sample of [0, 1) for each; ignored where low == high.
        dt: The firmware's loop period [s].

    Returns:
        The physics, and the numbers that were drawn, as applied.
    """
    numbers = np.empty(SIZE)
    for k in range(SIZE):
        numbers[k] = low[k] + (high[k] - low[k]) * samples[k] if high[k] > low[k] else low[k]
    numbers[LATENCY] = np.rint(numbers[LATENCY] / dt) * dt
    numbers[FEEDBACK_RATE] = 1.0 / (loops_between(numbers[FEEDBACK_RATE], dt) * dt)
    drawn = Drawn(*leading(numbers, SIZE))
    return varied(physics_of(nominal), drawn, dt), drawn


def places(name: str) -> tuple[int, ...]:
    """Indices of a parameter's numbers in `Drawn`: one, or four in the order of the wheels."""
    return tuple(Drawn._fields.index(number) for number in _numbers(name))


def _numbers(name: str) -> tuple[str, ...]:
    """Names of a parameter's numbers in `Drawn`."""
    return (name,) if name in Drawn._fields else tuple(f"{name}_{wheel}" for wheel in "abcd")


LEAST = {"deadband": 0.0, "latency": 0.0, "feedback_rate": 0.1}
MOST = {"latency": 10.0, "feedback_rate": 1e4}
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


def _check_latency(latency: Range, config: RobotConfig, step: float) -> None:
    """ConfigError where a command can take longer than an env step to reach the board."""
    dt = substep(config)
    slowest = wire_loops(config) * dt + latency[1]
    if slowest > step - dt / 2.0:
        raise ConfigError(
            f"randomization latency = {latency}: on this wire a line takes up to {slowest:g} s; "
            f"must be shorter than a step of the policy ({step:g} s)"
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
