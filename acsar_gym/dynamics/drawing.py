"""What an episode draws, and what that does to a robot's physics.

The single env and the batch both draw with `draw`, so that the same seed gives the same robot.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.dynamics.numbers import Physics, physics_of
from acsar_gym.jit import jit, leading, loop

Floats = NDArray[np.float64]


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
    left_wheel_radius: float = 1.0
    right_wheel_radius: float = 1.0
    turn_factor: float = 1.0
    command_delay: float = math.nan
    delay_samples: float = 0.0
    deadband_offset_a: float = 0.0
    deadband_offset_b: float = 0.0
    deadband_offset_c: float = 0.0
    deadband_offset_d: float = 0.0


class Ranges(NamedTuple):
    """Least and largest value of each number; both are the default where it doesn't vary."""

    low: Drawn
    high: Drawn
    delays: tuple[float, ...] = (0.0,)
    """What `delay_samples` is drawn from [s]; its low and high are the shares 0 and 1."""


SIZE = len(Drawn._fields)
LATENCY, FEEDBACK_RATE = Drawn._fields.index("latency"), Drawn._fields.index("feedback_rate")
DELAY_SAMPLES = Drawn._fields.index("delay_samples")


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
def deadened(configured: float, drawn: float, offset: float) -> float:
    """A wheel's deadband [rad/s]: configured or drawn, plus an offset, at least zero."""
    return max(replaced(configured, drawn) + offset, 0.0)


@jit
def turning(nominal: Physics, factor: float) -> float:
    """The tyres' `kappa` after the robot's turn factor is multiplied by a factor."""
    if factor == 1.0:
        return nominal.kappa
    ratio = (nominal.half_wheelbase / nominal.half_track) ** 2
    return ((1.0 + nominal.kappa * ratio) * factor - 1.0) / ratio


@jit
def varied(nominal: Physics, drawn: Drawn, dt: float) -> Physics:
    """Apply what was drawn to a robot's physics.

    Args:
        nominal: physics of the configured robot.
        drawn: numbers of the episode.
        dt: firmware loop period [s].
    """
    return Physics(
        left_radius=nominal.left_radius * drawn.wheel_radius * drawn.left_wheel_radius,
        right_radius=nominal.right_radius * drawn.wheel_radius * drawn.right_wheel_radius,
        half_wheelbase=nominal.half_wheelbase,
        half_track=nominal.half_track * drawn.track_width,
        mass=nominal.mass * drawn.mass,
        yaw_inertia=nominal.yaw_inertia * drawn.mass,
        grip=nominal.grip * drawn.mass * drawn.friction,
        kappa=turning(nominal, drawn.turn_factor),
        slip_speed=nominal.slip_speed,
        max_speed=nominal.max_speed,
        deadband_a=deadened(nominal.deadband_a, drawn.deadband, drawn.deadband_offset_a),
        deadband_b=deadened(nominal.deadband_b, drawn.deadband, drawn.deadband_offset_b),
        deadband_c=deadened(nominal.deadband_c, drawn.deadband, drawn.deadband_offset_c),
        deadband_d=deadened(nominal.deadband_d, drawn.deadband, drawn.deadband_offset_d),
        blend_a=lagging(nominal.blend_a, drawn.motor_lag_a, dt),
        blend_b=lagging(nominal.blend_b, drawn.motor_lag_b, dt),
        blend_c=lagging(nominal.blend_c, drawn.motor_lag_c, dt),
        blend_d=lagging(nominal.blend_d, drawn.motor_lag_d, dt),
        gain_a=nominal.gain_a * drawn.motor_gain_a,
        gain_b=nominal.gain_b * drawn.motor_gain_b,
        gain_c=nominal.gain_c * drawn.motor_gain_c,
        gain_d=nominal.gain_d * drawn.motor_gain_d,
        latency_loops=nominal.latency_loops + np.rint(drawn.latency / dt),
        command_delay=replaced(nominal.command_delay, drawn.command_delay) + drawn.delay_samples,
        feedback_loops=replaced(nominal.feedback_loops, loops_between(drawn.feedback_rate, dt)),
    )


@loop
def draw(
    nominal: Floats, low: Floats, high: Floats, delays: Floats, samples: Floats, dt: float
) -> tuple[Physics, Drawn]:
    """Draw a robot's physics for one episode.

    Args:
        nominal: Numbers of the configured `Physics`.
        low: Least value of each number of `Drawn`.
        high: Largest value of each.
        delays: What `delay_samples` is drawn from [s].
        samples: A uniform sample of [0, 1) for each; ignored where low == high.
        dt: The firmware's loop period [s].

    Returns:
        The physics, and the numbers that were drawn, as applied.
    """
    numbers = np.empty(SIZE)
    for k in range(SIZE):
        numbers[k] = low[k] + (high[k] - low[k]) * samples[k] if high[k] > low[k] else low[k]
    numbers[LATENCY] = np.rint(numbers[LATENCY] / dt) * dt
    place = min(int(numbers[DELAY_SAMPLES] * len(delays)), len(delays) - 1)
    numbers[DELAY_SAMPLES] = delays[place]
    numbers[FEEDBACK_RATE] = 1.0 / (loops_between(numbers[FEEDBACK_RATE], dt) * dt)
    drawn = Drawn(*leading(numbers, SIZE))
    return varied(physics_of(nominal), drawn, dt), drawn


def places(name: str) -> tuple[int, ...]:
    """Indices of a parameter's numbers in `Drawn`: one, or four in the order of the wheels."""
    return tuple(Drawn._fields.index(number) for number in numbers_of(name))


def numbers_of(name: str) -> tuple[str, ...]:
    """Names of a parameter's numbers in `Drawn`."""
    return (name,) if name in Drawn._fields else tuple(f"{name}_{wheel}" for wheel in "abcd")
