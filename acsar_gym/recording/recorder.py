"""Records a robot while it drives, without holding up its control loop."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.reading import bounded
from acsar_gym.recording.encoder import Encoder, Message
from acsar_gym.recording.events import Began, Clock, Event, Exchange
from acsar_gym.recording.header import header
from acsar_gym.recording.mcap_file import McapFile

CAPACITY = 20_000
"""Most events that wait for the writer: at 100 Hz more than a minute's."""
PAUSE = 0.02
"""How often the writer looks for events [s]."""
PIECE = 16
"""Events that the writer handles at once, so that the control loop never waits for it."""
BREATH = 0.0002
"""How long it lets others run after each piece [s]."""
FLUSH = 0.5
"""How often what was written is made safe from crashes [s]."""
WAIT = 0.001
"""How often a simulation looks whether the writer has caught up [s]."""
CLOSE = 10.0
"""Longest wait for the writer at the end [s]."""


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


class Recorder:
    """Records one robot to an MCAP file, and shows it live.

    The control loop only appends to a queue, which a thread empties. Where the queue is full, a
    real robot's events are dropped and counted; a simulation waits. A file that can't be written
    any more, as on a full disk, doesn't stop the robot: `close` and the next reset tell.

    Attributes: `dropped`, events that were dropped; `number`, that of the next exchange of the
    episode; `has_begun`, whether there has been an episode.

    Args:
        path: the file; None for a live view only. One that is there is replaced.
        about: what the header says about it, ready for JSON; see `recording.header`.
        sinks: what else gets the messages.
        capacity: most events that wait.
    """

    def __init__(
        self,
        path: str | os.PathLike[str] | None,
        about: Mapping[str, Any] | None = None,
        sinks: Sequence[Sink] = (),
        capacity: int = CAPACITY,
    ) -> None:
        self.path = None if path is None else Path(path)
        self.about = dict(about or {})
        self.dropped = 0
        self.number = 0
        self.has_begun = False
        self._sinks = list(sinks)
        self._capacity = capacity
        self._queue: deque[Event] = deque()
        self._info: Mapping[str, Any] = {}
        self._writer: _Writer | None = None
        self._closed = False
        self._clock_due = 0.0
        self._waits = False

    def open(self, config: RobotConfig) -> None:
        """Open the file and start the writer; idempotent.

        Raises:
            ConfigError: the file can't be written, or the recording has ended.
            MissingExtraError: mcap or rosbags isn't installed.
        """
        if self._closed:
            raise ConfigError(f"{self._name}: this recording has ended: make another one")
        if self._writer is not None:
            self._writer.check(self._name)
            return
        if self.path is not None:
            self._sinks.append(McapFile(self.path, header(config, self.about)))
        self._writer = _Writer(self._queue, Encoder(config), self._sinks)
        self._writer.start()
        _running.add(self)

    def describe(self, info: Mapping[str, Any]) -> None:
        """Say something about the next episode, such as seed and goal, ready for JSON."""
        self._info = info

    def begin(self, stamp: float, *, simulated: bool) -> None:
        """Begin an episode.

        Args:
            stamp: time of the reset on the link's clock [s].
            simulated: whether the link can wait for the writer.
        """
        self.number, self._waits, self.has_begun = 0, simulated, True
        self._clock_due = stamp + 1.0
        self._queue.append(Began(stamp, time.time_ns(), self._info))
        self._info = {}

    def exchanged(self, event: Exchange) -> None:
        """Record a control period of the wire, and once a second the clocks."""
        self.number = event.number + 1
        self.add(event)
        if event.stamp >= self._clock_due:
            self._clock_due = event.stamp + 1.0
            self.add(Clock(event.stamp, time.time_ns()))

    def add(self, event: Event) -> None:
        """Record an event, if there is room for it."""
        if len(self._queue) >= self._capacity and not self._has_room():
            self.dropped += 1
            writer = self._writer
            if writer is not None:
                writer.dropped = self.dropped
            return
        self._queue.append(event)

    def _has_room(self) -> bool:
        """Whether there is room; for a simulation once the writer has caught up."""
        writer = self._writer
        while self._waits and writer is not None and writer.is_alive():
            if len(self._queue) < self._capacity:
                return True
            time.sleep(WAIT)
        return False

    @property
    def _name(self) -> str:
        return "the live view" if self.path is None else str(self.path)

    def close(self) -> None:
        """Write what waits, and finish the file; idempotent.

        Raises:
            ConfigError: the file couldn't be written.
        """
        writer, self._writer = self._writer, None
        self._closed = True
        _running.discard(self)
        if writer is not None and writer.pid == os.getpid():
            writer.finish()
            writer.check(self._name)

    def __reduce__(self) -> tuple[type[Recorder], tuple[Path | None, dict[str, Any]]]:
        """Copies haven't begun yet."""
        return Recorder, (self.path, self.about)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class _Writer(threading.Thread):
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
        """Write what waits, and end."""
        self._ending.set()
        self.join(CLOSE)

    def check(self, name: str) -> None:
        """Raise ConfigError where writing has failed."""
        if self._error is not None:
            why = bounded.reason(self._error)
            raise ConfigError(f"{name}: can't be written: {why}") from None

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
            except Exception as error:  # noqa: BLE001 - told by `check`; the robot drives on
                self._error = error


_running: set[Recorder] = set()


def close_all() -> None:
    """Finish all recordings, for the end of the program; errors are ignored."""
    for recorder in list(_running):
        with contextlib.suppress(Exception):
            recorder.close()
