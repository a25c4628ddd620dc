"""Listens to a board while it is commanded, with the time of every line."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from acsar_gym.config import BITS_PER_BYTE, RobotConfig
from acsar_gym.links.base import Link
from acsar_gym.links.handshake import silence
from acsar_gym.protocol import MOTORS, ZERO, Decoder, Speeds, line_end, line_of

POLL = 0.001
"""Resolution of the times [s]."""
REPEAT = 0.05
"""A command is repeated so often, to prevent the firmware's time-out [s]."""
GAP = 0.5
"""A board that was silent so long in between was reset [s]."""
SILENT = 3.0
"""A board that is silent so long doesn't come back [s]; one that was reset takes 1 to 2 s."""
STALL = 0.05
"""Time that this program was held up counts as silence of the board only up to this [s]."""
CLEAR = 0.1
"""How long old lines may come [s]."""
KEPT = 400
"""Newest raw lines that are kept."""


class Line(NamedTuple):
    """A line of feedback."""

    stamp: float
    """When its last byte had arrived [s]."""
    begin: float
    """When its first byte began to arrive [s]."""
    speeds: Speeds
    """Speeds of the letters a, b, c, d [rad/s], not yet those of the wheels."""


class Ear:
    """Sends commands to the letters of a board, and hears its lines.

    Attributes: `decoder`; `gaps`, how long the board was silent each time that it was reset [s];
    `raw`, the newest lines as they came; `sent`, when the last byte of the newest command had left
    [s]; `trailing_comma`, of the commands.

    Args:
        link: to the board, open.
        config: of the robot.
    """

    def __init__(self, link: Link, config: RobotConfig) -> None:
        self._link = link
        self._byte_time = BITS_PER_BYTE / config.baud_rate
        self.decoder = Decoder()
        self.trailing_comma = True
        self.gaps: list[float] = []
        self.raw: deque[bytes] = deque(maxlen=KEPT)
        self.sent = 0.0
        self._speeds: Speeds = ZERO
        self._partial = b""
        self._begin: float | None = None
        self._polled = link.now()
        self._quiet = 0.0
        self._counted = 0
        self._since = self._until = self._polled

    def now(self) -> float:
        """Return the link's time [s]."""
        return self._link.now()

    def command(self, speeds: Speeds, order: str = MOTORS) -> None:
        """Send one command line.

        Args:
            speeds: of the letters a, b, c, d [rad/s].
            order: order of the letters in the line.
        """
        line = line_of(*speeds, b"")
        parts = line.split(b",")
        ordered = b",".join(parts[MOTORS.index(letter)] for letter in order)
        ordered += line_end(trailing_comma=self.trailing_comma)
        self.sent = self.now() + len(ordered) * self._byte_time
        self._link.write(ordered)

    def poll(self) -> list[Line]:
        """Let POLL pass, and return the lines that have arrived.

        Raises:
            BoardSilentError: nothing valid has arrived for SILENT.
            LinkError: the link is lost, or there was an emergency stop.
        """
        data = self._link.advance(POLL)
        now = self.now()
        self._quiet += min(now - self._polled, STALL)
        self._polled = now
        if data and self._begin is None:
            self._begin = now
        lines = [self._line(reading.over(self._speeds), now) for reading in self.decoder.feed(data)]
        self._keep(data)
        if lines:
            self._count(len(lines), now)
        elif self._quiet > SILENT:
            raise silence(self._quiet, self.decoder)
        return lines

    def _count(self, lines: int, now: float) -> None:
        """Count lines; after a reset of the board anew."""
        if self._quiet > GAP:
            self.gaps.append(self._quiet)
            self._counted = 0
        if not self._counted:
            self._since, lines = now, 1
        self._quiet, self._until = 0.0, now
        self._counted += lines

    @property
    def rate(self) -> float:
        """Lines that the board sends per second [Hz]; 0 where too few have come."""
        lasted = self._until - self._since
        return (self._counted - 1) / lasted if self._counted > 1 and lasted > 0.0 else 0.0

    def _line(self, speeds: Speeds, now: float) -> Line:
        """Return a line that ends now."""
        self._speeds = speeds
        lasted = len(self.raw[-1] if self.raw else b"") * self._byte_time
        begin = min(now - lasted, now if self._begin is None else self._begin)
        return Line(now, begin, speeds)

    def _keep(self, data: bytes) -> None:
        """Keep complete lines as they came, and when the first byte of the next one came."""
        if not data:
            return
        *lines, self._partial = (self._partial + data).split(b"\n")
        self.raw.extend(line[:200] for line in lines)
        self._partial = self._partial[:200]
        if lines:
            self._begin = self.now() if self._partial else None

    def hear(
        self,
        speeds: Speeds | None,
        enough: Callable[[Line], bool],
        patience: float,
        *,
        repeat: float = REPEAT,
        order: str = MOTORS,
    ) -> list[Line]:
        """Command speeds again and again, and listen until a line is enough.

        Args:
            speeds: of the letters [rad/s]; None to send nothing.
            enough: called with every line.
            patience: longest time [s].
            repeat: time between commands [s].
            order: order of the letters in the line.

        Returns:
            The lines; the last one was enough, unless patience ended.
        """
        begin = due = self.now()
        lines: list[Line] = []
        while (now := self.now()) - begin < patience:
            if speeds is not None and now >= due:
                self.command(speeds, order)
                due = now + repeat
            for line in self.poll():
                lines.append(line)
                if enough(line):
                    return lines
        return lines

    def clear(self) -> None:
        """Take what has arrived before; nothing of it counts."""
        self.pause(CLEAR)
        self._counted = 0

    def pause(self, lasting: float) -> None:
        """Listen to nothing in particular for a while [s]."""
        self.hear(None, lambda _: False, lasting)
