"""Runs and readings of one call: who measures, in which order, and what is kept."""

from __future__ import annotations

from pathlib import Path

import pytest
from calibration_tools import ACSAR, SCALES, line, spin, square

from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.tools.sysid import calibration_drive, calibration_runs
from acsar_gym.tools.sysid.calibrate import (
    CalibrationJob,
    DrivenRobot,
    GivenReadings,
    assign_readings,
    parse_readings,
)
from acsar_gym.tools.sysid.calibration_drive import RunPlan
from acsar_gym.tools.sysid.calibration_runs import CalibrationRun, configured_geometry

NOMINAL = configured_geometry(ACSAR)
LINE = CalibrationRun("straight 1", "straight", line(NOMINAL, 2.0))
TURN = CalibrationRun("turn 1", "turn", spin(NOMINAL, 20.0))
CW = CalibrationRun("square cw 1", "square", square(NOMINAL, 1.0, -1.0))
CCW = CalibrationRun("square ccw 1", "square", square(NOMINAL, 1.0, 1.0))
PLANS = calibration_drive.plan_straights(0.5, 0.4, 2)
WIRE = DrivenRobot("planar", ACSAR, ACSAR)


def kinds(run: CalibrationRun) -> list[str]:
    return [reading.kind for reading in run.readings]


def test_readings_go_to_the_runs_without_any_and_else_to_all() -> None:
    given = GivenReadings(measured=(2.0,), clockwise=((0.0, 0.1),), counter=((0.0, 0.2, 1.0),))
    found = assign_readings([LINE, TURN, CW, CCW], given, SCALES)
    assert [kinds(run) for run in found] == [
        ["distance"],
        [],
        ["x", "y"],
        ["x", "y", "heading"],
    ]
    more = assign_readings([*found, LINE], GivenReadings(measured=(2.1,)), SCALES)
    assert [run.readings[0].value for run in more if run.manoeuvre == "straight"] == [2.0, 2.1]
    again = assign_readings(more, GivenReadings(measured=(1.9, 1.8)), SCALES)
    assert [run.readings[0].value for run in again if run.manoeuvre == "straight"] == [1.9, 1.8]
    with pytest.raises(ConfigError, match="3 readings for 2 straight runs, 0 of them without"):
        assign_readings(more, GivenReadings(measured=(1.9, 1.8, 2.0)), SCALES)


@pytest.mark.parametrize(
    ("run", "text", "found"),
    [
        (LINE, "2.013\n", ["distance"]),
        (LINE, " 2.013, -0.02", ["distance", "aside"]),
        (TURN, "1150", ["heading"]),
        (CW, "0.1 -0.2", ["x", "y"]),
        (CW, "0.1 -0.2 3", ["x", "y", "heading"]),
        (CW, "", []),
    ],
)
def test_answers_are_numbers(run: CalibrationRun, text: str, found: list[str]) -> None:
    assert kinds(parse_readings(run, text, SCALES)) == found


@pytest.mark.parametrize("text", ["two", "1 2 3", "nan", "1e9"])
def test_other_answers_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="must be the straight distance"):
        parse_readings(LINE, text, SCALES)


def test_a_person_is_asked_again_until_the_answer_can_be_right(tmp_path: Path) -> None:
    path, asked = tmp_path / "cal.json", []
    calibration_runs.write_runs(path, [LINE, TURN], ACSAR)
    answers = iter(["far", "201", "2.01"])

    def ask(question: str) -> str:
        asked.append(question)
        return next(answers)

    sitting = CalibrationJob(ACSAR, GivenReadings(), SCALES, path, ask)
    sitting.read("straight")
    assert "straight 1: straight distance" in asked[0]
    assert "'far': must be" in asked[1]
    assert "contradicts the odometry" in asked[2]
    assert sitting.found[0].readings[0].value == 2.01
    assert sitting.found[1].readings == ()
    assert calibration_runs.read_runs(path, ACSAR)[0].readings == sitting.found[0].readings


def test_runs_are_kept_as_they_end(tmp_path: Path) -> None:
    path = tmp_path / "cal.json"
    sitting = CalibrationJob(ACSAR, GivenReadings(), SCALES, path)

    def before(plan: RunPlan) -> None:
        if plan.name == "straight 2":
            raise LinkError("unplugged")

    with pytest.raises(LinkError, match="unplugged"):
        sitting.drive(WIRE, PLANS, None, before)
    assert [run.name for run in calibration_runs.read_runs(path, ACSAR)] == ["straight 1"]


def test_the_next_call_adds_its_runs(tmp_path: Path) -> None:
    path = tmp_path / "cal.json"
    for _ in range(2):
        sitting = CalibrationJob(ACSAR, GivenReadings(), SCALES, path)
        sitting.drive(WIRE, PLANS[:1], None, lambda _: None)
        sitting.read("straight")
    found = calibration_runs.read_runs(path, ACSAR)
    assert [run.name for run in found] == ["straight 1", "straight 1 (2)"]
    assert all(run.readings for run in found)


def test_truth_is_not_read_where_somebody_measures() -> None:
    sitting = CalibrationJob(ACSAR, GivenReadings(measured=(0.5, 0.5)), SCALES)
    sitting.drive(WIRE, PLANS, None, lambda _: None)
    sitting.read("straight")
    assert [kinds(run) for run in sitting.found] == [["distance"]] * 2


def test_a_hidden_twin_is_the_robot_that_is_driven() -> None:
    twin = ACSAR.with_(wheel_radius=0.06)
    sitting = CalibrationJob(ACSAR, GivenReadings(), SCALES)
    sitting.drive(DrivenRobot("planar", ACSAR, twin), PLANS[:1], None, lambda _: None)
    fit = sitting.fit()
    assert fit is not None
    assert fit.geometry.radius == pytest.approx(0.06, rel=2e-3)
