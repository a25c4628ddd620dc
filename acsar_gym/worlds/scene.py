"""What a simulated link builds when it is reset, and its two frames: the world's and odometry's."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from acsar_gym.dynamics import Physics
    from acsar_gym.worlds.world import World

Pose = tuple[float, float, float]
"""x [m], y [m], theta [rad]."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A robot at rest at `start`, a world around it, and a goal, which only pictures show.

    Everything is in the frame of the world, as is a simulator's ground truth. The odometry frame
    begins at `start`.
    """

    start: Pose = (0.0, 0.0, 0.0)
    """x [m], y [m], theta [rad]."""
    goal: tuple[float, float] | None = None
    """x, y [m]; None: not shown."""
    world: World | None = None
    """Obstacles; None on an open floor."""
    physics: Physics | None = None
    """The simulated robot's physics in this episode; None: as configured."""


def to_world(start: Pose, pose: Pose) -> Pose:
    """Transform a pose from the odometry frame that begins at `start` into the world's frame."""
    x, y, theta = start
    cos, sin = math.cos(theta), math.sin(theta)
    return (
        x + cos * pose[0] - sin * pose[1],
        y + sin * pose[0] + cos * pose[1],
        math.remainder(theta + pose[2], math.tau),
    )


def to_odometry(start: Pose, pose: Pose) -> Pose:
    """Transform a pose from the world's frame into the odometry frame that begins at `start`."""
    dx, dy = pose[0] - start[0], pose[1] - start[1]
    cos, sin = math.cos(start[2]), math.sin(start[2])
    theta = math.remainder(pose[2] - start[2], math.tau)
    return cos * dx + sin * dy, cos * dy - sin * dx, theta


def point_in_world(start: Pose, point: tuple[float, float]) -> tuple[float, float]:
    """Transform a point [m] from the odometry frame that begins at `start` to the world's."""
    x, y, _ = to_world(start, (*point, 0.0))
    return x, y
