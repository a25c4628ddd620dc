"""Times of lines without the jitter of the host."""

from __future__ import annotations

import numpy as np
import pytest

from acsar_gym.recording.replay import remove_jitter

PERIOD = 0.02


def test_exact_times_stay() -> None:
    stamps = np.linspace(3.0, 3.0 + 499 * PERIOD, 500)
    assert remove_jitter(stamps, PERIOD) == pytest.approx(stamps, abs=1e-9)


@pytest.mark.parametrize("rate", [0.99, 1.0, 1.01])
def test_late_lines_are_moved_back(rate: float) -> None:
    rng = np.random.default_rng(0)
    true = 5.0 + rate * PERIOD * np.arange(1000)
    late = np.maximum.accumulate(true + rng.exponential(0.002, 1000))
    assert np.abs(late - true).max() > 0.008
    assert np.quantile(np.abs(remove_jitter(late, PERIOD) - true), 0.99) < 0.0015


def test_lost_lines_and_a_jump_of_the_clock_are_followed() -> None:
    true = PERIOD * np.arange(600)
    true[300:] += 0.007
    kept = np.delete(true, [40, 41, 42, 300, 500])
    errors = np.abs(remove_jitter(kept, PERIOD) - kept)
    assert errors.max() < 0.008
    assert np.median(errors) < 0.001


def test_what_isnt_periodic_stays() -> None:
    stamps = np.cumsum(np.random.default_rng(0).uniform(0.001, 0.1, 200))
    assert remove_jitter(stamps, PERIOD).tolist() == stamps.tolist()
    few = np.array([0.0, 0.02])
    assert remove_jitter(few, PERIOD) is few
    assert remove_jitter(np.zeros(9), PERIOD).tolist() == [0.0] * 9
