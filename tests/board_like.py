"""Simulated robots that are real for the driver, in simulated time, and wheels that fail."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.links.base import Link, LinkWrapper
from acsar_gym.protocol import ZERO, Decoder, Speeds, encode
from acsar_gym.worlds import Scene

LINE_JITTER = 0.01  # lines arrive up to this much early or late [s]


class LikeABoard(LinkWrapper):
    """A simulated robot that is real for the driver."""

    is_real = True
    truth = None
    lateness = 0.0


class Overshooting(LikeABoard):
    """A board whose speed loops overshoot, by a quarter of a step."""

    DAMPING = 0.4
    FREQUENCY = 15.0
    SUBSTEP = 0.001

    def __init__(self, link: Link) -> None:
        super().__init__(link)
        self._decoder = Decoder()
        self._wanted, self._speeds, self._rates = np.zeros((3, 4))

    def advance(self, period: float) -> bytes:
        readings = self._decoder.feed(super().advance(period))
        if readings:
            self._wanted = np.array(readings[-1].over(tuple(self._wanted)))
        for _ in range(round(period / self.SUBSTEP)):
            pull = self.FREQUENCY**2 * (self._wanted - self._speeds)
            self._rates += self.SUBSTEP * (pull - 2.0 * self.DAMPING * self.FREQUENCY * self._rates)
            self._speeds += self.SUBSTEP * self._rates
        return encode(self._speeds.tolist()) if readings else b""


class Fault(NamedTuple):
    """Factors of what motors get and encoders send, and the order in which speeds are sent."""

    commands: NDArray[np.float64] = np.ones(4)
    feedback: NDArray[np.float64] = np.ones(4)
    order: tuple[int, ...] = (0, 1, 2, 3)


FAULTS: dict[str, Callable[[NDArray[np.bool_]], Fault]] = {
    "dead": lambda wheel: Fault(commands=np.where(wheel, 0.0, 1.0)),
    "blocked": lambda wheel: Fault(feedback=np.where(wheel, 0.0, 1.0)),
    "reversed": lambda wheel: Fault(feedback=np.where(wheel, -1.0, 1.0)),
    "twice as fast": lambda wheel: Fault(feedback=np.where(wheel, 2.0, 1.0)),
    "all twice as fast": lambda _: Fault(feedback=np.full(4, 2.0)),
    "swapped sides": lambda _: Fault(order=(1, 0, 3, 2)),
    "all zero": lambda _: Fault(feedback=np.zeros(4)),
}
"""Faults by name; their argument is a mask of the faulty wheels."""


def make_fault(kind: str, wheel: int) -> Fault:
    """Return a fault by name, of one wheel or of all."""
    return FAULTS[kind](np.arange(4) == wheel)


class FaultyBoard(LinkWrapper):
    """A simulated robot that is real for the driver, with late and lost lines, and a fault.

    Attributes:
        failed_at: Time from which on the wheels are commanded to turn with the fault [s]; NaN
            before it is known.
        sent: Newest command of the driver [rad/s].
        measured: Newest speeds that the driver gets [rad/s].

    Args:
        link: Simulated link.
        rng: Draws which lines are late or lost.
        fault: Fault of the wheels.
        after: Time from the first command that turns wheels to the fault [s].
        dropped: Share of lines that are lost, of commands and of feedback.
    """

    is_real = True
    lateness: float | None = 0.0

    def __init__(
        self,
        link: Link,
        rng: np.random.Generator,
        fault: Fault | None = None,
        *,
        after: float = 0.0,
        dropped: float = 0.0,
    ) -> None:
        super().__init__(link)
        self._rng = rng
        self._fault = fault
        self._after = after
        self._dropped = dropped

    def reset(self, scene: Scene) -> None:
        super().reset(scene)
        self.failed_at = math.nan
        self.sent: Speeds = ZERO
        self.measured: Speeds = ZERO
        self._commands = Decoder()
        self._feedback = Decoder()
        self._lines: deque[tuple[float, bytes]] = deque()

    def write(self, data: bytes) -> None:
        for reading in self._commands.feed(data):
            self.sent = reading.over(self.sent)
        if math.isnan(self.failed_at) and any(self.sent):
            self.failed_at = self.now() + self._after
        if self._rng.random() >= self._dropped:
            commands = self._find_fault().commands
            super().write(encode((commands * self.sent).tolist()))

    def advance(self, period: float) -> bytes:
        for line in super().advance(period).splitlines(keepends=True):
            if self._rng.random() >= self._dropped:
                delay = self._rng.uniform(-0.5 * period, 2.0 * LINE_JITTER - 0.5 * period)
                self._lines.append((self.now() + delay, line))

        lines = b""
        while self._lines and self._lines[0][0] <= self.now():
            for reading in self._feedback.feed(self._lines.popleft()[1]):
                fault = self._find_fault()
                speeds = fault.feedback * reading.over(ZERO)
                a, b, c, d = speeds[list(fault.order)].tolist()
                self.measured = (a, b, c, d)
                lines += encode(self.measured)
        return lines

    def _find_fault(self) -> Fault:
        """Return the fault, once it is there."""
        if self._fault is not None and self.now() >= self.failed_at - 1e-9:
            return self._fault
        return Fault()
