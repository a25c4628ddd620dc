"""Measures runs with a LiDAR: scans at the end are matched against those at the start."""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.calibration.manoeuvres import Plan
from acsar_gym.calibration.runs import Floats, Reading
from acsar_gym.calibration.scans import FEWEST, Match, Reference, points
from acsar_gym.config import RobotConfig
from acsar_gym.errors import LidarError
from acsar_gym.lidars.base import newest_scan
from acsar_gym.robot import Robot
from acsar_gym.worlds import Pose
from acsar_gym.worlds.scene import to_odometry, to_world

SCANS = 10
"""Scans that are taken at rest at the start, and averaged at the end."""
METRES, RADIANS = 0.002, math.radians(0.1)
"""Standard deviation of a match that scans don't show: the LiDAR's mount, warped ranges."""
WORST = 0.02
"""A match with a larger standard deviation is refused [m, rad]."""
NEAR = 0.15
"""How far the match of a scan may be from odometry since the scan before [m, rad]."""
FEWEST_SHARE = 0.4
"""Least share of points that must match."""
FINE = 360
"""Rays of a scan for matching, at least."""


def fine(config: RobotConfig) -> RobotConfig:
    """The config with enough rays for matching."""
    return config.with_(lidar={"rays": max(FINE, config.lidar.rays)})


class LidarObserver:
    """Keeps the scans of a run; matches them once it has ended.

    The robot must have a LiDAR as its first sensor. Scans on the way only follow the robot, so
    that full turns are counted; the readings come from scans at rest.
    """

    def __init__(self, config: RobotConfig) -> None:
        self._config = config
        self._scans: list[tuple[Floats, Pose]] = []
        self._stamp = -math.inf

    def begin(self, robot: Robot) -> None:
        """Take scans at rest. LidarError where none come."""
        self._scans, self._stamp = [], -math.inf
        ticks = math.ceil((SCANS + 2) / (self._config.lidar.rate * self._config.period))
        for _ in range(ticks):
            robot.drive(0.0, 0.0)
            self.tick(robot)
        robot.odometry.reset()
        if len(self._scans) < 2:
            raise LidarError("the LiDAR sends no scans", "check its power and 'lidar.rate'")
        self._reference = self._at_rest(self._scans)
        self._scans = []

    def tick(self, robot: Robot) -> None:
        """Keep a scan that is new."""
        scan = newest_scan(robot.sensors)
        if scan is not None and scan.stamp > self._stamp:
            self._stamp = scan.stamp
            self._scans.append((scan.ranges.copy(), robot.odometry.pose))

    def readings(self, plan: Plan) -> list[Reading]:
        """Match the scans of the run.

        Raises:
            LidarError: scans show too little that is fixed, or too little of it in common.
        """
        reference = Reference(self._reference)
        pose, turned = self._follow(reference)
        last = self._at_rest(self._scans[-max(2, SCANS // 2) :])
        found = reference.match(last, pose)
        _check(found, plan)
        turned += math.remainder(found.pose[2] - pose[2], math.tau)
        x, y, _ = found.pose
        return [
            Reading("x", x, math.hypot(METRES, found.sigma[0]), "lidar"),
            Reading("y", y, math.hypot(METRES, found.sigma[1]), "lidar"),
            Reading("heading", turned, math.hypot(RADIANS, found.sigma[2]), "lidar"),
        ]

    def _follow(self, reference: Reference) -> tuple[Pose, float]:
        """Match scan after scan, each from the last pose and odometry since then.

        Returns:
            The last pose, and the turned angle with full turns [rad].
        """
        pose, turned, odometry = (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0)
        for ranges, now in self._scans:
            guess = to_world(pose, to_odometry(odometry, now))
            seen = points(ranges, self._config)
            found = reference.match(seen, guess) if len(seen) >= FEWEST else None
            after = found.pose if found is not None and _follows(found, guess) else guess
            turned += math.remainder(after[2] - pose[2], math.tau)
            pose, odometry = after, now
        return pose, turned

    def _at_rest(self, scans: list[tuple[Floats, Pose]]) -> Floats:
        """Points of the median of scans at rest. LidarError where too little is in range."""
        found = points(np.median([ranges for ranges, _ in scans], axis=0), self._config)
        if len(found) < FEWEST:
            raise LidarError(
                f"the LiDAR sees {len(found)} points within {self._config.lidar.max_range:g} m",
                "calibrate in a room with walls in range, or raise lidar.max_range",
            )
        return found


def _follows(found: Match, guess: Pose) -> bool:
    """Whether a match is good, and near where the robot can be."""
    x, y, theta = to_odometry(guess, found.pose)
    near = math.hypot(x, y) < NEAR and abs(theta) < NEAR
    return near and found.share > FEWEST_SHARE and max(found.sigma) < WORST


def _check(found: Match, plan: Plan) -> None:
    """Raise LidarError for a match that can't be trusted."""
    if found.share < FEWEST_SHARE:
        raise LidarError(
            f"{plan.name}: only {found.share:.0%} of the last scan's points match the first scan",
            "drive less, or in a room where walls stay in sight",
        )
    if max(found.sigma) > WORST:
        raise LidarError(
            f"{plan.name}: the scans don't tell where the robot is, as in a long corridor",
            "calibrate where walls of several directions are in range",
        )
