"""Scan matching in the plane: point-to-line ICP (Censi 2008) against one reference scan.

small_gicp, which is on PyPI, matches in space: a flat scan leaves its point-to-plane registration
degenerate (0.27 m RMS in a room where this one is 1 mm off), and there is nothing else small.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from acsar_gym.calibration.runs import Floats
from acsar_gym.config import RobotConfig
from acsar_gym.errors import optional
from acsar_gym.worlds import Pose

with optional("calibration", "scipy"):
    from scipy.spatial import KDTree

ITERATIONS = 40
"""Most iterations of a match."""
CONVERGED = 1e-7
"""A smaller change ends the iterations [m, rad]."""
GATE = 0.5
"""Farthest pair of points at the first iteration [m]."""
NARROWEST = 0.05
"""Farthest pair of points that is kept at the end, at least [m]."""
AROUND = 0.15
"""Points within this distance make a line [m]..."""
NEIGHBOURS = 6
"""...or so many, where fewer are as close."""
STRAIGHT = 0.25
"""Largest share of the neighbours' spread across their line; corners have more."""
ONE_WAY = 0.02
"""Where a smaller share of the lines' normals points across the others, all walls are parallel."""
FEWEST = 20
"""Fewest pairs of points for a match."""


@dataclass(frozen=True, eq=False, slots=True)
class Match:
    """Where a scan was taken, in the frame of the reference scan's robot."""

    pose: Pose
    """x [m], y [m], theta [rad]."""
    sigma: tuple[float, float, float]
    """Standard deviation of each, from the residuals; infinite where the match failed."""
    share: float
    """Share of the scan's points that were matched."""


class Reference:
    """A scan that others are matched against.

    Args:
        points: (n, 2), from `points` [m].
    """

    def __init__(self, points: Floats) -> None:
        self._tree = KDTree(points)
        self._points = points
        scatter = np.array([self._scatter(point) for point in points])
        spread, axes = np.linalg.eigh(scatter)
        self._normals = axes[:, :, 0]
        self._lines = spread[:, 0] < STRAIGHT**2 * np.maximum(spread[:, 1], 1e-12)

    def _scatter(self, point: Floats) -> Floats:
        """Scatter matrix of the points around one, (2, 2)."""
        near = np.asarray(self._tree.query_ball_point(point, AROUND))
        if len(near) < NEIGHBOURS:
            near = np.asarray(self._tree.query(point, k=min(NEIGHBOURS, len(self._points)))[1])
        around = self._points[near] - self._points[near].mean(axis=0)
        found: Floats = around.T @ around
        return found

    def match(self, points: Floats, guess: Pose) -> Match:
        """Match a scan.

        Args:
            points: (n, 2), from `points` [m].
            guess: pose at which it was taken, within some 0.3 m and 0.3 rad.
        """
        pose, gate = np.array(guess, np.float64), GATE
        for _ in range(ITERATIONS):
            step, _, off = self._step(points, pose, gate)
            if step is None:
                return Match(guess, (math.inf,) * 3, 0.0)
            pose += step
            gate = max(NARROWEST, min(gate, 4.0 * float(np.median(np.abs(off)))))
            if np.abs(step).max() < CONVERGED:
                break
        return self._judged(points, pose, gate)

    def _step(
        self, points: Floats, pose: Floats, gate: float
    ) -> tuple[Floats | None, Floats, Floats]:
        """One Gauss-Newton step (None where too few points match), Jacobian and residuals."""
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        turned = points @ np.array([[cos, sin], [-sin, cos]])
        placed = turned + pose[:2]
        distance, found = self._tree.query(placed)
        near = np.asarray(found)
        kept = (distance < gate) & self._lines[near]
        normals = self._normals[near[kept]]
        off = ((placed[kept] - self._points[near[kept]]) * normals).sum(axis=1)
        lever = turned[kept, 0] * normals[:, 1] - turned[kept, 1] * normals[:, 0]
        jacobian = np.column_stack([normals, lever])
        if len(off) < FEWEST:
            return None, jacobian, off
        return np.linalg.lstsq(jacobian, -off, rcond=None)[0], jacobian, off

    def _judged(self, points: Floats, pose: Floats, gate: float) -> Match:
        """The match at a pose, with its standard deviations."""
        step, jacobian, off = self._step(points, pose, gate)
        found = (float(pose[0]), float(pose[1]), float(pose[2]))
        if step is None:
            return Match(found, (math.inf,) * 3, 0.0)
        share, normals = len(off) / len(points), jacobian[:, :2]
        if np.linalg.eigvalsh(normals.T @ normals)[0] < ONE_WAY * len(off):
            return Match(found, (math.inf,) * 3, share)
        covariance = np.linalg.pinv(jacobian.T @ jacobian) * float(off @ off) / len(off)
        x, y, theta = np.sqrt(np.diag(covariance))
        return Match(found, (float(x), float(y), float(theta)), share)


def points(ranges: Floats, config: RobotConfig) -> Floats:
    """Convert ranges to points in the base frame; rays that met nothing are left out.

    Args:
        ranges: (rays,) [m].
        config: of the robot, with the LiDAR's position.

    Returns:
        (n, 2) [m].
    """
    lidar = config.lidar
    full = lidar.field_of_view > 2.0 * math.pi - 1e-6
    step = lidar.field_of_view / (lidar.rays if full else max(lidar.rays - 1, 1))
    bearings = -lidar.field_of_view / 2.0 + step * np.arange(lidar.rays)
    met = (ranges > lidar.min_range) & (ranges < lidar.max_range)
    rays = np.column_stack([np.cos(bearings), np.sin(bearings)]) * ranges[:, None]
    mount = np.array([config.lidar_x_offset, config.lidar_y_offset])
    found: Floats = (rays + mount)[met]
    return found
