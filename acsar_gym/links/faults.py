"""Lines between driver and board that are lost or late, and a link that loses and delays them."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, show_value
from acsar_gym.hashing import hash_sample
from acsar_gym.jit import loop
from acsar_gym.links.base import Arrivals, Link, LinkWrapper
from acsar_gym.protocol import MAX_LINE
from acsar_gym.worlds import Scene

TIME_TOLERANCE = 1e-9  # tolerance for comparing times that are sums of periods [s]

# The numbers of `line_hash`. They decide which lines are lost, so they never change.
FEEDBACK_LINE = 0
COMMAND_LINE = 1
DROPPED_LINE = 0
LATE_LINE = 4
FAULT_KINDS = 8  # largest number of kinds of faults

Share = Annotated[float, Field(ge=0.0, le=1.0, strict=True)]


@loop
def line_hash(key: float, stream: int, number: float, kind: int) -> float:
    """Return a uniform random number in [0, 1) for a line of an episode and a kind of fault."""
    return hash_sample(key, (int(number) * 3 + stream) * FAULT_KINDS + kind)


class Faults(Section):
    """Lines that are lost or late. By default there are none.

    A batch loses the same lines as the single env.

    Raises ConfigError for values out of range.
    """

    section = "faults"

    dropped_lines: Share = 0.0
    """Share of lines that never arrive."""
    late_lines: Share = 0.0
    """Share of lines that are delayed by `lateness`. Lines behind a late line wait for it."""
    lateness: Annotated[float, Field(ge=0.0, le=60.0, strict=True)] = 0.05
    """Delay of a late line [s], rounded up to whole periods."""

    @classmethod
    def of(cls, faults: Mapping[str, Any] | Faults | None) -> Faults:
        """Return the Faults that users mean by `faults=`. ConfigError if it can't be read."""
        if isinstance(faults, Faults):
            return faults
        if faults is not None and not isinstance(faults, Mapping):
            raise ConfigError(
                f"faults = {show_value(faults)}: must be a mapping such as dropped_lines: 0.01"
            )

        fields = {str(name): value for name, value in (faults or {}).items()}
        for name in fields:
            if name not in cls.model_fields:
                raise ConfigError(
                    f"unknown field {f'faults.{name[:40]}'!r}: faults are 'dropped_lines' and "
                    "'late_lines', with 'lateness'"
                )
        return cls.model_validate(fields)

    @property
    def possible(self) -> bool:
        """Whether any line can be lost or late."""
        return self.dropped_lines > 0.0 or self.late_lines > 0.0


class FaultyWire:
    """A direction of the cable in one episode. Lines keep their order."""

    def __init__(self, faults: Faults, key: float, stream: int) -> None:
        self._faults = faults
        self._key = key
        self._stream = stream
        self._lines_sent = 0
        self._partial = b""
        self._queue: deque[tuple[float, bytes]] = deque()

    def carry(self, data: bytes, now: float) -> bytes:
        """Put bytes in, and return the lines that arrive at the other end now."""
        lines = (self._partial + data).splitlines(keepends=True)

        # Bytes behind the last line end wait for the rest of their line.
        self._partial = b""
        if lines and not lines[-1].endswith((b"\r", b"\n")) and len(lines[-1]) <= MAX_LINE:
            self._partial = lines.pop()
        for line in lines:
            self._send(line, now)

        # The queue keeps the order, so a late line holds back the lines behind it.
        arrived = b""
        while self._queue and self._queue[0][0] <= now + TIME_TOLERANCE:
            arrived += self._queue.popleft()[1]
        return arrived

    def _send(self, line: bytes, now: float) -> None:
        """Put a line into the queue, unless it is lost."""
        release = now
        if line.strip():  # the second half of a line end that was split isn't a line
            number = self._lines_sent
            self._lines_sent += 1
            # A line that is lost isn't late as well.
            dropped = line_hash(self._key, self._stream, number, DROPPED_LINE)
            if dropped < self._faults.dropped_lines:
                return
            late = line_hash(self._key, self._stream, number, LATE_LINE)
            if late < self._faults.late_lines:
                release += self._faults.lateness

        self._queue.append((release, line))


class FaultyLink(LinkWrapper):
    """A link on which lines are lost or late, from the first reset on.

    Each reset draws its own faults. The same seed, resets and input give the same bytes. Times are
    those of the link's own clock, so a simulation isn't slowed down.
    """

    def __init__(self, link: Link, faults: Faults) -> None:
        super().__init__(link)
        self._faults = faults
        self.seed(np.random.default_rng())
        # Lines are complete until the first reset: a handshake must not fail by chance.
        self._start(Faults(), 0.0)

    def seed(self, rng: np.random.Generator) -> None:
        """Set what the next resets draw from."""
        self._key = float(rng.random())
        # The random number has 53 bits, which are all used as the seed.
        self._rng = np.random.default_rng(int(self._key * 2**53))

    def reset(self, scene: Scene) -> None:
        """Reset the link, and draw the faults of the new episode."""
        self.inner.reset(scene)

        # The next episode's key doesn't depend on how long this episode is.
        key = self._key
        self._key = float(self._rng.random())
        self._start(self._faults, key)

    def _start(self, faults: Faults, key: float) -> None:
        """Empty both directions of the cable. From now on lines have these faults."""
        self._commands = FaultyWire(faults, key, COMMAND_LINE)
        self._feedback = FaultyWire(faults, key, FEEDBACK_LINE)

    def write(self, data: bytes) -> None:
        """Send the lines that are neither lost nor late."""
        if due := self._commands.carry(data, self.inner.now()):
            self.inner.write(due)

    def advance(self, period: float) -> bytes:
        """Let a period pass [s], and return the feedback that arrived in it."""
        # Late commands arrive between two periods as well.
        self.write(b"")
        data = self.inner.advance(period)
        return self._feedback.carry(data, self.inner.now())

    @property
    def arrivals(self) -> Arrivals:
        """Empty: bytes don't arrive when the link received them."""
        return ()

    def close(self) -> None:
        """Close the link. Lines are complete until the next reset."""
        self._start(Faults(), 0.0)
        self.inner.close()
