"""Records a robot while it drives, without holding up its control loop."""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import (
    ConfigError,
    RecordingWarning,
    check_extra,
    explain_error,
    show_value,
)
from acsar_gym.guard.shutdown import call_at_end
from acsar_gym.links.base import Arrivals, Link, LinkWrapper
from acsar_gym.recording.events import NO_ACTION, UNKNOWN_TRUTH, Began, Event, Rows
from acsar_gym.recording.messages import make_header
from acsar_gym.recording.writer import RecordingWriter, Sink, Tabulator, check_target, next_number
from acsar_gym.robot import DriveObserver, Robot, StepResult
from acsar_gym.sensors.lidar import find_lidar
from acsar_gym.wire import round_stamp
from acsar_gym.worlds import Scene

QUEUE_CAPACITY = 20_000  # most events that wait for the writer: at 100 Hz more than a minute's
WRITER_TIMEOUT = 10.0  # longest wait of a simulation for the writer [s] (then it drops, too)
ROOM_POLL = 0.001  # how often a simulation looks whether the writer has caught up [s]
BLOCK_PERIOD = 0.5  # how often events are written, so that they survive a crash [s]
BLOCK_EVENTS = 300  # most events of a block: about a second of simulated time
LARGEST = float(np.finfo(np.float32).max)  # largest number of an action
CLOSE_TIMEOUT = 60.0  # longest wait for the writer at the end: a full queue takes about 3 s [s]

SinkMaker = Callable[[RobotConfig, Mapping[str, Any]], Sink]
"""Makes a sink of the robot's config and the header of the recording."""


class Recorder(DriveObserver):
    """Records one robot to an MCAP file.

    The control loop only appends to a queue, which a thread empties about twice a second. If the
    queue is full, a real robot's events are dropped and counted. A simulation waits at first. A
    file that can't be written any more, as on a full disk, doesn't stop the robot: the next reset
    or `close` warns once (RecordingWarning).

    Attributes:
        dropped: Number of events that were dropped.
        number: Number of the episode's next exchange.
        problem: Why the recording isn't whole. None if it is.

    Args:
        path: The file. An older recording of that name is kept under a number. None writes no
            file.
        about: What the header states about the recording, ready for JSON. See
            `recording.messages`.
        capacity: Largest number of events that wait.
        sinks: What else gets the blocks of the recording, such as a viewer.

    Example:
        >>> import tempfile
        >>> from acsar_gym import Robot, open_link
        >>> from acsar_gym.recording import Recorder, read
        >>> folder = tempfile.TemporaryDirectory()
        >>> path = f"{folder.name}/drive.mcap"
        >>> with Robot(open_link("planar"), recorder=Recorder(path)) as robot:
        ...     for _ in range(100):
        ...         robot.drive(0.2, 0.0)
        >>> read(path).episodes[0].poses.shape
        (100, 3)
        >>> folder.cleanup()
    """

    def __init__(
        self,
        path: str | os.PathLike[str] | None,
        about: Mapping[str, Any] | None = None,
        capacity: int = QUEUE_CAPACITY,
        sinks: Sequence[SinkMaker] = (),
    ) -> None:
        self.path = None if path is None else Path(path)
        self.about = dict(about or {})
        self.dropped = 0
        self.number = 0
        self.problem: str | None = None

        self._capacity = capacity
        self._sinks = sinks
        # Appending to a deque takes no lock, so the control loop never waits for the writer.
        self._queue: deque[Event] = deque()
        self._info: Mapping[str, Any] = {}
        self._clock_due = 0.0
        self._waits = False
        self._scan_stamp = -math.inf
        self._revolution: Any = None

        self._is_copy = False
        self._thread: threading.Thread | None = None
        self._open_sinks: list[Sink] = []
        self._wake = threading.Event()
        self._is_ending = False
        self._failure = ""

    @classmethod
    def of(cls, record: Any) -> Recorder | None:
        """Return a recorder for a file's name. A Recorder or None is returned as it is.

        Raises:
            ConfigError: It is anything else.
            MissingExtraError: mcap or rosbags isn't installed.
        """
        if record is None or isinstance(record, Recorder):
            return record
        if not isinstance(record, str | os.PathLike):
            raise ConfigError(f"record = {show_value(record)}: must be the name of a file")
        check_extra("recording", "record", "mcap", "rosbags")
        return cls(record)

    def watch(self, link: Link, config: RobotConfig) -> Link:
        """Return a link around another link, whose bytes are recorded."""
        return RecordedLink(link, self, config)

    def after_read(self, robot: Robot) -> None:
        """Record the scan that was read, and the first scan of an episode."""
        self._add_scan(robot)

    def after_tick(self, robot: Robot, linear: float, angular: float) -> None:
        """Record a control period, and the scan if no step reads it for a while."""
        # Plain tuples cost the control loop least. Their order is that of `TABLES`.
        odometry = robot.odometry
        tick = (
            self.number - 1,
            robot.wire.stamp,
            odometry.pose,
            odometry.twist,
            robot.speeds,
            odometry.wheel_positions,
            (float(linear), float(angular)),
            robot.safety.sent,
            robot.safety.reason,
            robot.lateness,
            robot.feedback_age,
            robot.wire.decoder.refused.total(),
        )

        self.add({"ticks": tick})
        self._add_scan(robot, pause=1.0 / robot.config.lidar.rate - 0.5 * robot.config.period)

    def _add_scan(self, robot: Robot, pause: float = 0.0) -> None:
        """Record the scan, unless the newest recorded scan is younger than a pause [s]."""
        lidar = find_lidar(robot.sensors)
        stamp = robot.wire.stamp
        if lidar is None or stamp - self._scan_stamp <= pause:
            return

        # Several scans may be made of the same revolution, which is recorded once.
        self._scan_stamp = stamp
        exchange = self.number - 1
        rows: dict[str, Any] = {"scans": (exchange, stamp), "ranges": lidar.scan.ranges}
        revolution = lidar.revolution
        if revolution is not self._revolution:
            self._revolution = revolution
            rows["revolutions"] = (exchange, revolution.stamp, len(revolution.times))
            rows["measurements"] = revolution[:3]
        self.add(rows)

    def after_step(
        self, robot: Robot, result: StepResult, action: NDArray[np.floating] | None = None
    ) -> None:
        """Record what a policy got, and what it did."""
        if action is None:
            action = NO_ACTION

        outcome = (result.terminated, result.truncated, result.is_success)
        rows = {
            "steps": (result.step, robot.link.now(), result.reward, *outcome),
            # The writer reads it later, when the caller may have changed the array.
            "observations": result.observation.copy(),
            "actions": np.clip(action, -LARGEST, LARGEST).astype(np.float32),
        }
        self.add(rows)

    def after_error(self, robot: Robot, error: Exception) -> None:
        """Record what stopped the robot."""
        # Names of files need not be UTF-8.
        text = str(error).encode(errors="backslashreplace")
        self.add({"faults": [(robot.link.now(), text)]})

    def check(self, source: Path | None = None) -> None:
        """Check, before a link opens, that the recording can begin or go on. Writes nothing.

        Args:
            source: The recording that the link replays.

        Raises:
            ConfigError: It has ended, would replace a file of another kind, or is `source`.
        """
        if self._is_ending:
            raise ConfigError(f"{self.path}: this recording has ended: make another one")
        if self._thread is None and self.path is not None:
            check_target(self.path, source)

    def open(self, config: RobotConfig) -> None:
        """Open the file and start the writer. Idempotent.

        Raises:
            ConfigError: As for `check`, or the file can't be written.
            MissingExtraError: mcap or rosbags isn't installed.

        Warns:
            RecordingWarning: Writing has failed since, once.
        """
        self.check()
        if self._thread is not None:
            self._warn()
            return

        # The link has been opened: from here on a file of the same name is replaced.
        header = make_header(config, self.about)
        # The file is opened last: it would stay locked after an error of another sink.
        open_sinks = [make(config, header) for make in self._sinks]
        if self.path is not None:
            # The copied recorder may still write its file.
            if self._is_copy and self.path.exists():
                self.path = next_number(self.path)
            # It is written first: a viewer may take its time.
            open_sinks.insert(0, RecordingWriter(self.path, config, header))
        self._open_sinks = open_sinks
        self._thread = threading.Thread(
            target=self._write_blocks, name="acsar_gym recorder", daemon=True
        )
        self._thread.start()
        _open_recorders.add(self)
        call_at_end(close_recorders)

    def _write_blocks(self) -> None:
        """Write about twice a second, until the end or an error. The robot drives on after it."""
        tabulator = Tabulator(self._open_sinks)
        is_last = False
        try:
            while not is_last:
                self._wake.wait(BLOCK_PERIOD)
                self._wake.clear()
                # Read before the queue is emptied: what came before `close` is then in it.
                is_last = self._is_ending
                # What comes meanwhile is written in the next round, so that each round ends.
                for waiting in range(len(self._queue), 0, -BLOCK_EVENTS):
                    count = min(waiting, BLOCK_EVENTS)
                    tabulator.add([self._queue.popleft() for _ in range(count)])
                for sink in self._open_sinks:
                    sink.flush()

            tabulator.add((), is_last=True)
            for sink in self._open_sinks:
                sink.close(self.dropped)
        except Exception as error:  # noqa: BLE001 - reported with the next reset
            self._failure = f"{explain_error(error)}; what follows isn't recorded"
            for sink in self._open_sinks:
                sink.abandon()

    def describe(self, info: Mapping[str, Any], **about: Any) -> None:
        """Describe the next episode.

        Args:
            info: Seed, goal, start and world, as far as they are known.
            about: Entries for the header of the recording, unless it has them.
        """
        self._info = info
        for name, value in about.items():
            self.about.setdefault(name, value)

    def begin(self, stamp: float, *, simulated: bool, stamped: bool = False) -> None:
        """Begin an episode.

        Args:
            stamp: Time of the reset on the link's clock [s].
            simulated: Whether time is simulated. A simulation waits for the writer.
            stamped: Whether lines have the times at which they were measured. See `Link.stamped`.
        """
        self.number = 0
        self._waits = simulated
        self._clock_due = stamp + 1.0
        self._scan_stamp = -math.inf
        self._revolution = None
        # A replay must know which times these are.
        info = {**self._info, "stamped": True} if stamped else self._info
        # Even into a full queue: without it, the next rows would count for the last episode.
        self._queue.append(Began(stamp, time.time_ns(), info))
        self._info = {}

    def add_period(self, stamp: float, rows: dict[str, Any]) -> None:
        """Record the rows of a control period of the wire, and once a second the clocks."""
        self.number += 1
        if stamp >= self._clock_due:
            self._clock_due = stamp + 1.0
            rows["clocks"] = (stamp, time.time_ns())
        self.add(rows)

    def add(self, rows: Rows) -> None:
        """Record rows, if there is room for them. A simulation waits for the writer first."""
        if len(self._queue) < self._capacity:
            self._queue.append(rows)
            return

        # Wheels don't wait for a disk. Simulated time may.
        # A disk that never answers must not stop a simulation for ever either.
        deadline = time.monotonic() + WRITER_TIMEOUT
        while len(self._queue) >= self._capacity:
            is_writing = self._thread is not None and self._thread.is_alive()
            if not is_writing or not self._waits or time.monotonic() >= deadline:
                self._waits = False  # a disk that doesn't answer
                self.dropped += 1
                return
            self._wake.set()
            time.sleep(ROOM_POLL)
        self._queue.append(rows)

    def close(self) -> None:
        """Write what waits, and finish the file. Idempotent.

        Warns:
            RecordingWarning: The file couldn't be written.
        """
        _open_recorders.discard(self)
        if self._is_ending or self._thread is None:
            return
        self._is_ending = True
        if self._thread.is_alive():  # not in a fork, nor after an error
            self._wake.set()
            self._thread.join(CLOSE_TIMEOUT)
            if self._thread.is_alive():
                self._failure = f"not finished after {CLOSE_TIMEOUT:g} s: the rest may be lost"
        self._warn()

    def _warn(self) -> None:
        """Warn once if writing has failed."""
        if self._failure and self.problem is None:
            self.problem = f"{self.path or 'viewer'}: can't be written: {self._failure}"
            warnings.warn(self.problem, RecordingWarning, stacklevel=3)

    def __reduce__(self) -> tuple[Callable[..., Recorder], tuple[Any, ...]]:
        """Copies haven't begun yet. If there is a file, they write one with another number."""
        return _copy_recorder, (self.path, self.about)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _copy_recorder(path: Path | None, about: Mapping[str, Any]) -> Recorder:
    recorder = Recorder(path, about)
    recorder._is_copy = True  # noqa: SLF001 - only copies are
    return recorder


_open_recorders: set[Recorder] = set()


def close_recorders() -> None:
    """Finish all recordings, for the end of the program. Errors are ignored."""
    for recorder in list(_open_recorders):
        with contextlib.suppress(Exception):
            recorder.close()


class RecordedLink(LinkWrapper):
    """Passes the bytes of another link to a recorder.

    Its clock is still between resets, writes and periods, so that a replay shows the same times.
    """

    def __init__(self, inner: Link, recorder: Recorder, config: RobotConfig) -> None:
        super().__init__(inner)
        self._recorder = recorder
        self._config = config
        self._writes: list[tuple[float, bytes]] = []
        self._now = 0.0

    def open(self) -> None:
        """Open the link, then the recorder: a link that doesn't open replaces no older recording.

        Raises:
            ConfigError: The recording can't be written, or must not replace an existing file.
            LinkError: As for the link.
        """
        prefix, _, replayed = self.inner.device.partition(":")
        self._recorder.check(Path(replayed) if prefix == "replay" else None)
        self.inner.open()
        try:
            self._recorder.open(self._config)
        except BaseException:
            self.inner.close()
            raise
        _ = self.inner.arrivals  # from now on the link notes when bytes arrive

    def reset(self, scene: Scene) -> None:
        """Start an episode."""
        self._recorder.open(self._config)
        self._record_last_writes()
        self.inner.reset(scene)
        self._now = self.inner.now()
        self._recorder.begin(
            self._now, simulated=self.inner.lateness is None, stamped=self.inner.stamped
        )

    def write(self, data: bytes) -> None:
        """Send bytes to the link."""
        self.inner.write(data)
        if self.inner.lateness is not None:  # time goes on meanwhile
            self._now = round_stamp(self.inner.now())
        self._writes.append((self._now, data))

    def advance(self, period: float) -> bytes:
        """Advance the link and record the period."""
        link = self.inner
        data = link.advance(period)
        self._now = now = link.now()
        # Links that don't know when their bytes arrived report nothing.
        pieces: Arrivals = tuple(link.arrivals)
        if b"".join([piece for _, piece in pieces]) != data:
            pieces = ((now, data),)

        truth = link.truth
        true_state = UNKNOWN_TRUTH if truth is None else (truth.pose, truth.twist, truth.contact)
        # All rows of a period are one event, which is recorded as a whole or dropped.
        number = self._recorder.number
        counts = (len(self._writes), len(pieces))
        rows: dict[str, Any] = {
            "exchanges": (number, now, *counts, link.lateness, *true_state),
            "sent": self._writes,
            "received": pieces,
        }
        if truth is not None and truth.crowd is not None:
            rows["movers"] = (number, now, truth.crowd.hit, truth.crowd.intrusions)
            rows["mover_states"] = truth.crowd.copy_states()

        self._writes = []
        self._recorder.add_period(now, rows)
        return data

    def now(self) -> float:
        """Return the time of the newest reset, write or period, on the link's clock [s]."""
        return self._now

    def close(self) -> None:
        """Close the link. The recording goes on with the next reset."""
        try:
            self.inner.close()
        finally:
            self._record_last_writes()

    def _record_last_writes(self) -> None:
        """Record what was sent since the last period of the episode."""
        if self._writes:
            self._recorder.add({"sent": self._writes})
        self._writes = []

    def __reduce__(self) -> tuple[Callable[[Link], Link], tuple[Link]]:
        """Copies aren't recorded: two robots can't write one file."""
        return _unwrapped, (self.inner,)


def _unwrapped(link: Link) -> Link:
    return link
