"""Runs and readings: odometry by closed forms, readings of options, and recorded runs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sysid_tools import ACSAR, line_wheels, spin_wheels

from acsar_gym.errors import ConfigError
from acsar_gym.links import open_link
from acsar_gym.recording import Recorder
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid.calibration import (
    CalibrationRun,
    Geometry,
    GivenReadings,
    check_readings,
    hash_runs,
    integrate_wheels,
    read_recorded_runs,
    read_tape,
)
from acsar_gym.tools.sysid.calibration_drive import drive_plans, plan_straights, plan_turns

NOMINAL = Geometry.of(ACSAR)
EVEN = Geometry(0.05, 0.0, 1.5)
LINE = CalibrationRun("straight 1", "straight", line_wheels(NOMINAL, 2.0))
LEFT = CalibrationRun("turn 1, left", "turn", spin_wheels(NOMINAL, 10.0 * math.pi))
RIGHT = CalibrationRun("turn 2, right", "turn", spin_wheels(NOMINAL, -10.0 * math.pi))
BACK_AT_START = CalibrationRun("straight 1", "straight", np.array([(0.0, 0.0), (1e6, -1e6)]))


def test_integrate_wheels_on_lines_arcs_and_full_turns() -> None:
    line = line_wheels(EVEN, 2.0)
    assert integrate_wheels(line, EVEN, 0.3) == pytest.approx((2.0, 0.0, 0.0))
    theta = 2.0 * 0.04 / 0.45  # unequal wheels drive an arc, integrated exactly in a single step
    radius = 2.0 / theta
    expected = (radius * math.sin(theta), radius * (1.0 - math.cos(theta)), theta)
    assert integrate_wheels(line[[0, -1]], Geometry(0.05, 0.04, 1.5), 0.3) == pytest.approx(
        expected
    )
    spin = spin_wheels(EVEN, 10.0 * math.pi)  # a larger multiplier turns less
    turned = integrate_wheels(spin, EVEN._replace(multiplier=2.0), 0.3)[2]
    assert turned == pytest.approx(10.0 * math.pi * 1.5 / 2.0)


@pytest.mark.parametrize(
    ("run", "given", "error"),
    [
        (LINE, GivenReadings([math.nan]), "which says 2.000 m: is it in metres"),
        (LEFT, GivenReadings(degrees=[3600.0]), "which says 1800"),
        (BACK_AT_START, GivenReadings([2.0]), "ended where it began"),
    ],
)
def test_check_readings_refuses_what_contradicts_odometry(
    run: CalibrationRun, given: GivenReadings, error: str
) -> None:
    with pytest.raises(ConfigError, match=f"^{run.name}: .*{error}"):
        check_readings(given.give([run])[0], ACSAR)


@pytest.mark.parametrize("multiplier", [0.7, 2.6])
def test_check_readings_takes_what_agrees_with_odometry(multiplier: float) -> None:
    config = ACSAR.with_(wheel_separation_multiplier=multiplier)
    turned = spin_wheels(Geometry.of(config), 10.0 * math.pi)
    run = CalibrationRun("turn 1, left", "turn", turned)
    for degrees in (1400.0, 1800.0, 2200.0):
        check_readings(GivenReadings(degrees=[degrees]).give([run])[0], config)


def test_given_readings_are_for_all_runs_of_a_manoeuvre() -> None:
    readings = GivenReadings((2.0, -2.1), (0.05, -0.05), (1712.0, -1713.0))  # a run is backward
    assert readings.check(["straight", "turn", "straight", "turn"])
    runs = readings.give([LINE, RIGHT, LINE, LEFT])
    values = [[(reading.kind, reading.value) for reading in run.readings] for run in runs]
    assert values == [
        [("distance", 2.0), ("aside", 0.05)],
        [("heading", -math.radians(1712.0))],
        [("distance", 2.1), ("aside", -0.05)],
        [("heading", math.radians(1713.0))],
    ]
    with pytest.raises(ConfigError, match="2 readings for 1 straight runs"):
        readings.check(["straight", "turn"])

    with pytest.raises(ConfigError, match=r"--measured 2\.0 nan: must be finite"):
        GivenReadings((2.0, math.nan)).check(["straight", "straight"])
    with pytest.raises(ConfigError, match="--aside needs --measured"):
        GivenReadings((), (0.1,)).check(["straight"])


def test_read_recorded_runs_returns_the_driven_runs(tmp_path: Path) -> None:
    path = tmp_path / "runs.mcap"
    plans = [*plan_straights(0.3, 0.4, 1), *plan_turns(0.5, (1.2,), (0.0,), 2)]
    recorder = Recorder(path)
    robot = Robot(open_link("planar", ACSAR), ACSAR, recorder=recorder)
    recorded: list[CalibrationRun] = []
    drive_plans(robot, plans, None, runs=recorded, announce=print, recorder=recorder)

    runs = read_recorded_runs(path, "all", ACSAR)
    for run, driven in zip(runs, recorded, strict=True):
        assert (run.name, run.manoeuvre) == (driven.name, driven.manoeuvre)
        assert np.abs(run.wheels[-1] - driven.wheels[-1]).max() < 1e-6
    assert len(read_recorded_runs(path, "turn", ACSAR)) == 2
    with pytest.raises(ConfigError, match=r"wheelbase is 0\.22 there and 0\.3 here"):
        read_recorded_runs(path, "turn", ACSAR.with_(wheelbase=0.3))


def test_read_recorded_runs_needs_the_manoeuvre_of_other_drives(tmp_path: Path) -> None:
    path = tmp_path / "unnamed.mcap"
    with Robot(open_link("planar", ACSAR), ACSAR, recorder=Recorder(path)) as robot:
        robot.drive(0.3, 0.0)
    with pytest.raises(ConfigError, match="say what was recorded"):
        read_recorded_runs(path, "all", ACSAR)


def test_hash_runs_differs_by_wheels_and_readings() -> None:
    measured = replace(LINE, readings=(read_tape("distance", 2.0),))
    assert len({hash_runs(runs) for runs in ([LINE], [LEFT], [LINE, LEFT], [measured])}) == 4
    assert hash_runs([LINE]) == hash_runs([replace(LINE, name="another")])
