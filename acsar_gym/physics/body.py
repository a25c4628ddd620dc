"""The contract between the emulated firmware and the simulated body that it drives."""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import re
import sys
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from acsar_gym.protocol import Speeds
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene
from acsar_gym.worlds.crowd import Crowd

Image = NDArray[np.uint8]
"""(height, width, 3): an RGB picture."""
OBSTACLE_HEIGHT = 0.6
"""Height of every obstacle that stands [m]."""
MOVER_HEIGHT = 1.7
"""Height of what moves [m]: a person's."""
WALL_THICKNESS = 0.002
"""Thickness of a segment's wall [m]."""
CHASSIS_CLEARANCE = 0.02
"""Height of the chassis above the floor [m]."""
OBSTACLE_PAINT = (0.42, 0.45, 0.5, 1.0)
MOVER_PAINT = (0.56, 0.27, 0.68, 1.0)
GOAL_PAINT = (0.15, 0.68, 0.38, 0.85)


class Body(Protocol):
    """Motors, tyres and chassis of a robot; the firmware steps it once a loop."""

    wheel_speeds: Speeds
    """Speeds of the four wheels [rad/s]."""
    wheel_angles: Speeds
    """Angles turned by the four wheels since the reset [rad]; the encoders measure them."""

    def reset(self, scene: Scene) -> None:
        """Build the scene, with the robot at rest at its start.

        Args:
            scene: start, world and physics.
        """

    def step(self, set_points: Speeds) -> None:
        """Simulate one firmware loop.

        Args:
            set_points: of the four wheel speeds [rad/s].
        """

    def place_movers(self, crowd: Crowd) -> None:
        """Put the movers of the scene's world where they are now, moving at their velocities.

        Args:
            crowd: knows them; it also decides whether the robot touches one.
        """

    def feel(self) -> None:
        """Check whether the robot touches a standing obstacle now; `truth` then tells it."""

    @property
    def truth(self) -> GroundTruth:
        """Ground truth of the robot, in the frame of the world."""

    @property
    def power(self) -> float:
        """Mechanical power of the motors now [W]; see `physics.model.motor_power`."""

    def close(self) -> None:
        """Close the physics engine; idempotent."""


@runtime_checkable
class Camera(Protocol):
    """Takes pictures of the robot and its scene."""

    def image(self, width: int, height: int) -> Image:
        """Take a picture.

        Args:
            width: of it [pixels].
            height: of it [pixels].

        Returns:
            (height, width, 3), RGB.
        """


def wrap_angle(theta: float) -> float:
    """Wrap an angle to [-pi, pi] [rad]."""
    return math.remainder(theta, 2.0 * math.pi)


def has_display() -> bool:
    """Whether there is an X server; without one PyBullet's window would end the whole process."""
    if not sys.platform.startswith("linux"):
        return True
    name = os.environ.get("DISPLAY", "")
    local = re.fullmatch(r"(?:unix)?:(\d+)(?:\.\d+)?", name)
    return Path(f"/tmp/.X11-unix/X{local[1]}").exists() if local else bool(name)  # noqa: S108


def prepare_opengl() -> None:
    """Import triton, where there is one, before anything draws with OpenGL.

    Mesa's drivers show their LLVM to all libraries that are loaded after them. Triton 3.7, which
    torch's CUDA builds bring and import with the first optimizer, would take it for its own and end
    the process with a segmentation fault (github.com/tensorflow/tensorflow/issues/124205).
    """
    with contextlib.suppress(ImportError):
        importlib.import_module("triton")
