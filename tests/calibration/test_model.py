"""Odometry of calibration runs against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from calibration_tools import ACSAR, line, of_sides, spin, square

from acsar_gym.odometry import Odometry
from acsar_gym.tools.sysid.calibration_runs import Geometry, configured_geometry, integrate_wheels

NOMINAL = Geometry(0.05, 0.0, 1.5)


def test_the_config_is_taken_as_mean_radius_ratio_and_multiplier() -> None:
    config = ACSAR.with_(left_wheel_radius_multiplier=0.99, right_wheel_radius_multiplier=1.03)
    geometry = configured_geometry(config)
    assert geometry.left == pytest.approx(0.05 * 0.99)
    assert geometry.right == pytest.approx(0.05 * 1.03)
    assert geometry.multiplier == config.wheel_separation_multiplier


def test_a_straight_line() -> None:
    assert integrate_wheels(line(NOMINAL, 2.0), NOMINAL, 0.3) == pytest.approx((2.0, 0.0, 0.0))


def test_unequal_wheels_drive_an_arc() -> None:
    real = Geometry(0.05, 0.04, 1.5)
    theta = 2.0 * 0.04 / 0.45
    radius = 2.0 / theta
    expected = (radius * math.sin(theta), radius * (1.0 - math.cos(theta)), theta)
    assert integrate_wheels(line(NOMINAL, 2.0), real, 0.3) == pytest.approx(expected)


def test_full_turns_count_and_a_larger_multiplier_turns_less() -> None:
    real = NOMINAL._replace(multiplier=2.0)
    _, _, theta = integrate_wheels(spin(NOMINAL, 10.0 * math.pi), real, 0.3)
    assert theta == pytest.approx(10.0 * math.pi * 1.5 / 2.0)


def test_coarse_samples_of_an_arc_are_exact() -> None:
    fine, coarse = of_sides([40.0], [50.0], 1000), of_sides([40.0], [50.0], 2)
    assert integrate_wheels(coarse, NOMINAL, 0.3) == pytest.approx(
        integrate_wheels(fine, NOMINAL, 0.3)
    )


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_it_agrees_with_the_driver_s_odometry(side: float) -> None:
    wheels = square(NOMINAL, 1.0, side)
    odometry = Odometry(0.05, 0.3, 1.5)
    for left, right in np.repeat(np.diff(wheels, axis=0) / 20.0, 20, axis=0):
        odometry.update((right, left, left, right), 1.0)
    x, y, theta = integrate_wheels(wheels, NOMINAL, 0.3)
    assert (x, y) == pytest.approx(odometry.pose[:2], abs=1e-3)
    assert math.remainder(theta - odometry.pose[2], math.tau) == pytest.approx(0.0, abs=1e-9)


def test_umbmark_s_equations_give_the_same_small_errors() -> None:
    """Borenstein and Feng 1996: alpha and beta from the ends of both squares, then E_d and E_b."""
    size, real = 4.0, Geometry(0.05, 0.002, 1.5 * 1.003)
    width = 0.3 * 1.5
    x_ccw, _, _ = integrate_wheels(square(NOMINAL, size, 1.0), real, 0.3)
    x_cw, _, _ = integrate_wheels(square(NOMINAL, size, -1.0), real, 0.3)
    alpha = (x_cw + x_ccw) / (-4.0 * size)
    beta = (x_cw - x_ccw) / (-4.0 * size)
    radius = size / 2.0 / math.sin(beta / 2.0)
    right_over_left = (radius + width / 2.0) / (radius - width / 2.0)
    wider = (math.pi / 2.0) / (math.pi / 2.0 - alpha)
    assert abs(right_over_left) == pytest.approx(1.002, abs=4e-4)
    assert wider == pytest.approx(1.003, abs=6e-4)
