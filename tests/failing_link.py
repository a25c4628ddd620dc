"""Links that fail: the cable is pulled, the board falls silent, or bytes are damaged."""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.errors import LinkLostError
from acsar_gym.links.base import Link, LinkWrapper
from acsar_gym.protocol import ZERO, Decoder
from acsar_gym.worlds import Scene


class FailingLink(LinkWrapper):
    """Fails in every episode, some time after the first command that turns wheels.

    Args:
        link: Link whose cable is pulled or whose board falls silent.
        after: Time until it fails [s].
        silent: Whether the board falls silent until the next reset; otherwise its cable is pulled,
            so that the link is lost until it is opened again.
    """

    def __init__(self, link: Link, after: float, *, silent: bool = False) -> None:
        super().__init__(link)
        self._after = after
        self._silent = silent
        self._decoder = Decoder()
        self._fails_at = math.inf

    def open(self) -> None:
        self._fails_at = math.inf
        self.inner.open()

    def reset(self, scene: Scene) -> None:
        self._fails_at = math.inf
        self.inner.reset(scene)

    def write(self, data: bytes) -> None:
        if self._has_failed():
            return
        turning = any(reading.speeds != ZERO for reading in self._decoder.feed(data))
        if turning and self._fails_at == math.inf:
            self._fails_at = self.inner.now() + self._after
        self.inner.write(data)

    def advance(self, period: float) -> bytes:
        data = self.inner.advance(period)
        return b"" if self._has_failed() else data

    def _has_failed(self) -> bool:
        """Whether the board is silent; LinkLostError if the cable is out."""
        failed = self.inner.now() >= self._fails_at
        if failed and not self._silent:
            self.inner.close()
            raise LinkLostError("robot0: lost while in use (unplugged)", "check the cable")
        return failed


class DamagedLink(LinkWrapper):
    """Feedback of which each piece is damaged with a probability of 30 %."""

    def __init__(self, link: Link) -> None:
        super().__init__(link)
        self._rng = np.random.default_rng(0)

    def advance(self, period: float) -> bytes:
        data = self.inner.advance(period)
        if not data or self._rng.random() > 0.3:
            return data
        place = int(self._rng.integers(len(data)))
        flipped = bytes([data[place] ^ 1 << int(self._rng.integers(8))])
        return (
            data[:place] + flipped + data[place + 1 :],
            data[:place],
            data + data,
            data[:place] + self._rng.bytes(64) + data[place:],
        )[self._rng.integers(4)]
