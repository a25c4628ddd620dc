"""Segments of boxes and of rooms' walls."""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.worlds.world import Floats


def box(x: float, y: float, length: float, width: float, theta: float = 0.0) -> Floats:
    """Sides of a box around (x, y), (4, 4), rotated by theta [rad]; lengths in m."""
    cos, sin = math.cos(theta), math.sin(theta)
    half = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (length / 2.0, width / 2.0)
    corners = half @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    return np.column_stack([corners, np.roll(corners, -1, axis=0)])


def outline(left: float, low: float, right: float, high: float) -> Floats:
    """Sides of a rectangle along the axes, (4, 4) [m]."""
    return box((left + right) / 2.0, (low + high) / 2.0, right - left, high - low)


def wall(start: tuple[float, float], end: tuple[float, float], doors: Floats) -> Floats:
    """Make a straight wall with gaps.

    Args:
        start: x, y [m].
        end: x, y [m].
        doors: (gaps, 2), where each gap begins and ends, as distances from `start` [m], sorted.

    Returns:
        (segments, 4) [m].
    """
    length = math.dist(start, end)
    edges = np.clip(np.concatenate([[0.0], np.ravel(doors), [length]]), 0.0, length)
    pieces = edges.reshape(-1, 2)
    pieces = pieces[pieces[:, 1] > pieces[:, 0]]
    along = (np.array(end) - start) / length
    ends: Floats = (np.array(start) + pieces.reshape(-1, 1) * along).reshape(-1, 4)
    return ends
