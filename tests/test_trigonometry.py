"""The functions of compiled loops are those of the C library."""

from __future__ import annotations

import math

import numpy as np
import pytest

from acsar_gym.trigonometry import angle_of, sincos


@pytest.mark.parametrize("largest", [math.tau, 1e4])
def test_sincos_is_exact_in_both_directions(largest: float) -> None:
    angles = np.linspace(-largest, largest, 5003).tolist()
    expected = [(math.sin(angle), math.cos(angle)) for angle in angles]
    assert [*map(sincos, angles)] == pytest.approx(np.array(expected), abs=2e-15)


def test_angle_of_is_exact_in_all_quarters() -> None:
    angles = np.linspace(-math.pi, math.pi, 5003)[1:-1]
    for length in (1e-6, 1.0, 1e6):
        vectors = zip(length * np.cos(angles), length * np.sin(angles), strict=True)
        assert [angle_of(x, y) for x, y in vectors] == pytest.approx(angles, abs=2e-8)
    assert angle_of(0.0, 0.0) == 0.0
    assert angle_of(-1.0, 0.0) == pytest.approx(math.pi)
