"""Checks of what users pass: options of tasks and of resets."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

from acsar_gym.errors import ConfigError, shown, suggestion
from acsar_gym.tasks.base import Goal

ONE_MODE = ("autoreset_mode", "lidar", "on_fault", "record", "threads", "view")
"""Options that only batches or only single envs have."""
DEFAULTS = "defaults"
"""The argument of both in which an id's registered defaults of such options are."""


def by_mode(options: Mapping[str, Any]) -> dict[str, Any]:
    """Move an id's defaults that only one mode has to DEFAULTS; see `with_defaults`."""
    own = {name: value for name, value in options.items() if name in ONE_MODE}
    shared = {name: value for name, value in options.items() if name not in ONE_MODE}
    return shared | ({DEFAULTS: own} if own else {})


def with_defaults(options: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """Add an id's registered defaults of options that only one mode has.

    Args:
        options: as given to an env or a batch.
        names: of this mode's options; defaults with other names belong to the other mode.
    """
    given = dict(options)
    defaults = given.pop(DEFAULTS, {})
    return {name: value for name, value in defaults.items() if name in names} | given


@dataclass(frozen=True, kw_only=True)
class Options:
    """The options that single environments and batches share; each has a subclass of it."""

    worlds: Any = None
    difficulty: Any = None
    sensors: Sequence[Any] = ()
    policy_rate: float = 10.0
    faults: Any = None
    randomization: Any = None
    render_mode: str | None = None

    def __post_init__(self) -> None:
        listed("sensors", self.sensors)

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Names of all options."""
        return tuple(field.name for field in fields(cls))

    @classmethod
    def split(cls, given: Mapping[str, Any]) -> tuple[Self, dict[str, Any]]:
        """Separate these options from those of the task.

        Args:
            given: all options, by name; "defaults" has those that `acsar_gym.register` was given
                and only one mode knows.

        Returns:
            These options, and the others.

        Raises:
            ConfigError: for values that are unknown or out of range.
        """
        own = cls.names()
        asked = with_defaults(given, own)
        rest = {name: value for name, value in asked.items() if name not in own}
        return cls(**{name: value for name, value in asked.items() if name in own}), rest


def known(options: Mapping[str, Any], names: tuple[str, ...]) -> Mapping[str, Any]:
    """Check the names of a reset's options.

    Args:
        options: as passed to `reset`.
        names: that the task knows.

    Returns:
        The options.

    Raises:
        ConfigError: for an unknown name, or where `options` is no mapping.
    """
    if not isinstance(options, Mapping):
        raise ConfigError(f"options = {shown(options)}: must be a mapping of names to values")
    for name in options:
        if name not in names:
            raise ConfigError(
                f"unknown reset option {shown(name)}{suggestion(str(name)[:40], names)}"
            )
    return options


def listed(name: str, value: Any) -> None:
    """Check that an option is a list or a tuple.

    Args:
        name: of the option, for the message.
        value: of the option.

    Raises:
        ConfigError: for anything else.
    """
    if not isinstance(value, list | tuple):
        raise ConfigError(f"{name} = {shown(value)}: must be a list, such as [ThreeRays]")


def positive(name: str, value: Any) -> float:
    """Check that an option is a positive, finite number, and return it.

    Args:
        name: of the option, for the message.
        value: of the option.

    Raises:
        ConfigError: for anything else.
    """
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not 0.0 < number < math.inf:
        raise ConfigError(f"{name} = {shown(value)}: must be a positive number")
    return number


def point(name: str, value: Any) -> Goal:
    """Check that an option is a point of two finite numbers (x, y) [m], and return it.

    Args:
        name: of the option, for the message.
        value: of the option.

    Raises:
        ConfigError: for anything else.
    """
    try:
        x, y = (float(number) for number in value)
        sound = math.isfinite(x + y)
    except (TypeError, ValueError, OverflowError):
        sound = False
    if not sound:
        raise ConfigError(f"{name} = {shown(value)}: must be two finite numbers (x, y) [m]")
    return (x, y)
