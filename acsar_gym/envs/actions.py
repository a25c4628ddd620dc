"""Checks of actions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from acsar_gym.errors import CommandError, shown


def checked(action: Any) -> tuple[float, float]:
    """Return an action as two floats, clipped to [-1, 1].

    Args:
        action: (2,), linear and angular.

    Raises:
        CommandError: for another shape, NaN or infinity.
    """
    try:
        linear, angular = np.asarray(action, np.float64).tolist()
        sound = math.isfinite(linear + angular)
    except (TypeError, ValueError, OverflowError):
        sound = False
    if not sound:
        raise CommandError(
            f"action = {shown(action)}: must be two finite numbers (linear, angular) in [-1, 1]"
        )
    return min(max(linear, -1.0), 1.0), min(max(angular, -1.0), 1.0)
