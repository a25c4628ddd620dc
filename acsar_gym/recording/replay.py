"""Replays a recording as a link: the same bytes at the same times, if the commands are the same."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LinkLostError
from acsar_gym.links.base import Arrivals, Link, RecordedScans
from acsar_gym.recording.reader import read
from acsar_gym.recording.recorded import REPLAY
from acsar_gym.recording.types import Episode, Floats, Movers, Recording
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.crowd import CLOCK, Crowd
from acsar_gym.worlds.movers import walk

SHOWN_BYTES = 40  # bytes of a command that a message shows, the last ones


class Tape:
    """Plays the control periods of an episode.

    Attributes:
        now: Time at the end of the newest period [s].
        stamped: Whether the times of what arrived are those of its measurement.
    """

    def __init__(self, episode: Episode) -> None:
        self._wire = episode.wire
        self._periods = episode.exchanges
        self._revolutions = episode.revolutions
        self._write_ends = np.concatenate([[0], np.cumsum(self._periods["writes"])])
        self._piece_ends = np.concatenate([[0], np.cumsum(self._periods["pieces"])])
        self._first_tick = float(episode.stamps[0]) if len(episode.stamps) else math.inf
        self._next = 0
        self._written = 0

        self.now = episode.start
        self.stamped = bool(episode.info.get("stamped"))

    @property
    def place(self) -> str:
        """Where the tape is, for messages."""
        tick = self._next - int(np.searchsorted(self._periods["stamp"], self._first_tick))
        return f"tick {tick}" if tick > 0 else f"period {self._next} of the reset"

    @property
    def exchange(self) -> int:
        """Number of the newest period; 0 before the first period."""
        return max(self._next - 1, 0)

    @property
    def is_over(self) -> bool:
        """Whether all periods have been played."""
        return self._next >= len(self._periods["stamp"])

    @property
    def has_gap(self) -> bool:
        """Whether the recording lacks the next period."""
        return int(self._periods["number"][self._next]) != self._next

    def note_write(self) -> None:
        """Move on to the time at which the next write was done, if time was real."""
        number = int(self._write_ends[self._next]) + self._written
        self._written += 1
        if self.lateness is not None and number < len(self._wire.sent_stamps):
            self.now = max(self.now, float(self._wire.sent_stamps[number]))

    def next(self) -> tuple[bytes, bytes]:
        """Play a period; returns what was sent and what arrived in it."""
        number = self._next
        self._next += 1
        self._written = 0
        self.now = float(self._periods["stamp"][number])
        sent = self._wire.sent[self._write_ends[number] : self._write_ends[number + 1]]
        return b"".join(sent), b"".join(piece for _, piece in self.arrivals)

    @property
    def remaining_writes(self) -> bytes:
        """What was sent after the last period, such as the stop at the end."""
        return b"".join(self._wire.sent[self._write_ends[-1] :])

    @property
    def truth(self) -> GroundTruth | None:
        """Ground truth at the end of the newest period; None if it wasn't recorded."""
        if not len(self._periods) or math.isnan(self._periods["contact"][self.exchange]):
            return None
        period = self._periods[self.exchange]
        x, y, theta = period["pose"].tolist()
        linear, angular = period["twist"].tolist()
        return GroundTruth((x, y, theta), (linear, angular), bool(period["contact"]))

    @property
    def lateness(self) -> float | None:
        """Lateness of the newest period [s]; None if time was simulated."""
        if not len(self._periods):
            return None
        lateness = float(self._periods["lateness"][self.exchange])
        return None if math.isnan(lateness) else lateness

    @property
    def arrivals(self) -> Arrivals:
        """When the bytes of the newest period arrived [s]."""
        pieces = slice(self._piece_ends[self.exchange], self._piece_ends[self._next])
        stamps = self._wire.got_stamps[pieces].tolist()
        return list(zip(stamps, self._wire.got[pieces], strict=True))

    def revolution(self) -> tuple[float, Floats] | None:
        """Return the end [s] of the LiDAR's newest revolution, and its measurements.

        Measurements are (3, n), as in `Revolutions.measured`. None if there is no revolution.
        """
        revolutions = self._revolutions
        number = int(np.searchsorted(revolutions.exchanges, self._next)) - 1
        if number < 0:
            return None
        return float(revolutions.stamps[number]), revolutions.measured[number]

    def oldest_measurement(self) -> float:
        """Return the largest age of a measurement while its revolution is the newest one [s]."""
        revolutions = self._revolutions
        ends = self._periods["stamp"]
        if not (len(revolutions.stamps) and len(ends)):
            return 0.0

        # A revolution is the newest one until the next revolution is read.
        last_periods = np.append(revolutions.exchanges[1:], len(ends) - 1)
        last_ends: list[float] = ends[np.clip(last_periods, 0, len(ends) - 1)].tolist()
        return max(
            end - float(measured[2].min(initial=end))
            for end, measured in zip(last_ends, revolutions.measured, strict=True)
        )


class RecordedCrowd(Crowd):
    """Movers that are where they were recorded."""

    def __init__(self, movers: Movers, config: RobotConfig) -> None:
        radii = movers.states[0, :, -1]
        at_origin = tuple(walk([[0.0, 0.0]], radius=radius) for radius in radii)
        super().__init__(World(movers=at_origin), config, 0.0)
        self._movers = movers
        self.play(0)

    def play(self, exchange: int) -> None:
        """Show what was recorded at the end of an exchange, or before it if that is missing."""
        row = int(np.searchsorted(self._movers.exchanges, exchange, side="right")) - 1
        row = max(row, 0)
        self.states[:, :CLOCK] = self._movers.states[row, :, :CLOCK]
        self.hit = float(self._movers.hits[row])
        self.intrusions = float(self._movers.intrusions[row])


class ReplayLink(Link):
    """Replays the episodes of a recording, one per reset, with the recorded times.

    If commands differ from the recorded commands, the replay ends with an error that names the
    tick.

    Args:
        path: The recording.
        compare: Whether other commands than recorded are an error.
    """

    def __init__(self, path: str | Path, *, compare: bool = True) -> None:
        self.device = f"{REPLAY}{path}"
        self._path = Path(path)
        self._compare = compare
        self._recording: Recording | None = None
        self._next_episode = 0
        self._tape: Tape | None = None
        self._crowd: RecordedCrowd | None = None
        self._sent = b""
        self._is_open = False

    def open(self) -> None:
        """Read the recording; ConfigError if it can't be read."""
        self._read()
        self._is_open = True

    def _read(self) -> Recording:
        if self._recording is None:
            self._recording = read(self._path, revolutions=True)
            self._load(self._recording.episodes[0])
        return self._recording

    def _load(self, episode: Episode) -> None:
        """Put an episode into the tape player, which knows its kind of time from then on."""
        self._tape = Tape(episode)
        self.stamped = self._tape.stamped
        self.lateness = self._tape.lateness

    def reset(self, scene: Scene) -> None:
        """Start the next episode; LinkLostError after the last episode."""
        self.open()
        recording = self._read()
        if self._next_episode >= len(recording.episodes):
            missing = "; the file is cut: its end is missing" if recording.cut else ""
            raise LinkLostError(
                f"{self._path}: all {self._next_episode} episodes have been played{missing}",
                "make a new link to play it again",
            )

        episode = recording.episodes[self._next_episode]
        self._next_episode += 1
        self._load(episode)
        has_movers = bool(len(episode.movers.stamps))
        self._crowd = RecordedCrowd(episode.movers, recording.config) if has_movers else None
        self._sent = b""

    def write(self, data: bytes) -> None:
        """Take commands, which the next `advance` compares."""
        self._playing_tape().note_write()
        self._sent += data

    def advance(self, period: float) -> bytes:
        """Return the bytes of the next period.

        Raises:
            LinkLostError: At the end of the episode, at a gap, and for other commands.
        """
        tape = self._playing_tape()
        sent = self._sent
        self._check_next(tape)

        recorded, received = tape.next()
        self.lateness = tape.lateness
        if self._crowd is not None:
            self._crowd.play(tape.exchange)
        self._sent = b""
        if self._compare and sent != recorded:
            shown = sent[-SHOWN_BYTES:].strip().decode("latin-1")
            expected = recorded[-SHOWN_BYTES:].strip().decode("latin-1")
            raise LinkLostError(
                f"{self._path}: other commands than recorded, {tape.place}: "
                f"{shown!r}, not {expected!r}",
                "was it made with this robot, goal and policy?",
            )
        return received

    def _check_next(self, tape: Tape) -> None:
        """Raise LinkLostError if the next period can't be played."""
        recording = self._read()
        if tape.is_over:
            if recording.cut and self._next_episode == len(recording.episodes):
                raise LinkLostError(
                    f"{self._path}: the file is cut here, {tape.place}", "what followed is missing"
                )
            raise LinkLostError(
                f"{self._path}: the recorded episode ends here, {tape.place}",
                "was it made with this goal and policy?",
            )

        if tape.has_gap:
            reason = "the file is damaged" if recording.damages else "its writer couldn't keep up"
            raise LinkLostError(
                f"{self._path}: the recording has a gap, {tape.place}",
                f"{reason}: it can't be replayed from here on",
            )

    def _playing_tape(self) -> Tape:
        if not self._is_open or self._tape is None or not self._next_episode:
            raise LinkLostError(f"{self._path}: nothing plays", "call reset() first")
        return self._tape

    def now(self) -> float:
        """Return the recorded time [s]."""
        return self._tape.now if self._tape else 0.0

    @property
    def truth(self) -> GroundTruth | None:
        """Recorded ground truth; None for the recording of a real robot, and before `open`."""
        truth = self._tape.truth if self._tape else None
        return truth if truth is None or not self._crowd else replace(truth, crowd=self._crowd)

    @property
    def arrivals(self) -> Arrivals:
        """When the bytes of the newest period arrived, as recorded [s]."""
        return self._tape.arrivals if self._tape else ()

    @property
    def scans(self) -> RecordedScans:
        """The recorded LiDAR; without revolutions if it wasn't recorded, or before `open`."""
        return self

    def revolution(self) -> tuple[float, Floats] | None:
        """Return the LiDAR's newest revolution; see `Tape.revolution`."""
        return self._tape.revolution() if self._tape else None

    def oldest_measurement(self) -> float:
        """Return the age of the oldest measurement in the episode; see `Tape` [s]."""
        return self._tape.oldest_measurement() if self._tape else 0.0

    def __reduce__(self) -> tuple[Callable[..., ReplayLink], tuple[Path]]:
        """Copy with the replay at its start."""
        return partial(ReplayLink, compare=self._compare), (self._path,)

    def close(self) -> None:
        """Close the link; a reset opens it again."""
        self._is_open = False
        self._sent = b""
