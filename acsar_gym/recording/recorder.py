"""Records a robot while it drives, without holding up its control loop."""

from __future__ import annotations

import contextlib
import os
import time
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, RecordingWarning
from acsar_gym.recording import target
from acsar_gym.recording.encoder import Encoder
from acsar_gym.recording.events import Began, Clock, Event, Exchange
from acsar_gym.recording.header import header
from acsar_gym.recording.mcap_file import McapFile
from acsar_gym.recording.writer import Sink, Writer

CAPACITY = 20_000
"""Most events that wait for the writer: at 100 Hz more than a minute's."""
PATIENCE = 10.0
"""Longest wait of a simulation for the writer [s]; from then on it drops, too."""
WAIT = 0.001
"""How often a simulation looks whether the writer has caught up [s]."""


class Recorder:
    """Records one robot to an MCAP file, and shows it live.

    The control loop only appends to a queue, which a thread empties. Where the queue is full, a
    real robot's events are dropped and counted; a simulation waits at first. A file that can't be
    written any more, as on a full disk, doesn't stop the robot: the next reset or `close` warns
    once (RecordingWarning).

    Attributes: `dropped`, events that were dropped; `number`, that of the next exchange of the
    episode; `has_begun`, whether there has been an episode; `problem`, why the recording isn't
    whole, None where it is.

    Args:
        path: the file; None for a live view only. A recording that is there is replaced.
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
        self.problem: str | None = None
        self._sinks = list(sinks)
        self._capacity = capacity
        self._queue: deque[Event] = deque()
        self._info: Mapping[str, Any] = {}
        self._writer: Writer | None = None
        self._closed = False
        self._clock_due = 0.0
        self._waits = False

    def check(self, source: Path | None = None) -> None:
        """Check, before a link opens, that the recording can begin or go on; writes nothing.

        Args:
            source: file that the link replays, which can't be written at the same time.

        Raises:
            ConfigError: it has ended, or must not replace the file that is there.
        """
        if self._closed:
            raise ConfigError(f"{self._name}: this recording has ended: make another one")
        if self._writer is None and self.path is not None:
            target.check(self.path, source)

    def open(self, config: RobotConfig) -> None:
        """Open the file and start the writer; idempotent.

        Warns (RecordingWarning) once where writing has failed since.

        Args:
            config: of the robot.

        Raises:
            ConfigError: as for `check`, or the file can't be written.
            MissingExtraError: mcap or rosbags isn't installed.
        """
        self.check()
        if self._writer is not None:
            self._tell(self._writer)
            return
        if self.path is not None:
            self._sinks.append(McapFile(self.path, header(config, self.about)))
        self._writer = Writer(self._queue, Encoder(config), self._sinks)
        self._writer.start()
        _running.add(self)

    def describe(self, info: Mapping[str, Any]) -> None:
        """Say something about the next episode.

        Args:
            info: such as seed and goal, ready for JSON.
        """
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
        """Record a control period of the wire, and once a second the clocks.

        Args:
            event: what was sent and heard in it.
        """
        self.number = event.number + 1
        self.add(event)
        if event.stamp >= self._clock_due:
            self._clock_due = event.stamp + 1.0
            self.add(Clock(event.stamp, time.time_ns()))

    def add(self, event: Event) -> None:
        """Record an event, if there is room for it.

        Args:
            event: of `recording.events`.
        """
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
        for _ in range(int(PATIENCE / WAIT) if self._waits else 0):
            if writer is None or not writer.is_alive():
                return False
            if len(self._queue) < self._capacity:
                return True
            time.sleep(WAIT)
        self._waits = False  # a disk that doesn't answer
        return False

    @property
    def _name(self) -> str:
        return "the live view" if self.path is None else str(self.path)

    def close(self) -> None:
        """Write what waits, and finish the file; idempotent, and nothing before the first `open`.

        Warns (RecordingWarning) where the file couldn't be written.
        """
        writer, self._writer = self._writer, None
        self._closed = self._closed or writer is not None
        _running.discard(self)
        if writer is not None and writer.pid == os.getpid():
            writer.finish()
            self._tell(writer)

    def _tell(self, writer: Writer) -> None:
        """Warn once where writing has failed."""
        problem = writer.problem
        if problem is not None and self.problem is None:
            self.problem = f"{self._name}: {problem}"
            warnings.warn(self.problem, RecordingWarning, stacklevel=3)

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


_running: set[Recorder] = set()


def close_all() -> None:
    """Finish all recordings, for the end of the program; errors are ignored."""
    for recorder in list(_running):
        with contextlib.suppress(Exception):
            recorder.close()
