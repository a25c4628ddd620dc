"""One direction of a cable whose lines have faults, and events that begin at random."""

from __future__ import annotations

import math
from collections import Counter, deque

import numpy as np

from acsar_gym.links.faults import EPSILON, LINE_FAULTS, Faults, Lines
from acsar_gym.links.lots import COMMANDS, FEEDBACK, lot

BUFFER = 65536
"""Most bytes that wait behind a late line; more are lost, as in a driver's buffer."""
MOST_BURSTS = 16
"""Bursts of garbage in one period, at most."""


class Event:
    """An event that begins at a set time or at random at a rate [1/s], and has a duration [s].

    Times count from `start` on.
    """

    def __init__(
        self,
        name: str,
        lasting: float,
        faults: Faults,
        count: Counter[str],
        rng: np.random.Generator,
    ) -> None:
        self._name, self._lasting, self._rng, self._count = name, lasting, rng, count
        self._rate: float = getattr(faults, f"{name}_rate")
        after: float | None = getattr(faults, f"{name}_at")
        self._after = self._pause() if after is None else after
        self._next = math.inf
        self._until = -math.inf

    def start(self, now: float) -> None:
        """Start the clock; before that the event can't begin."""
        self._next = now + self._after

    def _pause(self) -> float:
        """Draw the time until the next event [s]."""
        return float(self._rng.exponential(1.0 / self._rate)) if self._rate else math.inf

    def going(self, now: float) -> bool:
        """Whether the event is going on now; counts it when it begins."""
        if now + EPSILON >= max(self._next, self._until):
            self._count[self._name] += 1
            self._until = now + self._lasting
            self._next = self._until + self._pause()
        return now + EPSILON < self._until


class FaultyWire:
    """One direction of the cable. Lines keep their order: none overtakes a late one."""

    def __init__(
        self,
        faults: Faults,
        direction: str,
        key: float,
        rng: np.random.Generator,
        count: Counter[str],
    ) -> None:
        here = faults.direction in (direction, "both")
        self._suffers = here and faults.lines_suffer
        shares = [(name, n, getattr(faults, name)) for n, name in enumerate(LINE_FAULTS)]
        self._shares = [(name, kind, share) for name, kind, share in shares if share]
        self._whose = FEEDBACK if direction == "feedback" else COMMANDS
        self._key, self._number = key, 0
        self._lateness = faults.lateness
        self._burst_rate = faults.garbage_rate if here else 0.0
        self._burst = faults.garbage_bytes
        self._rng, self._count = rng, count
        self._lines = Lines()
        self._queue: deque[tuple[float, bytes]] = deque()
        self._waiting = 0

    def cut_off(self) -> None:
        """Forget an incomplete line."""
        self._lines.partial = b""

    def carry(self, data: bytes, now: float) -> bytes:
        """Put bytes in, and return those that come out at the other end now."""
        if not self._suffers:
            return data
        for line in self._lines.feed(data):
            self._send(line, now)
        out = b""
        while self._queue and self._queue[0][0] <= now + EPSILON:
            out += self._queue.popleft()[1]
        self._waiting -= len(out)
        return out

    def _send(self, line: bytes, now: float) -> None:
        """Queue a complete line with its faults."""
        hits: set[str] = set()
        if line.strip():  # the second half of a line end that was split isn't a line
            key, whose, number = self._key, self._whose, self._number
            hits = {name for name, n, share in self._shares if lot(key, whose, number, n) < share}
            self._number += 1
        if "dropped_lines" in hits:
            hits = {"dropped_lines"}
        self._count.update(hits)
        line = self._damaged(line, hits)
        if line and (not self._queue or self._waiting + len(line) <= BUFFER):
            self._queue.append((now + self._lateness * ("late_lines" in hits), line))
            self._waiting += len(line)

    def _damaged(self, line: bytes, hits: set[str]) -> bytes:
        """Apply faults to a line; empty where it is dropped."""
        if "dropped_lines" in hits:
            return b""
        if "cut_lines" in hits:
            line = line[: self._rng.integers(len(line))]
        if "corrupted_lines" in hits and line:
            bent = bytearray(line)
            most = min(3, len(line))
            places = self._rng.choice(len(line), self._rng.integers(1, most + 1), replace=False)
            for place in places:
                bent[place] ^= 1 << int(self._rng.integers(8))
            line = bytes(bent)
        return line * (1 + ("duplicated_lines" in hits))

    def noisy(self, data: bytes, period: float) -> bytes:
        """Insert garbage into the bytes of a period [s]."""
        if not self._burst_rate:
            return data
        bursts = min(int(self._rng.poisson(self._burst_rate * period)), MOST_BURSTS)
        for _ in range(bursts):
            place = self._rng.integers(len(data) + 1)
            data = data[:place] + self._rng.bytes(self._burst) + data[place:]
            self._count["garbage"] += 1
        return data
