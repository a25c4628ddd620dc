"""Worlds with a path to follow on an empty floor: smooth, or straight lines between waypoints."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from acsar_gym.errors import WorldError
from acsar_gym.worlds.world import Floats, Region, World

SPACING = 0.05
"""Distance between the points of a sampled path [m]."""
WAVES = 3


def smooth(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make a path of 4 to 8 m from the origin, with a curvature of up to 0.5 to 2 1/m."""
    length = rng.uniform(4.0, 8.0)
    s = np.arange(0.0, length, SPACING)
    waves = rng.uniform(0.5, 2.0, WAVES), rng.uniform(-math.pi, math.pi, WAVES)
    curvature = np.sin(s[:, None] * waves[0] + waves[1]).sum(axis=1)
    curvature *= (0.5 + 1.5 * difficulty) / np.abs(curvature).max()
    heading = np.concatenate([[0.0], np.cumsum(curvature[:-1] * SPACING)])
    steps = SPACING * np.column_stack([np.cos(heading), np.sin(heading)])
    return along(np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]))


def waypoints(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make a path of 3 to 6 lines of 0.8 to 2 m, with turns of up to 45 to 120 degrees."""
    pieces = int(rng.integers(3, 7))
    sharpest = math.radians(45.0 + 75.0 * difficulty)
    turns = rng.uniform(-sharpest, sharpest, pieces)
    turns[0] = 0.0
    heading, lengths = np.cumsum(turns), rng.uniform(0.8, 2.0, pieces)
    steps = lengths[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    return along(np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]))


def along(path: Floats) -> World:
    """Make an empty world with a path to follow; the robot starts on it, heading along it.

    Args:
        path: (points, 2) [m].

    Raises:
        WorldError: unless the path has two different points.
    """
    world = World(path=path)
    if world.path is None or len(world.path) < 2 or not world.length > 0.0:
        raise WorldError("path: must have at least two points (x, y) [m], not all the same")
    points = distinct(world.path)
    x, y = points[0].tolist()
    dx, dy = (points[1] - points[0]).tolist()
    end_x, end_y = points[-1].tolist()
    start = Region(x, y, 0.0, math.atan2(dy, dx))
    return World(start=start, goal=Region(end_x, end_y), path=points)


def to_follow(world: World) -> World:
    """Move a world's start and goal to the ends of its path; the start's heading is along it.

    Raises:
        WorldError: the world has no path.
    """
    if world.path is None:
        raise WorldError(f"{world.name or 'the world'}: has no path to follow")
    ends = along(world.path)
    return replace(world, start=ends.start, goal=ends.goal, path=ends.path)


def distinct(path: Floats) -> Floats:
    """Remove points of a path that repeat the one before them."""
    moved = np.concatenate([[True], np.abs(np.diff(path, axis=0)).sum(axis=1) > 0.0])
    kept: Floats = path[moved]
    return kept


def sampled(path: Floats, spacing: float = SPACING) -> Floats:
    """Sample a path at even distances, its end included.

    Args:
        path: (points, 2) [m].
        spacing: between two samples, at most [m].

    Returns:
        (samples, 3): x [m], y [m] and direction [rad] of the line that follows; at the end that of
        the last line.
    """
    path = distinct(path)
    steps = np.diff(path, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    count = max(2, 1 + math.ceil(at[-1] / spacing - 1e-9))
    s = np.linspace(0.0, at[-1], count)
    piece = np.clip(np.searchsorted(at, s, side="right") - 1, 0, len(steps) - 1)
    share = (s - at[piece]) / lengths[piece]
    points = path[piece] + share[:, None] * steps[piece]
    return np.column_stack([points, np.arctan2(steps[piece, 1], steps[piece, 0])])
