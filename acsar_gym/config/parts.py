"""Parameters of the simulated board and robot: motors, encoders, firmware, chassis and ground."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from acsar_gym.config.section import Section
from acsar_gym.config.units import Length, Rate, Speed, Wait


class MotorConfig(Section):
    """The motors and their speed control."""

    section = "motor"
    max_speed: Speed = 30.0
    """Largest wheel speed of the motors [rad/s], at most 1,000."""
    acceleration: Annotated[float, Field(gt=0.0, le=1e6)] = 60.0
    """Acceleration of the firmware's set point ramp [rad/s^2], at most 1e6."""
    time_constant: Annotated[float, Field(ge=0.0, le=100.0)] = 0.08
    """Time constant of the first-order speed loop [s], at most 100; hobby motors have 0.05-0.2."""
    deadband: Annotated[float, Field(ge=0.0, le=1e3)] = 0.0
    """Set points below this don't turn the wheel [rad/s], at most 1,000."""


class EncoderConfig(Section):
    """The wheel encoders, as the firmware reads them."""

    section = "encoder"
    counts_per_revolution: Annotated[int, Field(gt=0, le=10_000_000)] = 1320
    """Counts per turn of the wheel, at most ten million."""
    window: Annotated[float, Field(gt=0.0, le=5.0)] = 0.05
    """Averaging time of the feedback [s], at most 5 s and 2,000 loops of the firmware."""


class FirmwareConfig(Section):
    """The program of the microcontroller."""

    section = "firmware"
    loop_rate: Rate = 200.0
    """Rate of its control loop, and of the simulation's substeps [Hz], at most 10,000."""
    feedback_rate: Rate | None = None
    """Feedback lines per second [Hz]; None: one per tick of the control rate."""
    processing_time: Annotated[float, Field(ge=0.0, le=1.0)] = 0.00125
    """Time from the last byte of a line to its effect, and from encoder to first byte [s], at most
    1 s."""
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
