"""The numbers of one robot that its physics needs, and how compiled code gets them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import COMPILED, jit


class Physics(NamedTuple):
    """The numbers of one robot that its physics needs; SI units, wheels a to d in wheel order.

    Any of them may vary from episode to episode; see `randomization`.
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
    """Greatest friction force of one tyre along its rolling direction [N]."""
    kappa: float
    """(mu_lateral / mu_longitudinal)^2 of the tyres; 1 for isotropic friction."""
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


SIZE = len(Physics._fields)
Numbers = NDArray[np.float64] | Sequence[float]


@jit
def physics_of(n: Numbers) -> Physics:
    """Make a Physics of an array of its numbers.

    One by one, because numba takes twice as long for all of them at once.
    """
    return Physics(
        n[0],
        n[1],
        n[2],
        n[3],
        n[4],
        n[5],
        n[6],
        n[7],
        n[8],
        n[9],
        n[10],
        n[11],
        n[12],
        n[13],
        n[14],
        n[15],
        n[16],
        n[17],
        n[18],
        n[19],
        n[20],
        n[21],
        n[22],
        n[23],
        n[24],
    )


@jit
def physics_at(rows: NDArray[np.float64], i: int) -> Physics:
    """Make the Physics of robot i from column i of an array with a row for each number.

    The index is unsigned so that compiled code needs no check for negative ones, and can be
    vectorized.
    """
    k = np.uintp(i)
    return Physics(
        rows[0, k],
        rows[1, k],
        rows[2, k],
        rows[3, k],
        rows[4, k],
        rows[5, k],
        rows[6, k],
        rows[7, k],
        rows[8, k],
        rows[9, k],
        rows[10, k],
        rows[11, k],
        rows[12, k],
        rows[13, k],
        rows[14, k],
        rows[15, k],
        rows[16, k],
        rows[17, k],
        rows[18, k],
        rows[19, k],
        rows[20, k],
        rows[21, k],
        rows[22, k],
        rows[23, k],
        rows[24, k],
    )


def numbers_of(own: Physics) -> Numbers:
    """Convert a Physics to what `robot_step` takes: an array with numba, else a tuple (faster)."""
    return np.array(own, np.float64) if COMPILED else tuple(own)
