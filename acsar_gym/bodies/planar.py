"""A robot on a plane without an engine: the tyre model, integrated."""

from __future__ import annotations

import math

from acsar_gym.bodies.base import GroundTruth, wrapped
from acsar_gym.config import RobotConfig
from acsar_gym.dynamics import model
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.worlds import Scene
from acsar_gym.worlds.collisions import collides
from acsar_gym.worlds.geometry import Obstacles, surroundings


class PlanarBody:
    """Semi-implicit Euler on x, y and theta, as PyBullet integrates."""

    def __init__(self, config: RobotConfig) -> None:
        self._config = config
        self._dt = model.substep(config)
        self._configured = model.physics(config)
        self.reset(Scene())

    def reset(self, scene: Scene) -> None:
        """At rest at the scene's start, with the scene's physics."""
        self._physics = model.numbers_of(scene.physics or self._configured)
        self.wheel_angles: Speeds = ZERO
        self.wheel_speeds: Speeds = ZERO
        self._velocity = (0.0, 0.0, 0.0)  # vx, vy in the world frame, yaw rate
        self._pose = scene.start
        self._touched = False
        world = scene.world
        self._crowded = world is not None and world.obstacles > 0
        obstacles = Obstacles() if world is None else Obstacles(world.circles, world.segments)
        self._around = surroundings(obstacles, None, 1, self._config)

    def step(self, set_points: Speeds) -> None:
        """One loop period."""
        x, y, theta = self._pose
        self._velocity, self.wheel_speeds, self.wheel_angles = model.robot_step(
            math.cos(theta),
            math.sin(theta),
            self._velocity,
            self.wheel_speeds,
            self.wheel_angles,
            set_points,
            self._physics,
            self._dt,
        )
        vx, vy, rate = self._velocity
        dt = self._dt
        self._pose = (x + vx * dt, y + vy * dt, theta + rate * dt)

    def feel(self) -> None:
        """Note whether the footprint touches an obstacle now; the robot drives on through it."""
        if self._crowded and not self._touched:
            x, y, theta = self._pose
            self._touched = collides(x, y, math.cos(theta), math.sin(theta), 0, self._around)

    @property
    def truth(self) -> GroundTruth:
        """Pose, twist, and whether the footprint has touched an obstacle."""
        x, y, theta = self._pose
        vx, vy, rate = self._velocity
        forward = vx * math.cos(theta) + vy * math.sin(theta)
        return GroundTruth((x, y, wrapped(theta)), (forward, rate), self._touched)

    def close(self) -> None:
        """Nothing to free."""
