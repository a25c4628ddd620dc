"""What happened in an episode and when, as lines: read out of the recorded ticks, not logged."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.recording.types import Floats
from acsar_gym.safety.rules import Reason
from acsar_gym.tools.view.tail import GrowingEpisode, RecordingTail

NOTE, WARNING, ERROR = 0, 1, 2
"""Levels of lines, as those of diagnostic_msgs/DiagnosticStatus."""
BURST_GAP = 1.0
"""The same thing again within this time is in the same line [s]."""
REASON_WORDS = {
    Reason.NONE: "sent as asked",
    Reason.LIMITS: "limits of speed or acceleration",
    Reason.GEOFENCE: "outside the geofence: held",
    Reason.STALE_FEEDBACK: "feedback too old: stopped",
    Reason.EMERGENCY_STOP: "emergency stop: held",
}
REASON_LEVELS = {
    Reason.GEOFENCE: WARNING,
    Reason.STALE_FEEDBACK: WARNING,
    Reason.EMERGENCY_STOP: ERROR,
}
"""Those that aren't part of normal driving."""


class LogLine(NamedTuple):
    """What happened at a time since the reset [s]; `level` is NOTE, WARNING or ERROR."""

    time: float
    level: int
    text: str


class Burst(NamedTuple):
    """A thing that happened at times less than `BURST_GAP` apart: at `rows`."""

    begin: float
    end: float
    rows: NDArray[np.intp]

    @property
    def lasting(self) -> str:
        """How long it lasted, in words; empty for a moment."""
        return f" for {self.end - self.begin:.1f} s" if self.end - self.begin >= 0.05 else ""


def find_bursts(stamps: Floats, happened: NDArray[np.bool_]) -> Iterator[Burst]:
    """Group the rows at which something happened.

    Args:
        stamps: (n,) ascending [s].
        happened: (n,).
    """
    rows = np.flatnonzero(happened)
    if len(rows):
        edges = np.flatnonzero(np.diff(stamps[rows]) > BURST_GAP) + 1
        for group in np.split(rows, edges):
            yield Burst(float(stamps[group[0]]), float(stamps[group[-1]]), group)


def list_lines(episode: GrowingEpisode, late_tick: float) -> list[LogLine]:
    """Return what happened in an episode, in the order of time.

    Begin and end, what the safety layer held, late ticks, input that was refused, control periods
    that are missing, contact with an obstacle, and what ended the drive.
    """
    lines = [LogLine(0.0, NOTE, describe_beginning(episode.info))]
    lines += _list_tick_lines(episode, late_tick)
    truth = episode.truth.rows
    if len(truth):
        touched = np.diff(np.nan_to_num(truth[:, 4]), prepend=0.0) > 0.0
        touches = find_bursts(truth[:, 0], touched)
        lines += [LogLine(one.begin, ERROR, "touches an obstacle") for one in touches]
    lines += [LogLine(time, ERROR, text) for time, text in episode.faults]
    if len(steps := episode.steps.rows):
        stamp, _, terminated, truncated, success = steps[-1, 1:].tolist()
        if terminated or truncated:
            # A limit of time is a wrapper around the env, which records nothing.
            how = "solved" if success else "failed" if terminated else "cut short by a fault"
            count, total = len(steps) - 1, float(np.nansum(steps[1:, 2]))
            level = NOTE if success else WARNING
            text = f"ends: {how}, {count:,} step{'s' * (count != 1)}, return {total:.1f}"
            lines.append(LogLine(stamp, level, text))
    return sorted(lines, key=lambda line: line.time)


def _list_tick_lines(episode: GrowingEpisode, late_tick: float) -> Iterator[LogLine]:
    """Lines about the ticks of an episode."""
    stamps, lateness = episode.column("stamp"), episode.column("lateness")
    reasons = episode.column("reason")
    for reason, level in REASON_LEVELS.items():
        for burst in find_bursts(stamps, reasons == reason):
            yield LogLine(burst.begin, level, REASON_WORDS[reason] + burst.lasting)
    for burst in find_bursts(stamps, lateness > late_tick):
        count, worst = len(burst.rows), float(lateness[burst.rows].max()) * 1e3
        lasting = f"{count:,} ticks in {burst.end - burst.begin:.1f} s, at worst"
        text = f"late: {lasting if count > 1 else 'one tick,'} by {worst:.1f} ms"
        yield LogLine(burst.begin, WARNING, text)
    for column, text in (
        ("refused", "parts of the input were refused"),
        ("exchange", "control periods aren't recorded"),
    ):
        numbers = np.nan_to_num(episode.column(column))
        more = np.diff(numbers, prepend=numbers[:1]) - (column == "exchange")
        for burst in find_bursts(stamps, more > 0.0):
            yield LogLine(burst.begin, WARNING, f"{more[burst.rows].sum():,.0f} {text}")


def describe_end(tail: RecordingTail, time: float) -> LogLine:
    """Tell how a recording that isn't written any more has ended, at a time since the reset [s]."""
    if tail.damages:
        text = f"the recording ends; left out, damaged: {', '.join(tail.damages[:2])}"
        return LogLine(time, WARNING, text)
    if not tail.is_complete:
        return LogLine(time, WARNING, "the recording's end is missing")
    if tail.dropped:
        return LogLine(time, WARNING, f"the recording ends; {tail.dropped:,} events were dropped")
    return LogLine(time, NOTE, "the recording ends")


def describe_beginning(info: Mapping[str, Any]) -> str:
    """Tell what an episode begins with, as far as it is known."""
    words = [f"{name} {info[name]}" for name in ("seed", "world") if info.get(name) is not None]
    return "begins" + (f": {', '.join(words)}" if words else "")
