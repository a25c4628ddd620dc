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
        self._theta = self._turned = 0.0

    def begin(self, robot: Robot) -> None:
        """Note where the robot stands."""
        self._start = _truth(robot)
        self._theta, self._turned = self._start[2], 0.0

    def tick(self, robot: Robot) -> None:
        """Count the turned angle. LinkError where the robot has touched an obstacle."""
        theta = _truth(robot)[2]
        self._turned += math.remainder(theta - self._theta, math.tau)
        self._theta = theta

    def readings(self, robot: Robot, plan: Plan) -> list[Reading]:
        """The end pose in the frame of the start."""
        x, y, _ = to_odometry(self._start, _truth(robot))
        return [
            Reading("x", x, METRES, "truth"),
            Reading("y", y, METRES, "truth"),
            Reading("heading", self._turned, RADIANS, "truth"),
        ]


def _truth(robot: Robot) -> Pose:
    """The true pose of a simulated robot. LinkError on hardware, and after a collision."""
    truth = robot.link.truth
    if truth is None:
        raise LinkError("this link has no ground truth", "measure with a tape, or --lidar")
    if truth.contact:
        raise LinkError("the robot touched an obstacle of its world", "take a wider --world")
    return truth.pose
