"""Records a robot while it drives, without holding up its control loop."""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
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
from acsar_gym.links.base import Link
from acsar_gym.recording.events import Began, Clock, Event, Exchange, Fault, Scanned, Stepped, Tick
from acsar_gym.recording.messages import make_header
from acsar_gym.recording.recorded import RecordedLink
from acsar_gym.recording.writer import RecordingWriter, check_target, next_number
from acsar_gym.robot import DriveObserver, Robot, StepResult
from acsar_gym.sensors.lidar import find_lidar

QUEUE_CAPACITY = 20_000  # most events that wait for the writer: at 100 Hz more than a minute's
WRITER_TIMEOUT = 10.0  # longest wait of a simulation for the writer [s]; from then on it drops, too
ROOM_POLL = 0.001  # how often a simulation looks whether the writer has caught up [s]
BLOCK_PERIOD = 0.5  # how often events are written, so that they survive a crash [s]
BLOCK_EVENTS = 300  # most events of a block: about a second of simulated time
LARGEST = float(np.finfo(np.float32).max)  # largest number of an action
HANG_WAIT = 1.0  # how often the end looks whether the writer makes progress [s]
HANG_WAITS = 10  # a writer without progress in so many looks hangs; a suspended program loses one


class WriterThread(threading.Thread):
    """Writes events, about twice a second.

    Attributes:
        dropped: Number of events that were dropped.
        pid: Id of the process that it belongs to.
    """

    def __init__(self, queue: deque[Event], writer: RecordingWriter) -> None:
        super().__init__(name="acsar_gym recorder", daemon=True)
        self.dropped = 0
        self.pid = os.getpid()
        self._queue = queue
        self._writer = writer
        self._error: Exception | None = None
        self._hangs = False
        self._is_ending = False
        self._wake = threading.Event()

    def run(self) -> None:
        """Write until the end; after the first error nothing is written any more."""
        try:
            while not self._is_ending:
                self._wake.wait(BLOCK_PERIOD)
                self._wake.clear()
                self._write_queue()
            self._write_queue()
            self._writer.close(self.dropped)
        except Exception as error:  # noqa: BLE001 - reported by `problem`; the robot drives on
            self._error = error
            self._writer.abandon()
            while not self._is_ending:
                self._queue.clear()
                self._wake.wait(BLOCK_PERIOD)

    def hurry(self) -> None:
        """Write now what waits: the queue is full."""
        self._wake.set()

    def _write_queue(self) -> None:
        """Write the events that wait now."""
        queue = self._queue
        waiting = len(queue)
        for written in range(0, waiting, BLOCK_EVENTS):
            count = min(waiting - written, BLOCK_EVENTS)
            self._writer.add([queue.popleft() for _ in range(count)])
            self._writer.write_block()
        self._writer.flush()

    def finish(self) -> None:
        """Write what waits, and end, however long it takes; a thread that hangs is abandoned."""
        self._is_ending = True
        self._wake.set()
        looks = 0
        while self.is_alive() and looks < HANG_WAITS:
            written = self._writer.written
            self.join(HANG_WAIT)
            looks = looks + 1 if self._writer.written == written else 0
        self._hangs = self.is_alive()

    @property
    def problem(self) -> str | None:
        """Why writing has failed; None if it hasn't."""
        if self._error is not None:
            return f"can't be written: {explain_error(self._error)}; what follows isn't recorded"
        if not self._hangs:
            return None
        hung = f"can't be written: writing has hung for {HANG_WAIT * HANG_WAITS:g} s"
        return f"{hung}; what waits is lost if the program ends now"


class Recorder(DriveObserver):
    """Records one robot to an MCAP file.

    The control loop only appends to a queue, which a thread empties. If the queue is full, a real
    robot's events are dropped and counted; a simulation waits at first. A file that can't be
    written any more, as on a full disk, doesn't stop the robot: the next reset or `close` warns
    once (RecordingWarning).

    Attributes:
        dropped: Number of events that were dropped.
        number: Number of the episode's next exchange.
        has_begun: Whether there has been an episode.
        problem: Why the recording isn't whole; None if it is.

    Args:
        path: The file. An older recording of that name is kept under a number. None records
            nothing, for recorders that keep events themselves.
        about: What the header states about the recording, ready for JSON; see
            `recording.messages`.
        capacity: Largest number of events that wait.

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
    ) -> None:
        self.path = None if path is None else Path(path)
        self.about = dict(about or {})
        self.dropped = 0
        self.number = 0
        self.has_begun = False
        self.problem: str | None = None

        self._capacity = capacity
        self._queue: deque[Event] = deque()
        self._info: Mapping[str, Any] = {}
        self._writer: WriterThread | None = None
        self._closed = False
        self._clock_due = 0.0
        self._waits = False
        self._is_copy = False
        self._scan_stamp = -math.inf

    @classmethod
    def of(cls, record: Any) -> Recorder | None:
        """Return a recorder for a file's name; a Recorder or None as it is.

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

    def after_reset(self, robot: Robot) -> None:
        """Record the first scan of an episode."""
        self._scan_stamp = -math.inf
        self._add_scan(robot)

    def after_read(self, robot: Robot) -> None:
        """Record the scan that was read."""
        self._add_scan(robot)

    def after_tick(self, robot: Robot, linear: float, angular: float) -> None:
        """Record a control period, and the scan if no step reads it for a while."""
        tick = Tick(
            exchange=self.number - 1,
            stamp=robot.wire.stamp,
            pose=robot.odometry.pose,
            twist=robot.odometry.twist,
            speeds=robot.speeds,
            angles=robot.odometry.wheel_positions,
            asked=(float(linear), float(angular)),
            sent=robot.safety.sent,
            reason=robot.safety.reason,
            lateness=robot.lateness,
            feedback_age=robot.feedback_age,
            refused=robot.wire.decoder.refused.total(),
        )
        self.add(tick)

        self._add_scan(robot, pause=1.0 / robot.config.lidar.rate - 0.5 * robot.config.period)

    def _add_scan(self, robot: Robot, pause: float = 0.0) -> None:
        """Record the scan, unless the newest recorded scan is younger than a pause [s]."""
        lidar = find_lidar(robot.sensors)
        stamp = robot.wire.stamp
        if lidar is not None and stamp - self._scan_stamp > pause:
            self._scan_stamp = stamp
            scanned = Scanned(self.number - 1, stamp, lidar.scan.ranges, lidar.revolution)
            self.add(scanned)

    def after_step(
        self, robot: Robot, result: StepResult, action: NDArray[np.floating] | None = None
    ) -> None:
        """Record what a policy got, and what it did."""
        if action is not None:
            action = np.clip(action, -LARGEST, LARGEST).astype(np.float32)
        step = Stepped(
            step=result.step,
            stamp=robot.link.now(),
            observation=result.observation.copy(),
            action=action,
            reward=result.reward,
            terminated=result.terminated,
            truncated=result.truncated,
            success=result.is_success,
        )
        self.add(step)

    def after_error(self, robot: Robot, error: Exception) -> None:
        """Record what stopped the robot."""
        self.add(Fault(robot.link.now(), str(error)))

    def check(self, source: Path | None = None) -> None:
        """Check, before a link opens, that the recording can begin or go on; writes nothing.

        Args:
            source: The recording that the link replays.

        Raises:
            ConfigError: It has ended, would replace a file of another kind, or is `source`.
        """
        if self._closed:
            raise ConfigError(f"{self.path}: this recording has ended: make another one")
        if self._writer is None and self.path is not None:
            check_target(self.path, source)

    def open(self, config: RobotConfig) -> None:
        """Open the file and start the writer; idempotent.

        Raises:
            ConfigError: As for `check`, or the file can't be written.
            MissingExtraError: mcap or rosbags isn't installed.

        Warns:
            RecordingWarning: Writing has failed since, once.
        """
        self.check()
        if self._writer is not None:
            self._warn(self._writer)
            return
        if self.path is None:
            return
        if self._is_copy and self.path.exists():
            self.path = next_number(self.path)
        writer = RecordingWriter(self.path, config, make_header(config, self.about))
        self._writer = WriterThread(self._queue, writer)
        self._writer.start()
        _open_recorders.add(self)
        call_at_end(close_recorders)

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
            stamped: Whether lines have the times at which they were measured; see `Link.stamped`.
        """
        self.number = 0
        self.has_begun = True
        self._waits = simulated
        self._clock_due = stamp + 1.0
        info = {**self._info, "stamped": True} if stamped else self._info
        self._queue.append(Began(stamp, time.time_ns(), info))
        self._info = {}

    def add_exchange(self, event: Exchange) -> None:
        """Record a control period of the wire, and once a second the clocks."""
        self.number = event.number + 1
        self.add(event)
        if event.stamp >= self._clock_due:
            self._clock_due = event.stamp + 1.0
            self.add(Clock(event.stamp, time.time_ns()))

    def add(self, event: Event) -> None:
        """Record an event, if there is room for it; a simulation waits for the writer first."""
        if len(self._queue) < self._capacity:
            self._queue.append(event)
            return

        deadline = time.monotonic() + WRITER_TIMEOUT if self._waits else 0.0
        while len(self._queue) >= self._capacity:
            writer = self._writer
            if writer is None or not writer.is_alive() or time.monotonic() >= deadline:
                self._waits = False  # a disk that doesn't answer
                self.dropped += 1
                if writer is not None:
                    writer.dropped = self.dropped
                return
            writer.hurry()
            time.sleep(ROOM_POLL)
        self._queue.append(event)

    def close(self) -> None:
        """Write what waits, and finish the file; idempotent.

        Warns:
            RecordingWarning: The file couldn't be written.
        """
        writer = self._writer
        self._writer = None
        self._closed = self._closed or writer is not None
        _open_recorders.discard(self)
        if writer is not None and writer.pid == os.getpid():
            writer.finish()
            self._warn(writer)

    def _warn(self, writer: WriterThread) -> None:
        problem = writer.problem
        if problem is not None and self.problem is None:
            self.problem = f"{self.path}: {problem}"
            warnings.warn(self.problem, RecordingWarning, stacklevel=3)

    def __reduce__(self) -> tuple[Callable[..., Recorder], tuple[Any, ...]]:
        """Copies haven't begun yet. If the file exists, they write a file with another number."""
        return _copy_recorder, (self.path, self.about)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _copy_recorder(path: Path | None, about: dict[str, Any]) -> Recorder:
    recorder = Recorder(path, about)
    recorder._is_copy = True  # noqa: SLF001 - only copies are
    return recorder


_open_recorders: set[Recorder] = set()


def close_recorders() -> None:
    """Finish all recordings, for the end of the program; errors are ignored."""
    for recorder in list(_open_recorders):
        with contextlib.suppress(Exception):
            recorder.close()
