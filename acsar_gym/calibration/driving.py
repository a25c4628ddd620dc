"""Drives one run, closed-loop on odometry, and keeps the wheels' angles."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from acsar_gym.calibration.manoeuvres import Leg, Plan
from acsar_gym.calibration.runs import Reading, Run
from acsar_gym.errors import LinkError
from acsar_gym.robot import Robot
from acsar_gym.safety.rules import Reason
from acsar_gym.worlds import Scene

DISTANCE_GAIN = 3.0
"""Speed for each metre that is left [1/s]."""
ANGLE_GAIN = 3.0
"""Turn rate for each radian that is left [1/s]."""
SLOWEST = 0.2
"""Least share of the full speed, before a leg's end."""
HEADING_GAIN = 2.0
"""Turn rate for each radian off the wanted heading [1/s]."""
CLOSE = 0.002
"""A leg ends this close before its end, as a share of a metre or of a radian; the rest is rolled
out and measured."""
PATIENCE = 5.0
"""A leg that takes this much longer than three times its nominal time has failed [s]."""
REST = 1.5
"""How long the robot stands at the end of a run, to be measured [s]."""


class Observer(Protocol):
    """Measures a run without a tape: ground truth, or a LiDAR."""

    def begin(self, robot: Robot) -> None:
        """Note where the robot stands at the start of a run."""

    def tick(self, robot: Robot) -> None:
        """Follow the robot for one tick."""

    def readings(self, plan: Plan) -> list[Reading]:
        """What was measured; called after the run, when the robot isn't driven."""


def drive(robot: Robot, plan: Plan, scene: Scene, observer: Observer | None = None) -> Run:
    """Drive one run; the robot is stopped and closed on any way out of it.

    Args:
        robot: inactive.
        plan: what to drive.
        scene: where the simulated robot starts, and in which world.
        observer: measures the run; None for a tape measure.

    Raises:
        LinkError: the link failed, the robot was stopped, or doesn't get on.
    """
    driver = _Driver(robot, plan, observer)
    try:
        robot.reset(scene)
        if observer is not None:
            observer.begin(robot)
        for leg in plan.legs:
            driver.leg(leg)
        driver.rest()
    except BaseException as error:
        robot.deactivate(error)
        raise
    robot.deactivate()
    readings = [] if observer is None else observer.readings(plan)
    return Run(plan.name, plan.manoeuvre, np.array(driver.wheels), tuple(readings))


class _Driver:
    """Drives the legs of one run and keeps the angles of its wheels."""

    def __init__(self, robot: Robot, plan: Plan, observer: Observer | None) -> None:
        self.robot, self.plan, self.observer = robot, plan, observer
        self.wheels: list[tuple[float, float]] = [(0.0, 0.0)]
        self.aim = 0.0
        """Heading of the plan at the end of the legs so far [rad]."""
        self.heading = 0.0
        """By odometry, full turns included [rad]."""
        self.way = 0.0
        """Driven since the leg's start, by odometry [m]."""

    def leg(self, leg: Leg) -> None:
        """Drive one leg. LinkError where it doesn't end."""
        self.way, begin, full = 0.0, self.aim, abs(leg.angle)
        self.aim += leg.angle
        time = max(leg.distance / self.plan.linear if leg.distance else 0.0, self._turning(leg))
        for _ in range(math.ceil((3.0 * time + PATIENCE) / self.robot.config.period)):
            if self._ahead(leg, begin) if leg.distance else self._on_the_spot():
                return
        done = f"{self.way:.2f} of {leg.distance:.2f} m"
        if not leg.distance:
            done = f"{math.degrees(full - abs(self.aim - self.heading)):.0f} of "
            done += f"{math.degrees(full):.0f} degrees"
        raise LinkError(
            f"{self.plan.name}: only {done} by odometry",
            "check that nothing blocks the robot, its battery, and 'acsar-gym doctor'",
        )

    def _turning(self, leg: Leg) -> float:
        """Nominal time of a turn in place [s]."""
        return abs(leg.angle) / self.plan.angular if self.plan.angular else 0.0

    def _ahead(self, leg: Leg, begin: float) -> bool:
        """Drive a tick along a line or a circle; returns whether the leg has ended."""
        left = leg.distance - self.way
        if left < CLOSE:
            return True
        linear = self.plan.linear * min(1.0, max(SLOWEST, DISTANCE_GAIN * left / self.plan.linear))
        wanted = begin + leg.angle * min(1.0, self.way / leg.distance)
        rate = linear * leg.angle / leg.distance
        self._tick(
            -linear if self.plan.back else linear, rate + HEADING_GAIN * (wanted - self.heading)
        )
        return False

    def _on_the_spot(self) -> bool:
        """Turn for a tick; returns whether the leg has ended."""
        left = self.aim - self.heading
        if abs(left) < CLOSE:
            return True
        share = min(1.0, max(SLOWEST, ANGLE_GAIN * abs(left) / self.plan.angular))
        self._tick(0.0, math.copysign(share * self.plan.angular, left))
        return False

    def rest(self) -> None:
        """Stand until the wheels have come to rest."""
        for _ in range(math.ceil(REST / self.robot.config.period)):
            self._tick(0.0, 0.0)

    def _tick(self, linear: float, angular: float) -> None:
        """Drive for one tick. LinkError where the safety layer holds the robot."""
        robot, before = self.robot, self.robot.odometry.pose
        robot.drive(linear, angular)
        x, y, theta = robot.odometry.pose
        self.heading += math.remainder(theta - before[2], math.tau)
        self.way += math.hypot(x - before[0], y - before[1])
        a, b, c, d = robot.odometry.wheel_positions
        self.wheels.append(((b + c) / 2.0, (a + d) / 2.0))
        if self.observer is not None:
            self.observer.tick(robot)
        if robot.safety.stopped:
            raise _stopped(self.plan, robot)
        if robot.link.truth is not None and robot.link.truth.contact:
            raise LinkError(
                f"{self.plan.name}: the robot touched an obstacle of its world",
                "take a wider --world, or drive less",
            )


def _stopped(plan: Plan, robot: Robot) -> LinkError:
    """The error for a robot that the safety layer holds."""
    if robot.safety.reason != Reason.GEOFENCE:
        return LinkError(f"{plan.name}: ended by an emergency stop", "start again when it is safe")
    x, y, _ = robot.odometry.pose
    return LinkError(
        f"{plan.name}: stopped at ({x:.2f}, {y:.2f}) m by odometry, the edge of the stated space",
        "give more --space, or calibrate turns first",
    )
