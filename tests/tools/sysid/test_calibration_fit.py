"""The fit on synthetic readings and of hidden robots: what it finds, can't tell, and leaves out."""

from __future__ import annotations

import math

import pytest
from sysid_tools import (
    ACSAR,
    circle_wheels,
    draw_wheels,
    drive_plans,
    line_wheels,
    spin_wheels,
    usual_plans,
)

from acsar_gym.config import Measured
from acsar_gym.errors import ConfigError
from acsar_gym.physics.randomization import Randomization
from acsar_gym.tools.sysid.board_log import Estimate, Floats
from acsar_gym.tools.sysid.calibration import (
    CalibrationRun,
    Geometry,
    RunReading,
    configured_geometry,
    integrate_wheels,
    read_protractor,
    read_tape,
)
from acsar_gym.tools.sysid.calibration_fit import (
    GeometryFit,
    fit_geometry,
    make_calibrated_config,
)

NOMINAL = configured_geometry(ACSAR)
REAL = Geometry(0.0508, 0.03, 1.9)
WHEELS = {
    "straight": line_wheels(NOMINAL, 2.0),
    "turn": spin_wheels(NOMINAL, 10.0 * math.pi),
    "left": circle_wheels(NOMINAL, 0.5, 10.0 * math.pi),
    "right": circle_wheels(NOMINAL, 0.5, -10.0 * math.pi),
}
RADIUS, MULTIPLIER = 0.003, 0.01
"""Largest errors of hidden robots, as shares of the truth."""


def run(
    name: str, off: float = 0.0, wheels: Floats | None = None, real: Geometry = REAL
) -> CalibrationRun:
    """A run of the real robot with readings as a person takes them, `off` [m, rad] wrong."""
    turned = WHEELS[name] if wheels is None else wheels
    x, y, theta = integrate_wheels(turned, real, 0.3)
    if name == "straight":
        readings = [read_tape("distance", math.hypot(x, y) + off)]
    else:
        readings = [read_protractor(math.degrees(theta + off))]
    manoeuvre = "straight" if name == "straight" else "turn"
    return CalibrationRun(name, manoeuvre, turned, tuple(readings))


def test_straight_lines_turns_and_circles_together_tell_all() -> None:
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
    assert ("straight" in names) == (found.geometry.radius != 0.05)
    assert ("turn" in names) == (found.geometry.multiplier != NOMINAL.multiplier)


def test_circles_or_a_line_with_its_offset_tell_the_ratio() -> None:
    found = fit_geometry([run("turn"), run("left"), run("right")], ACSAR)
    assert {"radius_ratio", "wheel_separation_multiplier"} <= set(found.told)
    assert found.geometry.ratio == pytest.approx(REAL.ratio, abs=0.002)
    base = run("straight")
    x, y, _ = integrate_wheels(base.wheels, REAL, 0.3)
    both = base.read([read_tape("distance", math.hypot(x, y)), read_tape("aside", y)])
    assert set(fit_geometry([both], ACSAR).told) == {"wheel_radius", "radius_ratio"}


def test_an_outlier_is_left_out_and_named_but_not_one_of_two() -> None:
    good = [run("straight", off) for off in (0.001, -0.001, 0.002)]
    bad = run("straight", 0.08)
    found = fit_geometry([*good, bad, run("turn")], ACSAR)
    assert found.outliers == (bad,)
    assert found.geometry.radius == pytest.approx(0.0508, rel=2e-3)
    found = fit_geometry([run("straight", 0.05), run("straight", -0.05)], ACSAR)
    assert found.outliers == ()
    assert found.told["wheel_radius"].high - found.told["wheel_radius"].low > 0.001


@pytest.mark.parametrize(
    ("readings", "said"),
    [
        ([], "no run has a reading"),
        ([RunReading("distance", 2.0, 10.0, "tape")], "tell neither radius nor multiplier"),
        ([read_tape("distance", 9.0)], "wheel_radius to its bound"),
    ],
)
def test_errors_are_told(readings: list[RunReading], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        fit_geometry([run("straight").read(readings)], ACSAR)


def check_hidden(seed: int, link: str = "planar") -> None:
    """Calibrate one hidden robot, whose errors must be within the bounds."""
    twin = draw_wheels(seed)
    found = fit_geometry(drive_plans(usual_plans(), twin, link), ACSAR)
    true, factor = configured_geometry(twin), twin.body.turn_factor
    assert factor is not None
    assert found.geometry.left == pytest.approx(true.left, rel=RADIUS)
    assert found.geometry.right == pytest.approx(true.right, rel=RADIUS)
    assert found.geometry.multiplier == pytest.approx(factor, rel=MULTIPLIER)
    assert found.outliers == ()
    intervals = found.told["wheel_separation_multiplier"]
    assert intervals.low <= factor <= intervals.high


@pytest.mark.parametrize(
    "seed", [pytest.param(n, marks=[] if n in (0, 4) else pytest.mark.slow) for n in range(20)]
)
def test_a_hidden_robot_is_found(seed: int) -> None:
    check_hidden(seed)


@pytest.mark.parametrize(
    "seed", [pytest.param(n, marks=[] if n == 1 else pytest.mark.slow) for n in range(5)]
)
def test_a_hidden_robot_in_bullet_is_found(seed: int) -> None:
    pytest.importorskip("pybullet")
    check_hidden(seed, "bullet")


def test_the_calibrated_twin_turns_as_the_robot() -> None:
    """Without turn_factor it was 37 cm off in its own twin."""
    twin = draw_wheels(2)
    found = make_calibrated_config(fit_geometry(drive_plans(usual_plans(), twin), ACSAR), ACSAR)
    assert found.body.turn_factor == pytest.approx(twin.body.turn_factor, rel=MULTIPLIER)
    assert found.wheel_separation_multiplier == found.body.turn_factor
    again = fit_geometry(drive_plans(usual_plans()[:4], found), found)
    assert again.geometry == pytest.approx(configured_geometry(found), rel=0.003, abs=0.003)


def test_a_controller_in_ros_goes_on_taking_twists_as_it_did() -> None:
    fit = fitted(wheel_separation_multiplier=Estimate(1.5, 1.4, 1.6))
    found = make_calibrated_config(fit, ACSAR, in_ros=True)
    assert found.wheel_separation_multiplier == 1.5
    assert found.twist_geometry == ACSAR.twist_geometry
    again = make_calibrated_config(fit, found, in_ros=True)
    assert again.twist_geometry == ACSAR.twist_geometry
    assert make_calibrated_config(fit, ACSAR).ros2 == ACSAR.ros2


def fitted(**told: Estimate) -> GeometryFit:
    return GeometryFit(Geometry(0.0495, 0.02, 1.5), told, (), (), 1.0)


@pytest.mark.parametrize(
    ("one", "measured"),
    [
        (Estimate(1.03, 0.98, 1.08), "body.turn_factor"),  # hardly skids
        (Estimate(0.95, 0.9, 1.0), ""),  # no tyre has it
    ],
)
def test_any_multiplier_can_be_trained_with(one: Estimate, measured: str) -> None:
    turn = Measured(low=1.6, high=1.8, method="before")
    known = ACSAR.with_(body={"turn_factor": 1.7}, measured={"body.turn_factor": turn})
    found = make_calibrated_config(fitted(wheel_separation_multiplier=one), known)
    assert set(found.measured) == {"wheel_separation_multiplier", measured} - {""}
    if measured:
        assert 1.0 < found.measured[measured].low <= one.value
    Randomization.measured(found).ranges(found, 0.1)
