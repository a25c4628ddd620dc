"""Errors of the simulated LiDAR."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.lidar.scan import make_rays
from acsar_gym.lidar.simulated import LidarTraits, add_errors

RAYS = make_rays(RobotConfig.preset("acsar"))
TRAITS = LidarTraits(*[0.0] * 8)._replace(scan_rate=10.0, key=0.3)


def measure(true: float, revolutions: int = 300, beside: float = 0.0, **traits: float) -> Any:
    """Distances of many revolutions, (revolutions, 64). Every second ray is `beside` further."""
    measured = np.full((revolutions, 64), true)
    measured[:, ::2] += beside
    for number, distances in enumerate(measured):
        add_errors(distances, float(number - 1), TRAITS._replace(**traits), RAYS)
    return measured


def test_add_errors_draws_normal_noise_for_each_measurement() -> None:
    errors = (measure(2.0, 4000, noise=0.02) - 2.0) / 0.02
    assert errors.mean() == pytest.approx(0.0, abs=0.01)
    assert errors.std() == pytest.approx(1.0, abs=0.01)
    assert np.mean(np.abs(errors) < 1.0) == pytest.approx(0.683, abs=0.005)
    correlation = np.corrcoef(errors.T)
    assert np.abs(correlation - np.eye(64)).max() < 0.08
    assert (measure(5.0, noise=0.5) == 0.0).all()  # out of reach
    assert (measure(0.1, noise=1.0) > 0.0).all()  # near, not nothing


def test_add_errors_adds_dropouts_bias_and_outliers() -> None:
    measured = measure(2.0, noise=0.01, dropouts=0.2)
    assert np.mean(measured == 0.0) == pytest.approx(0.2, abs=0.015)
    assert (np.abs(measured[measured > 0.0] - 2.0) < 0.1).all()
    assert measure(2.0, bias=-0.03) == pytest.approx(1.97)
    assert (measure(2.0, outliers=0.5) == 2.0).all()  # not an edge
    mixed = measure(2.0, beside=1.0, outliers=0.3)
    between = mixed[(mixed > 2.0) & (mixed < 3.0)]
    assert len(between) / mixed.size == pytest.approx(0.3, abs=0.02)
    assert between.mean() == pytest.approx(2.5, abs=0.02)
