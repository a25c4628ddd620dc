"""The fit on synthetic readings: what it finds, what it can't tell, and what it leaves out."""

from __future__ import annotations

import math

import numpy as np
import pytest
from calibration_tools import ACSAR, SCALES, line, spin, square

from acsar_gym import RobotConfig
from acsar_gym.config import Measured
from acsar_gym.errors import ConfigError
from acsar_gym.tools.sysid.calibration_fit import fit_geometry
from acsar_gym.tools.sysid.calibration_runs import (
    CalibrationRun,
    Floats,
    Geometry,
    RunReading,
    configured_geometry,
    integrate_wheels,
)

NOMINAL = configured_geometry(ACSAR)
REAL = Geometry(0.0508, 0.03, 1.9)
WHEELS = {
    "straight": line(NOMINAL, 2.0),
    "turn": spin(NOMINAL, 10.0 * math.pi),
    "cw": square(NOMINAL, 1.0, -1.0),
    "ccw": square(NOMINAL, 1.0, 1.0),
}


def run(
    name: str, off: float = 0.0, wheels: Floats | None = None, real: Geometry = REAL
) -> CalibrationRun:
    """A run of the real robot with readings as a person takes them, `off` [m, rad] wrong."""
    turned = WHEELS[name] if wheels is None else wheels
    x, y, theta = integrate_wheels(turned, real, 0.3)
    if name == "straight":
        readings = [SCALES.metres("distance", math.hypot(x, y) + off)]
    elif name == "turn":
        readings = [SCALES.degrees(math.degrees(theta + off))]
    else:
        readings = [SCALES.metres("x", x + off), SCALES.metres("y", y)]
    manoeuvre = name if name in ("straight", "turn") else "square"
    return CalibrationRun(name, manoeuvre, turned, tuple(readings))


def test_straight_turn_and_squares_together_tell_all() -> None:
    found = fit_geometry([run(name) for name in WHEELS], ACSAR)
    assert found.geometry == pytest.approx(REAL, rel=1e-4)
    assert set(found.told) == {"wheel_radius", "radius_ratio", "wheel_separation_multiplier"}
    assert found.outliers == ()


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (["straight"], {"wheel_radius"}),
        (["turn"], {"wheel_separation_multiplier"}),
        (["straight", "turn"], {"wheel_radius", "wheel_separation_multiplier"}),
    ],
)
def test_a_manoeuvre_alone_tells_its_part_and_the_rest_stays(
    names: list[str], told: set[str]
) -> None:
    found = fit_geometry([run(name) for name in names], ACSAR)
    assert set(found.told) == told
    assert found.geometry.ratio == 0.0
    if "straight" not in names:
        assert found.geometry.radius == 0.05
    if "turn" not in names:
        assert found.geometry.multiplier == ACSAR.wheel_separation_multiplier


def test_squares_alone_tell_ratio_and_multiplier() -> None:
    found = fit_geometry([run("cw"), run("ccw")], ACSAR)
    assert {"radius_ratio", "wheel_separation_multiplier"} <= set(found.told)
    assert found.geometry.ratio == pytest.approx(REAL.ratio, abs=0.002)


def test_a_straight_line_with_its_offset_aside_tells_the_ratio() -> None:
    base = run("straight")
    x, y, _ = integrate_wheels(base.wheels, REAL, 0.3)
    both = base.read([SCALES.metres("distance", math.hypot(x, y)), SCALES.metres("aside", y)])
    assert set(fit_geometry([both], ACSAR).told) == {"wheel_radius", "radius_ratio"}


def test_what_is_not_told_widens_the_interval_unless_it_was_measured_before() -> None:
    one = fit_geometry([run("turn")], ACSAR).told["wheel_separation_multiplier"]
    known = ACSAR.with_(
        measured={"wheel_radius": Measured(low=0.0499, high=0.0501, method="calibrate straight")}
    )
    after = fit_geometry([run("turn")], known).told["wheel_separation_multiplier"]
    assert one.high - one.low > 4.0 * (after.high - after.low)


def test_more_repeats_narrow_the_interval() -> None:
    def width(count: int) -> float:
        one = fit_geometry([run("straight", 0.001 * (-1) ** i) for i in range(count)], ACSAR)
        return one.told["wheel_radius"].high - one.told["wheel_radius"].low

    assert width(1) > width(3) > width(12)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    rng, even, held = np.random.default_rng(3), REAL._replace(ratio=0.0), 0
    for _ in range(40):
        offs = rng.normal(0.0, SCALES.tape / 2.0, 3)
        one = fit_geometry([run("straight", off, real=even) for off in offs], ACSAR).told[
            "wheel_radius"
        ]
        held += one.low <= even.radius <= one.high
    assert held >= 35


def test_an_outlier_is_left_out_and_named() -> None:
    good = [run("straight", off) for off in (0.001, -0.001, 0.002)]
    bad = run("straight", 0.08)
    found = fit_geometry([*good, bad, run("turn")], ACSAR)
    assert found.outliers == (bad,)
    assert found.geometry.radius == pytest.approx(0.0508, rel=2e-3)


def test_two_readings_that_differ_are_both_kept() -> None:
    found = fit_geometry([run("straight", 0.05), run("straight", -0.05)], ACSAR)
    assert found.outliers == ()
    one = found.told["wheel_radius"]
    assert one.high - one.low > 0.001


def test_it_starts_far_from_the_config() -> None:
    far = RobotConfig.preset("acsar").with_(wheel_separation_multiplier=1.0)
    wheels = {
        "cw": square(configured_geometry(far), 1.0, -1.0),
        "ccw": square(configured_geometry(far), 1.0, 1.0),
        "straight": line(configured_geometry(far), 2.0),
    }
    found = fit_geometry([run(name, wheels=own) for name, own in wheels.items()], far)
    assert found.geometry == pytest.approx(REAL, rel=1e-3)


def test_errors_are_told() -> None:
    with pytest.raises(ConfigError, match="no run has a reading yet"):
        fit_geometry([CalibrationRun("straight 1", "straight", WHEELS["straight"])], ACSAR)
    weak = CalibrationRun("turn", "turn", WHEELS["turn"], (RunReading("x", 0.0, 0.1, "tape"),))
    with pytest.raises(ConfigError, match="tell neither radius nor multiplier"):
        fit_geometry([weak], ACSAR)
    absurd = CalibrationRun(
        "far", "straight", WHEELS["straight"], (SCALES.metres("distance", 9.0),)
    )
    with pytest.raises(ConfigError, match="push wheel_radius to its bound"):
        fit_geometry([absurd], ACSAR)
