"""Read actions, whatever a policy returns."""

from __future__ import annotations

from typing import Any

import numpy as np

from acsar_gym.errors import CommandError, format_error, show_value
from acsar_gym.tasks.state import Floats

NUMBER_KINDS = "fiub"
"""Kinds of numpy's types that are numbers: no text, complex numbers or objects."""


def read_actions(actions: Any, shape: tuple[int, ...]) -> Floats:
    """Convert an action, or those of a batch, to a new array."""
    is_single = len(shape) == 1
    must = "two finite numbers (linear, angular) in [-1, 1]" if is_single else f"numbers {shape}"
    problem = f"action{'' if is_single else 's'} = {{}}: must be {must}"
    try:
        given = np.asarray(actions)
        is_numeric = given.dtype.kind in NUMBER_KINDS
        # numba would compile for arrays in another order
        numbers = given.astype(np.float64, order="C") if is_numeric else None
    except Exception as error:
        reason = format_error(error)
        raise CommandError(f"{problem.format(show_value(actions))}; {reason}") from error
    if numbers is None or (is_single and numbers.shape != shape):
        raise CommandError(problem.format(show_value(actions)))
    if numbers.shape != shape:
        raise CommandError(f"actions of shape {numbers.shape}: must be {shape}")
    if np.isfinite(numbers).all():
        return numbers
    if is_single:
        raise CommandError(problem.format(show_value(actions)))
    robot = int(np.isfinite(numbers).all(axis=1).argmin())
    raise CommandError(f"action of env {robot} is {numbers[robot]}: must be finite numbers")
