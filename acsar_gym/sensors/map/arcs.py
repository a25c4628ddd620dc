"""Free ways along arcs: how far a footprint can drive straight on, or in a curve, until it touches.

A skid-steer robot that keeps its velocities drives an arc around a centre on the base's y axis. A
point is described by where it lies beside that arc (`across`) and how far ahead (`along`, measured
along the arc), and so is the footprint, whose front depends on `across`: it is tabulated for each
arc. What the dynamic window approach computes for its candidates (Fox, Burgard and Thrun, "The
dynamic window approach to collision avoidance", 1997), a policy gets as numbers, because clearances
in directions don't say whether the robot passes an obstacle by a hair.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config.footprint import Outline, outline_radius, outline_sides
from acsar_gym.jit import jit, subroutine
from acsar_gym.trigonometry import angle_of

Floats = NDArray[np.float64]
CURVATURES = (-0.9, -0.55, -0.3, -0.15, -0.06, 0.0, 0.06, 0.15, 0.3, 0.55, 0.9)
"""Of the arcs, in units of 1 / radius of the footprint; positive to the left."""
ARCS = len(CURVATURES)
LONGEST_ARC = 8.0
"""A longer free way counts as this one, in radii."""
MARGIN = 0.25
"""Free ways are also measured for a footprint that is wider by this on both sides, in radii."""
BANDS = 25
"""Parts of the footprint's width, in each of which its front is tabulated; odd, so that what is
straight ahead doesn't lie between two."""
LEVELS = np.array([0.1, 0.9])
"""Places within a band where its front is looked up, in parts of its width."""
OUTLINE_POINTS = 96
"""The outline is looked at in so many points, about."""
BEHIND = -1e9
"""Where a band of the footprint has no second part [m]."""


@jit
def along_arc(x: float, y: float, curvature: float) -> tuple[float, float]:
    """Where a point of the base frame lies beside an arc, to the left, and how far along it [m].

    What the robot would meet after more than half a turn lies behind it.
    """
    if curvature == 0.0:
        return y, x
    distance = 1.0 / abs(curvature)
    side = 1.0 if curvature > 0.0 else -1.0
    inward = distance - side * y
    across = side * (distance - math.sqrt(x * x + inward * inward))
    return across, distance * angle_of(inward, x)


@lru_cache(maxsize=1024)
def tabulate_arcs(outline: Outline) -> tuple[Floats, Floats]:
    """Tabulate a footprint's fronts along the arcs.

    A slanted front differs within a band: what lies beyond a part of it counts as touched already.

    Returns:
        (ARCS, 2): the least and the greatest `across` of the footprint, and (ARCS, BANDS, 4): of
        each band of it, how far its front reaches along the arc, at most and at least, that part's
        back, and the front of the part behind it [m].
    """
    radius = outline_radius(outline)
    steps = np.arange(0.0, 1.0, len(outline) / OUTLINE_POINTS)
    edge = np.concatenate(
        [np.asarray(a) + steps[:, None] * np.subtract(b, a) for a, b in outline_sides(outline)]
    )
    spans, fronts = np.empty((ARCS, 2)), np.empty((ARCS, BANDS, 4))
    for arc, curvature in enumerate(CURVATURES):
        points = [along_arc(float(x), float(y), curvature / radius) for x, y in edge]
        across, along = np.array(points).T
        next_across, next_along = np.roll(across, -1), np.roll(along, -1)
        low, high = across.min(), across.max()
        levels = low + (high - low) * (np.arange(BANDS)[:, None, None] + LEVELS[:, None]) / BANDS
        met = (across > levels) != (next_across > levels)
        slope = (next_along - along) / np.where(met, next_across - across, 1.0)
        crossed = np.where(met, along + slope * (levels - across), BEHIND)
        nearest = np.sort(crossed, axis=2)[:, :, -3:]  # (BANDS, levels, 3)
        spans[arc] = low, high
        fronts[arc, :, 0] = nearest[:, :, 2].max(axis=1)
        fronts[arc, :, 1] = nearest[:, :, 2].min(axis=1)
        fronts[arc, :, 2] = nearest[:, :, 1].min(axis=1)
        fronts[arc, :, 3] = nearest[:, :, 0].max(axis=1)
    return spans, fronts


@subroutine
def measure_arcs(spans: Floats, fronts: Floats, radius: float, spots: Floats, out: Floats) -> None:
    """Measure the free way along each arc."""
    margin = MARGIN * radius
    for arc in range(ARCS):
        curvature = CURVATURES[arc] / radius
        low, high = spans[arc, 0], spans[arc, 1]
        free = wide = LONGEST_ARC * radius
        for n in range(len(spots)):
            across, along = along_arc(spots[n, 0], spots[n, 1], curvature)
            if across < low - margin or across > high + margin:
                continue
            band = min(max(int((across - low) / (high - low) * BANDS), 0), BANDS - 1)
            if along >= fronts[arc, band, 1]:
                gap = max(along - fronts[arc, band, 0], 0.0)
            elif fronts[arc, band, 3] <= along < fronts[arc, band, 2]:
                gap = along - fronts[arc, band, 3]
            else:
                continue
            wide = min(wide, gap)
            if low <= across <= high:
                free = min(free, gap)
        out[arc], out[ARCS + arc] = free / radius, wide / radius
