"""Readings of people: files, and those that can't be right."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from calibration_tools import ACSAR, SCALES, line, spin, square

from acsar_gym.errors import ConfigError
from acsar_gym.tools.sysid import calibrate
from acsar_gym.tools.sysid.calibrate import check_readings, read_square, read_straight, read_turn
from acsar_gym.tools.sysid.calibration_runs import CalibrationRun, RunReading, configured_geometry

NOMINAL = configured_geometry(ACSAR)
LINE = CalibrationRun("straight 1", "straight", line(NOMINAL, 2.0))
LEFT = CalibrationRun("turn 1, left", "turn", spin(NOMINAL, 10.0 * math.pi))
RIGHT = CalibrationRun("turn 2, right", "turn", spin(NOMINAL, -10.0 * math.pi))
CW = CalibrationRun("square cw 1", "square", square(NOMINAL, 1.0, -1.0))
CCW = CalibrationRun("square ccw 1", "square", square(NOMINAL, 1.0, 1.0))


def values(found: list[RunReading]) -> dict[str, float]:
    return {reading.kind: reading.value for reading in found}


def test_numbers_become_readings_of_the_run() -> None:
    assert values(read_straight([2.01], SCALES)) == {"distance": 2.01}
    assert values(read_straight([-2.01], SCALES)) == {"distance": 2.01}  # backwards
    assert values(read_straight([2.01, -0.05], SCALES)) == {"distance": 2.01, "aside": -0.05}
    assert values(read_turn(1712.0, LEFT, SCALES)) == {"heading": math.radians(1712.0)}
    assert values(read_turn(1712.0, RIGHT, SCALES)) == {"heading": -math.radians(1712.0)}
    assert values(read_turn(-1712.0, LEFT, SCALES)) == {"heading": math.radians(1712.0)}
    assert values(read_square([0.1, -0.2], CW, SCALES)) == {"x": 0.1, "y": -0.2}
    assert values(read_square([0.1, 0.2, 5.0], CW, SCALES))["heading"] == math.radians(-355.0)
    assert values(read_square([0.1, 0.2, 5.0], CCW, SCALES))["heading"] == math.radians(365.0)


def test_corners_are_read_with_and_without_names(tmp_path: Path) -> None:
    path = tmp_path / "cw.csv"
    path.write_text("x,y,degrees\n0.01,-0.02,1.5\n\n0.03,0.04\n", encoding="utf-8")
    assert calibrate.read_corners(path) == [(0.01, -0.02, 1.5), (0.03, 0.04)]
    path.write_text("0.01, -0.02\n", encoding="utf-8")
    assert calibrate.read_corners(path) == [(0.01, -0.02)]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no rows"),
        ("x,y\n", "no rows"),
        ("0.1\n", "row 1, '0.1': must be x,y or x,y,degrees"),
        ("0.1,0.2\n0.1,inf\n", "row 2"),
        ("1,2,3,4\n", "row 1"),
    ],
)
def test_bad_corners_are_one_error(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "cw.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=said):
        calibrate.read_corners(path)


@pytest.mark.parametrize(
    ("run", "read", "said"),
    [
        (
            LINE,
            read_straight([201.3], SCALES),
            "more than 30%: odometry says 2.000 m: in centimetres",
        ),
        (LINE, read_straight([2013.0], SCALES), "odometry says 2.000 m: in millimetres"),
        (LINE, read_straight([2.7], SCALES), "another run's"),
        (LINE, read_straight([1.3], SCALES), "odometry says 2.000 m"),
        (LINE, read_straight([0.0], SCALES), "odometry says 2.000 m"),
        (LINE, read_straight([2.0, 30.0], SCALES), "farther than the robot drove"),
        (LEFT, read_turn(5.0, LEFT, SCALES), "odometry says 1800 degrees: counted the full turns"),
        (LEFT, read_turn(0.0, LEFT, SCALES), "odometry says 1800 degrees"),
        (LEFT, read_turn(900.0, LEFT, SCALES), "odometry says 1800 degrees"),
        (LEFT, read_turn(3600.0, LEFT, SCALES), "odometry says 1800 degrees"),
        (CW, read_square([12.0, 3.0], CW, SCALES), "farther than the robot drove"),
    ],
)
def test_readings_that_contradict_the_odometry_are_refused(
    run: CalibrationRun, read: list[RunReading], said: str
) -> None:
    with pytest.raises(ConfigError, match=said) as told:
        check_readings(run.read(read), ACSAR)
    assert str(told.value).startswith(run.name)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("angles", [(0.0, 0.0), (1e6, -1e6)])
@pytest.mark.parametrize("read", [0.0, 2.0])
def test_a_straight_run_that_went_nowhere_is_refused(
    angles: tuple[float, float], read: float
) -> None:
    run = CalibrationRun("straight 1", "straight", np.array([(0.0, 0.0), angles]))
    with pytest.raises(ConfigError, match="straight 1: ended where it began, by odometry"):
        check_readings(run.read(read_straight([read], SCALES)), ACSAR)


def test_a_turn_that_skidding_explains_is_told_and_kept() -> None:
    told = check_readings(LEFT.read(read_turn(1180.0, LEFT, SCALES)), ACSAR)
    assert "a multiplier of 2.35 explains it" in told
    plain = ACSAR.with_(wheel_separation_multiplier=1.0)
    wheels = spin(configured_geometry(plain), 10.0 * math.pi)
    run = CalibrationRun("turn 1", "turn", wheels)
    assert "multiplier of 2.00" in check_readings(run.read(read_turn(900.0, run, SCALES)), plain)


def test_readings_close_to_the_odometry_pass() -> None:
    assert check_readings(LINE.read(read_straight([2.05, 0.1], SCALES)), ACSAR) == ""
    assert check_readings(RIGHT.read(read_turn(1712.0, RIGHT, SCALES)), ACSAR) == ""
    small = CalibrationRun("square ccw 1", "square", square(NOMINAL, 0.2, 1.0))
    assert check_readings(small.read(read_square([-0.1, 0.1, -48.0], small, SCALES)), ACSAR) == ""
