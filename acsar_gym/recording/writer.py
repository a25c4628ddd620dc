"""The thread that writes a recording: it encodes events, and passes the messages on."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from acsar_gym.reading import bounded
from acsar_gym.recording.encoder import Encoder, Message
from acsar_gym.recording.events import Event

PAUSE = 0.02
"""How often the writer looks for events [s]."""
PIECE = 16
"""Events that the writer handles at once, so that the control loop never waits for it."""
BREATH = 0.0002
"""How long it lets others run after each piece [s]."""
FLUSH = 0.5
"""How often what was written is made safe from crashes [s]."""
HANG_WAIT = 1.0
"""How often the end looks whether the writer makes progress [s]."""
HANG_WAITS = 10
"""A writer that has made none in so many looks hangs; a program that was stopped loses only one."""


class Sink(Protocol):
    """Something that takes messages: a file, or viewers."""

    def add(self, message: Message) -> None:
        """Take a message."""

    def flush(self) -> None:
        """Pass on what was added."""

    def close(self, end: Mapping[str, Any]) -> None:
        """End; `end` has the number of dropped events."""

    def abandon(self) -> None:
        """End after an error; raises nothing."""


class Writer(threading.Thread):
    """Encodes events and passes the messages on.

    Attributes: `dropped`, events that were dropped; `pid`, the process that it belongs to.

    Args:
        queue: of events.
        encoder: makes messages.
        sinks: take them.
    """

    def __init__(self, queue: deque[Event], encoder: Encoder, sinks: Sequence[Sink]) -> None:
        super().__init__(name="acsar_gym recorder", daemon=True)
        self.dropped = 0
        self.pid = os.getpid()
        self._queue = queue
        self._encoder = encoder
        self._sinks = sinks
        self._error: Exception | None = None
        self._progress = 0
        self._hangs = False
        self._ending = threading.Event()

    def run(self) -> None:
        """Work until the end."""
        due = time.monotonic() + FLUSH
        while not self._ending.wait(PAUSE):
            self._empty()
            if time.monotonic() >= due:
                self._guarded(self._flush)
                due = time.monotonic() + FLUSH
        self._empty()
        self._guarded(self._close)
        for sink in self._sinks if self._error else ():
            sink.abandon()

    def finish(self) -> None:
        """Write what waits, and end, however long it takes; one that hangs is left to itself."""
        self._ending.set()
        looks = 0
        while self.is_alive() and looks < HANG_WAITS:
            before = self._progress
            self.join(HANG_WAIT)
            looks = looks + 1 if self._progress == before else 0
        self._hangs = self.is_alive()

    @property
    def problem(self) -> str | None:
        """Why writing has failed; None where it hasn't."""
        if self._error is None:
            hung = f"can't be written: writing has hung for {HANG_WAIT * HANG_WAITS:g} s"
            return f"{hung}; what waits is lost if the program ends now" if self._hangs else None
        why = bounded.reason(self._error)
        return f"can't be written: {why}; what follows isn't recorded"

    def _empty(self) -> None:
        """Write what waits in the queue now, piece by piece."""
        queue = self._queue
        for _ in range(len(queue) // PIECE + 1):
            events = [queue.popleft() for _ in range(min(PIECE, len(queue)))]
            self._guarded(self._write, events)
            time.sleep(BREATH)

    def _write(self, events: Sequence[Event]) -> None:
        for message in self._encoder.encode(events, self.dropped):
            for sink in self._sinks:
                sink.add(message)
            self._progress += 1

    def _flush(self) -> None:
        for sink in self._sinks:
            sink.flush()

    def _close(self) -> None:
        for sink in self._sinks:
            sink.close({"dropped": self.dropped})

    def _guarded(self, work: Any, *arguments: Any) -> None:
        """Do something; after the first error nothing is written any more."""
        if self._error is None:
            try:
                work(*arguments)
                self._progress += 1
            except Exception as error:  # noqa: BLE001 - told by `problem`; the robot drives on
                self._error = error
