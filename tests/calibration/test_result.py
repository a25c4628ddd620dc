"""The robot's file that a calibration writes: values, and which intervals hold on."""

from __future__ import annotations

import pytest
from calibration_tools import ACSAR

from acsar_gym.config import Measured
from acsar_gym.physics import Randomization
from acsar_gym.tools.sysid.calibration_fit import FittedValue, GeometryFit, make_calibrated_config
from acsar_gym.tools.sysid.calibration_runs import Geometry

WHEEL = Measured(low=0.04, high=0.06, method="before")
TURN = Measured(low=1.6, high=1.8, method="before")


def fitted(**told: FittedValue) -> GeometryFit:
    return GeometryFit(Geometry(0.0495, 0.02, 1.5), told, (), (), 1.0)


def test_a_radius_that_follows_from_the_ratio_has_no_old_interval() -> None:
    before = ACSAR.with_(left_wheel_radius_multiplier=0.98, measured={"wheel_radius": WHEEL})
    found = make_calibrated_config(fitted(radius_ratio=FittedValue.around(0.02, 0.001)), before)
    assert found.wheel_radius == 0.0495
    assert set(found.measured) == {"left_wheel_radius_multiplier", "right_wheel_radius_multiplier"}


@pytest.mark.parametrize(("low", "value", "high"), [(0.98, 1.03, 1.08), (0.95, 1.0002, 1.05)])
def test_a_robot_that_hardly_skids_can_be_trained_with(
    low: float, value: float, high: float
) -> None:
    one = FittedValue(value, low, high)
    found = make_calibrated_config(fitted(wheel_separation_multiplier=one), ACSAR)
    assert 1.0 < found.measured["body.turn_factor"].low <= value
    Randomization.measured(found).ranges(found, 0.1)


def test_a_multiplier_that_no_tyre_has_ends_the_interval_of_the_tyres() -> None:
    known = ACSAR.with_(body={"turn_factor": 1.7}, measured={"body.turn_factor": TURN})
    one = FittedValue(0.95, 0.9, 1.0)
    found = make_calibrated_config(fitted(wheel_separation_multiplier=one), known)
    assert set(found.measured) == {"wheel_separation_multiplier"}
    Randomization.measured(found).ranges(found, 0.1)
