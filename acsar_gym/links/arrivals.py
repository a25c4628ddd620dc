"""Notes when bytes arrive at a serial port."""

from __future__ import annotations

import time

from acsar_gym.links.base import Arrivals
from acsar_gym.links.open_port import OpenPort

IDLE = 0.001
"""Pause where a port says that there are bytes and has none [s]."""


class Ear:
    """Waits for the end of a control period, and notes what arrives meanwhile.

    Attributes: `wanted`, whether the next period's bytes are to be read as they arrive, and not
    only at its end, which costs less; `pieces`, what arrived in the newest period.
    """

    def __init__(self) -> None:
        self.wanted = False
        self._listens = False
        self.pieces: Arrivals = []

    def begin(self) -> None:
        """Begin a period."""
        self.pieces = []
        self._listens, self.wanted = self.wanted, False

    def wait(self, port: OpenPort, seconds: float) -> None:
        """Wait for bytes, or for a time [s]; LinkLostError if the device is gone."""
        if not self._listens:
            time.sleep(seconds)
        elif port.wait(seconds):
            data = port.read()
            if data:
                self.pieces.append((time.monotonic(), data))
            else:
                time.sleep(min(IDLE, seconds))

    def heard(self, rest: bytes) -> bytes:
        """End a period; returns all that arrived in it, `rest` being what is read just now."""
        if rest and self._listens:
            self.pieces.append((time.monotonic(), rest))
        return b"".join([piece for _, piece in self.pieces]) if self.pieces else rest
