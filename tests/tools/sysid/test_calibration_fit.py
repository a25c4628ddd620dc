"""The fit of radii and multiplier, on synthetic readings and of hidden robots."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from sysid_tools import (
    ACSAR,
    circle_wheels,
    draw_wheels,
    drive_with_truth,
    line_wheels,
    read_as_person,
    spin_wheels,
    usual_plans,
)

from acsar_gym.config import Measured, RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.physics.randomization import Randomization
from acsar_gym.tools.sysid.board_log import Estimate
from acsar_gym.tools.sysid.calibration import (
    CalibrationRun,
    Geometry,
    RunReading,
    integrate_wheels,
    read_protractor,
    read_tape,
)
from acsar_gym.tools.sysid.calibration_fit import (
    GeometryFit,
    fit_geometry,
    make_calibrated_config,
)

NOMINAL = Geometry.of(ACSAR)
REAL = Geometry(0.0508, 0.03, 1.9)
WHEELS = {
    "straight": line_wheels(NOMINAL, 2.0),
    "aside": line_wheels(NOMINAL, 2.0),
    "turn": spin_wheels(NOMINAL, 10.0 * math.pi),
    "left": circle_wheels(NOMINAL, 0.5, 10.0 * math.pi),
    "right": circle_wheels(NOMINAL, 0.5, -10.0 * math.pi),
}
RADIUS = "wheel_radius"
RATIO = "radius_ratio"
MULTIPLIER = "wheel_separation_multiplier"


def make_run(name: str, off: float = 0.0) -> CalibrationRun:
    """A run of the real robot with readings as a person takes them, `off` [m, rad] wrong."""
    x, y, theta = integrate_wheels(WHEELS[name], REAL, 0.3)
    if name in ("left", "right", "turn"):
        readings = (read_protractor(math.degrees(theta + off)),)
        return CalibrationRun(name, "turn", WHEELS[name], readings)
    distance = read_tape("distance", math.hypot(x, y) + off)
    offsets = [read_tape("aside", y)] if name == "aside" else []
    return CalibrationRun(name, "straight", WHEELS[name], (distance, *offsets))


@pytest.mark.parametrize(
    ("names", "narrowed"),
    [
        (["straight", "turn"], {RADIUS, MULTIPLIER}),
        (["turn", "left", "right"], {RATIO, MULTIPLIER}),
        (["straight", "turn", "left", "right"], {RADIUS, RATIO, MULTIPLIER}),
        (["aside"], {RADIUS, RATIO}),
    ],
)
def test_fit_geometry_finds_what_the_manoeuvres_show(names: list[str], narrowed: set[str]) -> None:
    fit = fit_geometry([make_run(name) for name in names], ACSAR)
    assert set(fit.narrowed) == narrowed
    changed = np.not_equal(fit.geometry, NOMINAL)
    assert changed.tolist() == [name in narrowed for name in (RADIUS, RATIO, MULTIPLIER)]
    if len(narrowed) == 3:
        assert fit.geometry == pytest.approx(REAL, rel=1e-4)


def test_fit_geometry_hardly_counts_a_wrong_reading() -> None:
    runs = [make_run("straight", off) for off in (0.001, -0.001, 0.002, 0.08)]
    fit = fit_geometry(runs, ACSAR)
    assert fit.geometry.radius == pytest.approx(0.0508, rel=2e-3)
    assert fit.rms > 10.0


def test_fit_geometry_widens_intervals_if_residuals_exceed_their_scales() -> None:
    """Wheels of a side drag each other. 1.006 was measured as 1.0017 with +- 0.0004."""
    twin = RobotConfig(
        wheel_radius=0.04989,
        wheel_separation=0.336,
        wheelbase=0.286,
        left_wheel_radius_multiplier=1.006,
        right_wheel_radius_multiplier=0.9945,
        motor={"gain": (1.003, 1.024, 0.968, 1.032), "acceleration": 32.0, "deadband": 0.37},
        body={"turn_factor": 1.623},
    )
    guess = RobotConfig(wheel_radius=0.051, wheel_separation=0.336, wheelbase=0.286)

    fit = fit_geometry(drive_with_truth(usual_plans(), twin, guess), guess)
    assert fit.rms > 2.0
    for name, interval in make_calibrated_config(fit, guess).measured.items():
        is_turning = name in (MULTIPLIER, "body.turn_factor")
        true: Any = twin.body.turn_factor if is_turning else getattr(twin, name)
        assert interval.low <= true <= interval.high, name


def test_fit_geometry_refuses_useless_readings() -> None:
    vague = (RunReading("distance", 2.0, 10.0, "tape"),)
    with pytest.raises(ConfigError, match="tell neither radius nor multiplier"):
        fit_geometry([replace(make_run("straight"), readings=vague)], ACSAR)


@pytest.mark.parametrize(("link", "seed"), [("planar", 4), ("bullet", 1)])
def test_fit_geometry_finds_a_hidden_robot(link: str, seed: int) -> None:
    if link == "bullet":
        pytest.importorskip("pybullet")
    twin = draw_wheels(seed)
    runs = drive_with_truth(usual_plans(), twin, link=link)
    fit = fit_geometry([read_as_person(run) for run in runs], ACSAR)
    true = Geometry.of(twin)
    factor: Any = twin.body.turn_factor
    assert fit.geometry.radii == pytest.approx(true.radii, rel=0.003)
    assert fit.geometry.multiplier == pytest.approx(factor, rel=0.01)
    assert fit.narrowed[MULTIPLIER].low <= factor <= fit.narrowed[MULTIPLIER].high

    # The twin turns as the robot. Without turn_factor it was 37 cm off.
    config = make_calibrated_config(fit, ACSAR)
    assert config.wheel_separation_multiplier == config.body.turn_factor == fit.geometry.multiplier


def make_fit(**narrowed: Estimate) -> GeometryFit:
    return GeometryFit(Geometry(0.0495, 0.02, 1.5), narrowed, (), 1.0)


def test_make_calibrated_config_keeps_the_twists_of_a_controller_in_ros() -> None:
    fit = make_fit(wheel_separation_multiplier=Estimate(1.5, 1.4, 1.6))
    config = make_calibrated_config(fit, ACSAR, in_ros=True)
    again = make_calibrated_config(fit, config, in_ros=True)
    for robot in (config, again):
        assert robot.wheel_separation_multiplier == 1.5
        assert robot.twist_geometry == ACSAR.twist_geometry


@pytest.mark.parametrize("gain", [0.97, (0.96, 0.98, 0.97, 0.97)])
def test_make_calibrated_config_takes_a_radius_out_of_the_gain(gain: float | tuple[float]) -> None:
    """Twists were sent by 0.0485 m, so that the wheels of a controller turned 3 % slower."""
    measured = {"motor.gain": Measured(low=0.96, high=0.98, method="identify")}
    guess = ACSAR.with_(wheel_radius=0.0485, motor={"gain": gain}, measured=measured)
    fit = make_fit(wheel_radius=Estimate(0.05, 0.0499, 0.0501))
    config = make_calibrated_config(fit, guess, in_ros=True)
    assert np.mean(config.motor.gain) == pytest.approx(1.0)
    assert config.twist_geometry[:2] == pytest.approx((0.05, 0.05))
    assert config.measured["motor.gain"].low == pytest.approx(0.96 / 0.97)
    not_in_ros = make_calibrated_config(fit, guess)
    assert (not_in_ros.motor, not_in_ros.ros2) == (guess.motor, guess.ros2)


@pytest.mark.parametrize(
    ("multiplier", "names"),
    [
        (Estimate(1.03, 0.98, 1.08), {MULTIPLIER, "body.turn_factor"}),  # hardly skids
        (Estimate(0.95, 0.9, 1.0), {MULTIPLIER}),  # no tyre has it
    ],
)
def test_make_calibrated_config_can_be_trained_with(multiplier: Estimate, names: set[str]) -> None:
    turn = Measured(low=1.6, high=1.8, method="before")
    guess = ACSAR.with_(body={"turn_factor": 1.7}, measured={"body.turn_factor": turn})
    config = make_calibrated_config(make_fit(wheel_separation_multiplier=multiplier), guess)
    assert set(config.measured) == names
    if len(names) == 2:
        assert 1.0 < config.measured["body.turn_factor"].low <= multiplier.value
    Randomization.measured(config).ranges(config, 0.1)
