"""Rates that must be whole multiples of each other."""

from __future__ import annotations

import math

from acsar_gym.errors import ConfigError, shown

LEAST_RATE = 0.01
"""Of ticks and of a policy's steps [Hz]: slower ones would simulate for ever."""


def whole_ratio(fast_name: str, fast: float, slow_name: str, slow: float) -> int:
    """The ratio fast / slow as an int.

    Raises ConfigError unless it is a whole number of at least 1, or where slow is below 0.01 Hz.
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
    if isinstance(value, str | bytes):
        raise TypeError
    return float(value)
