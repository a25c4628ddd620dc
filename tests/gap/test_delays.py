"""Delays of steps by closed form, and what the two-sample test tells."""

from __future__ import annotations

import math

import numpy as np
import pytest

from acsar_gym.tools.sysid.delays import (
    FEWEST_DELAYS,
    Floats,
    compare_delays,
    find_steps,
    measure_delays,
)

PERIOD = 0.01


def square(duration: float, half: float, height: float = 5.0) -> tuple[Floats, Floats]:
    """Command lines at 100 Hz: speeds that change between 0 and `height` every `half` seconds."""
    stamps = np.arange(0.0, duration, PERIOD)
    high = (stamps / half + 1e-9).astype(int) % 2 == 1
    return stamps, np.where(high, height, 0.0)[:, None] * np.ones(4)


def answered(commands: tuple[Floats, Floats], delay: float) -> tuple[Floats, Floats]:
    """Feedback lines that repeat the commands `delay` later."""
    return commands[0] + delay, commands[1]


def test_steps_are_changes_after_a_held_command() -> None:
    stamps, speeds = square(2.0, 0.5)
    begun = find_steps(stamps, speeds)
    assert np.allclose(stamps[begun.any(axis=1)], [0.5, 1.0, 1.5])
    assert begun.sum() == 3 * 4


def test_a_ramp_is_one_step() -> None:
    stamps = np.arange(0.0, 1.0, PERIOD)
    ramp = np.clip((stamps - 0.5) * 40.0, 0.0, 5.0)[:, None] * np.ones(4)
    assert np.allclose(stamps[find_steps(stamps, ramp).any(axis=1)], [0.51])


def test_a_ramps_delay_is_that_between_command_and_feedback() -> None:
    stamps = np.arange(0.0, 1.0, PERIOD)
    ramp = np.clip((stamps - 0.5) * 20.0, 0.0, 5.0)[:, None] * np.array([1.0, -0.5, -0.5, 1.0])
    assert measure_delays(stamps, ramp, stamps + 0.03, ramp) == pytest.approx([0.03])


def test_a_log_begins_at_rest() -> None:
    stamps = np.arange(0.0, 0.2, PERIOD)
    speeds = np.where(stamps > 0.015, 5.0, 0.0)[:, None] * np.ones(4)
    assert measure_delays(stamps, speeds, stamps + 0.005, speeds) == pytest.approx([0.005])
    assert not find_steps(stamps, speeds + 1.0).any()


def test_a_step_faster_than_the_hold_is_none() -> None:
    stamps, speeds = square(2.0, 0.1)
    assert find_steps(stamps, speeds).any(axis=1).sum() <= 1


@pytest.mark.parametrize("delay", [0.012, 0.035])
def test_the_delay_of_a_pure_delay(delay: float) -> None:
    commands = square(4.0, 0.5)
    assert measure_delays(*commands, *answered(commands, delay)) == pytest.approx([delay] * 7)


def test_one_wheel_is_enough() -> None:
    stamps, speeds = square(4.0, 0.5)
    speeds = speeds * np.array([0.0, 0.0, -1.0, 0.0])
    assert measure_delays(stamps, speeds, stamps + 0.02, speeds) == pytest.approx([0.02] * 7)


def test_wheels_that_step_at_different_times_have_steps_of_their_own() -> None:
    stamps = np.arange(0.0, 4.0, PERIOD)
    starts = np.array([0.0, 0.1, 0.2, 0.3])  # no 0.15 s without a change of some wheel
    high = ((stamps[:, None] - starts) / 0.4 + 1e-9).astype(int) % 2 == 1
    speeds = np.where(high, 5.0, 0.0)
    found = measure_delays(stamps, speeds, stamps + 0.02, speeds)
    assert found == pytest.approx([0.02] * int(find_steps(stamps, speeds).sum()))
    assert len(found) > 30


def test_a_wheel_that_still_turns_hides_its_own_steps_only() -> None:
    commands = square(4.0, 0.5)
    turning = commands[1].copy()
    turning[:, 1] = 10.0 * commands[0]
    only = commands[1] * np.array([1.0, 0.0, 0.0, 0.0])
    assert measure_delays(commands[0], only, commands[0] + 0.02, turning) == pytest.approx(
        [0.02] * 7
    )


def test_wheels_that_dont_move_have_no_delay() -> None:
    commands = square(4.0, 0.5)
    assert np.isnan(measure_delays(*commands, commands[0], np.zeros_like(commands[1]))).all()


def test_wheels_that_still_turn_are_left_out() -> None:
    commands = square(4.0, 0.5)
    turning = commands[0][:, None] * np.ones(4) * 10.0
    assert np.isnan(measure_delays(*commands, commands[0], turning)).all()


@pytest.mark.parametrize("lines", [0, 1])
def test_an_empty_log_has_no_delay(lines: int) -> None:
    stamps, speeds = square(4.0, 0.5)
    assert len(measure_delays(stamps[:lines], speeds[:lines], stamps[:lines], speeds[:lines])) == 0


def sample(count: int, mean: float, seed: int) -> Floats:
    """Delays as they are over a wire: up to a period of waiting for the line, and some jitter."""
    rng = np.random.default_rng(seed)
    return mean + rng.uniform(0.0, PERIOD, count) + rng.normal(0.0, 0.001, count)


def test_ten_milliseconds_are_told_from_a_dozen_steps() -> None:
    test = compare_delays(sample(12, 0.030, 0), sample(12, 0.040, 1))
    assert test.differs
    assert test.interval[0] < 0.010 < test.interval[1]
    assert test.difference == pytest.approx(0.010, abs=0.003)


def test_equal_distributions_are_rarely_told_apart() -> None:
    tests = [
        compare_delays(sample(30, 0.03, 2 * n), sample(30, 0.03, 2 * n + 1)) for n in range(40)
    ]
    assert sum(test.differs for test in tests) <= 5
    assert sum(test.interval[0] < 0.0 < test.interval[1] for test in tests) >= 34


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
