"""What the planners share: the robot's map, what is around, and the clearance of the footprint."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import PolicyError
from acsar_gym.jit import loop
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.sensors.map.seen import CELL_SHIFT, CELLS, LAST_CELL, cell_centre
from acsar_gym.sensors.map.sensor import MapSensor
from acsar_gym.tasks.state import Floats
from acsar_gym.tools.baselines.base import BaselinePolicy
from acsar_gym.tools.policies.policy import GOAL_NUMBERS, DecodedObservation, PolicyContext
from acsar_gym.truth import GroundTruth

Pose = tuple[float, float, float]
"""x [m], y [m], theta [rad] in the odometry frame."""
NO_TRACKS = np.zeros((0, 5))
TRACK_MARGIN = 0.15
"""Obstacles that are no farther from a mover's hull belong to it [m]."""


@loop
def polygon_distance(x: float, y: float, sides: Floats) -> float:
    """Distance of a point from a convex polygon, (sides, 4); 0 inside [m]."""
    best = np.inf
    is_inside = True
    for n in range(len(sides)):
        ax, ay = sides[n, 0], sides[n, 1]
        ex, ey = sides[n, 2] - ax, sides[n, 3] - ay
        share = ((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey)
        share = min(max(share, 0.0), 1.0)
        dx, dy = x - ax - share * ex, y - ay - share * ey
        best = min(best, dx * dx + dy * dy)
        is_inside = is_inside and ex * (y - ay) >= ey * (x - ax)
    return 0.0 if is_inside else math.sqrt(best)


@loop
def points_clearance(
    x: float, y: float, theta: float, points: Floats, sides: Floats, outer: float, most: float
) -> float:
    """Distance of the footprint at a pose from the nearest point.

    Args:
        x: of the pose [m].
        y: of the pose [m].
        theta: of the pose [rad].
        points: (n, 2), in the same frame as the pose [m].
        sides: of the footprint, (sides, 4), in the base frame [m].
        outer: radius of the disc around the footprint [m].
        most: farther points don't count [m].

    Returns:
        The distance, at most `most`; 0 where a point lies within the footprint [m].
    """
    cos, sin, best = math.cos(theta), math.sin(theta), most
    for n in range(len(points)):
        dx, dy = points[n, 0] - x, points[n, 1] - y
        reach = outer + best
        if dx * dx + dy * dy < reach * reach:
            gap = polygon_distance(dx * cos + dy * sin, dy * cos - dx * sin, sides)
            best = min(best, gap)
    return best


def to_base(pose: Pose, places: Floats) -> Floats:
    """(n, 2): places of the odometry frame in the base frame of a robot that is there [m]."""
    dx, dy, cos, sin = *(places - pose[:2]).T, math.cos(pose[2]), math.sin(pose[2])
    return np.column_stack([dx * cos + dy * sin, dy * cos - dx * sin])


def cells_of(places: Floats, side: float) -> NDArray[np.int64]:
    """(n, 2): the cells in which places of the odometry frame lie, as `MapSensor.cells_met`."""
    return np.floor(places / side + CELL_SHIFT).astype(np.int64)


def true_tracks(truth: GroundTruth, pose: Pose) -> Floats:
    """(m, 5): as `MappedPolicy.tracks`, of a robot whose pose by odometry is `pose`."""
    if truth.crowd is None:
        return NO_TRACKS
    states, base, turned = truth.crowd.states, truth.pose, truth.pose[2] - pose[2]
    cos, sin = math.cos(turned), math.sin(turned)
    back = np.array([[cos, -sin], [sin, cos]])
    places = pose[:2] + (states[:, :2] - base[:2]) @ back
    return np.column_stack([places, states[:, 2:4] @ back, truth.crowd.radii])


class MappedPolicy(BaselinePolicy):
    """Drives along the way that the robot's map plans, around what the LiDAR sees and saw."""

    needs = GOAL_NUMBERS
    what = ("a goal", "obstacle_goal")
    lidar = True
    follows_movers: ClassVar[bool] = False
    """Whether it uses the tracks of the map."""

    def equip(self, setting: PolicyContext) -> None:
        """Prepare for a robot and a task.

        Raises:
            PolicyError: the robot has no map.
        """
        super().equip(setting)
        if setting.map is None:
            raise PolicyError(
                f"{self.name}: needs a map, which {setting.task} doesn't observe: use --env "
                "obstacle_goal, or another policy"
            )
        self.map: MapSensor = setting.map
        corners = np.array(setting.config.outline)
        self.sides = np.hstack([corners, np.roll(corners, -1, axis=0)])
        self.outer = self.units.radius
        self._angles = ray_spec(setting.config).angles()
        self.reset()

    def reset(self) -> None:
        """Forget the last command, and where things were met."""
        super().reset()
        self.sent = (0.0, 0.0)
        self._places = np.full((CELLS, CELLS, 2), 1e6)  # newest of each cell, as the map has it

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Decide by the robot's map and its newest scan."""
        self.sent = self.decide(self.map.pose, seen)
        return self.sent

    @abstractmethod
    def decide(self, pose: Pose, seen: DecodedObservation) -> tuple[float, float]:
        """Choose the velocity command.

        Returns:
            Linear [m/s] and angular velocity [rad/s].
        """

    def tracks(self) -> Floats:
        """(m, 5): movers, in the odometry frame: x, y [m], their rates [m/s], and radius [m]."""
        return self.map.movers if self.follows_movers else NO_TRACKS

    def obstacles(
        self, pose: Pose, seen: DecodedObservation, reach: float, tracks: Floats = NO_TRACKS
    ) -> Floats:
        """(n, 2): what is around the robot and belongs to no track, in the odometry frame [m].

        The newest scan, and the newest place of what was met in each cell of the map, as cells are
        too coarse for a footprint that passes within centimetres.
        """
        config, (x, y, theta) = self.setting.config, pose
        cos, sin = math.cos(theta), math.sin(theta)
        origin = (
            x + cos * config.lidar_x_offset - sin * config.lidar_y_offset,
            y + sin * config.lidar_x_offset + cos * config.lidar_y_offset,
        )
        ranges = np.zeros(0) if seen.ranges is None else seen.ranges
        along = np.column_stack([np.cos(self._angles + theta), np.sin(self._angles + theta)])
        scan = (origin + ranges[:, None] * along)[ranges < config.lidar.max_range - 1e-3]
        side = self.map.cell_side
        i, j = (cells_of(scan, side) & LAST_CELL).T
        self._places[i, j] = scan
        cells = self.map.cells_met(reach)
        i, j = (cells & LAST_CELL).T
        places = self._places[i, j]
        elsewhere = (cells_of(places, side) != cells).any(axis=1)
        places[elsewhere] = cell_centre(cells[elsewhere], side)
        near = np.abs(scan - pose[:2]).max(axis=1) <= reach
        points = np.concatenate([scan[near], places])
        apart = np.hypot(*(points[:, None] - tracks[:, :2]).T).T
        standing: Floats = points[(apart > tracks[:, 4] + TRACK_MARGIN).all(axis=1)]
        return standing

    def carrot(self, pose: Pose, lookahead: float) -> tuple[float, float]:
        """The point that is so far along the way [m], in the base frame [m]."""
        x, y = self.map.point_ahead(lookahead)
        dx, dy = x - pose[0], y - pose[1]
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        return dx * cos + dy * sin, dy * cos - dx * sin
