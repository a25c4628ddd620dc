"""What the baselines with a map share: odometry, the map kept from the scans, and the plan."""

from __future__ import annotations

import math
from abc import abstractmethod

import numpy as np

from acsar_gym.baselines.around import Around
from acsar_gym.baselines.base import BaselinePolicy
from acsar_gym.baselines.costmap import Costmap
from acsar_gym.baselines.geometry import sides_of
from acsar_gym.baselines.motion import Motion, Pose
from acsar_gym.baselines.potential import Potential, potential
from acsar_gym.config import footprint
from acsar_gym.lidars.base import ray_spec
from acsar_gym.policies.setting import GOAL, Seen, Setting
from acsar_gym.tasks.base import OBSERVATION_LIMIT, Floats

REPLAN = 3
"""Steps between two plans."""


class MappedPolicy(BaselinePolicy):
    """Keeps a map of the obstacles seen so far, and plans the way to the goal on it."""

    needs = GOAL
    lidar = True
    compiled = True

    def equip(self, setting: Setting) -> None:
        """Prepare for a robot and a task."""
        super().equip(setting)
        config = setting.config
        self.sides = sides_of(config)
        self.outer = footprint.radius(config.outline)
        self.radii = (footprint.border_distance(config.outline, 0.0, 0.0), self.outer)
        self._angles = ray_spec(config).angles()
        self.reset()

    def reset(self) -> None:
        """Forget map and motion."""
        super().reset()
        self._motion: Motion | None = None
        self._scan = np.zeros((0, 2))
        self._steps = 0
        self.sent = (0.0, 0.0)

    def act(self, seen: Seen) -> tuple[float, float]:
        """Update pose, map and plan, then decide."""
        if self._motion is None:
            self._motion = Motion(seen.goal, self.setting.period)
            self.known = Costmap(seen.goal)
        farthest = OBSERVATION_LIMIT * (self.setting.scale or 1.0) - 1e-3
        motion = self._motion
        pose = motion.update(seen.goal, (seen.linear, seen.angular), farthest)
        self._enter(pose, seen)
        if self._steps % REPLAN == 0:
            self.plan: Potential = potential(self.known, pose[:2], motion.goal, self.radii)
        self._steps += 1
        self.sent = self.decide(pose, motion.goal, seen)
        return self.sent

    @abstractmethod
    def decide(self, pose: Pose, goal: tuple[float, float], seen: Seen) -> tuple[float, float]:
        """Choose the velocity command.

        Args:
            pose: x [m], y [m], theta [rad] in the odometry frame.
            goal: in the odometry frame [m].
            seen: the observation.

        Returns:
            Linear [m/s] and angular velocity [rad/s].
        """

    def _enter(self, pose: Pose, seen: Seen) -> None:
        """Enter the newest scan into the map."""
        config, (x, y, theta) = self.setting.config, pose
        if seen.ranges is None:
            return
        cos, sin = math.cos(theta), math.sin(theta)
        origin = (
            x + cos * config.lidar_x_offset - sin * config.lidar_y_offset,
            y + sin * config.lidar_x_offset + cos * config.lidar_y_offset,
        )
        along = np.column_stack([np.cos(self._angles + theta), np.sin(self._angles + theta)])
        met, ends = (
            seen.ranges < config.lidar.max_range - 1e-3,
            origin + seen.ranges[:, None] * along,
        )
        self.known.update(origin, ends, met.astype(np.float64))
        self._scan = ends[met]

    def obstacles(self, pose: Pose, reach: float) -> Floats:
        """(n, 2): what is known within a square around the robot, in the odometry frame [m].

        The newest scan counts as it is, too: the mean of a cell may hide a corner.
        """
        near = np.abs(self._scan - pose[:2]).max(axis=1) <= reach
        return np.concatenate([self.known.points(pose[0], pose[1], reach), self._scan[near]])

    def around(self, pose: Pose, reach: float, goal: tuple[float, float], radius: float) -> Around:
        """Collect what predicted motions are scored by.

        Args:
            pose: of the robot.
            reach: how far it may drive meanwhile [m].
            goal: in the odometry frame [m].
            radius: of the goal [m].
        """
        near, plan = self.obstacles(pose, reach + self.outer + 0.3), self.plan
        return Around(near, self.sides, self.outer, plan.values, plan.x, plan.y, *goal, radius)

    def carrot(
        self, pose: Pose, goal: tuple[float, float], lookahead: float
    ) -> tuple[float, float]:
        """The point of the plan that is so far from the robot, in the base frame [m].

        Args:
            pose: of the robot.
            goal: which ends the plan [m].
            lookahead: [m].
        """
        way = self.plan.way(pose[0], pose[1], 1.5 * lookahead)
        far = np.hypot(way[:, 0] - pose[0], way[:, 1] - pose[1]) >= lookahead
        x, y = way[int(far.argmax())].tolist() if far.any() else goal
        dx, dy, cos, sin = x - pose[0], y - pose[1], math.cos(pose[2]), math.sin(pose[2])
        return dx * cos + dy * sin, dy * cos - dx * sin
