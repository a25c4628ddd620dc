"""Rates that must be integer multiples of each other, and times that must fit them."""

from __future__ import annotations

import math

from acsar_gym.errors import ConfigError, shown

LEAST_RATE = 0.01
"""Lowest rate of ticks and policy steps [Hz], which bounds the simulated time of a step."""

MOST_SAMPLES = 2_000
"""Most encoder readings that the simulated firmware stores for averaging."""


def whole_ratio(fast_name: str, fast: float, slow_name: str, slow: float) -> int:
    """Return the ratio of two rates.

    Args:
        fast_name: name of the faster rate, for the message.
        fast: [Hz].
        slow_name: name of the slower rate, for the message.
        slow: [Hz].

    Returns:
        fast / slow as an int.

    Raises:
        ConfigError: it isn't an integer of at least 1, or `slow` is below 0.01 Hz.
    """
    try:
        fast, slow = _number(fast), _number(slow)
        ratio = fast / slow
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        ratio = math.nan
    if not ratio > 0.0:
        raise ConfigError(f"{slow_name} = {shown(slow)}: must be a positive number of Hz")
    if slow < LEAST_RATE:
        raise ConfigError(f"{slow_name} = {slow:g} Hz: must be at least {LEAST_RATE:g} Hz")
    whole = round(min(ratio, 1e9))
    if whole < 1 or not math.isclose(ratio, whole, rel_tol=1e-9):
        raise ConfigError(
            f"{fast_name} = {fast:g} Hz: must be a whole multiple of {slow_name} = {slow:g} Hz"
        )
    return whole


def check_feedback(rate: float, timeout: float, loop: float) -> None:
    """Check how often a board sends.

    Args:
        rate: lines per second [Hz].
        timeout: longest time without a line [s].
        loop: the firmware's loop rate [Hz].

    Raises:
        ConfigError: the rate is above `loop`, or the time-out below one and a half periods.
    """
    if rate > loop:
        raise ConfigError(
            f"firmware.feedback_rate = {rate:g} Hz: must be at most "
            f"firmware.loop_rate = {loop:g} Hz"
        )
    if timeout < 1.5 / rate:
        raise ConfigError(
            f"feedback_timeout = {timeout:g} s: must be at least one and a half "
            f"periods of the feedback at {rate:g} Hz"
        )


def check_window(window: float, loop: float) -> None:
    """Check the averaging time of the encoders.

    Args:
        window: averaging time [s].
        loop: the firmware's loop rate [Hz].

    Raises:
        ConfigError: it is shorter than one loop, or longer than `MOST_SAMPLES` of them.
    """
    if window * loop < 1.0 - 1e-9:
        raise ConfigError(
            f"encoder.window = {window:g} s: must be at least one period of "
            f"firmware.loop_rate ({1.0 / loop:g} s)"
        )
    if window * loop > MOST_SAMPLES:
        raise ConfigError(
            f"encoder.window = {window:g} s: must be at most {MOST_SAMPLES:,} "
            f"periods of firmware.loop_rate ({MOST_SAMPLES / loop:g} s)"
        )


def _number(value: float) -> float:
    """Convert to float; TypeError for strings, which float() would accept."""
    if isinstance(value, str | bytes):
        raise TypeError
    return float(value)
