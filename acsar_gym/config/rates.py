"""Rates that must be integer multiples of each other."""

from __future__ import annotations

import math

from acsar_gym.errors import ConfigError, shown

LEAST_RATE = 0.01
"""Lowest rate of ticks and policy steps [Hz], which bounds the simulated time of a step."""


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


def _number(value: float) -> float:
    """Convert to float; TypeError for strings, which float() would accept."""
    if isinstance(value, str | bytes):
        raise TypeError
    return float(value)
