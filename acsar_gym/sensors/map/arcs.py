"""Free ways along arcs: how far a footprint can drive straight on, or in a curve, until it touches.

A skid-steer robot that keeps its velocities drives an arc around a centre on the base's y axis. A
point is described by its distance beside that arc (`across`) and its distance ahead along the arc
(`along`). So is the footprint, whose front depends on `across` and is tabulated for each arc. The
dynamic window approach computes this for its candidates (Fox, Burgard and Thrun, "The dynamic
window approach to collision avoidance", 1997). A policy that had clearances in directions of 7.5
degrees only grazed obstacles that stood 2 cm too near, so it needs these numbers
(docs/experiments.md).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from acsar_gym.config.footprint import Outline, outline_radius, outline_sides
from acsar_gym.jit import jit, subroutine
from acsar_gym.sensors.map.seen import Floats
from acsar_gym.trigonometry import angle_of

CURVATURES = (-0.9, -0.55, -0.3, -0.15, -0.06, 0.0, 0.06, 0.15, 0.3, 0.55, 0.9)
"""Curvatures of the arcs, in units of 1 / radius of the footprint, positive to the left."""
ARCS = len(CURVATURES)
LONGEST_ARC = 8.0
"""A longer free way counts as this, in radii."""
MARGIN = 0.25
"""Free ways are also measured for a footprint that is wider by this on both sides, in radii."""
BANDS = 25
"""Parts of the footprint's width, in each of which its front is tabulated. Their number is odd, so
that an obstacle straight ahead doesn't lie between two of them."""
LEVELS = np.array([0.1, 0.9])
"""Places in a band at which its front is looked up, as shares of its width."""
OUTLINE_POINTS = 96
"""Approximate number of points that represent the outline."""
BEHIND = -1e9
"""Place of a second part of a band that has no second part [m]."""
FRONT, LATEST_FRONT, BACK, SECOND_FRONT = range(4)
"""Columns of a band: how far its front reaches along the arc at most and at least, the back of that
part, and the front of a part behind it [m]."""


@jit
def along_arc(x: float, y: float, curvature: float) -> tuple[float, float]:
    """Return where a point of the base frame lies beside an arc, to the left, and along it [m].

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

    A slanted front differs within a band: an obstacle beyond the latest part of it counts as
    touched already.

    Args:
        outline: Corners of the footprint.

    Returns:
        (ARCS, 2): Least and greatest `across` of the footprint, and (ARCS, BANDS, 4): its bands.
    """
    # Points along the outline, because arcs bend it: its corners alone don't bound it.
    radius = outline_radius(outline)
    steps = np.arange(0.0, 1.0, len(outline) / OUTLINE_POINTS)
    edge = np.concatenate(
        [np.asarray(a) + steps[:, None] * np.subtract(b, a) for a, b in outline_sides(outline)]
    )
    spans = np.empty((ARCS, 2))
    fronts = np.empty((ARCS, BANDS, 4))
    for arc, curvature in enumerate(CURVATURES):
        points = [along_arc(float(x), float(y), curvature / radius) for x, y in edge]
        across, along = np.array(points).T
        next_across = np.roll(across, -1)
        low = across.min()
        high = across.max()
        spans[arc] = low, high

        # Where the outline crosses each level, the farthest three crossings last.
        levels = low + (high - low) * (np.arange(BANDS)[:, None, None] + LEVELS[:, None]) / BANDS
        crosses = (across > levels) != (next_across > levels)
        slope = (np.roll(along, -1) - along) / np.where(crosses, next_across - across, 1.0)
        crossings = np.where(crosses, along + slope * (levels - across), BEHIND)
        second_front, back, front = np.sort(crossings, axis=2)[:, :, -3:].transpose(2, 0, 1)
        fronts[arc, :, FRONT] = front.max(axis=1)
        fronts[arc, :, LATEST_FRONT] = front.min(axis=1)
        fronts[arc, :, BACK] = back.min(axis=1)
        fronts[arc, :, SECOND_FRONT] = second_front.max(axis=1)
    return spans, fronts


@subroutine
def measure_arcs(spans: Floats, fronts: Floats, radius: float, spots: Floats, out: Floats) -> None:
    """Measure the free way along each arc.

    Args:
        spans: First table of `tabulate_arcs`.
        fronts: Second table of `tabulate_arcs`.
        radius: Radius of the footprint [m].
        spots: (n, 2): Obstacles in the base frame [m].
        out: (2 ARCS,): Gets the free ways, then those of the wider footprint, in radii.
    """
    margin = MARGIN * radius
    for arc in range(ARCS):
        curvature = CURVATURES[arc] / radius
        low = spans[arc, 0]
        high = spans[arc, 1]
        free = LONGEST_ARC * radius
        wide = free
        for n in range(len(spots)):
            across, along = along_arc(spots[n, 0], spots[n, 1], curvature)
            if across < low - margin or across > high + margin:
                continue

            # The front that meets the obstacle: that of its band, or that of a part behind it.
            band = min(max(int((across - low) / (high - low) * BANDS), 0), BANDS - 1)
            if along >= fronts[arc, band, LATEST_FRONT]:
                gap = max(along - fronts[arc, band, FRONT], 0.0)
            elif fronts[arc, band, SECOND_FRONT] <= along < fronts[arc, band, BACK]:
                gap = along - fronts[arc, band, SECOND_FRONT]
            else:
                continue
            # The wider footprint has the fronts of its outermost bands.
            wide = min(wide, gap)
            if low <= across <= high:
                free = min(free, gap)
        out[arc] = free / radius
        out[ARCS + arc] = wide / radius
