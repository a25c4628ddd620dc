"""Runs are driven on odometry, within a fence, and stopped on any way out."""

from __future__ import annotations

import math

import numpy as np
import pytest
from calibration_tools import ACSAR

from acsar_gym import RobotConfig
from acsar_gym.config import Geofence
from acsar_gym.errors import LinkError
from acsar_gym.links import open_link
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid import calibration_drive
from acsar_gym.tools.sysid.calibration_drive import TruthObserver, drive_run
from acsar_gym.tools.sysid.calibration_runs import configured_geometry, integrate_wheels
from acsar_gym.worlds import Scene, World

PLANS = {
    "line": calibration_drive.plan_straights(0.5, 0.4, 1)[0],
    "back": calibration_drive.plan_straights(0.5, 0.4, 2)[1],
    "turn": calibration_drive.plan_turns(1.5, (1.2,), (0.0,), 1)[0],
    "circle": calibration_drive.plan_turns(1.0, (1.0,), (0.3,), 1)[0],
    "square": calibration_drive.plan_squares(0.4, 0.4, 1.2, 1, 0)[0],
}
ENDS = {
    "line": (0.5, 0.0, 0.0),
    "back": (-0.5, 0.0, 0.0),
    "turn": (0.0, 0.0, 3.0 * math.pi),
    "circle": (0.0, 0.0, 2.0 * math.pi),
    "square": (0.0, 0.0, -2.0 * math.pi),
}


def robot(config: RobotConfig = ACSAR, twin: RobotConfig = ACSAR) -> Robot:
    return Robot(open_link("planar", twin), config)


@pytest.mark.parametrize("name", PLANS)
def test_a_run_ends_where_it_should_and_tells_its_wheels(name: str) -> None:
    run = drive_run(robot(), PLANS[name], Scene((1.0, 2.0, 0.5)), TruthObserver())
    ends = integrate_wheels(run.wheels, configured_geometry(ACSAR), ACSAR.wheel_separation)
    assert ends == pytest.approx(ENDS[name], abs=0.04)
    readings = {reading.kind: reading.value for reading in run.readings}
    assert tuple(readings.values()) == pytest.approx(ends, abs=0.02)


def test_a_line_is_straight_by_odometry_although_motors_differ() -> None:
    weak = ACSAR.with_(motor={"gain": (1.0, 0.95, 0.95, 1.0)})
    run = drive_run(robot(twin=weak), PLANS["line"], Scene())
    _, y, theta = integrate_wheels(run.wheels, configured_geometry(ACSAR), ACSAR.wheel_separation)
    assert abs(theta) < 0.15
    assert abs(y) < 0.05


def test_without_an_observer_there_are_no_readings() -> None:
    assert drive_run(robot(), PLANS["line"], Scene()).readings == ()


def test_the_fence_stops_it_with_an_error() -> None:
    fenced = ACSAR.with_(geofence=Geofence(min_x=-1.0, max_x=0.3, min_y=-1.0, max_y=1.0))
    one = robot(fenced)
    with pytest.raises(LinkError, match=r"straight 1: stopped at \(0\.3\d, .* edge of the stated"):
        drive_run(one, PLANS["line"], Scene())
    assert not one.active


class Stopper(TruthObserver):
    """Stops the robot on its way, as `acsar-gym estop` does."""

    ticks = 0

    def tick(self, robot: Robot) -> None:
        self.ticks += 1
        if self.ticks == 30:
            robot.estop()


def test_an_emergency_stop_ends_the_run() -> None:
    one = robot()
    with pytest.raises(LinkError, match="ended by an emergency stop"):
        drive_run(one, PLANS["line"], Scene(), Stopper())
    assert not one.active


@pytest.mark.parametrize(
    ("name", "done"), [("line", r"0\.00 of 0\.50 m"), ("turn", "0 of 540 deg")]
)
def test_a_robot_that_does_not_get_on_is_told(name: str, done: str) -> None:
    dead = ACSAR.with_(motor={"deadband": 1000.0})
    with pytest.raises(LinkError, match=f"only {done}|wheel") as told:
        drive_run(robot(twin=dead), PLANS[name], Scene())
    assert "\n" not in str(told.value)


def test_a_collision_is_told() -> None:
    world = World(segments=np.array([(0.4, -1.0, 0.4, 1.0)]))
    with pytest.raises(LinkError, match="touched an obstacle"):
        drive_run(robot(), PLANS["line"], Scene(world=world), TruthObserver())
