"""A simulated robot that the driver takes for a board, in simulated time."""

from __future__ import annotations

from typing import Any

from acsar_gym.protocol import MOTORS, Decoder, encode


class LikeABoard:
    """A simulated robot without truth, which is what a board is for the driver.

    `crossed` are two motors whose encoders are swapped, as letters.
    """

    truth = None
    lateness = 0.0

    def __init__(self, link: Any, crossed: str = "") -> None:
        self.link = link
        self._crossed = [MOTORS.index(motor) for motor in crossed]
        self._decoder = Decoder()

    def advance(self, period: float) -> bytes:
        got: bytes = self.link.advance(period)
        if not self._crossed:
            return got
        one, two = self._crossed
        lines = b""
        for reading in self._decoder.feed(got):
            speeds = [speed or 0.0 for speed in reading.speeds]
            speeds[one], speeds[two] = speeds[two], speeds[one]
            lines += encode(speeds)
        return lines

    def __getattr__(self, name: str) -> Any:
        return getattr(self.link, name)
