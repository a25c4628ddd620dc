"""The contract between the firmware's twin and the physics below it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from acsar_gym.protocol import Speeds
from acsar_gym.worlds import Pose, Scene

Image = NDArray[np.uint8]
"""height x width x 3, RGB."""


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """What only a simulator knows; it never feeds an observation. World frame."""

    pose: Pose = (0.0, 0.0, 0.0)
    """x [m], y [m], theta [rad]"""
    twist: tuple[float, float] = (0.0, 0.0)
    """forward speed [m/s], yaw rate [rad/s]"""
    contact: bool = False
    """whether the robot has touched an obstacle since the reset, at the end of any period"""


class Body(Protocol):
    """Motors, tyres and chassis, stepped by the firmware once a loop period."""

    wheel_speeds: Speeds
    """Speeds of the four wheels [rad/s]."""
    wheel_angles: Speeds
    """Angles turned by the four wheels since the reset [rad]; what encoders see."""

    def reset(self, scene: Scene) -> None:
        """Build the scene; the robot stands still at its start."""

    def step(self, set_points: Speeds) -> None:
        """Let one loop period pass with these wheel speed set points [rad/s]."""

    def feel(self) -> None:
        """Note whether the robot touches an obstacle now, for `truth`."""

    @property
    def truth(self) -> GroundTruth:
        """The state of the robot now."""

    def close(self) -> None:
        """Free the engine; twice is once."""


@runtime_checkable
class Camera(Protocol):
    """Takes pictures of the robot and its scene."""

    def image(self, width: int, height: int) -> Image:
        """A picture, height x width x 3, RGB."""


def wrapped(theta: float) -> float:
    """The angle within [-pi, pi]."""
    return math.remainder(theta, 2.0 * math.pi)
