"""Robots with hidden radii and multiplier, and a person who measures them with a tape."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from acsar_gym import RobotConfig
from acsar_gym.links import open_link
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid import calibration_drive
from acsar_gym.tools.sysid.calibrate import ReadingScales
from acsar_gym.tools.sysid.calibration_drive import RunPlan, TruthObserver, drive_run
from acsar_gym.tools.sysid.calibration_runs import CalibrationRun, Floats, Geometry, RunReading
from acsar_gym.worlds import Scene

ACSAR = RobotConfig.preset("acsar")
SCALES = ReadingScales()


def hidden(seed: int) -> RobotConfig:
    """A robot whose multiplier is 1.2 to 2.2, and whose radii are off by up to 3 % a side."""
    rng = np.random.default_rng(seed)
    left, right = rng.uniform(0.97, 1.03, 2).tolist()
    return ACSAR.with_(
        left_wheel_radius_multiplier=left,
        right_wheel_radius_multiplier=right,
        body={"turn_factor": float(rng.uniform(1.2, 2.2))},
    )


class Person(TruthObserver):
    """Reads a tape with marks every 5 mm and a protractor with marks every degree."""

    def readings(self, plan: RunPlan) -> list[RunReading]:
        x, y, heading = (reading.value for reading in super().readings(plan))
        degrees = SCALES.degrees(float(round(math.degrees(heading))))
        if plan.manoeuvre == "straight":
            return [SCALES.metres("distance", to_mark(math.hypot(x, y)))]
        if plan.manoeuvre == "turn":
            return [degrees]
        return [SCALES.metres("x", to_mark(x)), SCALES.metres("y", to_mark(y)), degrees]


def to_mark(length: float) -> float:
    """The nearest mark of the tape [m]."""
    return round(length / SCALES.tape) * SCALES.tape


def usual_plans() -> list[RunPlan]:
    """What `straight`, `turn` and `square` drive by default."""
    return [
        *calibration_drive.plan_straights(2.0, 0.3, 3),
        *calibration_drive.plan_turns(5.0, (0.6, 1.2), (0.0,), 1),
        *calibration_drive.plan_squares(1.0, 0.3, 0.9, 2, 2),
    ]


def driven(
    plans: Sequence[RunPlan], twin: RobotConfig, link: str = "planar"
) -> list[CalibrationRun]:
    """Drive a simulated robot that is thought to be an ACSAR, and measure with the tape."""
    robot = Robot(open_link(link, twin), ACSAR)
    return [drive_run(robot, plan, Scene(), Person()) for plan in plans]


def of_sides(left: Sequence[float], right: Sequence[float], parts: int = 100) -> Floats:
    """Wheel angles of legs, each with these angles of the left and the right wheels [rad]."""
    ends = np.cumsum([(0.0, 0.0), *zip(left, right, strict=True)], axis=0)
    return np.concatenate(
        [np.linspace(begin, end, parts, endpoint=False) for begin, end in pairwise(ends)]
        + [ends[-1:]]
    )


def line(geometry: Geometry, distance: float) -> Floats:
    """Wheel angles of a straight command of the robot that odometry takes it for."""
    return of_sides([distance / geometry.radius], [distance / geometry.radius])


def spin(geometry: Geometry, angle: float, separation: float = 0.3) -> Floats:
    """Wheel angles of a turn in place."""
    turned = angle * separation * geometry.multiplier / 2.0 / geometry.radius
    return of_sides([-turned], [turned])


def square(geometry: Geometry, size: float, side: float, separation: float = 0.3) -> Floats:
    """Wheel angles of a square to the left (side = 1) or to the right (-1)."""
    ahead = size / geometry.radius
    turned = side * math.pi / 4.0 * separation * geometry.multiplier / geometry.radius
    return of_sides([ahead, -turned] * 4, [ahead, turned] * 4)
