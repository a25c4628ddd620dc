"""Runs and readings of one call: odometry by closed forms, who measures, what is refused."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from sysid_tools import ACSAR, circle_wheels, leg_wheels, line_wheels, spin_wheels

from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.links import open_link
from acsar_gym.odometry import Odometry
from acsar_gym.recording import Recorder
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid.calibration import (
    CalibrationJob,
    CalibrationRun,
    Geometry,
    check_given_readings,
    check_readings,
    configured_geometry,
    give_readings,
    integrate_wheels,
    read_recorded_runs,
)
from acsar_gym.tools.sysid.calibration_drive import (
    RunPlan,
    drive_plans,
    plan_straights,
    plan_turns,
)

NOMINAL = configured_geometry(ACSAR)
EVEN = Geometry(0.05, 0.0, 1.5)
LINE = CalibrationRun("straight 1", "straight", line_wheels(NOMINAL, 2.0))
LEFT = CalibrationRun("turn 1, left", "turn", spin_wheels(NOMINAL, 10.0 * math.pi))
RIGHT = CalibrationRun("turn 2, right", "turn", spin_wheels(NOMINAL, -10.0 * math.pi))
BACK_AT_START = CalibrationRun("straight 1", "straight", np.array([(0.0, 0.0), (1e6, -1e6)]))
PLANS = plan_straights(0.5, 0.4, 2)


def test_straight_lines_arcs_and_full_turns() -> None:
    line = line_wheels(EVEN, 2.0)
    assert integrate_wheels(line, EVEN, 0.3) == pytest.approx((2.0, 0.0, 0.0))
    theta = 2.0 * 0.04 / 0.45  # unequal wheels drive an arc
    radius = 2.0 / theta
    expected = (radius * math.sin(theta), radius * (1.0 - math.cos(theta)), theta)
    assert integrate_wheels(line, Geometry(0.05, 0.04, 1.5), 0.3) == pytest.approx(expected)
    spin = spin_wheels(EVEN, 10.0 * math.pi)  # a larger multiplier turns less
    turned = integrate_wheels(spin, EVEN._replace(multiplier=2.0), 0.3)[2]
    assert turned == pytest.approx(10.0 * math.pi * 1.5 / 2.0)
    fine, coarse = leg_wheels([40.0], [50.0], 1000), leg_wheels([40.0], [50.0], 2)
    exact = integrate_wheels(fine, EVEN, 0.3)
    assert integrate_wheels(coarse, EVEN, 0.3) == pytest.approx(exact)


def test_it_agrees_with_the_driver_s_odometry() -> None:
    config = ACSAR.with_(left_wheel_radius_multiplier=0.99, right_wheel_radius_multiplier=1.03)
    geometry, odometry = configured_geometry(config), Odometry.of(config)
    assert (geometry.left, geometry.right) == pytest.approx((0.05 * 0.99, 0.05 * 1.03))
    wheels = circle_wheels(geometry, 0.5, 4.0)
    for left, right in np.repeat(np.diff(wheels, axis=0) / 20.0, 20, axis=0):
        odometry.update((right, left, left, right), 1.0)
    found = integrate_wheels(wheels, geometry, config.wheel_separation)
    assert found[:2] == pytest.approx(odometry.pose[:2], abs=1e-3)
    assert math.remainder(found[2] - odometry.pose[2], math.tau) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("run", "row", "values"),
    [
        (LINE, [2.01], {"distance": 2.01}),
        (LINE, [-2.01, -0.05], {"distance": 2.01, "aside": -0.05}),  # backwards
        (LEFT, [1712.0], {"heading": math.radians(1712.0)}),
        (RIGHT, [1712.0], {"heading": -math.radians(1712.0)}),
        (LEFT, [-1712.0], {"heading": math.radians(1712.0)}),
    ],
)
def test_numbers_become_readings_of_the_run(
    run: CalibrationRun, row: list[float], values: dict[str, float]
) -> None:
    readings = give_readings(run, row).readings
    assert {reading.kind: reading.value for reading in readings} == values


@pytest.mark.parametrize(
    ("run", "row", "said"),
    [
        (LINE, [201.3], "is it in metres"),
        (LINE, [2.7], "which says 2.000 m"),
        (LINE, [2.0, 30.0], "it drove 2.0"),
        (LEFT, [5.0], "full turns counted"),
        (LEFT, [3600.0], "which says 1800 degrees"),
        (BACK_AT_START, [2.0], "ended where it began"),
    ],
)
def test_readings_that_contradict_the_odometry_are_refused(
    run: CalibrationRun, row: list[float], said: str
) -> None:
    with pytest.raises(ConfigError, match=said) as error:
        check_readings(give_readings(run, row), ACSAR)
    assert str(error.value).startswith(run.name)
    assert "\n" not in str(error.value)


def test_readings_of_options_are_for_all_runs_of_a_manoeuvre() -> None:
    given = check_given_readings((2.0, 2.1), (), (1712.0,))
    job = CalibrationJob(ACSAR, given)
    job.runs = [LINE, LEFT, LINE]
    job.finish()
    assert [run.readings[0].kind for run in job.runs] == ["distance", "heading", "distance"]
    with pytest.raises(ConfigError, match="2 readings for 1 straight runs"):
        job.check_given(Counter(straight=1, turn=1))
    with pytest.raises(ConfigError, match="--aside has 1 readings, --measured 2"):
        check_given_readings((2.0, 2.1), (0.1,), ())
    with pytest.raises(ConfigError, match="--measured-deg nan"):
        check_given_readings((), (), (math.nan,))


def test_a_person_is_asked_again_until_the_answer_can_be_right() -> None:
    questions: list[str] = []
    answers = iter(["far", "nan", "1 2 3", "201", " 2.01, -0.02", ""])

    def ask(question: str) -> str:
        questions.append(question)
        return next(answers)

    job = CalibrationJob(ACSAR, {}, ask)
    job.runs = [LINE, LEFT]
    job.finish()
    assert "straight 1" in questions[0]
    assert "'far'" in questions[1]
    assert "contradicts the odometry" in questions[4]
    assert [reading.value for reading in job.runs[0].readings] == [2.01, -0.02]
    assert job.runs[1].readings == ()


def drive(job: CalibrationJob, plans: list[RunPlan], recorder: Recorder | None = None) -> None:
    robot = Robot(open_link("planar", ACSAR), ACSAR, recorder=recorder)
    drive_plans(job, robot, plans, None, lambda _: None, recorder)


def test_runs_that_ended_before_a_failure_are_there() -> None:
    def fail(plan: RunPlan) -> None:
        if plan.name == "straight 2":
            raise LinkError("unplugged")

    job = CalibrationJob(ACSAR, check_given_readings((0.5, 0.5), (), ()))
    with pytest.raises(LinkError, match="unplugged"):
        drive_plans(job, Robot(open_link("planar", ACSAR), ACSAR), PLANS, None, fail)
    job.finish()
    assert [run.name for run in job.runs] == ["straight 1"]
    assert job.runs[0].readings[0].source == "tape"  # truth isn't read where somebody measures


def test_a_recording_holds_the_same_runs(tmp_path: Path) -> None:
    path = tmp_path / "runs.mcap"
    job = CalibrationJob(ACSAR, {})
    plans = [*plan_straights(0.3, 0.4, 1), *plan_turns(0.5, (1.2,), (0.0,), 2)]
    drive(job, plans, Recorder(path))
    runs = read_recorded_runs(path, "all", ACSAR)
    assert [(run.name, run.manoeuvre) for run in runs] == [
        (run.name, run.manoeuvre) for run in job.runs
    ]
    for run, driven in zip(runs, job.runs, strict=True):
        assert np.abs(run.wheels[-1] - driven.wheels[-1]).max() < 1e-6
    assert len(read_recorded_runs(path, "turn", ACSAR)) == 2
    with pytest.raises(ConfigError, match=r"wheelbase is 0\.22 there and 0\.3 here"):
        read_recorded_runs(path, "turn", ACSAR.with_(wheelbase=0.3))
    other = tmp_path / "other.mcap"
    with Robot(open_link("planar", ACSAR), ACSAR, recorder=Recorder(other)) as robot:
        robot.drive(0.3, 0.0)
    with pytest.raises(ConfigError, match="say what was recorded"):
        read_recorded_runs(other, "all", ACSAR)
    path.write_bytes(b"no recording")
    with pytest.raises(ConfigError) as error:
        read_recorded_runs(path, "turn", ACSAR)
    assert "\n" not in str(error.value)
