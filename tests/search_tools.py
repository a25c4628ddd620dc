"""Worlds that are searched, and lengths of ways in them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from acsar_gym.worlds.geometry import point_clearance, segment_clearance
from acsar_gym.worlds.world import Floats, Region, World

CUT = 2e-3
"""How much nearer than its radius a path may come to an obstacle [m]."""
ROUGHLY = 1.04
"""Times as long as by hand."""
RESOLVED = 0.04
"""Room on both sides of a disc in which the search finds a way, a cell's half diagonal [m]."""


def array(*rows: Any) -> Any:
    return np.array(rows, np.float64)


PILLAR = array([0.0, 0.0, 0.5])


def between(start: Any, goal: Any, circles: Any = (), segments: Any = (), name: str = "") -> World:
    return World(
        circles, segments, Region(*map(float, start)), Region(*map(float, goal)), name=name
    )


def closest(path: Floats, world: World) -> float:
    return float(segment_clearance(path[:-1], path[1:], world).min())


def polar(radius: float, angle: float) -> Any:
    return radius * array(math.cos(angle), math.sin(angle))


def around(start: Any, goal: Any, centre: Any, radius: float, *, reflex: bool = False) -> float:
    """Tangent, arc, tangent: the shortest way round a disc on one of its sides."""
    a, b = np.subtract(start, centre), np.subtract(goal, centre)
    far = math.hypot(*a), math.hypot(*b)
    angle = math.acos(max(-1.0, float(a @ b) / far[0] / far[1]))
    angle = math.tau - angle if reflex else angle
    tangents = [math.sqrt(d * d - radius * radius) for d in far]
    return sum(tangents) + radius * (angle - sum(math.acos(radius / d) for d in far))


def random_world(seed: int, radius: float) -> World:
    """Circles and segments, start and goal with room around them."""
    rng = np.random.default_rng(seed)
    circles = np.column_stack([rng.uniform(-2, 2, (8, 2)), rng.uniform(0.0, 0.4, 8)])
    starts = rng.uniform(-2, 2, (4, 2))
    segments = np.column_stack([starts, starts + rng.uniform(-1, 1, (4, 2))])
    everywhere = rng.uniform(-2.6, 2.6, (400, 2))
    free = point_clearance(everywhere, World(circles, segments)) > radius + RESOLVED
    ends = everywhere[free][:2]
    return between(ends[0], ends[1], circles, segments)
