"""When robots stopped, from the commands that they received: for `stopping` and `ros_stopping`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

from acsar_gym.protocol import ZERO, Decoder
from acsar_gym.testing import EmulatedBoard

LIMIT = 0.25
"""Longest time from a fault to a zero command [s]."""
MAX_STARTS = 3
"""Number of times that a robot is started which a busy computer didn't drive."""
FAULT_JITTER = 0.02
"""Faults come within this time, at any phase of the control loop [s]."""


def list_commands(board: EmulatedBoard) -> Iterator[tuple[float, bool]]:
    """When each command came [s], and whether it turned wheels."""
    decoder = Decoder()
    for event in board.events():
        for reading in decoder.feed(event.get("rx", "").encode("latin-1")):
            yield event["t"], reading.speeds != ZERO


def find_stop(commands: Iterable[tuple[float, bool]], fault: float) -> float:
    """Return when a robot was commanded to stop and not to drive again [s]. inf if it wasn't.

    That is the first zero command after the fault, or the last one if all came before it.

    Args:
        commands: When each came [s], and whether it turned wheels.
        fault: Time of the fault [s].
    """
    zero = math.inf
    for when, turns in commands:
        if turns:
            zero = math.inf
        elif zero == math.inf or zero < fault:
            zero = when
    return zero
