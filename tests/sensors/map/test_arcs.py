"""Free ways along arcs are those of the exact footprint."""

from __future__ import annotations

import cmath
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

RECTANGLE = make_rectangle(0.5, 0.4)
TRIANGLE = ((0.3, 0.0), (-0.1, 0.2), (-0.2, -0.25))
STRAIGHT = CURVATURES.index(0.0)


def measure(outline: Any, x: float, y: float) -> Any:
    """(2, ARCS): Free ways, and those of the wider footprint [m]."""
    radius = outline_radius(outline)
    out = np.empty((2, ARCS))
    spots = np.array([[x, y]])
    measure_arcs(*tabulate_arcs(outline), radius, spots=spots, out=out.ravel())
    return out * radius


@given(
    st.sampled_from([RECTANGLE, make_rectangle(0.4, 0.7), TRIANGLE]),
    st.integers(0, ARCS - 1),
    st.complex_numbers(max_magnitude=2.0),
)
def test_measure_arcs_of_a_footprint_that_is_driven_along_an_arc_touches_where_the_free_way_ends(
    outline: Any, arc: int, spot: complex
) -> None:
    radius = outline_radius(outline)
    curvature = CURVATURES[arc] / radius
    tolerance = 0.1 * radius  # a slanted front differs by this within a band
    assume(not contains_point(outline, spot.real, spot.imag))
    assume(border_distance(outline, spot.real, spot.imag) > tolerance)
    assume(along_arc(spot.real, spot.imag, curvature)[1] >= 0.0)

    free = measure(outline, spot.real, spot.imag)[0, arc]
    half_turn = math.pi / abs(curvature) if curvature else math.inf
    nearest = math.inf
    for way in np.arange(0.0, min(LONGEST_ARC * radius, half_turn), 0.005):
        turn = way * curvature
        driven = (cmath.exp(1j * turn) - 1.0) / (1j * curvature) if curvature else way
        relative = (spot - driven) * cmath.exp(-1j * turn)
        nearest = min(nearest, border_distance(outline, relative.real, relative.imag))
        if contains_point(outline, relative.real, relative.imag):
            assert free <= way + tolerance
            return
    if nearest > tolerance:
        assert free >= min(0.999 * LONGEST_ARC * radius, half_turn - 2.2 * radius)


@pytest.mark.parametrize(("share", "wide"), [(0.5, 0.75), (1.01, None)])
def test_measure_arcs_of_the_wider_footprint(share: float, wide: float | None) -> None:
    radius = outline_radius(RECTANGLE)
    longest = LONGEST_ARC * radius
    ways = measure(RECTANGLE, 1.0, 0.2 + share * MARGIN * radius)
    assert ways[:, STRAIGHT] == pytest.approx([longest, wide or longest], abs=1e-3)
