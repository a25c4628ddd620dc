"""Hidden robots, measured with a tape: marks every 5 mm, and a protractor's every degree."""

from __future__ import annotations

import pytest
from calibration_tools import ACSAR, driven, hidden, usual_plans

from acsar_gym.tools.sysid.calibration_fit import GeometryFit, fit_geometry, make_calibrated_config
from acsar_gym.tools.sysid.calibration_runs import configured_geometry

RADIUS, MULTIPLIER = 0.003, 0.01
"""Largest errors, as shares of the truth."""


def check(seed: int, link: str = "planar") -> GeometryFit:
    """Calibrate one hidden robot and print its errors, which must be within the bounds."""
    twin = hidden(seed)
    found = fit_geometry(driven(usual_plans(), twin, link), ACSAR)
    true, factor = configured_geometry(twin), twin.body.turn_factor
    assert factor is not None
    errors = (
        found.geometry.left / true.left - 1.0,
        found.geometry.right / true.right - 1.0,
        found.geometry.multiplier / factor - 1.0,
    )
    print(f"| {seed} | {link} | {factor:.4f} | " + " | ".join(f"{e:+.3%}" for e in errors) + " |")
    assert max(abs(errors[0]), abs(errors[1])) < RADIUS
    assert abs(errors[2]) < MULTIPLIER
    assert found.outliers == ()
    intervals = found.told["wheel_separation_multiplier"]
    assert intervals.low <= factor <= intervals.high
    return found


@pytest.mark.parametrize("seed", [0, 4])
def test_a_hidden_robot_is_found(seed: int) -> None:
    check(seed)


def test_a_hidden_robot_in_bullet_is_found() -> None:
    pytest.importorskip("pybullet")
    check(1, "bullet")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_twenty_hidden_robots_are_found(seed: int) -> None:
    check(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_hidden_robots_in_bullet_are_found(seed: int) -> None:
    check(seed, "bullet")


def test_the_calibrated_twin_turns_as_the_robot() -> None:
    """Without turn_factor it was 37 cm off in its own twin."""
    twin = hidden(2)
    found = make_calibrated_config(fit_geometry(driven(usual_plans(), twin), ACSAR), ACSAR)
    assert found.body.turn_factor == pytest.approx(twin.body.turn_factor, rel=MULTIPLIER)
    assert found.wheel_separation_multiplier == found.body.turn_factor
    again = fit_geometry(driven(usual_plans()[:4], found), found)
    assert again.geometry == pytest.approx(configured_geometry(found), rel=0.003, abs=0.003)
