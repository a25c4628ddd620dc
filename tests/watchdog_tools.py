"""Commands for a watched link, and the watchdogs of this process."""

from __future__ import annotations

import contextlib

import psutil

from acsar_gym.protocol import ZERO, encode

TURNING = encode((3.0, 3.0, 3.0, 3.0))
ZEROS = b"\r\n" + encode(ZERO)
HASTY = 0.5
"""Time-out of a watchdog that shall trip, and not before a busy machine has gone on [s]."""


def children() -> list[psutil.Process]:
    """Watchdogs of this process, living and dead. A dead process has no command line."""

    def watches(process: psutil.Process) -> bool:
        with contextlib.suppress(psutil.Error):
            return any("watchdog_child" in word for word in process.cmdline())
        return True

    return [child for child in psutil.Process().children() if watches(child)]
