"""Measures runs of a simulated robot by its ground truth."""

from __future__ import annotations

import math

from acsar_gym.calibration.manoeuvres import Plan
from acsar_gym.calibration.runs import Reading
from acsar_gym.errors import LinkError
from acsar_gym.robot import Robot
from acsar_gym.worlds import Pose
from acsar_gym.worlds.scene import to_odometry

METRES, RADIANS = 2e-4, 1e-3
"""Standard deviations of truth."""


class TruthObserver:
    """Reads the end pose of each run from a simulation."""

    def __init__(self) -> None:
        self._start: Pose = (0.0, 0.0, 0.0)
        self._pose: Pose = (0.0, 0.0, 0.0)
        self._turned = 0.0

    def begin(self, robot: Robot) -> None:
        """Note where the robot stands."""
        self._start = self._pose = _truth(robot)
        self._turned = 0.0

    def tick(self, robot: Robot) -> None:
        """Follow the robot."""
        pose = _truth(robot)
        self._turned += math.remainder(pose[2] - self._pose[2], math.tau)
        self._pose = pose

    def readings(self, plan: Plan) -> list[Reading]:
        """The end pose in the frame of the start."""
        x, y, _ = to_odometry(self._start, self._pose)
        return [
            Reading("x", x, METRES, "truth"),
            Reading("y", y, METRES, "truth"),
            Reading("heading", self._turned, RADIANS, "truth"),
        ]


def _truth(robot: Robot) -> Pose:
    """The true pose of a simulated robot. LinkError on hardware."""
    truth = robot.link.truth
    if truth is None:
        raise LinkError("this link has no ground truth", "measure with a tape, or --lidar")
    return truth.pose
