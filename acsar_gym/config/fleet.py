"""Fleets: the robots of a batch, which may differ."""

from __future__ import annotations

import re
from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from acsar_gym.config import drawn
from acsar_gym.config.robot import RobotConfig, RobotSource
from acsar_gym.errors import ConfigError

FleetSource = RobotSource | Sequence[RobotSource]
"""Type of a batch's `robot` argument. See `make_fleet`."""
MAX_KINDS = 10_000
"""Most robots of a fleet."""
SHARED_FIELDS = (
    "control_rate",
    "baud_rate",
    "trailing_comma",
    "firmware.loop_rate",
    "firmware.processing_time",
    "firmware.command_timeout",
    "encoder.window",
)
"""The timing of the wire and of the board, which all robots of a batch share."""
_COUNTED = re.compile(r"(?:([0-9]{1,5})x)?(.*)", re.DOTALL)
"""A name that may follow a number of robots, as in "24xjackal"."""


class Fleet(NamedTuple):
    """Robots that may differ, except for the timing of their wires."""

    robots: tuple[RobotConfig, ...]
    names: tuple[str, ...]
    """Names of the robots in messages."""


def make_fleet(source: FleetSource, most: int = MAX_KINDS) -> Fleet:
    """Return the robots that a value of a batch's `robot` argument means.

    Args:
        source: A robot, as for `RobotConfig.of`, a range of drawn robots, such as "drawn:train" or
            "drawn:0-63", several of these with commas between, with "24xjackal" for 24 of them, or
            a list of robots.
        most: Number of robots to use, the first ones of `source`.

    Raises:
        ConfigError: A robot isn't valid for `RobotConfig.of`, there is no robot or more than
            10,000, or the robots differ in `SHARED_FIELDS`.
    """
    sources = _list_sources(source)
    if not 1 <= len(sources) <= MAX_KINDS:
        raise _wrong_size(len(sources))
    # Robots that no row of the batch gets are never made.
    robots = tuple(RobotConfig.of(robot) for robot in sources[:most])
    names = tuple(_name(robot, place) for place, robot in enumerate(sources[:most]))
    fleet = Fleet(robots, names)

    # All robots of a batch send and receive in the same ticks.
    for place in range(1, len(robots)):
        for path in SHARED_FIELDS:
            check_equal(fleet, place, path)
    return fleet


def _list_sources(source: FleetSource) -> list[RobotSource]:
    """Return the single robots of a fleet."""
    if not isinstance(source, str):
        return [*source] if isinstance(source, Sequence) else [source]

    # Counts and ranges may be mixed: "24xjackal,drawn:0-7".
    names: list[RobotSource] = []
    for item in source.split(","):
        count, name = _COUNTED.findall(item)[0]
        repetitions = int(count or 1)
        numbers = drawn.parse_numbers(name)
        robots = [name]
        if numbers is not None:
            # A range may have a billion numbers: count them before names are made.
            if len(numbers) * repetitions > MAX_KINDS:
                raise _wrong_size(len(numbers) * repetitions)
            robots = [f"{drawn.PREFIX}{number}" for number in numbers]
        names += robots * repetitions
    return names


def _wrong_size(robots: int) -> ConfigError:
    return ConfigError(
        f"robot: a fleet of {robots:,} robots: must have 1 to {MAX_KINDS:,}; "
        "drawn ones are given as 'drawn:0-63'"
    )


def check_equal(fleet: Fleet, place: int, path: str) -> None:
    """Raise ConfigError if a robot of a fleet differs from the first robot in a field.

    Args:
        fleet: The robots.
        place: Index of the robot in the fleet.
        path: Dotted name of the field.
    """
    first, value = map(attrgetter(path), (fleet.robots[0], fleet.robots[place]))
    if first != value:
        raise ConfigError(
            f"robot: {fleet.names[0]} has {path} = {first}, {fleet.names[place]} {value}: must be "
            "the same for all robots of a batch"
        )


def _name(source: RobotSource, place: int) -> str:
    """Return the name of a robot in messages."""
    if isinstance(source, str | Path):
        return str(source)
    name = source.name if isinstance(source, RobotConfig) else ""
    return name or f"number {place}"
