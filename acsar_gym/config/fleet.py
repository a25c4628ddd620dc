"""Fleets: the robots of a batch, which may differ."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from acsar_gym.config import drawn, files
from acsar_gym.config.robot import RobotConfig, RobotSource
from acsar_gym.errors import ConfigError

FleetSource = RobotSource | Sequence[RobotSource]
"""Type of a batch's `robot` argument; see `make_fleet`."""
_COUNTED = re.compile(r"(?:([0-9]{1,5})x)?(.*)", re.DOTALL)
MAX_KINDS = 10_000
"""Robots of a fleet, at most."""
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
    each: Sequence[RobotSource]
    if isinstance(source, str):
        names = [",".join(group) for group in files.group_parts(source.split(","))]
        counted = [_COUNTED.fullmatch(name) for name in names]
        parts = [found.groups() for found in counted if found]
        each = [name for count, part in parts for name in drawn.expand_name(part) * int(count or 1)]
    elif isinstance(source, Sequence):
        each = source
    else:
        return Fleet((RobotConfig.of(source),), (_name(source, 0),))
    if not 1 <= len(each) <= MAX_KINDS:
        raise ConfigError(
            f"robot: a fleet of {len(each):,} robots: must have 1 to {MAX_KINDS:,}; "
            "drawn ones are given as 'drawn:0-63'"
        )
    used = each[:most]
    fleet = Fleet(
        tuple(RobotConfig.of(one) for one in used),
        tuple(_name(one, place) for place, one in enumerate(used)),
    )
    for place in range(1, len(used)):
        for path in SHARED_FIELDS:
            check_equal(fleet, place, path)
    return fleet


def check_equal(fleet: Fleet, place: int, path: str) -> None:
    """Raise ConfigError where a field of a fleet's robot isn't that of its first one."""
    one, other = (_get_field(fleet.robots[at], path) for at in (0, place))
    if one != other:
        raise ConfigError(
            f"robot: {fleet.names[0]} has {path} = {one}, {fleet.names[place]} {other}: must be "
            "the same for all robots of a batch"
        )


def _get_field(config: RobotConfig, path: str) -> object:
    """A field by its dotted name."""
    found: object = config
    for name in path.split("."):
        found = getattr(found, name)
    return found


def _name(source: RobotSource, place: int) -> str:
    """What a message calls a robot of a fleet."""
    if isinstance(source, str | Path):
        return str(source)
    named = source.name if isinstance(source, RobotConfig) else ""
    return named or f"number {place}"
