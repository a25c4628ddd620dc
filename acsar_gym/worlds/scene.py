"""What a simulated link builds when it is reset."""

from __future__ import annotations

from dataclasses import dataclass

Pose = tuple[float, float, float]
"""x [m], y [m], theta [rad]."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A robot at rest at `start`, and a marker at `goal` for pictures only."""

    start: Pose = (0.0, 0.0, 0.0)
    goal: tuple[float, float] | None = None
