"""Read actions, whatever a policy returns."""

from __future__ import annotations

from typing import Any

import numpy as np

from acsar_gym.errors import CommandError, format_error, show_value
from acsar_gym.tasks.state import Floats

NUMBER_KINDS = "fiub"
"""Kinds of numpy's types that are numbers: no text, complex numbers or objects."""


def read_actions(actions: Any, shape: tuple[int, ...]) -> Floats:
    """Convert an action, or those of a batch, to a new array.

    Raises:
        CommandError: It has another shape, or isn't finite numbers.
    """
    try:
        array = np.asarray(actions)
        is_numeric = array.dtype.kind in NUMBER_KINDS
        # numba would compile for arrays in another order
        numbers = array.astype(np.float64, order="C") if is_numeric else None
    except Exception as error:
        raise CommandError(f"{_refuse(actions, shape)}; {format_error(error)}") from error

    is_single = len(shape) == 1
    if numbers is None or (is_single and numbers.shape != shape):
        raise CommandError(_refuse(actions, shape))
    if numbers.shape != shape:
        raise CommandError(f"actions of shape {numbers.shape}: must be {shape}")

    is_finite = np.isfinite(numbers)
    if is_finite.all():
        return numbers
    if is_single:
        raise CommandError(_refuse(actions, shape))
    robot = int(is_finite.all(axis=1).argmin())
    raise CommandError(f"action of env {robot} is {numbers[robot]}: must be finite numbers")


def _refuse(actions: Any, shape: tuple[int, ...]) -> str:
    """The message for actions that can't be used."""
    if len(shape) == 1:
        must = "two finite numbers (linear, angular) in [-1, 1]"
        return f"action = {show_value(actions)}: must be {must}"
    return f"actions = {show_value(actions)}: must be numbers of shape {shape}"
