"""Options: of environments, of registrations and of resets, and checks of single numbers."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Self

import numpy as np
from pydantic import field_validator

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, show_value, suggest_name
from acsar_gym.tasks.factory import explain_option

ONE_MODE_OPTIONS = (
    "autoreset_mode",
    "lidar",
    "on_fault",
    "record",
    "threads",
    "view",
)
"""Options that only batches or only single envs have."""
MODE_DEFAULTS = "defaults"
"""The argument of both in which an id's registered defaults of such options are."""
MAX_STEPS = 10**9  # largest time limit of an episode [steps]
NO_LIMIT = -1  # what Gymnasium's `make` takes for no time limit, beside None


class SharedOptions(Section):
    """The options that single environments and batches share; each has a subclass of it."""

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
        if isinstance(value, list | tuple):
            return value
        raise ValueError("must be a list, such as [ThreeRays]")

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Names of all options."""
        return tuple(cls.model_fields)

    @classmethod
    def split(cls, given: Mapping[str, Any]) -> tuple[Self, dict[str, Any]]:
        """Separate these options from those of the task."""
        names, chosen = cls.names(), dict(given)
        defaults = chosen.pop(MODE_DEFAULTS, {})
        chosen = {name: value for name, value in defaults.items() if name in names} | chosen
        others = {name: value for name, value in chosen.items() if name not in names}
        return cls(**{name: value for name, value in chosen.items() if name in names}), others


def split_by_mode(options: Mapping[str, Any]) -> dict[str, Any]:
    """Move an id's defaults that only one mode has to MODE_DEFAULTS; see `SharedOptions.split`."""
    of_one_mode = {name: value for name, value in options.items() if name in ONE_MODE_OPTIONS}
    shared = {name: value for name, value in options.items() if name not in of_one_mode}
    return shared | ({MODE_DEFAULTS: of_one_mode} if of_one_mode else {})


def check_register_options(
    name: str, task: Any, options: Iterable[str], others: Iterable[str]
) -> None:
    """Check the options with which an id is registered."""
    known = [*inspect.signature(task).parameters, *SharedOptions.names(), *ONE_MODE_OPTIONS]
    known += ["link", "robot"]
    for option in options:
        if option not in known:
            hint = explain_option(task, option[:40], [*known, *others])
            raise ConfigError(f"{name}: unknown option {show_value(option)}{hint}")


def check_reset_options(options: Any, names: Sequence[str]) -> Mapping[str, Any]:
    """Return a reset's options once their names are checked."""
    if not isinstance(options, Mapping):
        raise ConfigError(f"options = {show_value(options)}: must be a mapping of names to values")
    for name in options:
        if name not in names:
            raise ConfigError(
                f"unknown reset option {show_value(name)}{suggest_name(str(name)[:40], names)}"
            )
    return options


def check_count(name: str, value: int, most: int) -> int:
    """Check that an option is a whole number from 1 to `most`, and return it."""
    if not isinstance(value, int | np.integer) or not 1 <= value <= most:
        raise ConfigError(
            f"{name} = {show_value(value)}: must be a whole number from 1 to {most:,}"
        )
    return int(value)


def read_step_limit(value: Any) -> int | None:
    """Return `max_episode_steps` [steps]; None for no limit. ConfigError where it is no number."""
    if value is None or (isinstance(value, int | np.integer) and value == NO_LIMIT):
        return None
    return check_count("max_episode_steps", value, MAX_STEPS)


def check_positive(name: str, value: Any) -> float:
    """Return an option that must be a positive, finite number; ConfigError where it isn't."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not 0.0 < number < math.inf:
        raise ConfigError(f"{name} = {show_value(value)}: must be a positive number")
    return number


def check_distances(value: Any) -> tuple[float, float]:
    """Return a `goal_distance`, which must be 0 < nearest <= farthest; ConfigError otherwise."""
    try:
        nearest, farthest = (float(distance) for distance in value)
    except (TypeError, ValueError, OverflowError):
        nearest, farthest = math.nan, math.nan
    if not 0.0 < nearest <= farthest < math.inf:
        raise ConfigError(
            f"goal_distance = {show_value(value)}: must be (nearest, farthest) [m], with "
            "0 < nearest <= farthest"
        )
    return nearest, farthest
