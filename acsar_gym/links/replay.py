"""Replays a recording as a link: the same bytes at the same times, if the commands are the same."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import LinkLostError
from acsar_gym.links.base import Arrivals
from acsar_gym.protocol import ZERO, encode
from acsar_gym.recording.reader import read
from acsar_gym.recording.tape import Tape
from acsar_gym.recording.types import Recording
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene

LEAD_PERIODS = 2  # periods at rest that precede a part of an episode: so many end a reset (`wire`)


class ByteStream(Protocol):
    """A byte stream, such as an open serial port."""

    def write(self, data: bytes) -> object:
        """Send bytes."""

    def read(self, size: int) -> bytes:
        """Read exactly `size` bytes, or fewer after the port's own time-out."""


class ReplayLink:
    """Replays the episodes of a recording, one per reset, with the recorded times.

    Commands are compared with those recorded. Where they differ, what was recorded is no answer to
    them, so the replay ends with an error that names the tick. A part of an episode has no reset of
    its own: the robot is said to stand still for as long as one takes.

    Attributes: `replays`, the path.
    """

    def __init__(
        self, path: str | Path, port: ByteStream | None = None, *, compare: bool = True
    ) -> None:
        self.replays = Path(path)
        self._port = port
        self._compare = compare
        self._recording: Recording | None = None
        self._next_episode = 0
        self._tape: Tape | None = None
        self._sent = b""
        self._lead = 0
        self._is_open = False

    def open(self) -> None:
        """Read the recording; ConfigError if it can't be read."""
        if self._recording is None:
            self._recording = read(self.replays, revolutions=True)
            self._tape = Tape(self._recording.episodes[0])
        self._is_open = True

    def reset(self, scene: Scene) -> None:
        """Start the next episode; LinkLostError after the last one."""
        self.open()
        episodes = self._recording.episodes if self._recording else ()
        if self._next_episode >= len(episodes):
            missing = "; the file is cut: its end is missing" if self._is_cut() else ""
            raise LinkLostError(
                f"{self.replays}: all {self._next_episode} episodes have been played{missing}",
                "make a new link to play it again",
            )
        episode = episodes[self._next_episode]
        self._tape = Tape(episode)
        self._lead = LEAD_PERIODS if "part" in episode.info else 0
        self._next_episode += 1
        self._sent = b""

    def _is_cut(self) -> bool:
        """Whether the file is cut, after the newest episode."""
        recording = self._recording
        return (
            recording is not None
            and recording.cut
            and self._next_episode == len(recording.episodes)
        )

    def write(self, data: bytes) -> None:
        """Take commands, which the next `advance` compares; a port gets them as well."""
        tape = self._require_tape()
        if not self._lead:
            tape.wrote()
        self._sent += data
        if self._port is not None:
            self._port.write(data)

    def advance(self, period: float) -> bytes:
        """Return the bytes of the next period.

        Raises:
            LinkLostError: the episode ends here, commands differ, or the recording has a gap.
        """
        tape, sent = self._require_tape(), self._sent
        if self._lead:
            self._lead -= 1
            self._sent = b""
            return encode(ZERO)
        if tape.is_over:
            if self._is_cut():
                raise LinkLostError(
                    f"{self.replays}: the file is cut here, {tape.place}",
                    "what followed is missing",
                )
            raise LinkLostError(
                f"{self.replays}: the recorded episode ends here, {tape.place}",
                "was it made with this goal and policy?",
            )
        if tape.has_gap:
            damaged = self._recording is not None and bool(self._recording.damages)
            why = "the file is damaged" if damaged else "its writer couldn't keep up"
            raise LinkLostError(
                f"{self.replays}: the recording has a gap, {tape.place}",
                f"{why}: it can't be replayed from here on",
            )
        recorded, got = tape.next()
        self._sent = b""
        if self._compare and sent != recorded:
            one, other = (data[-40:].strip().decode("latin-1") for data in (sent, recorded))
            raise LinkLostError(
                f"{self.replays}: other commands than recorded, {tape.place}: "
                f"{one!r}, not {other!r}",
                "was it made with this robot, goal and policy?",
            )
        if self._port is None:
            return got
        arrived = self._port.read(len(got))
        if len(arrived) != len(got):
            raise LinkLostError(
                f"{self.replays}: the port sent {len(arrived)} of {len(got)} bytes",
                "check the tape player",
            )
        return arrived

    def _require_tape(self) -> Tape:
        if not self._is_open or self._tape is None or not self._next_episode:
            raise LinkLostError(f"{self.replays}: nothing plays", "call reset() first")
        return self._tape

    def now(self) -> float:
        """Return the recorded time [s]."""
        return self._tape.now - self._lead * self._tape.first_period if self._tape else 0.0

    @property
    def truth(self) -> GroundTruth | None:
        """Recorded ground truth; None for the recording of a real robot, and before `open`."""
        return self._tape.truth if self._tape else None

    @property
    def echoes(self) -> bool | None:
        """Whether the board of this episode echoed; None where it was simulated."""
        return None if self._tape is None or self.lateness is None else self._tape.echoes

    @property
    def lateness(self) -> float | None:
        """Recorded lateness [s]; None where time was simulated, and before the first period."""
        return self._tape.lateness if self._tape else None

    @property
    def arrivals(self) -> Arrivals:
        """When the bytes of the newest period arrived, as recorded [s]."""
        return self._tape.arrivals if self._tape else []

    def revolution(self) -> tuple[float, NDArray[np.float64]] | None:
        """Return the LiDAR's revolution that was the newest one; see `Tape.revolution`."""
        return self._tape.revolution() if self._tape else None

    def oldest_measurement(self) -> float:
        """Return the age of the oldest measurement in the episode; see `Tape` [s]."""
        return self._tape.oldest_measurement() if self._tape else 0.0

    def __reduce__(self) -> tuple[Callable[..., ReplayLink], tuple[Path, ByteStream | None]]:
        """Copy with the replay at its beginning."""
        return partial(ReplayLink, compare=self._compare), (self.replays, self._port)

    def close(self) -> None:
        """Close the link, but not the port, which its owner closes. A reset opens it again."""
        self._is_open = False
        self._sent = b""
