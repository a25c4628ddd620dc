"""What the planners share: the robot's map, what is around, and the clearance of the footprint."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import ClassVar

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
from acsar_gym.worlds.geometry import Surroundings, footprint_gap, make_surroundings, outer_radius

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


@loop
def footprint_clearance(pose: Pose, points: Floats, footprint: Surroundings, limit: float) -> float:
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
    outer = outer_radius(footprint, 0)
    nearest = limit
    for n in range(len(points)):
        dx = points[n, 0] - x
        dy = points[n, 1] - y
        reach = outer + nearest
        if dx * dx + dy * dy < reach * reach:
            gap, _, _ = footprint_gap(dx * cos + dy * sin, dy * cos - dx * sin, footprint, 0)
            nearest = min(nearest, gap)
    return nearest


def to_base(pose: Pose, places: Floats) -> Floats:
    """(n, 2): places of the odometry frame in the base frame of a robot that is there [m]."""
    dx, dy = (places - pose[:2]).T
    cos = math.cos(pose[2])
    sin = math.sin(pose[2])
    return np.column_stack([dx * cos + dy * sin, dy * cos - dx * sin])


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
        self.footprint = make_surroundings(None, None, setting.config)
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
        # The scan, without rays that have met nothing.
        x, y, theta = pose
        config = self.setting.config
        cos = math.cos(theta)
        sin = math.sin(theta)
        origin = (
            x + cos * config.lidar_x_offset - sin * config.lidar_y_offset,
            y + sin * config.lidar_x_offset + cos * config.lidar_y_offset,
        )
        ranges = np.array(seen.ranges)
        along = np.column_stack([np.cos(self._angles + theta), np.sin(self._angles + theta)])
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
        is_near = np.abs(scan - pose[:2]).max(axis=1) <= reach
        points = np.concatenate([scan[is_near], places])
        distances = np.hypot(*(points[:, None] - tracks[:, X:RATE_X]).T).T
        standing: Floats = points[(distances > tracks[:, RADIUS] + TRACK_MARGIN).all(axis=1)]
        return standing

    def carrot(self, pose: Pose, lookahead: float) -> tuple[float, float]:
        """The point at a distance along the way [m], in the base frame [m]."""
        ((x, y),) = to_base(pose, np.array([self.map.point_ahead(lookahead)])).tolist()
        return x, y
