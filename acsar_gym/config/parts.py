"""Parameters of the simulated board and robot: motors, encoders, firmware, chassis and ground."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from pydantic import Field

from acsar_gym.config.section import Section
from acsar_gym.config.units import Delay, Length, PerWheel, Rate, Speed, Wait, of_wheel, per_wheel


class WheelMotor(NamedTuple):
    """The motor values of one wheel; see `MotorConfig`."""

    gain: float
    acceleration: float
    time_constant: float
    deadband: float


class MotorConfig(Section):
    """The motors and their speed control; values of single wheels as four numbers, a to d."""

    section = "motor"
    max_speed: Speed = 30.0
    """Largest wheel speed of the motors [rad/s], at most 1,000."""
    gain: Annotated[PerWheel, per_wheel(Field(gt=0.0, le=100.0))] = 1.0
    """Wheel speed for a set point of 1 rad/s, at most 100; a number, or four."""
    acceleration: Annotated[PerWheel, per_wheel(Field(gt=0.0, le=1e6))] = 60.0
    """Acceleration of the firmware's set point ramp [rad/s^2], at most 1e6; a number, or four."""
    time_constant: Annotated[PerWheel, per_wheel(Field(ge=0.0, le=100.0))] = 0.08
    """Time constant of the first-order speed loop [s], at most 100; hobby motors have 0.05-0.2. A
    number, or four."""
    deadband: Annotated[PerWheel, per_wheel(Field(ge=0.0, le=1e3))] = 0.0
    """Set points times gain below this don't turn the wheel [rad/s], at most 1,000; a number, or
    four."""

    def of_wheel(self, wheel: int) -> WheelMotor:
        """Return the values of one wheel.

        Args:
            wheel: 0 to 3 for a to d.
        """
        return WheelMotor(*(of_wheel(getattr(self, name), wheel) for name in WheelMotor._fields))


class EncoderConfig(Section):
    """The wheel encoders, as the firmware reads them."""

    section = "encoder"
    counts_per_revolution: Annotated[int, Field(gt=0, le=10_000_000)] = 1320
    """Counts per turn of the wheel, at most ten million."""
    window: Annotated[float, Field(gt=0.0, le=5.0)] = 0.05
    """Averaging time of the feedback [s], at most 5 s and 2,000 loops of the firmware."""
    quantum: Annotated[float, Field(gt=0.0, le=100.0)] | None = None
    """Printed speeds are rounded to multiples of this [rad/s], at most 100; None: not rounded, but
    for the two decimals of a line."""


class FirmwareConfig(Section):
    """The program of the microcontroller."""

    section = "firmware"
    loop_rate: Rate = 200.0
    """Rate of its control loop, and of the simulation's substeps [Hz], at most 10,000."""
    feedback_rate: Rate | None = None
    """Feedback lines per second [Hz]; None: one per tick of the control rate."""
    processing_time: Delay = 0.00125
    """Time from the last byte of a line to its effect, and from encoder to first byte [s], at most
    1 s."""
    command_delay: Delay = 0.0
    """Further time from the last byte of a command to its effect [s], at most 1 s."""
    delay_samples: Annotated[tuple[Delay, ...], Field(max_length=1_000)] = ()
    """Measured delays of commands on top of `command_delay` [s], as quantiles of equal weight. Only
    randomization uses them: each episode draws one."""
    command_timeout: Wait | None = 0.5
    """Motors stop after this time without a valid command [s], at most 1 h; None: never."""


class BodyConfig(Section):
    """Chassis and ground."""

    section = "body"
    mass: Annotated[float, Field(gt=0.0, le=1e5)] = 4.0
    """Mass of the whole robot [kg], at most 100 t."""
    length: Length = 0.34
    """Length of the footprint, along x [m]."""
    width: Length = 0.34
    """Width of the footprint over the wheels, along y [m]."""
    height: Length = 0.12
    """Height of the top of the chassis above ground [m]."""
    friction: Annotated[float, Field(gt=0.0, le=100.0)] = 1.0
    """Coulomb friction coefficient between tyre and ground, at most 100."""
    slip_speed: Speed = 0.005
    """Slip speed below which friction is proportional to slip [m/s], at most 1,000."""
    turn_factor: Annotated[float, Field(gt=1.0, le=100.0)] | None = None
    """Factor by which the robot turns slower than the differential-drive formula says, at most 100.
    It sets the tyres' sideways friction: (mu_lateral / mu_longitudinal)^2 =
    (turn_factor - 1) (wheel_separation / wheelbase)^2. None: equal friction in all directions, so
    1 + (wheelbase / wheel_separation)^2."""
