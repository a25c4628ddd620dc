"""Runs and readings of one call: who measures, in which order, what is refused and kept."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from sysid_tools import ACSAR, SCALES, line_wheels, spin_wheels, square_wheels

from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.tools.sysid.calibrate import (
    CalibrationJob,
    DrivenRobot,
    GivenReadings,
    assign_readings,
    check_readings,
    give_readings,
    read_corners,
)
from acsar_gym.tools.sysid.calibration_drive import RunPlan, plan_straights
from acsar_gym.tools.sysid.calibration_runs import (
    CalibrationRun,
    configured_geometry,
    read_runs,
    write_runs,
)

NOMINAL = configured_geometry(ACSAR)
LINE = CalibrationRun("straight 1", "straight", line_wheels(NOMINAL, 2.0))
LEFT = CalibrationRun("turn 1, left", "turn", spin_wheels(NOMINAL, 10.0 * math.pi))
RIGHT = CalibrationRun("turn 2, right", "turn", spin_wheels(NOMINAL, -10.0 * math.pi))
CW = CalibrationRun("square cw 1", "square", square_wheels(NOMINAL, 1.0, -1.0))
CCW = CalibrationRun("square ccw 1", "square", square_wheels(NOMINAL, 1.0, 1.0))
BACK_AT_START = CalibrationRun("straight 1", "straight", np.array([(0.0, 0.0), (1e6, -1e6)]))
PLANS = plan_straights(0.5, 0.4, 2)
ROBOT = DrivenRobot("planar", ACSAR, ACSAR)


def kinds(run: CalibrationRun) -> list[str]:
    return [reading.kind for reading in run.readings]


@pytest.mark.parametrize(
    ("run", "row", "values"),
    [
        (LINE, [2.01], {"distance": 2.01}),
        (LINE, [-2.01], {"distance": 2.01}),  # backwards
        (LINE, [2.01, -0.05], {"distance": 2.01, "aside": -0.05}),
        (LEFT, [1712.0], {"heading": math.radians(1712.0)}),
        (RIGHT, [1712.0], {"heading": -math.radians(1712.0)}),
        (LEFT, [-1712.0], {"heading": math.radians(1712.0)}),
        (CW, [0.1, -0.2], {"x": 0.1, "y": -0.2}),
        (CW, [0.1, 0.2, 5.0], {"x": 0.1, "y": 0.2, "heading": math.radians(-355.0)}),
        (CCW, [0.1, 0.2, 5.0], {"x": 0.1, "y": 0.2, "heading": math.radians(365.0)}),
    ],
)
def test_numbers_become_readings_of_the_run(
    run: CalibrationRun, row: list[float], values: dict[str, float]
) -> None:
    found = give_readings(run, row, SCALES).readings
    assert {reading.kind: reading.value for reading in found} == values


def test_corners_are_read_with_and_without_names(tmp_path: Path) -> None:
    path = tmp_path / "cw.csv"
    path.write_text("x,y,degrees\n0.01,-0.02,1.5\n\n0.03,0.04\n", encoding="utf-8")
    assert read_corners(path) == [(0.01, -0.02, 1.5), (0.03, 0.04)]
    path.write_text("0.01, -0.02\n", encoding="utf-8")
    assert read_corners(path) == [(0.01, -0.02)]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x,y\n", "no rows"),
        ("0.1,0.2\n0.1,inf\n", "row 2"),
        ("1,2,3,4\n", "row 1"),
    ],
)
def test_bad_corners_are_one_error(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "cw.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=said):
        read_corners(path)


@pytest.mark.parametrize(
    ("run", "row", "said"),
    [
        (LINE, [201.3], "in centimetres"),
        (LINE, [2013.0], "in millimetres"),
        (LINE, [2.7], "odometry says"),
        (LINE, [0.0], "odometry says"),
        (LINE, [2.0, 30.0], "farther than the robot drove"),
        (LEFT, [5.0], "counted the full turns"),
        (LEFT, [900.0], "odometry says 1800 degrees"),
        (LEFT, [3600.0], "odometry says 1800 degrees"),
        (CW, [12.0, 3.0], "farther than the robot drove"),
        (BACK_AT_START, [0.0], "ended where it began"),
        (BACK_AT_START, [2.0], "ended where it began"),
    ],
)
def test_readings_that_contradict_the_odometry_are_refused(
    run: CalibrationRun, row: list[float], said: str
) -> None:
    with pytest.raises(ConfigError, match=said) as told:
        check_readings(give_readings(run, row, SCALES), ACSAR)
    assert str(told.value).startswith(run.name)
    assert "\n" not in str(told.value)


SMALL = CalibrationRun("square ccw 1", "square", square_wheels(NOMINAL, 0.2, 1.0))


@pytest.mark.parametrize(
    ("run", "row", "told"),
    [
        (LEFT, [1180.0], "multiplier of 2.35"),  # which skidding explains
        (LINE, [2.05, 0.1], ""),
        (RIGHT, [1712.0], ""),
        (SMALL, [-0.1, 0.1, -48.0], ""),
    ],
)
def test_readings_that_can_be_right_are_kept(
    run: CalibrationRun, row: list[float], told: str
) -> None:
    found = check_readings(give_readings(run, row, SCALES), ACSAR)
    assert told in found
    assert bool(told) == bool(found)


def test_readings_go_to_the_runs_without_any_and_else_to_all() -> None:
    given = GivenReadings(measured=(2.0,), clockwise=((0.0, 0.1),), counter=((0.0, 0.2, 1.0),))
    found = assign_readings([LINE, LEFT, CW, CCW], given, SCALES)
    assert [kinds(run) for run in found] == [["distance"], [], ["x", "y"], ["x", "y", "heading"]]

    def lines(runs: list[CalibrationRun]) -> list[float]:
        return [run.readings[0].value for run in runs if run.manoeuvre == "straight"]

    more = assign_readings([*found, LINE], GivenReadings(measured=(2.1,)), SCALES)
    assert lines(more) == [2.0, 2.1]
    again = assign_readings(more, GivenReadings(measured=(1.9, 1.8)), SCALES)
    assert lines(again) == [1.9, 1.8]
    with pytest.raises(ConfigError, match="3 readings for 2 straight runs"):
        assign_readings(more, GivenReadings(measured=(1.9, 1.8, 2.0)), SCALES)


def test_a_person_is_asked_again_until_the_answer_can_be_right(tmp_path: Path) -> None:
    path, asked = tmp_path / "cal.json", []
    write_runs(path, [LINE, LEFT], ACSAR)
    answers = iter(["far", "nan", "1 2 3", "201", " 2.01, -0.02"])

    def ask(question: str) -> str:
        asked.append(question)
        return next(answers)

    job = CalibrationJob(ACSAR, GivenReadings(), SCALES, path, ask)
    job.read("straight")
    assert "straight 1" in asked[0]
    assert "'far'" in asked[1]
    assert "contradicts the odometry" in asked[4]
    assert [reading.value for reading in job.found[0].readings] == [2.01, -0.02]
    assert job.found[1].readings == ()
    assert read_runs(path, ACSAR)[0].readings == job.found[0].readings


def test_runs_are_kept_as_they_end_and_the_next_call_adds_its_own(tmp_path: Path) -> None:
    path = tmp_path / "cal.json"

    def before(plan: RunPlan) -> None:
        if plan.name == "straight 2":
            raise LinkError("unplugged")

    with pytest.raises(LinkError, match="unplugged"):
        CalibrationJob(ACSAR, GivenReadings(), SCALES, path).drive(ROBOT, PLANS, None, before)
    assert [run.name for run in read_runs(path, ACSAR)] == ["straight 1"]
    job = CalibrationJob(ACSAR, GivenReadings(), SCALES, path)
    job.drive(ROBOT, PLANS[:1], None, lambda _: None)
    job.read("straight")
    found = read_runs(path, ACSAR)
    assert [run.name for run in found] == ["straight 1", "straight 1 (2)"]
    assert all(run.readings for run in found)


def test_readings_for_runs_that_were_not_finished_are_left_out() -> None:
    given = GivenReadings((2.0, 2.1), (), (1712.0,), ((0.0, 0.1),), ((0.2, 0.3), (0.4, 0.5)))
    assert given.of_first([]) == GivenReadings()
    assert given.of_first([LINE]) == GivenReadings((2.0,))
    finished = [LINE, LINE, LEFT, CW, CCW]
    assert given.of_first(finished) == GivenReadings(
        (2.0, 2.1), (), (1712.0,), ((0.0, 0.1),), ((0.2, 0.3),)
    )


def test_truth_is_not_read_where_somebody_measures() -> None:
    job = CalibrationJob(ACSAR, GivenReadings(measured=(0.5, 0.5)), SCALES)
    job.drive(ROBOT, PLANS, None, lambda _: None)
    job.read("straight")
    assert [kinds(run) for run in job.found] == [["distance"]] * 2
