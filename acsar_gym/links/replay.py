"""Replays a recording as a link: the same bytes at the same times, whatever is commanded."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from acsar_gym.errors import LinkLostError
from acsar_gym.links import recording
from acsar_gym.worlds import Scene


class Port(Protocol):
    """A byte stream, such as an open serial port."""

    def write(self, data: bytes) -> object:
        """Send bytes."""

    def read(self, size: int) -> bytes:
        """Read exactly `size` bytes, or fewer after the port's own time-out."""


class ReplayLink:
    """Replays the episodes of a recording, one per reset, with the recorded times.

    Args:
        path: the recording.
        port: read the feedback of each period from this port, to which another program replays
            it; the recording then only provides the number of bytes. None to use the recorded
            bytes.
    """

    truth = None
    lateness = None

    def __init__(self, path: Path, port: Port | None = None) -> None:
        self._path = path
        self._port = port
        self._episodes: list[recording.Episode] = []
        self._next_episode = 0
        self._next_period = 0
        self._now = 0.0
        self._is_open = False

    def open(self) -> None:
        """Read the recording; ConfigError if it can't be read."""
        if not self._episodes:
            self._episodes = recording.read(self._path)
        self._is_open = True

    def reset(self, scene: Scene) -> None:
        """Start the next episode; LinkLostError after the last one."""
        self.open()
        if self._next_episode >= len(self._episodes):
            raise LinkLostError(
                f"{self._path}: all {self._next_episode} episodes have been played",
                "make a new link to play it again",
            )
        self._now = self._episodes[self._next_episode].start
        self._next_episode += 1
        self._next_period = 0

    def write(self, data: bytes) -> None:
        """Send commands to the port, if there is one; they don't affect the replay."""
        self._check_open()
        if self._port is not None:
            self._port.write(data)

    def advance(self, period: float) -> bytes:
        """Return the bytes of the next period; LinkLostError at the end of the episode."""
        self._check_open()
        periods = self._episodes[self._next_episode - 1].periods
        if self._next_period >= len(periods):
            raise LinkLostError(
                f"{self._path}: the recorded episode ends here",
                "was it made with this goal and policy?",
            )
        entry = periods[self._next_period]
        self._next_period += 1
        got = entry.got if self._port is None else self._port.read(len(entry.got))
        if len(got) != len(entry.got):
            raise LinkLostError(
                f"{self._path}: the port sent {len(got)} of {len(entry.got)} bytes",
                "check the tape player",
            )
        self._now = entry.stamp
        return got

    def _check_open(self) -> None:
        if not self._is_open or self._next_episode == 0:
            raise LinkLostError(f"{self._path}: nothing plays", "call reset() first")

    def now(self) -> float:
        """Return the recorded time [s]."""
        return self._now

    def __reduce__(self) -> tuple[type[ReplayLink], tuple[Path, Port | None]]:
        """Copy with the replay at its beginning."""
        return ReplayLink, (self._path, self._port)

    def close(self) -> None:
        """Close the link, but not the port, which its owner closes. A reset opens it again."""
        self._is_open = False
