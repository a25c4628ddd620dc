"""Replays a recording as a link: the same bytes at the same times, if the commands are the same."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LinkLostError
from acsar_gym.links.base import Arrivals, Link, RecordedScans
from acsar_gym.recording.blocks import Head
from acsar_gym.recording.events import Tables
from acsar_gym.recording.reader import read
from acsar_gym.recording.types import Episode, Floats, Movers, Recording
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.crowd import CLOCK, Crowd
from acsar_gym.worlds.movers import walk

SHOWN_BYTES = 40  # bytes of a command that a message shows, the last ones


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
        # The first row is the reset's, which is shown until the first exchange.
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

    truth: GroundTruth | None = None
    """As recorded. None for the recording of a real robot, and before `open`."""
    arrivals: Arrivals = ()

    def __init__(self, path: str | Path, *, compare: bool = True) -> None:
        self.device = f"replay:{path}"
        self._path = Path(path)
        self._compare = compare
        self._recording: Recording | None = None
        self._played = 0
        self._is_open = False
        self._load(Episode(Head(), Tables()))

    def open(self) -> None:
        """Read the recording. Raises ConfigError if it can't be read."""
        if self._recording is None:
            self._recording = read(self._path)
            self._load(self._recording.episodes[0])
        self._is_open = True

    def _load(self, episode: Episode) -> None:
        """Take an episode, whose kind of time the link has from then on."""
        self._episode = episode
        self._periods = episode.exchanges
        # Where the bytes of each period end in the log of the wire.
        self._write_ends = np.concatenate([[0], np.cumsum(self._periods["writes"])]).tolist()
        self._piece_ends = np.concatenate([[0], np.cumsum(self._periods["pieces"])]).tolist()

        # People are where they were recorded, whatever the world's movers would do.
        self._crowd: RecordedCrowd | None = None
        if self._recording is not None and len(episode.movers.stamps):
            self._crowd = RecordedCrowd(episode.movers, self._recording.config)

        self._now = episode.start
        self._next_period = 0
        self._sent = b""
        self._written = 0
        self.stamped = episode.wire.stamped
        self.lateness = self.truth = None
        self.arrivals = ()
        if len(self._periods):
            self._show(0)

    def _show(self, number: int) -> None:
        """Show lateness and truth of a period."""
        period = self._periods[number]
        lateness = float(period["lateness"])
        self.lateness = None if math.isnan(lateness) else lateness
        # People first, as the truth contains them.
        if self._crowd is not None:
            self._crowd.play(number)
        if not math.isnan(period["contact"]):
            x, y, theta = period["pose"].tolist()
            linear, angular = period["twist"].tolist()
            contact = bool(period["contact"])
            self.truth = GroundTruth((x, y, theta), (linear, angular), contact, crowd=self._crowd)

    def reset(self, scene: Scene) -> None:
        """Start the next episode. Raises LinkLostError after the last episode."""
        self.open()
        recording = self._recording
        # Another episode would need feedback that was never recorded.
        if recording is None or self._played >= len(recording.episodes):
            is_cut = recording is not None and recording.cut
            missing = "; the file is cut: its end is missing" if is_cut else ""
            raise LinkLostError(
                f"{self._path}: all {self._played} episodes have been played{missing}",
                "make a new link to play it again",
            )
        self._load(recording.episodes[self._played])
        self._played += 1

    def write(self, data: bytes) -> None:
        """Take commands, which the next `advance` compares. If time was real, it goes on."""
        self._check_playing()
        # A real clock went on while bytes were written, and a policy may have read it.
        number = self._write_ends[self._next_period] + self._written
        self._written += 1
        self._sent += data
        stamps = self._episode.wire.sent_stamps
        if self.lateness is not None and number < len(stamps):
            self._now = max(self._now, float(stamps[number]))

    def advance(self, period: float) -> bytes:
        """Return the bytes of the next period.

        Raises:
            LinkLostError: At the end of the episode, at a gap, and for other commands.
        """
        self._check_next(self._check_playing())
        number = self._next_period
        self._next_period += 1
        self._now = float(self._periods["stamp"][number])
        self._show(number)

        wire = self._episode.wire
        # Pieces keep their own times, since lines are stamped by their last byte.
        pieces = slice(self._piece_ends[number], self._piece_ends[number + 1])
        received = wire.got[pieces]
        stamps = wire.got_stamps[pieces].tolist()
        self.arrivals = list(zip(stamps, received, strict=True))

        # Feedback is an answer to the recorded commands only.
        sent = self._sent
        self._sent = b""
        self._written = 0
        writes = slice(self._write_ends[number], self._write_ends[number + 1])
        recorded = b"".join(wire.sent[writes])
        if self._compare and sent != recorded:
            shown = sent[-SHOWN_BYTES:].strip().decode("latin-1")
            expected = recorded[-SHOWN_BYTES:].strip().decode("latin-1")
            raise LinkLostError(
                f"{self._path}: other commands than recorded, {self._describe_place()}: "
                f"{shown!r}, not {expected!r}",
                "was it made with this robot, goal and policy?",
            )
        return b"".join(received)

    def _check_next(self, recording: Recording) -> None:
        """Raise LinkLostError if the next period can't be played."""
        number = self._next_period
        if number >= len(self._periods):
            problem = "the recorded episode ends here"
            fix = "was it made with this goal and policy?"
            if recording.cut and self._played == len(recording.episodes):
                problem = "the file is cut here"
                fix = "what followed is missing"
        elif int(self._periods["number"][number]) != number:
            reason = "the file is damaged" if recording.damages else "its writer couldn't keep up"
            problem = "the recording has a gap"
            fix = f"{reason}: it can't be replayed from here on"
        else:
            return
        raise LinkLostError(f"{self._path}: {problem}, {self._describe_place()}", fix)

    def _describe_place(self) -> str:
        """Describe where the replay is, for messages."""
        # Ticks are counted from the end of the reset, as users count them.
        first = self._episode.stamps[:1].min(initial=math.inf)
        tick = self._next_period - int(np.searchsorted(self._periods["stamp"], first))
        return f"tick {tick}" if tick > 0 else f"period {self._next_period} of the reset"

    def _check_playing(self) -> Recording:
        """Return the recording. Raises LinkLostError if no episode of it plays."""
        if not (self._is_open and self._played and self._recording):
            raise LinkLostError(f"{self._path}: nothing plays", "call reset() first")
        return self._recording

    def now(self) -> float:
        """Return the recorded time [s]."""
        return self._now

    @property
    def scans(self) -> RecordedScans:
        """The recorded LiDAR. Without revolutions if it wasn't recorded, or before `open`."""
        return self

    def revolution(self) -> tuple[float, Floats] | None:
        """Return the end [s] of the LiDAR's newest revolution, and its measurements.

        Measurements are (3, n), as in `Revolutions.measured`. None if there is no revolution.
        """
        revolutions = self._episode.revolutions
        # The newest revolution that had ended when this period began.
        number = int(np.searchsorted(revolutions.exchanges, self._next_period)) - 1
        if number < 0:
            return None
        return float(revolutions.stamps[number]), revolutions.measured[number]

    def __reduce__(self) -> tuple[Callable[..., ReplayLink], tuple[Path]]:
        """Copy with the replay at its start."""
        return partial(ReplayLink, compare=self._compare), (self._path,)

    def close(self) -> None:
        """Close the link. A reset opens it again."""
        self._is_open = False
        self._sent = b""
