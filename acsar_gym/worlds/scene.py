"""What a simulated link builds when it is reset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from acsar_gym.worlds.world import World

Pose = tuple[float, float, float]
"""x [m], y [m], theta [rad]."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A robot at rest at `start`, a world around it, and a marker at `goal` for pictures only.

    Everything is in one frame. Environments use the odometry frame, in which the robot starts at
    the origin.
    """

    start: Pose = (0.0, 0.0, 0.0)
    goal: tuple[float, float] | None = None
    world: World | None = None
