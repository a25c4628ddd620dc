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
        next_period: Number of the next period.
        lateness: Lateness of the newest period [s]. None if time was simulated.
        truth: Ground truth at the end of the newest period. None if it wasn't recorded.
        arrivals: When the bytes of the newest period arrived [s].
    """

    def __init__(self, episode: Episode) -> None:
        self.now = episode.start
        self.next_period = 0
        self.lateness: float | None = None
        self.truth: GroundTruth | None = None
        self.arrivals: Arrivals = ()

        self._wire = episode.wire
        self._periods = episode.exchanges
        self._revolutions = episode.revolutions
        self._write_ends = np.concatenate([[0], np.cumsum(self._periods["writes"])]).tolist()
        self._piece_ends = np.concatenate([[0], np.cumsum(self._periods["pieces"])]).tolist()
        self._first_tick = float(episode.stamps[0]) if len(episode.stamps) else math.inf
        self._written = 0
        if len(self._periods):
            self._show(0)

    def _show(self, number: int) -> None:
        """Show lateness and truth of a period."""
        period = self._periods[number]
        lateness = float(period["lateness"])
        self.lateness = None if math.isnan(lateness) else lateness
        if not math.isnan(period["contact"]):
            x, y, theta = period["pose"].tolist()
            linear, angular = period["twist"].tolist()
            self.truth = GroundTruth((x, y, theta), (linear, angular), bool(period["contact"]))

    @property
    def place(self) -> str:
        """Where the tape is, for messages."""
        tick = self.next_period - int(np.searchsorted(self._periods["stamp"], self._first_tick))
        return f"tick {tick}" if tick > 0 else f"period {self.next_period} of the reset"

    @property
    def is_over(self) -> bool:
        """Whether all periods have been played."""
        return self.next_period >= len(self._periods)

    @property
    def has_gap(self) -> bool:
        """Whether the recording lacks the next period."""
        return int(self._periods["number"][self.next_period]) != self.next_period

    def note_write(self) -> None:
        """Move on to the time at which the next write was done, if time was real."""
        number = self._write_ends[self.next_period] + self._written
        self._written += 1
        if self.lateness is not None and number < len(self._wire.sent_stamps):
            self.now = max(self.now, float(self._wire.sent_stamps[number]))

    def next(self) -> tuple[bytes, bytes]:
        """Play a period. Returns what was sent and what arrived in it."""
        number = self.next_period
        self.next_period += 1
        self._written = 0
        self.now = float(self._periods["stamp"][number])
        self._show(number)
        pieces = slice(self._piece_ends[number], self._piece_ends[number + 1])
        received = self._wire.got[pieces]
        stamps = self._wire.got_stamps[pieces].tolist()
        self.arrivals = list(zip(stamps, received, strict=True))
        sent = self._wire.sent[self._write_ends[number] : self._write_ends[number + 1]]
        return b"".join(sent), b"".join(received)

    @property
    def remaining_writes(self) -> bytes:
        """What was sent after the last period, such as the stop at the end."""
        return b"".join(self._wire.sent[self._write_ends[-1] :])

    def revolution(self) -> tuple[float, Floats] | None:
        """Return the end [s] of the LiDAR's newest revolution, and its measurements.

        Measurements are (3, n), as in `Revolutions.measured`. None if there is no revolution.
        """
        revolutions = self._revolutions
        number = int(np.searchsorted(revolutions.exchanges, self.next_period)) - 1
        if number < 0:
            return None
        return float(revolutions.stamps[number]), revolutions.measured[number]

    def oldest_measurement(self) -> float:
        """Return the largest age of a measurement while its revolution is the newest one [s]."""
        revolutions = self._revolutions
        if not (len(revolutions.stamps) and len(self._periods)):
            return 0.0

        # A revolution is the newest one until the next revolution is read.
        last = len(self._periods) - 1
        periods = np.clip(np.append(revolutions.exchanges[1:], last), 0, last)
        ends: list[float] = self._periods["stamp"][periods].tolist()
        return max(
            end - float(measured[2].min(initial=end))
            for end, measured in zip(ends, revolutions.measured, strict=True)
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
        row = int(np.searchsorted(self._movers.exchanges[1:], exchange, side="right"))
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
        """Read the recording. Raises ConfigError if it can't be read."""
        if self._recording is None:
            self._recording = read(self._path)
            self._load(self._recording.episodes[0])
        self._is_open = True

    def _load(self, episode: Episode) -> None:
        """Put an episode into the tape player, which knows its kind of time from then on."""
        self._tape = Tape(episode)
        self.stamped = episode.wire.stamped
        self.lateness = self._tape.lateness

    def reset(self, scene: Scene) -> None:
        """Start the next episode. Raises LinkLostError after the last episode."""
        self.open()
        recording = self._recording
        if recording is None or self._next_episode >= len(recording.episodes):
            is_cut = recording is not None and recording.cut
            missing = "; the file is cut: its end is missing" if is_cut else ""
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
        _, tape = self._playing()
        tape.note_write()
        self._sent += data

    def advance(self, period: float) -> bytes:
        """Return the bytes of the next period.

        Raises:
            LinkLostError: At the end of the episode, at a gap, and for other commands.
        """
        recording, tape = self._playing()
        self._check_next(recording, tape)

        sent = self._sent
        self._sent = b""
        recorded, received = tape.next()
        self.lateness = tape.lateness
        if self._crowd is not None:
            self._crowd.play(tape.next_period - 1)
        if self._compare and sent != recorded:
            shown = sent[-SHOWN_BYTES:].strip().decode("latin-1")
            expected = recorded[-SHOWN_BYTES:].strip().decode("latin-1")
            raise LinkLostError(
                f"{self._path}: other commands than recorded, {tape.place}: "
                f"{shown!r}, not {expected!r}",
                "was it made with this robot, goal and policy?",
            )
        return received

    def _check_next(self, recording: Recording, tape: Tape) -> None:
        """Raise LinkLostError if the next period can't be played."""
        if tape.is_over:
            problem = "the recorded episode ends here"
            fix = "was it made with this goal and policy?"
            if recording.cut and self._next_episode == len(recording.episodes):
                problem = "the file is cut here"
                fix = "what followed is missing"
        elif tape.has_gap:
            reason = "the file is damaged" if recording.damages else "its writer couldn't keep up"
            problem = "the recording has a gap"
            fix = f"{reason}: it can't be replayed from here on"
        else:
            return
        raise LinkLostError(f"{self._path}: {problem}, {tape.place}", fix)

    def _playing(self) -> tuple[Recording, Tape]:
        is_playing = self._is_open and self._next_episode
        if not is_playing or self._recording is None or self._tape is None:
            raise LinkLostError(f"{self._path}: nothing plays", "call reset() first")
        return self._recording, self._tape

    def now(self) -> float:
        """Return the recorded time [s]."""
        return self._tape.now if self._tape else 0.0

    @property
    def truth(self) -> GroundTruth | None:
        """Recorded ground truth. None for the recording of a real robot, and before `open`."""
        truth = self._tape.truth if self._tape else None
        return truth if truth is None or not self._crowd else replace(truth, crowd=self._crowd)

    @property
    def arrivals(self) -> Arrivals:
        """When the bytes of the newest period arrived, as recorded [s]."""
        return self._tape.arrivals if self._tape else ()

    @property
    def scans(self) -> RecordedScans:
        """The recorded LiDAR. Without revolutions if it wasn't recorded, or before `open`."""
        return self

    def revolution(self) -> tuple[float, Floats] | None:
        """Return the LiDAR's newest revolution. See `Tape.revolution`."""
        return self._tape.revolution() if self._tape else None

    def oldest_measurement(self) -> float:
        """Return the age of the oldest measurement in the episode. See `Tape` [s]."""
        return self._tape.oldest_measurement() if self._tape else 0.0

    def __reduce__(self) -> tuple[Callable[..., ReplayLink], tuple[Path]]:
        """Copy with the replay at its start."""
        return partial(ReplayLink, compare=self._compare), (self._path,)

    def close(self) -> None:
        """Close the link. A reset opens it again."""
        self._is_open = False
        self._sent = b""
