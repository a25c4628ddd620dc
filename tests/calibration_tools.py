"""Robots with hidden wheels, a person with a tape, and wheel angles of simple drives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from acsar_gym import RobotConfig
from acsar_gym.links import open_link
from acsar_gym.recording.types import Floats
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid.calibration import (
    CalibrationRun,
    Geometry,
    RunReading,
    read_protractor,
    read_tape,
)
from acsar_gym.tools.sysid.calibration_drive import RunPlan, drive_run, plan_straights, plan_turns

ACSAR = RobotConfig.preset("acsar")
TAPE_DIVISION = 0.005


def draw_wheels(seed: int) -> RobotConfig:
    """A robot whose multiplier is 1.2 to 2.2, and whose radii are off by up to 3 % a side."""
    rng = np.random.default_rng(seed)
    multipliers = rng.uniform(0.97, 1.03, 2).tolist()
    return ACSAR.with_(
        left_wheel_radius_multiplier=multipliers[0],
        right_wheel_radius_multiplier=multipliers[1],
        body={"turn_factor": float(rng.uniform(1.2, 2.2))},
    )


def read_as_person(run: CalibrationRun) -> CalibrationRun:
    """Read a run with a tape with marks every 5 mm and a protractor with marks every degree."""

    def read(truth: RunReading) -> RunReading:
        if truth.kind == "heading":
            return read_protractor(float(round(math.degrees(truth.value))))
        return read_tape(truth.kind, round(truth.value / TAPE_DIVISION) * TAPE_DIVISION)

    kinds = ("heading",) if run.manoeuvre == "turn" else ("distance", "aside")
    return replace(
        run, readings=tuple(read(truth) for truth in run.readings if truth.kind in kinds)
    )


def usual_plans() -> list[RunPlan]:
    """What `straight` and `turn` drive by default."""
    return [*plan_straights(2.0, 0.3, 3), *plan_turns(5.0, (0.6, 1.2), (0.0,), 1)]


def drive_with_truth(
    plans: Sequence[RunPlan], twin: RobotConfig, config: RobotConfig = ACSAR, link: str = "planar"
) -> list[CalibrationRun]:
    """Drive a simulated robot that isn't as configured. The truth measures."""
    robot = Robot(open_link(link, twin), config)
    return [drive_run(robot, replace(plan, back=False), reads_truth=True) for plan in plans]


def leg_wheels(left: Sequence[float], right: Sequence[float], parts: int = 100) -> Floats:
    """Wheel angles of legs, each with these angles of the left and the right wheels [rad]."""
    ends = np.cumsum([(0.0, 0.0), *zip(left, right, strict=True)], axis=0)
    return np.concatenate(
        [np.linspace(start, end, parts, endpoint=False) for start, end in pairwise(ends)]
        + [ends[-1:]]
    )


def line_wheels(geometry: Geometry, distance: float) -> Floats:
    """Wheel angles of a straight command of the robot that odometry takes it for."""
    return leg_wheels([distance / geometry.radius], [distance / geometry.radius])


def spin_wheels(geometry: Geometry, angle: float, separation: float = 0.3) -> Floats:
    """Wheel angles of a turn in place."""
    turned = angle * separation * geometry.multiplier / 2.0 / geometry.radius
    return leg_wheels([-turned], [turned])


def circle_wheels(geometry: Geometry, radius: float, angle: float) -> Floats:
    """Wheel angles of a circle that the centre drives, to the left where the angle is positive."""
    way = radius * abs(angle)
    turned = angle * 0.3 * geometry.multiplier / 2.0
    return leg_wheels([(way - turned) / geometry.radius], [(way + turned) / geometry.radius])
