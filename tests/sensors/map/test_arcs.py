"""Free ways along arcs are those of the exact footprint."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from acsar_gym.config.footprint import (
    border_distance,
    contains_point,
    make_rectangle,
    outline_radius,
)
from acsar_gym.sensors.map.arcs import (
    ARCS,
    CURVATURES,
    LONGEST_ARC,
    MARGIN,
    along_arc,
    measure_arcs,
    tabulate_arcs,
)

CIRCLE = tuple((0.3 * math.cos(a), 0.3 * math.sin(a)) for a in np.arange(16) * math.tau / 16)
OUTLINES = [
    make_rectangle(0.5, 0.4),
    make_rectangle(0.4, 0.7),
    CIRCLE,
    ((0.3, 0.0), (-0.1, 0.2), (-0.2, -0.25)),
]
STEP = 0.005
PLACES = st.floats(-1.5, 1.5)


def measure(outline: Any, *spots: tuple[float, float]) -> Any:
    """(2, ARCS): free ways, and those of the wider footprint [m]."""
    radius, out = outline_radius(outline), np.empty(2 * ARCS)
    measure_arcs(*tabulate_arcs(outline), radius, np.array(spots).reshape(-1, 2), out)
    return out.reshape(2, ARCS) * radius


def drive(outline: Any, arc: int, spot: tuple[float, float]) -> tuple[float, float]:
    """Drive along an arc until the spot is inside of the outline.

    Returns:
        How far that is, for half a turn at most [m], and the least distance from spot to border on
        the way of the longest arc [m].
    """
    curvature, nearest = CURVATURES[arc] / outline_radius(outline), math.inf
    longest = LONGEST_ARC * outline_radius(outline)
    if curvature:
        longest = min(longest, math.pi / abs(curvature))
    for far in np.arange(0.0, longest, STEP):
        turn = far * curvature
        x = math.sin(turn) / curvature if curvature else far
        y = (1.0 - math.cos(turn)) / curvature if curvature else 0.0
        c, s = math.cos(turn), math.sin(turn)
        seen = c * (spot[0] - x) + s * (spot[1] - y), c * (spot[1] - y) - s * (spot[0] - x)
        nearest = min(nearest, border_distance(outline, *seen))
        if contains_point(outline, *seen):
            return float(far), 0.0
    return math.inf, nearest


@given(st.sampled_from(OUTLINES), st.integers(0, ARCS - 1), PLACES, PLACES)
def test_what_touches_is_found_no_later_than_it_touches(
    outline: Any, arc: int, x: float, y: float
) -> None:
    grazing = 0.1 * outline_radius(outline)  # what a slanted front differs by within a band
    assume(not contains_point(outline, x, y) and border_distance(outline, x, y) > grazing)
    touched, nearest = drive(outline, arc, (x, y))
    told = measure(outline, (x, y))[0, arc]
    ahead = along_arc(x, y, CURVATURES[arc] / outline_radius(outline))[1] >= 0.0
    if touched < (math.inf if ahead else drive_limit(outline, arc)):  # half a turn counts
        assert told <= touched + grazing
    elif nearest > grazing:
        assert told >= LONGEST_ARC * outline_radius(outline) * 0.999 or told > drive_limit(
            outline, arc
        )


def drive_limit(outline: Any, arc: int) -> float:
    """What `drive` drives at most, less the footprint's own length [m]."""
    radius = outline_radius(outline)
    curvature = abs(CURVATURES[arc]) / radius
    return (math.pi / curvature if curvature else math.inf) - 2.2 * radius


@pytest.mark.parametrize(("x", "wanted"), [(0.6, 0.35), (0.2501, 0.0), (2.0, 1.75)])
def test_straight_ahead_it_is_the_distance_from_the_front(x: float, wanted: float) -> None:
    ways = measure(make_rectangle(0.5, 0.4), (x, 0.1))
    assert ways[:, ARCS // 2] == pytest.approx([wanted, wanted], abs=1e-3)


def test_what_passes_beside_the_footprint_counts_for_the_wider_one() -> None:
    outline = make_rectangle(0.5, 0.4)
    longest, margin = LONGEST_ARC * outline_radius(outline), MARGIN * outline_radius(outline)
    beside = measure(outline, (1.0, 0.2 + 0.5 * margin))[:, ARCS // 2]
    assert beside == pytest.approx([longest, 0.75], abs=1e-3)
    far = measure(outline, (1.0, 0.2 + 1.01 * margin))[:, ARCS // 2]
    assert far == pytest.approx([longest, longest])
