"""A simulated robot that the driver takes for a board, in simulated time."""

from __future__ import annotations

import numpy as np

from acsar_gym.links.base import Link, LinkWrapper
from acsar_gym.protocol import MOTORS, Decoder, encode


class LikeABoard(LinkWrapper):
    """A simulated robot that is real for the driver.

    `crossed` are two motors whose encoders are swapped, as letters.
    """

    is_real = True
    truth = None
    lateness = 0.0

    def __init__(self, link: Link, crossed: str = "") -> None:
        super().__init__(link)
        self._crossed = [MOTORS.index(motor) for motor in crossed]
        self._decoder = Decoder()

    def advance(self, period: float) -> bytes:
        got: bytes = self.inner.advance(period)
        if not self._crossed:
            return got
        one, two = self._crossed
        lines = b""
        for reading in self._decoder.feed(got):
            speeds = [speed or 0.0 for speed in reading.speeds]
            speeds[one], speeds[two] = speeds[two], speeds[one]
            lines += encode(speeds)
        return lines


class Overshooting(LikeABoard):
    """A board whose speed loops overshoot, by a quarter of a step."""

    DAMPING, FREQUENCY, SUBSTEP = 0.4, 15.0, 0.001

    def __init__(self, link: Link) -> None:
        super().__init__(link)
        self._wanted, self._speeds, self._rates = np.zeros((3, 4))

    def advance(self, period: float) -> bytes:
        heard = self._decoder.feed(super().advance(period))
        if heard:
            self._wanted = np.array(heard[-1].over(tuple(self._wanted)))
        for _ in range(round(period / self.SUBSTEP)):
            pull = self.FREQUENCY**2 * (self._wanted - self._speeds)
            self._rates += self.SUBSTEP * (pull - 2.0 * self.DAMPING * self.FREQUENCY * self._rates)
            self._speeds += self.SUBSTEP * self._rates
        return encode(self._speeds.tolist()) if heard else b""
