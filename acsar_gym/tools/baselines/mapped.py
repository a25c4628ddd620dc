"""What the planners share: the robot's map, what is around, and the clearance of the footprint."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import PolicyError
from acsar_gym.jit import jit, loop
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.sensors.map.seen import CELL_SHIFT, CELLS, LAST_CELL, cell_centre
from acsar_gym.sensors.map.sensor import MapSensor
from acsar_gym.tasks.state import Floats
from acsar_gym.tools.baselines.base import BaselinePolicy
from acsar_gym.tools.policies.policy import GOAL_NUMBERS, DecodedObservation, PolicyContext
from acsar_gym.worlds.geometry import turn_back
from acsar_gym.worlds.world import point_in_world, to_odometry

Pose = tuple[float, float, float]
"""x [m], y [m], theta [rad] in the odometry frame."""
X = 0
Y = 1
RATE_X = 2
RATE_Y = 3
RADIUS = 4
"""Columns of tracks of movers, in the odometry frame [m, m/s]."""
NO_TRACKS = np.zeros((0, 5))
TRACK_MARGIN = 0.15
"""Obstacles that are no farther from a mover's hull belong to it [m]."""


@jit
def blend_of(seconds: float, lag: float) -> float:
    """Share of the way to a command that motors of a time constant go in some time [s]."""
    return 1.0 - math.exp(-seconds / lag) if lag > 0.0 else 1.0


class Footprint(NamedTuple):
    """The outline of a robot, a convex polygon, in a form that compiled loops read fast."""

    sides: Floats
    """(sides, 4): ends of the sides in the base frame [m]."""
    outer: float
    """Radius of the disc around it [m]."""


@loop
def polygon_distance(x: float, y: float, sides: Floats) -> float:
    """Distance of a point from a convex polygon, (sides, 4). 0 inside [m]."""
    nearest = np.inf
    is_inside = True
    for n in range(len(sides)):
        start_x = sides[n, 0]
        start_y = sides[n, 1]
        side_x = sides[n, 2] - start_x
        side_y = sides[n, 3] - start_y

        # The nearest place of the side, as a share of its length.
        share = (x - start_x) * side_x + (y - start_y) * side_y
        share = share / (side_x * side_x + side_y * side_y)
        share = min(max(share, 0.0), 1.0)
        dx = x - start_x - share * side_x
        dy = y - start_y - share * side_y
        nearest = min(nearest, dx * dx + dy * dy)
        is_inside = is_inside and side_x * (y - start_y) >= side_y * (x - start_x)
    return 0.0 if is_inside else math.sqrt(nearest)


@loop
def footprint_clearance(pose: Pose, points: Floats, footprint: Footprint, limit: float) -> float:
    """Distance of the footprint at a pose from the nearest point.

    Args:
        pose: Pose of the robot.
        points: (n, 2), in the same frame as the pose [m].
        footprint: Footprint of the robot.
        limit: Points that are farther away don't count [m].

    Returns:
        The distance, at most `limit`. 0 if a point lies within the footprint [m].
    """
    x, y, theta = pose
    cos = math.cos(theta)
    sin = math.sin(theta)
    nearest = limit
    for n in range(len(points)):
        dx = points[n, 0] - x
        dy = points[n, 1] - y
        reach = footprint.outer + nearest
        if dx * dx + dy * dy < reach * reach:
            gap = polygon_distance(dx * cos + dy * sin, dy * cos - dx * sin, footprint.sides)
            nearest = min(nearest, gap)
    return nearest


def to_base(pose: Pose, places: Floats) -> Floats:
    """(n, 2): places of the odometry frame in the base frame of a robot that is there [m]."""
    dx, dy = (places - pose[:2]).T
    return np.column_stack(turn_back(dx, dy, math.cos(pose[2]), math.sin(pose[2])))


def cells_of(places: Floats, side: float) -> NDArray[np.int64]:
    """(n, 2): the cells in which places of the odometry frame lie, as `MapSensor.cells_met`."""
    return np.floor(places / side + CELL_SHIFT).astype(np.int64)


class MappedPolicy(BaselinePolicy):
    """Drives along the way that the robot's map plans, around what the LiDAR sees and saw."""

    needs = GOAL_NUMBERS
    needs_in_words = ("a goal", "obstacle_goal")
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
                f"{self.name}: needs a LiDAR and its map, which {setting.task} doesn't observe: "
                "use --env obstacle_goal, or another policy"
            )
        self.map: MapSensor = setting.map
        corners = np.array(setting.config.outline)
        sides = np.hstack([corners, np.roll(corners, -1, axis=0)])
        self.footprint = Footprint(sides, outer=self.units.radius)
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

    def obstacles(self, pose: Pose, seen: DecodedObservation, reach: float) -> Floats:
        """(n, 2): what is around the robot and belongs to no track, in the odometry frame [m].

        The newest scan, and the newest place of what was met in each cell of the map, as cells are
        too coarse for a footprint that passes within centimetres.
        """
        # The scan, without rays that have met nothing.
        config = self.setting.config
        origin = point_in_world(pose, (config.lidar_x_offset, config.lidar_y_offset))
        angles = self._angles + pose[2]
        ranges = np.array(seen.ranges)
        along = np.column_stack([np.cos(angles), np.sin(angles)])
        scan = (origin + ranges[:, None] * along)[ranges < config.lidar.max_range - 1e-3]

        # The newest place of each cell. If another cell has overwritten it, the centre.
        side = self.map.cell_side
        i, j = (cells_of(scan, side) & LAST_CELL).T
        self._places[i, j] = scan
        cells = self.map.cells_met(reach)
        i, j = (cells & LAST_CELL).T
        places = self._places[i, j]
        is_elsewhere = (cells_of(places, side) != cells).any(axis=1)
        places[is_elsewhere] = cell_centre(cells[is_elsewhere], side)

        # Without what belongs to a track.
        tracks = self.tracks()
        is_near = np.abs(scan - pose[:2]).max(axis=1) <= reach
        points = np.concatenate([scan[is_near], places])
        distances = np.hypot(*(points[:, None] - tracks[:, X:RATE_X]).T).T
        standing: Floats = points[(distances > tracks[:, RADIUS] + TRACK_MARGIN).all(axis=1)]
        return standing

    def carrot(self, pose: Pose, lookahead: float) -> tuple[float, float]:
        """The point at a distance along the way [m], in the base frame [m]."""
        x, y, _ = to_odometry(pose, (*self.map.point_ahead(lookahead), 0.0))
        return x, y
