"""Readings of people: files, and those that can't be right."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from calibration_tools import ACSAR, SCALES, line, spin, square

from acsar_gym.calibration import readings
from acsar_gym.calibration.model import configured
from acsar_gym.calibration.readings import check, of_corner, of_line, of_turn
from acsar_gym.calibration.runs import Reading, Run
from acsar_gym.errors import ConfigError

NOMINAL = configured(ACSAR)
LINE = Run("straight 1", "straight", line(NOMINAL, 2.0))
LEFT = Run("turn 1, left", "turn", spin(NOMINAL, 10.0 * math.pi))
RIGHT = Run("turn 2, right", "turn", spin(NOMINAL, -10.0 * math.pi))
CW = Run("square cw 1", "square", square(NOMINAL, 1.0, -1.0))
CCW = Run("square ccw 1", "square", square(NOMINAL, 1.0, 1.0))


def values(found: list[Reading]) -> dict[str, float]:
    return {reading.kind: reading.value for reading in found}


def test_numbers_become_readings_of_the_run() -> None:
    assert values(of_line([2.01], SCALES)) == {"distance": 2.01}
    assert values(of_line([-2.01], SCALES)) == {"distance": 2.01}  # backwards
    assert values(of_line([2.01, -0.05], SCALES)) == {"distance": 2.01, "aside": -0.05}
    assert values(of_turn(1712.0, LEFT, SCALES)) == {"heading": math.radians(1712.0)}
    assert values(of_turn(1712.0, RIGHT, SCALES)) == {"heading": -math.radians(1712.0)}
    assert values(of_turn(-1712.0, LEFT, SCALES)) == {"heading": math.radians(1712.0)}
    assert values(of_corner([0.1, -0.2], CW, SCALES)) == {"x": 0.1, "y": -0.2}
    assert values(of_corner([0.1, 0.2, 5.0], CW, SCALES))["heading"] == math.radians(-355.0)
    assert values(of_corner([0.1, 0.2, 5.0], CCW, SCALES))["heading"] == math.radians(365.0)


def test_corners_are_read_with_and_without_names(tmp_path: Path) -> None:
    path = tmp_path / "cw.csv"
    path.write_text("x,y,degrees\n0.01,-0.02,1.5\n\n0.03,0.04\n", encoding="utf-8")
    assert readings.corners(path) == [(0.01, -0.02, 1.5), (0.03, 0.04)]
    path.write_text("0.01, -0.02\n", encoding="utf-8")
    assert readings.corners(path) == [(0.01, -0.02)]


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
        readings.corners(path)


@pytest.mark.parametrize(
    ("run", "read", "said"),
    [
        (LINE, of_line([201.3], SCALES), "more than 30%: odometry says 2.000 m: in centimetres"),
        (LINE, of_line([2013.0], SCALES), "odometry says 2.000 m: in millimetres"),
        (LINE, of_line([2.7], SCALES), "another run's"),
        (LINE, of_line([1.3], SCALES), "odometry says 2.000 m"),
        (LINE, of_line([0.0], SCALES), "odometry says 2.000 m"),
        (LINE, of_line([2.0, 30.0], SCALES), "farther than the robot drove"),
        (LEFT, of_turn(5.0, LEFT, SCALES), "odometry says 1800 degrees: counted the full turns"),
        (LEFT, of_turn(0.0, LEFT, SCALES), "odometry says 1800 degrees"),
        (LEFT, of_turn(900.0, LEFT, SCALES), "odometry says 1800 degrees"),
        (LEFT, of_turn(3600.0, LEFT, SCALES), "odometry says 1800 degrees"),
        (CW, of_corner([12.0, 3.0], CW, SCALES), "farther than the robot drove"),
    ],
)
def test_readings_that_contradict_the_odometry_are_refused(
    run: Run, read: list[Reading], said: str
) -> None:
    with pytest.raises(ConfigError, match=said) as told:
        check(run.read(read), ACSAR)
    assert str(told.value).startswith(run.name)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("angles", [(0.0, 0.0), (1e6, -1e6)])
@pytest.mark.parametrize("read", [0.0, 2.0])
def test_a_straight_run_that_went_nowhere_is_refused(
    angles: tuple[float, float], read: float
) -> None:
    run = Run("straight 1", "straight", np.array([(0.0, 0.0), angles]))
    with pytest.raises(ConfigError, match="straight 1: ended where it began, by odometry"):
        check(run.read(of_line([read], SCALES)), ACSAR)


def test_a_turn_that_skidding_explains_is_told_and_kept() -> None:
    told = check(LEFT.read(of_turn(1180.0, LEFT, SCALES)), ACSAR)
    assert "a multiplier of 2.35 explains it" in told
    plain = ACSAR.with_(wheel_separation_multiplier=1.0)
    wheels = spin(configured(plain), 10.0 * math.pi)
    run = Run("turn 1", "turn", wheels)
    assert "multiplier of 2.00" in check(run.read(of_turn(900.0, run, SCALES)), plain)


def test_readings_close_to_the_odometry_pass() -> None:
    assert check(LINE.read(of_line([2.05, 0.1], SCALES)), ACSAR) == ""
    assert check(RIGHT.read(of_turn(1712.0, RIGHT, SCALES)), ACSAR) == ""
    small = Run("square ccw 1", "square", square(NOMINAL, 0.2, 1.0))
    assert check(small.read(of_corner([-0.1, 0.1, -48.0], small, SCALES)), ACSAR) == ""
