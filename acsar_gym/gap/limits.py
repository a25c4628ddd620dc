"""Limits that a gap must keep, for continuous integration: `--fail-over METRIC=VALUE`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from acsar_gym.errors import ConfigError, shown, suggestion


def parsed(given: Sequence[str], known: Sequence[str]) -> dict[str, float]:
    """Parse limits such as "wheel_speed_rms=0.5".

    Args:
        given: the limits.
        known: names of the metrics.

    Returns:
        Metrics and their limits, in SI units.

    Raises:
        ConfigError: an unknown metric, or a value that isn't a number from 0 up.
    """
    limits = {}
    for text in given:
        name, equals, value = text.partition("=")
        if name not in known:
            raise ConfigError(f"--fail-over: unknown metric {shown(name)}{suggestion(name, known)}")
        try:
            limit = float(value) if equals else math.nan
        except ValueError:
            limit = math.nan
        if not 0.0 <= limit < math.inf:
            raise ConfigError(
                f"--fail-over {shown(text)}: must be METRIC=VALUE with a value of at least 0, "
                "such as wheel_speed_rms=0.5"
            )
        limits[name] = limit
    return limits


def exceeded(limits: Mapping[str, float], figures: Mapping[str, float]) -> list[str]:
    """Return a line for each limit that isn't kept; what couldn't be measured isn't, either."""
    lines = []
    for name, limit in limits.items():
        size = abs(figures[name])
        if math.isnan(size):
            lines.append(f"{name}: couldn't be measured, the limit is {limit:g}")
        elif size > limit:
            lines.append(f"{name} = {size:.4g}: over the limit of {limit:g}")
    return lines
