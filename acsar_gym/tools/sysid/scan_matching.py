"""Measures runs with a LiDAR: scans are matched by point-to-line ICP (Censi 2008).

small_gicp, which is on PyPI, matches in space: a flat scan leaves its point-to-plane registration
degenerate (0.27 m RMS in a room where this one is 1 mm off), and there is nothing else small.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LidarError, require_extra
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.robot import Robot
from acsar_gym.sensors.lidar import newest_scan
from acsar_gym.tools.sysid.calibration_drive import RunPlan
from acsar_gym.tools.sysid.calibration_runs import RunReading
from acsar_gym.tools.sysid.delays import Floats
from acsar_gym.worlds import Pose
from acsar_gym.worlds.world import to_odometry, to_world

with require_extra("calibration", "scipy"):
    from scipy.spatial import KDTree

MAX_ITERATIONS = 40
"""Most iterations of a match."""
CONVERGED_STEP = 1e-7
"""A smaller change ends the iterations [m, rad]."""
FIRST_GATE = 0.5
"""Farthest pair of points at the first iteration [m]."""
NARROWEST_GATE = 0.05
"""Farthest pair of points that is kept at the end, at least [m]."""
LINE_DISTANCE = 0.15
"""Points within this distance make a line [m]..."""
LINE_POINTS = 6
"""...or so many, where fewer are as close."""
LINE_SPREAD = 0.25
"""Largest share of the neighbours' spread across their line; corners have more."""
PARALLEL_SHARE = 0.02
"""Where a smaller share of the lines' normals points across the others, all walls are parallel."""
FEWEST_PAIRED_POINTS = 20
"""Fewest pairs of points for a match."""
RESTING_SCANS = 10
"""Scans that are taken at rest at the start, and averaged at the end."""
SCAN_METRES = 0.002
SCAN_RADIANS = math.radians(0.1)
"""Standard deviation of a match that scans don't show: the LiDAR's mount, warped ranges."""
WORST_SIGMA = 0.02
"""A match with a larger standard deviation is refused [m, rad]."""
NEAR_ODOMETRY = 0.15
"""How far the match of a scan may be from odometry since the scan before [m, rad]."""
MATCHED_SHARE = 0.4
"""Least share of points that must match."""
FINE_RAYS = 360
"""Rays of a scan for matching, at least."""


class ScanMatch(NamedTuple):
    """Where a scan was taken, in the frame of the reference scan's robot."""

    pose: Pose
    """x [m], y [m], theta [rad]."""
    sigma: tuple[float, float, float]
    """Standard deviation of each, from the residuals; infinite where the match failed."""
    share: float
    """Share of the scan's points that were matched."""


class ReferenceScan:
    """A scan that others are matched against.

    Args:
        points: (n, 2), from `scan_points` [m].
    """

    def __init__(self, points: Floats) -> None:
        self._tree = KDTree(points)
        self._points = points
        scatter = np.empty((len(points), 2, 2))
        for number, point in enumerate(points):
            near = np.asarray(self._tree.query_ball_point(point, LINE_DISTANCE))
            if len(near) < LINE_POINTS:
                near = np.asarray(self._tree.query(point, k=min(LINE_POINTS, len(points)))[1])
            around = points[near] - points[near].mean(axis=0)
            scatter[number] = around.T @ around
        spread, axes = np.linalg.eigh(scatter)
        self._normals = axes[:, :, 0]
        self._lines = spread[:, 0] < LINE_SPREAD**2 * np.maximum(spread[:, 1], 1e-12)

    def match(self, points: Floats, guess: Pose) -> ScanMatch:
        """Match a scan.

        Args:
            points: (n, 2), from `scan_points` [m].
            guess: pose at which it was taken, within some 0.3 m and 0.3 rad.
        """
        pose, gate = np.array(guess, np.float64), FIRST_GATE
        for _ in range(MAX_ITERATIONS):
            jacobian, off = self._pair_points(points, pose, gate)
            if len(off) < FEWEST_PAIRED_POINTS:
                return ScanMatch(guess, (math.inf,) * 3, 0.0)
            step = np.linalg.lstsq(jacobian, -off, rcond=None)[0]  # Gauss-Newton
            pose += step
            gate = max(NARROWEST_GATE, min(gate, 4.0 * float(np.median(np.abs(off)))))
            if np.abs(step).max() < CONVERGED_STEP:
                break
        jacobian, off = self._pair_points(points, pose, gate)
        found = (float(pose[0]), float(pose[1]), float(pose[2]))
        if len(off) < FEWEST_PAIRED_POINTS:
            return ScanMatch(found, (math.inf,) * 3, 0.0)
        share, normals = len(off) / len(points), jacobian[:, :2]
        if np.linalg.eigvalsh(normals.T @ normals)[0] < PARALLEL_SHARE * len(off):
            return ScanMatch(found, (math.inf,) * 3, share)
        covariance = np.linalg.pinv(jacobian.T @ jacobian) * float(off @ off) / len(off)
        x, y, theta = np.sqrt(np.diag(covariance)).tolist()
        return ScanMatch(found, (x, y, theta), share)

    def _pair_points(self, points: Floats, pose: Floats, gate: float) -> tuple[Floats, Floats]:
        """Jacobian (pairs, 3) and distances (pairs,) of points to the nearest point's line."""
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        turned = points @ np.array([[cos, sin], [-sin, cos]])
        placed = turned + pose[:2]
        distance, found = self._tree.query(placed)
        near = np.asarray(found)
        kept = (distance < gate) & self._lines[near]
        normals = self._normals[near[kept]]
        off = ((placed[kept] - self._points[near[kept]]) * normals).sum(axis=1)
        lever = turned[kept, 0] * normals[:, 1] - turned[kept, 1] * normals[:, 0]
        return np.column_stack([normals, lever]), off


def scan_points(ranges: Floats, config: RobotConfig) -> Floats:
    """Convert ranges to points in the base frame; rays that met nothing are left out.

    Args:
        ranges: (rays,) [m].
        config: of the robot, with the LiDAR's position.

    Returns:
        (n, 2) [m].
    """
    lidar = config.lidar
    bearings = ray_spec(config).angles()
    met = (ranges > lidar.min_range) & (ranges < lidar.max_range)
    rays = np.column_stack([np.cos(bearings), np.sin(bearings)]) * ranges[:, None]
    found: Floats = (rays + np.array([config.lidar_x_offset, config.lidar_y_offset]))[met]
    return found


def with_fine_scans(config: RobotConfig) -> RobotConfig:
    """The config with enough rays for matching."""
    return config.with_(lidar={"rays": max(FINE_RAYS, config.lidar.rays)})


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
        ticks = (RESTING_SCANS + 2) / (self._config.lidar.rate * self._config.period)
        for _ in range(math.ceil(ticks)):
            robot.drive(0.0, 0.0)
            self.tick(robot)
        robot.odometry.reset()
        if len(self._scans) < 2:
            raise LidarError("the LiDAR sends no scans", "check its power and 'lidar.rate'")
        self._reference = self._average_scans(self._scans)
        self._scans = []

    def tick(self, robot: Robot) -> None:
        """Keep a scan that is new."""
        scan = newest_scan(robot.sensors)
        if scan is not None and scan.stamp > self._stamp:
            self._stamp = scan.stamp
            self._scans.append((scan.ranges.copy(), robot.odometry.pose))

    def readings(self, plan: RunPlan) -> list[RunReading]:
        """Match the scans of the run, each from the last pose and odometry since then.

        Raises:
            LidarError: scans show too little that is fixed, or too little of it in common.
        """
        reference = ReferenceScan(self._reference)
        pose, turned, odometry = (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0)
        for ranges, now in self._scans:
            after = guess = to_world(pose, to_odometry(odometry, now))
            seen = scan_points(ranges, self._config)
            if len(seen) >= FEWEST_PAIRED_POINTS:
                found = reference.match(seen, guess)
                x, y, theta = to_odometry(guess, found.pose)
                near = math.hypot(x, y) < NEAR_ODOMETRY and abs(theta) < NEAR_ODOMETRY
                if near and found.share > MATCHED_SHARE and max(found.sigma) < WORST_SIGMA:
                    after = found.pose
            turned += math.remainder(after[2] - pose[2], math.tau)
            pose, odometry = after, now
        last = self._average_scans(self._scans[-max(2, RESTING_SCANS // 2) :])
        found = reference.match(last, pose)
        if found.share < MATCHED_SHARE:
            raise LidarError(
                f"{plan.name}: only {found.share:.0%} of the last scan's points match the first "
                "scan",
                "drive less, or in a room where walls stay in sight",
            )
        if max(found.sigma) > WORST_SIGMA:
            raise LidarError(
                f"{plan.name}: the scans don't tell where the robot is, as in a long corridor",
                "calibrate where walls of several directions are in range",
            )
        turned += math.remainder(found.pose[2] - pose[2], math.tau)
        sigmas = [
            math.hypot(least, own)
            for least, own in zip(
                (SCAN_METRES, SCAN_METRES, SCAN_RADIANS), found.sigma, strict=True
            )
        ]
        return [
            RunReading("x", found.pose[0], sigmas[0], "lidar"),
            RunReading("y", found.pose[1], sigmas[1], "lidar"),
            RunReading("heading", turned, sigmas[2], "lidar"),
        ]

    def _average_scans(self, scans: list[tuple[Floats, Pose]]) -> Floats:
        """Points of the median of scans at rest. LidarError where too little is in range."""
        found = scan_points(np.median([ranges for ranges, _ in scans], axis=0), self._config)
        if len(found) < FEWEST_PAIRED_POINTS:
            raise LidarError(
                f"the LiDAR sees {len(found)} points within {self._config.lidar.max_range:g} m",
                "calibrate in a room with walls in range, or raise lidar.max_range",
            )
        return found
