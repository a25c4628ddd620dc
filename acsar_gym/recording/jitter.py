"""Takes the jitter of the host out of the times at which a board's lines arrived."""

from __future__ import annotations

import numpy as np

from acsar_gym.errors import optional
from acsar_gym.recording.wire_log import Floats

WINDOW = 50
"""Number of lines over which the board's clock is followed."""
RANK = 2
"""How many earlier lines of a window may be late by more than half a period."""
REGULAR = 0.25
"""Lines count as periodic if half of them are late by less than this share of the period."""


def steady(stamps: Floats, period: float) -> Floats:
    """Estimate when nearly periodic lines would have arrived without delays by the host.

    A board sends its lines by its own clock; its host's scheduler and adapter see them at that time
    or later. So within a window the phase of the earliest lines is that of the board's clock, and
    every line is late by what its phase is after it.

    Args:
        stamps: (k,) times of arrival [s], ascending.
        period: nominal period [s]; the board's own may differ by a few percent.

    Returns:
        (k,) times [s]; those given, if the lines aren't periodic or too few.
    """
    with optional("identification", "scipy"):
        from scipy.ndimage import rank_filter, uniform_filter1d  # noqa: PLC0415 - slow to import

    if len(stamps) < WINDOW:
        return stamps
    step = _period(stamps, period)
    turns = stamps / step
    waves = np.exp(2j * np.pi * turns)
    means = [uniform_filter1d(part, WINDOW, mode="nearest") for part in (waves.real, waves.imag)]
    phases = np.arctan2(means[1], means[0]) / (2.0 * np.pi)
    off = turns - phases
    off = (off - np.rint(off)) * step
    earliest = uniform_filter1d(rank_filter(off, RANK, WINDOW, mode="nearest"), WINDOW)
    late = off - earliest
    late = np.where(late < -REGULAR * step, late + step, late)  # by more than half a period
    return stamps - late if float(np.median(late)) < REGULAR * step else stamps


def _period(stamps: Floats, period: float) -> float:
    """Return the period of the lines [s]: the median over windows, some of whose lines are lost."""
    step = float(np.median(np.diff(stamps)))
    if abs(step - period) > 0.1 * period:
        step = period
    half = WINDOW // 2
    lasted = stamps[half:] - stamps[:-half]
    return float(np.median(lasted / np.maximum(1.0, np.rint(lasted / step))))
