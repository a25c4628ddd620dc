"""A robot on a plane, simulated without a physics engine."""

from __future__ import annotations

import math

from acsar_gym.config import RobotConfig
from acsar_gym.jit import record_of
from acsar_gym.physics import model
from acsar_gym.physics.body import wrap_angle
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene
from acsar_gym.worlds.crowd import Crowd
from acsar_gym.worlds.geometry import footprint_collides, make_surroundings


class PlanarBody:
    """Integrates the tyre model by semi-implicit Euler on x, y and theta, as PyBullet does."""

    def __init__(self, config: RobotConfig) -> None:
        self._config = config
        self._dt = model.loop_period(config)
        self._configured = model.compute_physics(config)
        self.reset(Scene())

    def reset(self, scene: Scene) -> None:
        """Put the robot at rest at the scene's start, with the scene's obstacles and physics."""
        self._physics = record_of(scene.physics or self._configured)
        self.wheel_angles: Speeds = ZERO
        self.wheel_speeds: Speeds = ZERO
        self._velocity: model.Velocity = (0.0, 0.0, 0.0)  # in the frame of the world
        self._pose = scene.start
        self._touched = False

        world = scene.world
        self._crowded = world is not None and world.obstacles > 0
        self._around = make_surroundings(world, None, self._config)

    def step(self, set_points: Speeds) -> None:
        """Simulate one firmware loop with these set points of the four wheel speeds [rad/s]."""
        x, y, theta = self._pose
        dt = self._dt
        self._velocity, self.wheel_speeds, self.wheel_angles = model.robot_step(
            math.cos(theta),
            math.sin(theta),
            self._velocity,
            self.wheel_speeds,
            self.wheel_angles,
            set_points,
            self._physics,
            dt,
        )
        vx, vy, rate = self._velocity
        self._pose = (x + vx * dt, y + vy * dt, theta + rate * dt)

    def place_movers(self, crowd: Crowd) -> None:
        """Do nothing: movers don't stop the robot, as other obstacles don't."""

    def feel(self) -> None:
        """Check whether the footprint touches an obstacle now. Obstacles don't stop the robot."""
        if self._crowded and not self._touched:
            x, y, theta = self._pose
            cos, sin = math.cos(theta), math.sin(theta)
            self._touched = footprint_collides(x, y, cos, sin, 0, self._around)

    @property
    def truth(self) -> GroundTruth:
        """Ground truth of the robot, in the frame of the world."""
        x, y, theta = self._pose
        vx, vy, rate = self._velocity
        forward = vx * math.cos(theta) + vy * math.sin(theta)
        return GroundTruth((x, y, wrap_angle(theta)), (forward, rate), self._touched)

    @property
    def power(self) -> float:
        """Mechanical power of the motors now [W]; see `physics.model.motor_power`."""
        theta = self._pose[2]
        return model.motor_power(
            math.cos(theta), math.sin(theta), self._velocity, self.wheel_speeds, self._physics
        )

    def close(self) -> None:
        """Do nothing: there is no engine."""
