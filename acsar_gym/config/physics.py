"""The numbers by which a robot moves: made from its configuration, and varied by randomization."""

from __future__ import annotations

from typing import NamedTuple


class Physics(NamedTuple):
    """The numbers of a robot that its physics needs, in SI units, for the wheels a to d.

    Randomization may vary any of them from episode to episode. Compiled functions that Python calls
    take it as a record, see `jit.record_of`.
    """

    left_radius: float
    """Radius of the left wheels [m]."""
    right_radius: float
    """Radius of the right wheels [m]."""
    half_wheelbase: float
    """Half the distance between the front and rear axles [m]."""
    half_track: float
    """Half the distance between the left and right wheels [m]."""
    mass: float
    """Mass of the robot [kg]."""
    yaw_inertia: float
    """Moment of inertia about the vertical axis [kg m^2]."""
    grip: float
    """Greatest friction force of a tyre along its rolling direction [N]."""
    kappa: float
    """(mu_lateral / mu_longitudinal)^2 of the tyres. 1 is isotropic friction."""
    slip_speed: float
    """Below this slip speed friction grows linearly with it [m/s]."""
    max_speed: float
    """Top speed of a motor [rad/s]."""
    deadband_a: float
    """Set points below this don't turn a wheel [rad/s]."""
    deadband_b: float
    deadband_c: float
    deadband_d: float
    blend_a: float
    """Share of the difference to its set point by which a wheel's speed changes in a firmware
    loop."""
    blend_b: float
    blend_c: float
    blend_d: float
    gain_a: float
    """Factor from a wheel's set point to its speed."""
    gain_b: float
    gain_c: float
    gain_d: float
    latency_loops: float
    """Delay of commands and of feedback on top of the wire's own [firmware loops]."""
    command_delay: float
    """Further delay of commands [s]."""
    feedback_loops: float
    """Period of feedback lines [firmware loops]."""
    scan_rate: float
    """Revolutions of the LiDAR per second [Hz]."""
    range_noise: float
    """Standard deviation of a measured range [m]."""
    range_bias: float
    """Added to all measured ranges [m]."""
    range_dropouts: float
    """Share of measurements that fail."""
    range_outliers: float
    """Share of measurements at an edge that lie anywhere between its two sides."""
