"""What predicted motions are scored by: obstacles, footprint, and the way left to the goal."""

from __future__ import annotations

import math
from typing import NamedTuple

from acsar_gym.baselines.geometry import clearance
from acsar_gym.baselines.potential import interpolated
from acsar_gym.jit import jit, loop
from acsar_gym.tasks.base import Floats

State = tuple[float, float, float, float, float, float, float]
"""Pose (x, y, theta), twist, and last command (linear, angular) [m, rad, s]."""


class Around(NamedTuple):
    """What surrounds the robot, in the frame of its pose."""

    near: Floats
    """(n, 2): obstacles [m]."""
    sides: Floats
    """(sides, 4): of the footprint, in the base frame [m]."""
    outer: float
    """Radius of the disc around the footprint [m]."""
    values: Floats
    """The navigation function at the centres of its cells [m]."""
    left: float
    """x of its first cell [m], with y the next one."""
    low: float
    x: float
    """Of the goal [m]."""
    y: float
    radius: float
    """Of the goal [m]."""


@loop
def free_at(x: float, y: float, theta: float, around: Around, most: float) -> float:
    """Clearance of the footprint at a pose, at most `most` [m]."""
    return clearance(x, y, theta, around.near, around.sides, around.outer, most)


@jit
def arrived(x: float, y: float, around: Around) -> bool:
    """Whether a place is within the goal."""
    dx, dy = around.x - x, around.y - y
    return dx * dx + dy * dy < around.radius * around.radius


@loop
def way_left(x: float, y: float, theta: float, nose: float, around: Around) -> float:
    """The navigation function `nose` ahead of a pose, so that the heading matters [m]."""
    ahead_x, ahead_y = x + nose * math.cos(theta), y + nose * math.sin(theta)
    return interpolated(around.values, around.left, around.low, ahead_x, ahead_y)
