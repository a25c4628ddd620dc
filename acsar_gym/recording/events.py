"""What the control loop hands to the recorder; making one takes less than a microsecond."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from acsar_gym.bodies.base import GroundTruth
from acsar_gym.protocol import Speeds

Pair = tuple[float, float]
Pieces = tuple[tuple[float, bytes], ...]
"""Bytes with the times at which they were sent or arrived [s]."""


class Began(NamedTuple):
    """A reset: an episode begins."""

    stamp: float
    wall: int
    """Wall clock at the same moment [ns since 1970]."""
    info: Mapping[str, Any]


class Exchange(NamedTuple):
    """One control period of the wire."""

    number: int
    stamp: float
    sent: Pieces
    received: Pieces
    lateness: float | None
    truth: GroundTruth | None


class Written(NamedTuple):
    """Bytes that were sent after the last control period of a link, such as the stop at its end."""

    sent: Pieces


class Tick(NamedTuple):
    """One tick of the robot, after the exchange of the same number."""

    exchange: int
    stamp: float
    pose: tuple[float, float, float]
    twist: Pair
    speeds: Speeds
    angles: Speeds
    asked: Pair
    sent: Pair
    reason: int
    """An IntEnum with a name, such as `safety.rules.Reason`, or a number."""
    lateness: float | None
    feedback_age: float
    refused: int


class Scanned(NamedTuple):
    """A scan became the newest one."""

    exchange: int
    stamp: float
    ranges: Any
    """(rays,) [m]."""


class Stepped(NamedTuple):
    """A step of the env, or its reset, which has no action."""

    step: int
    stamp: float
    observation: Any
    action: Any
    reward: float
    terminated: bool
    truncated: bool
    success: bool = False


class Fault(NamedTuple):
    """Something that stopped the robot."""

    stamp: float
    text: str


class Clock(NamedTuple):
    """Wall clock and link's clock at the same moment."""

    stamp: float
    wall: int


Event = Began | Exchange | Written | Tick | Scanned | Stepped | Fault | Clock
