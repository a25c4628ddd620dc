"""The contract between the emulated firmware and the simulated body that it drives."""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import re
import sys
from pathlib import Path
from typing import NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.jit import record_of
from acsar_gym.physics import model
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Pose, Scene
from acsar_gym.worlds.crowd import Crowd

Image = NDArray[np.uint8]
"""An RGB picture, (height, width, 3)."""
Paint = tuple[float, float, float, float]
"""Red, green, blue and alpha, each 0 to 1."""

OBSTACLE_HEIGHT = 0.6
"""Height of every standing obstacle [m]."""
MOVER_HEIGHT = 1.7
"""Height of movers, that of a person [m]."""
WALL_THICKNESS = 0.002
"""Thickness of a segment's wall [m]."""
CHASSIS_CLEARANCE = 0.02
"""Height of the chassis above the floor [m]."""
GOAL_RADIUS = 0.15
"""Radius of the disc that marks a goal [m]."""
OBSTACLE_PAINT: Paint = (0.42, 0.45, 0.5, 1.0)
MOVER_PAINT: Paint = (0.56, 0.27, 0.68, 1.0)
GOAL_PAINT: Paint = (0.15, 0.68, 0.38, 0.85)


class Body:
    """Motors, tyres and chassis of a robot. The firmware steps it once a loop.

    Args:
        config: Robot configuration.

    Attributes:
        wheel_speeds: Speeds of the four wheels [rad/s].
        wheel_angles: Angles turned by the four wheels since the reset [rad]. The encoders measure
            them.
    """

    def __init__(self, config: RobotConfig) -> None:
        self._config = config
        self._dt = model.loop_period(config)
        self._configured = model.compute_physics(config)

    def reset(self, scene: Scene) -> None:
        """Build the scene, with the robot at rest at its start.

        Args:
            scene: Start, world and physics of the episode.
        """
        self.wheel_speeds: Speeds = ZERO
        self.wheel_angles: Speeds = ZERO
        self._touched = False
        self._physics = scene.physics or self._configured
        # Compiled functions need a record. It is made in each episode, not in each loop.
        self._record = record_of(self._physics)

    def step(self, set_points: Speeds) -> None:
        """Simulate one firmware loop.

        Args:
            set_points: Set points of the four wheel speeds [rad/s].
        """
        raise NotImplementedError

    def place_movers(self, crowd: Crowd) -> None:
        """Put the movers of the scene's world where they are now, moving at their velocities.

        Does nothing in a body that movers don't stop.

        Args:
            crowd: State of the movers. It also decides whether the robot touches a mover.
        """

    def feel(self) -> None:
        """Check whether the robot touches a standing obstacle now. `truth` then reports it."""

    def _locate(self) -> tuple[Pose, model.Velocity]:
        """The robot's pose, and its velocity in the frame of the world."""
        raise NotImplementedError

    @property
    def truth(self) -> GroundTruth:
        """Ground truth of the robot, in the frame of the world."""
        # Odometry can't see sideways motion, so the twist has only the forward speed.
        (x, y, theta), (vx, vy, rate) = self._locate()
        forward = vx * math.cos(theta) + vy * math.sin(theta)
        pose = (x, y, math.remainder(theta, math.tau))
        return GroundTruth(pose, (forward, rate), self._touched)

    @property
    def power(self) -> float:
        """Mechanical power of the motors now [W]. See `physics.model.motor_power`."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the physics engine, if there is one. Idempotent."""


@runtime_checkable
class Camera(Protocol):
    """Takes pictures of the robot and its scene."""

    def image(self, width: int, height: int) -> Image:
        """Take a picture.

        Args:
            width: Width of the picture [pixels].
            height: Height of the picture [pixels].

        Returns:
            The picture, (height, width, 3), RGB.
        """


class Chassis(NamedTuple):
    """Sizes of a chassis between its wheels, over the height of the axles [m]."""

    bottom: float
    top: float
    width: float
    tyre: float
    """Width of a tyre."""

    @classmethod
    def of(cls, config: RobotConfig) -> Self:
        """Return the chassis of a robot."""
        body = config.body
        radius = config.wheel_radius
        bottom = min(CHASSIS_CLEARANCE, radius) - radius
        # A body's width reaches to the outer sides of its tyres, so their width follows.
        tyre = max(0.02, body.width - config.wheel_separation)
        return cls(
            bottom,
            top=max(body.height - radius, bottom + 0.01),
            # A gap of 5 mm on either side separates the chassis from the tyres.
            width=max(0.02, config.wheel_separation - tyre - 0.01),
            tyre=tyre,
        )


def wheel_hubs(half_wheelbase: float, half_track: float) -> list[tuple[float, float]]:
    """Return the wheels' centres in the base frame [m], in wheel order."""
    x = half_wheelbase
    y = half_track
    return [(x, -y), (x, y), (-x, y), (-x, -y)]


def has_display() -> bool:
    """Return whether there is an X server. Without it PyBullet's window would end the process."""
    if not sys.platform.startswith("linux"):
        return True
    name = os.environ.get("DISPLAY", "")
    # A local X server has a socket in /tmp. A display of another computer is believed.
    local = re.fullmatch(r"(?:unix)?:(\d+)(?:\.\d+)?", name)
    return Path(f"/tmp/.X11-unix/X{local[1]}").exists() if local else bool(name)  # noqa: S108


def prepare_opengl() -> None:
    """Import triton, if it is installed, before anything draws with OpenGL.

    Mesa's drivers show their LLVM to all libraries that are loaded after them. Triton 3.7, which
    torch's CUDA builds install and import with the first optimizer, would use that LLVM and end the
    process with a segmentation fault (github.com/tensorflow/tensorflow/issues/124205).
    """
    with contextlib.suppress(ImportError):
        importlib.import_module("triton")
