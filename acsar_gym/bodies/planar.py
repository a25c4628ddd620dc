"""A robot on a plane without an engine: the tyre model, integrated."""

from __future__ import annotations

import math

from acsar_gym import dynamics
from acsar_gym.bodies.base import GroundTruth, Image, wrapped
from acsar_gym.config import RobotConfig
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.worlds import Scene


class PlanarBody:
    """Semi-implicit Euler on x, y and theta, as PyBullet integrates."""

    def __init__(self, config: RobotConfig) -> None:
        self._params = dynamics.params(config)
        self._flat_params = tuple(self._params)
        self.reset(Scene())

    def reset(self, scene: Scene) -> None:
        """At rest at the scene's start."""
        self.wheel_angles: Speeds = ZERO
        self.wheel_speeds: Speeds = ZERO
        self._velocity = (0.0, 0.0, 0.0)  # vx, vy in the world frame, yaw rate
        self._pose = scene.start

    def step(self, set_points: Speeds) -> None:
        """One loop period."""
        x, y, theta = self._pose
        self._velocity, self.wheel_speeds, self.wheel_angles = dynamics.robot_step(
            math.cos(theta),
            math.sin(theta),
            self._velocity,
            self.wheel_speeds,
            self.wheel_angles,
            set_points,
            self._flat_params,
        )
        vx, vy, rate = self._velocity
        dt = self._params.dt
        self._pose = (x + vx * dt, y + vy * dt, theta + rate * dt)

    @property
    def truth(self) -> GroundTruth:
        """Pose and twist; there is nothing here to touch."""
        x, y, theta = self._pose
        vx, vy, rate = self._velocity
        forward = vx * math.cos(theta) + vy * math.sin(theta)
        return GroundTruth((x, y, wrapped(theta)), (forward, rate))

    def image(self, width: int, height: int) -> Image | None:
        """The planar robot has no camera."""
        return None

    def close(self) -> None:
        """Nothing to free."""
