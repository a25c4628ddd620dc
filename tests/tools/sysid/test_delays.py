"""Delays of steps by closed form, and what the two-sample test tells."""

from __future__ import annotations

import math

import numpy as np
import pytest

from acsar_gym.tools.sysid.board_log import Floats
from acsar_gym.tools.sysid.tracks import FEWEST_DELAYS, compare_delays, measure_delays

PERIOD = 0.01


def square(duration: float, half: float, height: float = 5.0) -> tuple[Floats, Floats]:
    """Command lines at 100 Hz: speeds that change between 0 and `height` every `half` seconds."""
    stamps = np.arange(0.0, duration, PERIOD)
    high = (stamps / half + 1e-9).astype(int) % 2 == 1
    return stamps, np.where(high, height, 0.0)[:, None] * np.ones(4)


@pytest.mark.parametrize("delay", [0.012, 0.035])
@pytest.mark.parametrize("wheels", [(1.0, 1.0, 1.0, 1.0), (0.0, 0.0, -1.0, 0.0)])
def test_the_delay_of_a_pure_delay(delay: float, wheels: tuple[float, ...]) -> None:
    stamps, speeds = square(4.0, 0.5)
    speeds = speeds * wheels
    found = measure_delays(stamps, speeds, stamps + delay, speeds)
    assert found == pytest.approx([delay] * 7)


def sample(count: int, mean: float, seed: int) -> Floats:
    """Delays as they are over a wire: up to a period of waiting for the line, and some jitter."""
    rng = np.random.default_rng(seed)
    return mean + rng.uniform(0.0, PERIOD, count) + rng.normal(0.0, 0.001, count)


def test_ten_milliseconds_are_told_from_a_dozen_steps() -> None:
    test = compare_delays(sample(12, 0.030, 0), sample(12, 0.040, 1))
    assert test.differs
    assert test.difference == pytest.approx(0.010, abs=0.003)


def test_jitter_of_the_stamps_is_no_difference() -> None:
    exact = np.repeat([0.082, 0.092], 20)
    stamped = exact + np.random.default_rng(0).uniform(0.0, 0.0008, 40)
    assert compare_delays(exact, stamped).p_value == 1.0
    assert compare_delays(exact, stamped + 0.002).differs
    assert compare_delays(exact + 0.002, stamped).differs


def test_too_few_delays_give_no_test() -> None:
    test = compare_delays(sample(FEWEST_DELAYS - 1, 0.03, 0), sample(50, 0.06, 1))
    assert math.isnan(test.p_value)
    assert not test.differs
    assert test.counts == (FEWEST_DELAYS - 1, 50)
    assert math.isnan(compare_delays(np.array([]), sample(50, 0.06, 1)).difference)
