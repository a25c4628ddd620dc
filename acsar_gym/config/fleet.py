"""Fleets: the robots of a batch, which may differ."""

from __future__ import annotations

import re
from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from acsar_gym.config import drawn, files
from acsar_gym.config.robot import RobotConfig, RobotSource
from acsar_gym.errors import ConfigError

FleetSource = RobotSource | Sequence[RobotSource]
"""Type of a batch's `robot` argument; see `make_fleet`."""
_COUNTED = re.compile(r"(?:([0-9]{1,5})x)?(.*)", re.DOTALL)
MAX_KINDS = 10_000  # robots of a fleet, at most
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


class Fleet(NamedTuple):
    """Robots that differ, but for the timing of their wires."""

    robots: tuple[RobotConfig, ...]
    names: tuple[str, ...]
    """How messages call them."""


def make_fleet(source: FleetSource, most: int = MAX_KINDS) -> Fleet:
    """Return the robots that a value of a batch's `robot` argument means.

    Args:
        source: one robot, as for `RobotConfig.of`; a range of drawn ones, such as "drawn:train" or
            "drawn:0-63"; several of these with commas between, "24xjackal" for 24 of them; or a
            list of robots.
        most: how many of them are used; the first ones.

    Raises:
        ConfigError: for a robot as `RobotConfig.of`, no robot, more than 10,000, or robots whose
            `SHARED_FIELDS` differ.
    """
    robots: list[RobotSource] = []
    if not isinstance(source, str):
        robots += source if isinstance(source, Sequence) else [source]
    else:
        for group in files.group_parts(source.split(",")):
            counted = _COUNTED.match(",".join(group))
            count, name = counted.groups() if counted else ("1", "")
            robots += drawn.expand_name(name) * int(count or 1)
    if not 1 <= len(robots) <= MAX_KINDS:
        raise ConfigError(
            f"robot: a fleet of {len(robots):,} robots: must have 1 to {MAX_KINDS:,}; "
            "drawn ones are given as 'drawn:0-63'"
        )
    used = robots[:most]
    fleet = Fleet(
        tuple(RobotConfig.of(robot) for robot in used),
        tuple(_name(robot, place) for place, robot in enumerate(used)),
    )
    for place in range(1, len(used)):
        for path in SHARED_FIELDS:
            check_equal(fleet, place, path)
    return fleet


def check_equal(fleet: Fleet, place: int, path: str) -> None:
    """Raise ConfigError where a field of a fleet's robot isn't that of its first one."""
    first, other = map(attrgetter(path), (fleet.robots[0], fleet.robots[place]))
    if first != other:
        raise ConfigError(
            f"robot: {fleet.names[0]} has {path} = {first}, {fleet.names[place]} {other}: must be "
            "the same for all robots of a batch"
        )


def _name(source: RobotSource, place: int) -> str:
    """What a message calls a robot of a fleet."""
    if isinstance(source, str | Path):
        return str(source)
    named = source.name if isinstance(source, RobotConfig) else ""
    return named or f"number {place}"
