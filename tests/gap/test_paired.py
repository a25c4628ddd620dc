"""Paired differences: published intervals, closed forms, and what pairing is good for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from acsar_gym.tools.sysid.sim_real import compare_means, compare_rates, paired_rate_interval


def test_newcombes_own_example() -> None:
    found = paired_rate_interval(
        36, 12, 2, 0
    )  # the first of his table; he subtracts the other way round
    assert (-found[1], -found[0]) == pytest.approx((0.0569, 0.3404), abs=5e-5)


def test_sides_may_be_exchanged() -> None:
    one, other = paired_rate_interval(19, 7, 1, 3), paired_rate_interval(19, 1, 7, 3)
    assert one == pytest.approx((-other[1], -other[0]))


def test_the_sign_is_second_minus_first() -> None:
    better = compare_rates([0.0] * 20, [1.0] * 20, [(0.0, 1.0)] * 20)
    assert better.values == (0.0, 1.0)
    assert better.difference == 1.0
    assert better.interval[0] > 0.7
    assert better.differs


def test_equal_outcomes_arent_certain_to_be_equal() -> None:
    same = compare_rates([1.0] * 20, [1.0] * 20, [(1.0, 1.0)] * 20)
    assert same.difference == 0.0
    assert same.interval[0] < -0.05
    assert same.interval[1] > 0.05
    assert not same.differs


def test_pairing_sees_what_means_hide() -> None:
    rng = np.random.default_rng(0)
    first = rng.uniform(2.0, 8.0, 20)
    second = first + rng.normal(0.2, 0.05, 20)
    found = compare_means(first.tolist(), second.tolist(), list(zip(first, second, strict=True)))
    assert found.intervals[0][1] > found.values[1]
    assert found.interval[0] < 0.2 < found.interval[1]
    assert found.differs


def test_what_isnt_known_is_left_out() -> None:
    found = compare_means([1.0, math.nan], [2.0], [(1.0, 2.0), (math.nan, 3.0)])
    assert (found.counts, found.pairs, found.difference) == ((1, 1), 1, 1.0)
    nothing = compare_rates([], [], [])
    assert math.isnan(nothing.difference)
    assert math.isnan(nothing.interval[0])
    assert not nothing.differs
