"""The resolution of printed speeds."""

from __future__ import annotations

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.tools.sysid import feedback_lines

SPEEDS = np.random.default_rng(3).uniform(-11.0, 11.0, 3000)


@pytest.mark.parametrize("step", [0.027, 0.05, 0.0871, 0.12, 0.3])
def test_a_step_is_found_under_the_rounding_to_two_decimals(step: float) -> None:
    found = feedback_lines.find_quantum(np.round(step * np.round(SPEEDS / step), 2))
    assert found is not None
    assert found.step == pytest.approx(step, abs=2e-4)
    assert found.low <= step <= found.high


def test_a_board_that_cuts_digits_has_a_step_too() -> None:
    found = feedback_lines.find_quantum(np.trunc(0.087 * np.round(SPEEDS / 0.087) * 100.0) / 100.0)
    assert found is not None
    assert found.step == pytest.approx(0.087, abs=5e-4)


def test_damaged_lines_hide_no_step() -> None:
    printed = np.round(0.12 * np.round(SPEEDS / 0.12), 2)
    printed[:10] = 7.31
    found = feedback_lines.find_quantum(printed)
    assert found is not None
    assert found.step == pytest.approx(0.12, abs=1e-3)


def test_numbers_without_steps_are_finer_than_two_decimals_show() -> None:
    found = feedback_lines.find_quantum(np.round(SPEEDS, 2))
    assert found is not None
    assert (found.step, found.low) == (0.01, 0.0)


def test_too_few_speeds_tell_nothing() -> None:
    assert feedback_lines.find_quantum(np.round(SPEEDS[:10], 2)) is None


def test_encoder_counts_are_recognized_below_a_coarser_rounding() -> None:
    config = RobotConfig.preset("acsar")
    count = feedback_lines.count_speed(config, 0.05)
    printed = np.round(0.05 * np.round(count * np.round(SPEEDS / count) / 0.05), 2)
    assert feedback_lines.is_explained_by_counts(printed, config, 0.05, 0.05)
    assert not feedback_lines.is_explained_by_counts(printed, config, 0.045, 0.05)
