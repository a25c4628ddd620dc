"""Reads a recording part by part, with what the viewer shows of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.recording.reader import StoredEpisode, read
from acsar_gym.recording.types import Floats, Movers


@dataclass(frozen=True, eq=False)
class Part:
    """Some seconds of an episode. Times are since its reset [s].

    Attributes:
        episode: Number of the episode, from 0.
        info: Seed, goal, start and world, as far as they are known.
        ticks: Table of ticks; see `recording.events.TICKS`.
        exchanges: Table of control periods; see `recording.events.EXCHANGES`.
        steps: Table of the env's steps; see `recording.events.STEPS`.
        sent: Time and wheel speeds of each command on the wire [rad/s], (k, 5).
        scan_times: Times of scans, (s,).
        ranges: Their ranges [m], (s, rays).
        movers: What moves, in the frame of the world.
        faults: Times and texts of what stopped the robot.
    """

    episode: int
    info: Mapping[str, Any]
    ticks: NDArray[Any]
    exchanges: NDArray[Any]
    steps: NDArray[Any]
    sent: Floats
    scan_times: Floats
    ranges: Floats
    movers: Movers
    faults: list[tuple[float, str]]

    def numbers(self, name: str, count: int) -> tuple[float, ...] | None:
        """Return some numbers of `info`; None if they aren't there, or aren't numbers."""
        try:
            numbers = tuple(map(float, self.info[name]))
        except (KeyError, TypeError, ValueError, OverflowError):
            return None
        return numbers if len(numbers) == count and np.isfinite(numbers).all() else None

    @property
    def is_simulated(self) -> bool:
        """Whether the truth is known."""
        return bool(np.isfinite(self.exchanges["contact"]).any())

    @property
    def start(self) -> tuple[float, float, float]:
        """Start in the frame of the world [m, m, rad]."""
        x, y, theta = self.numbers("start", 3) or (0.0, 0.0, 0.0)
        return x, y, theta


class Tape:
    """A recording that is shown. ConfigError if it can't be read.

    Attributes:
        path: The file.
        header: Header of the recording.
        config: The robot.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._recording = read(path)
        self.header = self._recording.header
        self.config = self._recording.config

    def read_parts(self) -> Iterator[Part]:
        """Yield the recording part by part."""
        for number, episode in enumerate(self._recording.episodes):
            if isinstance(episode, StoredEpisode):
                for tables in episode.tables.split():
                    yield self._make_part(number, StoredEpisode.of(tables))

    def _make_part(self, number: int, episode: StoredEpisode) -> Part:
        def since_reset(name: str) -> NDArray[Any]:
            table = episode.tables[name].copy()
            table["stamp"] -= episode.start
            return table

        times, speeds = episode.wire.commands(self.config)
        movers = episode.movers
        texts = [text.decode(errors="replace") for text in episode.tables.list_pieces("faults")]
        return Part(
            episode=number,
            info=episode.info,
            ticks=since_reset("ticks"),
            exchanges=since_reset("exchanges"),
            steps=since_reset("steps"),
            sent=np.column_stack([times - episode.start, speeds]),
            scan_times=episode.scans.stamps - episode.start,
            ranges=episode.scans.ranges,
            movers=replace(movers, stamps=movers.stamps - episode.start),
            faults=list(zip(since_reset("faults")["stamp"].tolist(), texts, strict=True)),
        )

    def describe_end(self) -> str:
        """Describe how the recording has ended."""
        recording = self._recording
        if recording.damages:
            return f"the recording ends; {recording.describe_damage()}"
        if recording.cut:
            return "the recording's end is missing"
        lost = f"; {recording.dropped:,} events were dropped" if recording.dropped else ""
        return f"the recording ends{lost}"
