"""What runs drive and the floor that they need; they are driven on odometry, within a fence."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
from calibration_tools import ACSAR

from acsar_gym import RobotConfig
from acsar_gym.config import Geofence
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.links import open_link
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid.calibration import Geometry, integrate_wheels
from acsar_gym.tools.sysid.calibration_drive import (
    SPACE_SLACK,
    RunPlan,
    drive_run,
    find_needed_space,
    make_fence,
    plan_straights,
    plan_turns,
)

LINES = plan_straights(2.0, 0.3, 3)
PLANS = {
    "line": (plan_straights(0.5, 0.4, 1)[0], (0.5, 0.0, 0.0)),
    "back": (plan_straights(0.5, 0.4, 2)[1], (-0.5, 0.0, 0.0)),
    "turn": (plan_turns(1.5, (1.2,), (0.0,), 1)[0], (0.0, 0.0, 3.0 * math.pi)),
    "circle": (plan_turns(1.0, (1.0,), (0.3,), 1)[0], (0.0, 0.0, 2.0 * math.pi)),
}
"""Plans, and where they end."""
LINE, TURN = PLANS["line"][0], PLANS["turn"][0]


@pytest.mark.parametrize(
    ("plans", "ahead", "aside"),
    [
        (LINES, 2.0, 0.0),
        (plan_turns(2.0, (0.5,), (0.0,), 1), 0.0, 0.0),
        (plan_turns(2.0, (0.5,), (0.5,), 2), 0.5, 1.0),
    ],
)
def test_the_floor_holds_path_robot_and_slack(
    plans: list[RunPlan], ahead: float, aside: float
) -> None:
    own = find_needed_space(plan_turns(1.0, (0.5,), (0.0,), 1), ACSAR)[0]
    slack = SPACE_SLACK * max(ahead, aside)
    expected = (ahead + slack + own, aside + slack + own)
    assert find_needed_space(plans, ACSAR) == pytest.approx(expected, abs=1e-3)


def test_the_fence_is_around_the_space_also_on_the_way_back() -> None:
    ahead, back = (make_fence(ACSAR, plan, (4.0, 1.5)) for plan in LINES[:2])
    assert ahead.max_x == -back.min_x > 3.5
    assert ahead.min_x == -back.max_x > -1.5
    assert ahead.max_y == -ahead.min_y < 1.5


@pytest.mark.parametrize(
    ("make", "arguments", "said"),
    [
        (plan_straights, (0.0, 0.3, 1), "--distance 0"),
        (plan_turns, (-1.0, (1.0,), (0.0,), 1), "--turns -1"),
        (plan_turns, (1.0, (1.0,), (-0.3,), 1), "--radii -0.3"),
        (plan_straights, (1.0, 0.3, 500), "500 runs"),
    ],
)
def test_bad_sizes_are_told(make: Any, arguments: tuple[object, ...], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        make(*arguments)


def make_robot(config: RobotConfig = ACSAR, twin: RobotConfig = ACSAR) -> Robot:
    return Robot(open_link("planar", twin), config)


@pytest.mark.parametrize(("plan", "end"), PLANS.values(), ids=PLANS)
def test_a_run_ends_where_it_should_and_tells_its_wheels(
    plan: RunPlan, end: tuple[float, ...]
) -> None:
    run = drive_run(make_robot(), plan, reads_truth=True)
    ends = integrate_wheels(run.wheels, Geometry.of(ACSAR), ACSAR.wheel_separation)
    assert ends == pytest.approx(end, abs=0.04)
    readings = {reading.kind: reading.value for reading in run.readings}
    expected = {"distance": math.hypot(*ends[:2]), "aside": ends[1], "heading": ends[2]}
    assert readings == pytest.approx({kind: expected[kind] for kind in readings}, abs=0.02)


def test_the_fence_stops_it_with_an_error() -> None:
    robot = make_robot(ACSAR.with_(geofence=Geofence(min_x=-1.0, max_x=0.3, min_y=-1.0, max_y=1.0)))
    with pytest.raises(LinkError, match=r"straight 1: stopped at \(0\.3\d, "):
        drive_run(robot, LINE)
    assert not robot.active


def test_an_emergency_stop_ends_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Halfway, as `acsar-gym estop` asks for it."""
    robot, ticks = make_robot(), itertools.count()

    def stop_late(*twist: float) -> None:
        if next(ticks) == 30:
            robot.estop()
        Robot.drive(robot, *twist)

    monkeypatch.setattr(robot, "drive", stop_late)
    with pytest.raises(LinkError, match="emergency stop"):
        drive_run(robot, LINE)
    assert next(ticks) > 30
    assert not robot.active


@pytest.mark.parametrize("plan", [LINE, TURN])
def test_a_robot_that_does_not_get_on_is_told(plan: RunPlan) -> None:
    dead = ACSAR.with_(motor={"deadband": 1000.0})
    with pytest.raises(LinkError, match=r"only 0(\.00)? of|wheel"):
        drive_run(make_robot(twin=dead), plan)
