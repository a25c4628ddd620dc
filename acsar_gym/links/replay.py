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
from acsar_gym.links.base import Arrivals
from acsar_gym.protocol import ZERO, encode
from acsar_gym.recording.reader import read
from acsar_gym.recording.types import Episode, Floats, Movers, Recording
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.crowd import CLOCK, Crowd
from acsar_gym.worlds.movers import walk

LEAD_PERIODS = 2  # periods at rest that precede a part of an episode: so many end a reset (`wire`)


class Tape:
    """Plays the control periods of an episode.

    Attributes: `now`, the time at the end of the newest period [s]; `first_period`, how long the
    first one lasts [s]; `echoes`, whether what arrived has echoes; `stamped`, whether its times are
    those at which it was measured.
    """

    def __init__(self, episode: Episode) -> None:
        self._first_tick = float(episode.stamps[0]) if len(episode.stamps) else math.inf
        self._periods = periods = episode.exchanges
        self._wire, self._turns = episode.wire, episode.revolutions
        self.echoes = self._wire.echoes
        self.stamped = bool(episode.info.get("stamped"))
        self._writes, self._pieces = (
            np.concatenate([[0], np.cumsum(np.maximum(counts, 0))])
            for counts in (periods.writes, periods.pieces)
        )
        self._next = 0
        self._written = 0
        self._revolution = -1
        self.now = episode.start
        self.first_period = float(periods.stamps[0]) - self.now if len(periods.stamps) else 0.0

    @property
    def place(self) -> str:
        """Where the tape is, for messages."""
        tick = self._next - int(np.searchsorted(self._periods.stamps, self._first_tick))
        return f"tick {tick}" if tick > 0 else f"period {self._next} of the reset"

    @property
    def exchange(self) -> int:
        """Number of the newest period; 0 before the first one."""
        return max(self._next - 1, 0)

    @property
    def is_over(self) -> bool:
        """Whether all periods have been played."""
        return self._next >= len(self._periods.stamps)

    @property
    def has_gap(self) -> bool:
        """Whether the recording lacks the next period, or bytes of it."""
        wire, number = self._wire, self._next
        lacks_sent = bool(self._writes[number + 1] > len(wire.sent))
        lacks_got = bool(self._pieces[number + 1] > len(wire.got))
        return lacks_sent or lacks_got or int(self._periods.numbers[number]) != number

    def wrote(self) -> None:
        """Move on to the time at which the next write was done, where time was real."""
        number = int(self._writes[self._next]) + self._written
        self._written += 1
        stamps = self._wire.sent_stamps
        if self.lateness is not None and number < len(stamps):
            self.now = max(self.now, float(stamps[number]))

    def next(self) -> tuple[bytes, bytes]:
        """Play a period; returns what was sent and what arrived in it."""
        number, wire = self._next, self._wire
        self._next += 1
        self._written = 0
        self.now = float(self._periods.stamps[number])
        sent = wire.sent[self._writes[number] : self._writes[number + 1]]
        got = wire.got[self._pieces[number] : self._pieces[number + 1]]
        return b"".join(sent), b"".join(got)

    @property
    def rest(self) -> bytes:
        """What was sent after the last period, such as the stop at the end."""
        return b"".join(self._wire.sent[self._writes[-1] :])

    @property
    def truth(self) -> GroundTruth | None:
        """Ground truth at the end of the newest period; None where it wasn't recorded."""
        if not len(self._periods.truth):
            return None
        x, y, theta, linear, angular, contact = self._periods.truth[self.exchange].tolist()
        if math.isnan(x):
            return None
        return GroundTruth((x, y, theta), (linear, angular), bool(contact))

    @property
    def lateness(self) -> float | None:
        """Lateness of the newest period [s]; None where time was simulated."""
        if not len(self._periods.lateness):
            return None
        late = float(self._periods.lateness[self.exchange])
        return None if math.isnan(late) else late

    @property
    def arrivals(self) -> list[tuple[float, bytes]]:
        """When the bytes of the newest period arrived [s]."""
        wire, number = self._wire, self._next
        span = slice(self._pieces[max(number - 1, 0)], self._pieces[number])
        return list(zip(wire.got_stamps[span].tolist(), wire.got[span], strict=True))

    def revolution(self) -> tuple[float, Floats] | None:
        """End [s] of the newest revolution of the LiDAR, and its bearings, distances and times.

        They are (3, n), as in `Revolutions.measured`; None where there is no revolution.
        """
        turns, place = self._turns, self._revolution
        while place + 1 < len(turns.stamps) and turns.exchanges[place + 1] < self._next:
            place += 1
        self._revolution = place
        return (float(turns.stamps[place]), turns.measured[place]) if place >= 0 else None

    def oldest_measurement(self) -> float:
        """Age that a measurement reaches while its revolution is the LiDAR's newest one [s]."""
        turns, ends = self._turns, self._periods.stamps
        if not (len(turns.stamps) and len(ends)):
            return 0.0
        followed = np.append(turns.exchanges[1:], len(ends) - 1)  # then the next one is read
        until: list[float] = ends[np.clip(followed, 0, len(ends) - 1)].tolist()
        ages = zip(until, turns.measured, strict=True)
        return max(end - float(measured[2].min(initial=end)) for end, measured in ages)


class RecordedCrowd(Crowd):
    """Movers that are where they were recorded."""

    def __init__(self, movers: Movers, config: RobotConfig) -> None:
        standing = [walk([[0.0, 0.0]], radius=radius) for radius in movers.states[0, :, -1]]
        super().__init__(World(movers=tuple(standing)), config, 0.0)
        self._movers = movers
        self.play(0)

    def play(self, exchange: int) -> None:
        """Show what was recorded at the end of an exchange; of one that is missing, before it."""
        place = int(np.searchsorted(self._movers.exchanges, exchange, side="right")) - 1
        place = max(place, 0)
        self.states[:, :CLOCK] = self._movers.states[place, :, :CLOCK]
        self.hit = float(self._movers.hits[place])
        self.intrusions = float(self._movers.intrusions[place])


class ReplayLink:
    """Replays the episodes of a recording, one per reset, with the recorded times.

    Where commands differ from those recorded, the replay ends with an error that names the tick. A
    part of an episode has no reset: the robot is said to stand still for as long as one takes.

    Attributes: `replays`, the path.
    """

    def __init__(self, path: str | Path, *, compare: bool = True) -> None:
        self.replays = Path(path)
        self._compare = compare
        self._recording: Recording | None = None
        self._next_episode = 0
        self._tape: Tape | None = None
        self._crowd: RecordedCrowd | None = None
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
        self._crowd = None
        if self._recording is not None and len(episode.movers.stamps):
            self._crowd = RecordedCrowd(episode.movers, self._recording.config)
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
        """Take commands, which the next `advance` compares."""
        tape = self._require_tape()
        if not self._lead:
            tape.wrote()
        self._sent += data

    def advance(self, period: float) -> bytes:
        """The bytes of the next period; LinkLostError at the end, a gap, and for other commands."""
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
        if self._crowd is not None:
            self._crowd.play(tape.exchange)
        self._sent = b""
        if self._compare and sent != recorded:
            one, other = (data[-40:].strip().decode("latin-1") for data in (sent, recorded))
            raise LinkLostError(
                f"{self.replays}: other commands than recorded, {tape.place}: "
                f"{one!r}, not {other!r}",
                "was it made with this robot, goal and policy?",
            )
        return got

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
        truth = self._tape.truth if self._tape else None
        return truth if truth is None or not self._crowd else replace(truth, crowd=self._crowd)

    @property
    def echoes(self) -> bool | None:
        """Whether the board of this episode echoed; None where it was simulated."""
        return None if self._tape is None or self.lateness is None else self._tape.echoes

    @property
    def stamped(self) -> bool:
        """Whether the lines of this episode have the times at which they were measured."""
        return self._tape is not None and self._tape.stamped

    @property
    def lateness(self) -> float | None:
        """Recorded lateness [s]; None where time was simulated, and before the first period."""
        return self._tape.lateness if self._tape else None

    @property
    def arrivals(self) -> Arrivals:
        """When the bytes of the newest period arrived, as recorded [s]."""
        return self._tape.arrivals if self._tape else []

    def revolution(self) -> tuple[float, Floats] | None:
        """Return the LiDAR's revolution that was the newest one; see `Tape.revolution`."""
        return self._tape.revolution() if self._tape else None

    def oldest_measurement(self) -> float:
        """Return the age of the oldest measurement in the episode; see `Tape` [s]."""
        return self._tape.oldest_measurement() if self._tape else 0.0

    def __reduce__(self) -> tuple[Callable[..., ReplayLink], tuple[Path]]:
        """Copy with the replay at its beginning."""
        return partial(ReplayLink, compare=self._compare), (self.replays,)

    def close(self) -> None:
        """Close the link; a reset opens it again."""
        self._is_open = False
        self._sent = b""
