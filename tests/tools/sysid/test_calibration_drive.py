"""Runs of a calibration: the floor that they need, and driving them on odometry within a fence."""

from __future__ import annotations

import itertools
import math

import pytest
from sysid_tools import ACSAR

from acsar_gym import RobotConfig
from acsar_gym.config import Geofence
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.links import open_link
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid.calibration import Geometry, integrate_wheels
from acsar_gym.tools.sysid.calibration_drive import (
    SPACE_SLACK,
    RunPlan,
    check_space,
    drive_plans,
    drive_run,
    find_needed_space,
    make_fence,
    plan_straights,
    plan_turns,
)

LINES = plan_straights(2.0, 0.3, 3)
ENDS = {
    "line": (plan_straights(0.5, 0.4, 1)[0], (0.5, 0.0, 0.0)),
    "back": (plan_straights(0.5, 0.4, 2)[1], (-0.5, 0.0, 0.0)),
    "turn": (plan_turns(1.5, (1.2,), (0.0,), 1)[0], (0.0, 0.0, 3.0 * math.pi)),
    "circle": (plan_turns(1.0, (1.0,), (0.3,), 1)[0], (0.0, 0.0, 2.0 * math.pi)),
}
"""Plans, and their ends."""


def test_find_needed_space_holds_path_robot_and_slack() -> None:
    robot = find_needed_space(plan_turns(1.0, (0.5,), (0.0,), 1), ACSAR)[0]
    plans = plan_turns(2.0, (0.5,), (0.5,), 2)
    slack = SPACE_SLACK + robot
    space = find_needed_space(plans, ACSAR)
    assert space == pytest.approx((0.5 + slack, 1.0 + slack), abs=1e-3)
    assert find_needed_space(LINES, ACSAR)[0] == pytest.approx(2.0 * (1.0 + SPACE_SLACK) + robot)
    check_space(plans, ACSAR, space)
    for free, message in ((None, "--space is missing"), ((space[0], 0.1), "too small")):
        with pytest.raises(ConfigError, match=message):
            check_space(plans, ACSAR, free)


def test_make_fence_is_around_the_space_also_on_the_way_back() -> None:
    ahead, back = (make_fence(ACSAR, plan, (4.0, 1.5)) for plan in LINES[:2])
    assert ahead.max_x == -back.min_x > 3.5
    assert ahead.min_x == -back.max_x > -1.5
    assert ahead.max_y == -ahead.min_y < 1.5


def test_plan_straights_names_runs_that_go_backward() -> None:
    names = ["straight 1", "straight 2, backwards", "straight 3"]
    assert [plan.name for plan in LINES] == names
    announced: list[RunPlan] = []
    plans = plan_straights(0.05, 0.3, 2)
    drive_plans(make_robot(), plans, None, runs=[], announce=announced.append)
    assert [(plan.name, plan.back) for plan in announced] == [
        ("straight 1", False),
        ("straight 2", False),  # a simulated robot starts each run at the origin
    ]


def test_plans_refuse_bad_sizes() -> None:
    with pytest.raises(ConfigError, match=r"--radii -0\.3"):
        plan_turns(1.0, (1.0,), (-0.3,), 1)
    with pytest.raises(ConfigError, match="500 runs"):
        plan_straights(1.0, 0.3, 500)


def make_robot(config: RobotConfig = ACSAR, twin: RobotConfig = ACSAR) -> Robot:
    return Robot(open_link("planar", twin), config)


@pytest.mark.parametrize(("plan", "end"), ENDS.values(), ids=ENDS)
def test_drive_run_ends_as_planned(plan: RunPlan, end: tuple[float, ...]) -> None:
    run = drive_run(make_robot(), plan, reads_truth=True)
    x, y, theta = integrate_wheels(run.wheels, Geometry.of(ACSAR), ACSAR.wheel_separation)
    assert (x, y, theta) == pytest.approx(end, abs=0.04)
    expected = {"distance": math.hypot(x, y), "aside": y, "heading": theta}
    for reading in run.readings:
        assert reading.value == pytest.approx(expected[reading.kind], abs=0.02)
    assert len(run.readings) == (1 if plan.manoeuvre == "turn" else 3)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"min_x": -1.0, "max_x": 0.3}, r"straight 1: stopped at \(0\.3\d, "),
        ({}, "straight 1: ended by an emergency stop"),
    ],
    ids=["fence", "emergency stop"],
)
def test_drive_run_ends_when_the_robot_is_stopped(
    limits: dict[str, float], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = make_robot(ACSAR.with_(geofence=Geofence(**limits) if limits else None))
    ticks = itertools.count()

    def stop_late(*twist: float) -> None:
        if next(ticks) == 200:  # as with `acsar-gym estop`
            robot.estop()
        Robot.drive(robot, *twist)

    monkeypatch.setattr(robot, "drive", stop_late)
    with pytest.raises(LinkError, match=message):
        drive_run(robot, LINES[0])
    assert (next(ticks) > 200) == (not limits)
    assert not robot.active


def test_drive_run_fails_if_the_robot_does_not_move() -> None:
    robot = make_robot(ACSAR.with_(wheel_check=False), ACSAR.with_(motor={"deadband": 1000.0}))
    with pytest.raises(LinkError, match="only 0 of 540 degrees"):
        drive_run(robot, ENDS["turn"][0])


def test_drive_run_ends_where_slow_wheels_stop_in_their_deadband() -> None:
    robot = make_robot(twin=ACSAR.with_(motor={"deadband": 0.5}))
    run = drive_run(robot, plan_turns(0.2, (0.3,), (0.0,), 1)[0])
    turned = integrate_wheels(run.wheels, Geometry.of(ACSAR), ACSAR.wheel_separation)[2]
    assert turned == pytest.approx(0.4 * math.pi, abs=0.1)
