"""Options of environments and of resets, and checks of single numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, Self

import numpy as np
from pydantic import field_validator

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, show_value, suggest_name

SINGLE_OPTIONS = ("lidar", "on_fault", "record", "view")
"""Options that only single envs have."""
BATCH_OPTIONS = ("autoreset_mode", "threads")
"""Options that only batches have."""
MODE_DEFAULTS = "defaults"
"""The argument of both in which an id's registered defaults of such options are."""
MAX_STEPS = 10**9
"""Largest time limit of an episode [steps]."""
NO_LIMIT = -1
"""What Gymnasium's `make` takes for no time limit, in addition to None."""


class SharedOptions(Section):
    """The options that single environments and batches share. Each has a subclass of it."""

    worlds: Any = None
    difficulty: Any = None
    sensors: Any = ()
    policy_rate: Any = 10.0
    max_episode_steps: Any = None
    faults: Any = None
    randomization: Any = None
    render_mode: Any = None

    @field_validator("sensors")
    @classmethod
    def _is_list(cls, value: Any) -> Any:
        # A text is a sequence as well, of letters.
        if isinstance(value, list | tuple):
            return value
        raise ValueError("must be a list, such as [ThreeRays]")

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Names of all options."""
        return tuple(cls.model_fields)

    @classmethod
    def split(cls, options: Mapping[str, Any]) -> tuple[Self, dict[str, Any]]:
        """Separate these options from those of the task."""
        of_task = dict(options)

        # Gymnasium passes registered defaults of one mode to both modes.
        defaults = of_task.pop(MODE_DEFAULTS, {})
        chosen = {name: defaults[name] for name in cls.names() if name in defaults}
        chosen |= {name: of_task.pop(name) for name in cls.names() if name in options}
        return cls(**chosen), of_task


def check_names(
    problem: str, names: Iterable[Any], known: Iterable[str], others: Iterable[str] = ()
) -> None:
    """Raise ConfigError for the first unknown name.

    Args:
        problem: What is wrong, with `{}` for the name.
        names: Names that a user has given.
        known: Names that there are.
        others: More names that the message suggests.
    """
    for name in names:
        if name not in known:
            hint = suggest_name(str(name)[:40], {*known, *others})
            raise ConfigError(f"{problem.format(show_value(name))}{hint}")


def check_reset_options(options: Any, names: Iterable[str]) -> Mapping[str, Any]:
    """Return a reset's options once their names are checked."""
    if not isinstance(options, Mapping):
        raise ConfigError(f"options = {show_value(options)}: must be a mapping of names to values")
    check_names("unknown reset option {}", options, names)
    return options


def check_count(name: str, value: int, most: int) -> int:
    """Check that an option is a whole number from 1 to `most`, and return it."""
    if not isinstance(value, int | np.integer) or not 1 <= value <= most:
        raise ConfigError(
            f"{name} = {show_value(value)}: must be a whole number from 1 to {most:,}"
        )
    return int(value)


def read_step_limit(value: Any) -> int | None:
    """Return `max_episode_steps` [steps]. None for no limit. ConfigError for other values."""
    if value is None or (isinstance(value, int | np.integer) and value == NO_LIMIT):
        return None
    return check_count("max_episode_steps", value, MAX_STEPS)


def read_number(value: Any) -> float:
    """Convert what a user passes to a number. NaN if it isn't a number."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def check_finite(name: str, value: Any) -> float:
    """Return a number that must be finite."""
    number = read_number(value)
    if not math.isfinite(number):
        raise ConfigError(f"{name} = {show_value(value)}: must be a finite number")
    return number


def store_positive(task: object, name: str) -> float:
    """Store an option of a task, which may be text, as a positive number, and return it."""
    value = getattr(task, name)
    number = read_number(value)
    if not 0.0 < number < math.inf:
        raise ConfigError(f"{name} = {show_value(value)}: must be a positive number")
    object.__setattr__(task, name, number)
    return number


def check_distances(value: Any) -> tuple[float, float]:
    """Return a `goal_distance`, which must be 0 < nearest <= farthest."""
    try:
        nearest, farthest = map(read_number, value)
    except (TypeError, ValueError):
        nearest = farthest = math.nan
    if not 0.0 < nearest <= farthest < math.inf:
        raise ConfigError(
            f"goal_distance = {show_value(value)}: must be (nearest, farthest) [m], with "
            "0 < nearest <= farthest"
        )
    return nearest, farthest
