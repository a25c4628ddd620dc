"""Odometry of calibration runs against closed forms; their files, and those of recordings."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sysid_tools import ACSAR, SCALES, leg_wheels, line_wheels, spin_wheels, square_wheels

from acsar_gym.errors import ConfigError
from acsar_gym.odometry import Odometry
from acsar_gym.recording import Recorder
from acsar_gym.tools.sysid.calibrate import CalibrationJob, DrivenRobot, GivenReadings
from acsar_gym.tools.sysid.calibration_drive import plan_turns
from acsar_gym.tools.sysid.calibration_runs import (
    CalibrationRun,
    Geometry,
    configured_geometry,
    format_runs,
    hash_runs,
    integrate_wheels,
    read_recorded_runs,
    read_runs,
    write_runs,
)

NOMINAL = Geometry(0.05, 0.0, 1.5)
WHEELS = line_wheels(configured_geometry(ACSAR), 2.0)
RUN = CalibrationRun("straight 1", "straight", WHEELS, (SCALES.metres("distance", 2.0),))


def test_the_config_is_taken_as_mean_radius_ratio_and_multiplier() -> None:
    config = ACSAR.with_(left_wheel_radius_multiplier=0.99, right_wheel_radius_multiplier=1.03)
    geometry = configured_geometry(config)
    assert geometry.left == pytest.approx(0.05 * 0.99)
    assert geometry.right == pytest.approx(0.05 * 1.03)
    assert geometry.multiplier == config.wheel_separation_multiplier


def test_straight_lines_arcs_and_full_turns() -> None:
    line = line_wheels(NOMINAL, 2.0)
    assert integrate_wheels(line, NOMINAL, 0.3) == pytest.approx((2.0, 0.0, 0.0))
    theta = 2.0 * 0.04 / 0.45  # unequal wheels drive an arc
    radius = 2.0 / theta
    expected = (radius * math.sin(theta), radius * (1.0 - math.cos(theta)), theta)
    assert integrate_wheels(line, Geometry(0.05, 0.04, 1.5), 0.3) == pytest.approx(expected)
    spin = spin_wheels(NOMINAL, 10.0 * math.pi)  # a larger multiplier turns less
    turned = integrate_wheels(spin, NOMINAL._replace(multiplier=2.0), 0.3)[2]
    assert turned == pytest.approx(10.0 * math.pi * 1.5 / 2.0)
    fine, coarse = leg_wheels([40.0], [50.0], 1000), leg_wheels([40.0], [50.0], 2)
    exact = integrate_wheels(fine, NOMINAL, 0.3)
    assert integrate_wheels(coarse, NOMINAL, 0.3) == pytest.approx(exact)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_it_agrees_with_the_driver_s_odometry(side: float) -> None:
    wheels = square_wheels(NOMINAL, 1.0, side)
    odometry = Odometry(0.05, 0.3, 1.5)
    for left, right in np.repeat(np.diff(wheels, axis=0) / 20.0, 20, axis=0):
        odometry.update((right, left, left, right), 1.0)
    x, y, theta = integrate_wheels(wheels, NOMINAL, 0.3)
    assert (x, y) == pytest.approx(odometry.pose[:2], abs=1e-3)
    assert math.remainder(theta - odometry.pose[2], math.tau) == pytest.approx(0.0, abs=1e-9)


def test_runs_are_read_back_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "cal.json"
    write_runs(path, [RUN, RUN.read([])], ACSAR)
    one, two = read_runs(path, ACSAR)
    assert (one.name, one.manoeuvre, one.readings) == (RUN.name, RUN.manoeuvre, RUN.readings)
    assert np.abs(one.wheels - RUN.wheels).max() < 1e-6
    assert two.readings == ()
    assert hash_runs([one], ACSAR) == hash_runs([RUN], ACSAR)
    with pytest.raises(ConfigError, match=r"wheel_separation is 0\.3 there and 0\.4"):
        read_runs(path, ACSAR.with_(wheel_separation=0.4))


def broken(**changes: Any) -> bytes:
    data = json.loads(json.dumps(format_runs([RUN], ACSAR)))
    data["runs"][0] |= changes
    return json.dumps(data).encode()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (broken()[:200], "JSON"),
        (b'{"success_rate": 1.0}', "isn't a file of calibration runs"),
        (broken(wheels=[[0.0, 0.0]]), "wheels"),
        (broken(wheels=[[0.0, 1e9], [0.0, 1.0]]), "too large"),
        (broken(manoeuvre="dance"), "dance"),
        (broken(readings=[{"kind": "x", "value": 1, "sigma": 0, "source": "tape"}]), "reading"),
    ],
)
def test_cut_and_foreign_files_are_one_error(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "cal.json"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=said) as told:
        read_runs(path, ACSAR)
    assert str(path) in str(told.value)
    assert "\n" not in str(told.value)


def test_a_recording_holds_the_same_runs(tmp_path: Path) -> None:
    path = tmp_path / "turns.mcap"
    job = CalibrationJob(ACSAR, GivenReadings(), SCALES)
    robot = DrivenRobot("planar", ACSAR, ACSAR, recorder=Recorder(path))
    job.drive(robot, plan_turns(0.5, (1.2,), (0.0,), 2), None, lambda _: None)
    found = read_recorded_runs(path, "turn", ACSAR)
    assert [run.name for run in found] == ["turn 1 of turns.mcap", "turn 2 of turns.mcap"]
    for one, other in zip(job.found, found, strict=True):
        assert np.abs(one.wheels[-1] - other.wheels[-1]).max() < 1e-6
    with pytest.raises(ConfigError, match=r"wheelbase is 0\.22 there and 0\.3 here"):
        read_recorded_runs(path, "turn", ACSAR.with_(wheelbase=0.3))
    with pytest.raises(ConfigError, match="say what was recorded"):
        read_recorded_runs(path, "all", ACSAR)
    path.write_bytes(b"no recording")
    with pytest.raises(ConfigError) as told:
        read_recorded_runs(path, "turn", ACSAR)
    assert "\n" not in str(told.value)
