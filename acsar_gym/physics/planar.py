"""A robot on a plane, simulated without a physics engine."""

from __future__ import annotations

import math

from acsar_gym.config import RobotConfig
from acsar_gym.physics import model
from acsar_gym.physics.body import Body
from acsar_gym.protocol import Speeds
from acsar_gym.worlds import Pose, Scene
from acsar_gym.worlds.geometry import footprint_collides, make_surroundings


class PlanarBody(Body):
    """Integrates the tyre model by semi-implicit Euler on x, y and theta, as PyBullet does.

    Obstacles and movers don't stop the robot.
    """

    def __init__(self, config: RobotConfig) -> None:
        super().__init__(config)
        self.reset(Scene())

    def reset(self, scene: Scene) -> None:
        """Put the robot at rest at the scene's start, with the scene's obstacles and physics."""
        super().reset(scene)
        self._velocity: model.Velocity = (0.0, 0.0, 0.0)  # in the frame of the world
        self._pose = scene.start
        self._crowded = scene.world is not None and scene.world.obstacles > 0
        self._around = make_surroundings(scene.world, None, self._config)

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
            self._record,
            dt,
        )

        # Semi-implicit: the pose follows from the new velocity.
        vx, vy, rate = self._velocity
        self._pose = (x + vx * dt, y + vy * dt, theta + rate * dt)

    def feel(self) -> None:
        """Check whether the footprint touches an obstacle now."""
        # A contact is remembered until the reset, so it is looked for once.
        if self._crowded and not self._touched:
            x, y, theta = self._pose
            cos = math.cos(theta)
            sin = math.sin(theta)
            self._touched = footprint_collides(x, y, cos, sin, which=0, around=self._around)

    def _locate(self) -> tuple[Pose, model.Velocity]:
        return self._pose, self._velocity

    @property
    def power(self) -> float:
        """Mechanical power of the motors now [W]. See `physics.model.motor_power`."""
        theta = self._pose[2]
        return model.motor_power(
            math.cos(theta), math.sin(theta), self._velocity, self.wheel_speeds, self._record
        )
