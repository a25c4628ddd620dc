"""Shows a recording, also while it is being written, and a second one over it."""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from acsar_gym.errors import ConfigError, escape_unprintable
from acsar_gym.links.factory import is_device
from acsar_gym.physics.bodies import BODIES
from acsar_gym.recording.pairs import SeedKey, have_same_goal, number_seeds
from acsar_gym.recording.types import Floats
from acsar_gym.streams import print_error
from acsar_gym.tools.view.entities import (
    APPLICATION,
    TIMELINE,
    EpisodeLogger,
    make_blueprint,
    to_odometry_points,
)
from acsar_gym.tools.view.tail import Block, RecordingTail
from acsar_gym.tools.view.viewer import merge_files, open_viewer

RECORD_HINT = "drive with --record FILE, and view that file with --live"
POLL_INTERVAL = 0.3
"""Time between two looks at a recording that is being written [s]."""


def find_recording(source: str) -> Path:
    """Return the path of a recording.

    Raises:
        ConfigError: It is a link, which only a recording of its robot can show.
    """
    path = Path(source.removeprefix("replay:"))
    is_recording = path.suffix == ".mcap" or path.is_file() or path.is_dir()
    if not is_recording and (source in BODIES or source == "serial" or is_device(source)):
        raise ConfigError(f"{source}: isn't a recording: {RECORD_HINT}")
    return path


class Overlay:
    """A recording whose episodes are drawn over those of another one; it stays in memory."""

    def __init__(self, path: Path) -> None:
        self.tail = RecordingTail(path)
        self.name = escape_unprintable(path.name)
        episodes = defaultdict[int, list[Block]](list)
        for block in self.tail.read():
            episodes[block.episode].append(block)
        if not episodes:
            raise ConfigError(f"{path}: holds no episode")
        keys = number_seeds(read_seed(blocks[0]) for blocks in episodes.values())
        self._episodes = dict(zip(keys, episodes.values(), strict=True))

    def find_partner(self, key: SeedKey, block: Block) -> list[Block]:
        """Find the episode of the same seed and goal; ConfigError where there is none."""
        partner = self._episodes.get(key)
        if partner is None or not have_same_goal(
            block.numbers("goal", 2), partner[0].numbers("goal", 2)
        ):
            seed = "" if key[0] is None else f" (seed {key[0]})"
            raise ConfigError(
                f"{self.name}: has no partner of episode {block.episode + 1}{seed}: record both "
                "with the same seeds and goals"
            )
        return partner


def read_seed(block: Block) -> int | None:
    """Seed of an episode; None where it isn't known."""
    seed = block.info.get("seed")
    return seed if isinstance(seed, int) else None


def measure_gap(
    block: Block, partner: Sequence[Block], shift: float
) -> Iterator[tuple[str, Floats, Floats]]:
    """Measure how far two robots are from each other at the same time since their first ticks.

    A robot whose episode is over stays where it was. Yields "odometry" and "truth", times [s] and
    distances [m], (n,) each, where both places are known.
    """
    for name in ("odometry", "truth") if partner else ():
        times, places = _list_places([block], name)
        stamps, others = _list_places(partner, name)
        if len(times) and len(stamps):
            other = [np.interp(times, stamps + shift, others[:, axis]) for axis in (0, 1)]
            yield name, times, np.hypot(places[:, 0] - other[0], places[:, 1] - other[1])


def _list_places(blocks: Sequence[Block], name: str) -> tuple[Floats, Floats]:
    """Times, and places in the odometry frame (n, 2), where they are known."""
    if name == "odometry":
        times = np.concatenate([block.ticks["stamp"] for block in blocks])
        return times, np.concatenate([block.poses[:, :2] for block in blocks])
    truth = np.concatenate([block.truth for block in blocks])
    truth = truth[np.isfinite(truth[:, 1])]
    return truth[:, 0], to_odometry_points(blocks[0].start, truth[:, 1:3])


class RerunWriter:
    """Writes the episodes of a recording into recordings of Rerun, each of which `connect` gets."""

    def __init__(
        self,
        tail: RecordingTail,
        overlay: Overlay | None,
        connect: Callable[[rr.RecordingStream], None],
        *,
        live: bool = False,
    ) -> None:
        self.problems: list[str] = []
        self.count = 0
        self._tail, self._overlay, self._connect = tail, overlay, connect
        self._live = live
        self._begin_run()

    def _begin_run(self) -> None:
        self._run = self._tail.run
        self._number = -1
        self._seeds: list[int | None] = []
        self._stream: Any = None
        self._partner: list[Block] = []
        self._end = self._shift = 0.0
        self._has_ended = False

    def update(self) -> None:
        """Write what the recording has that wasn't written yet."""
        for block in self._tail.read():
            if self._tail.run != self._run:
                self.finish_episode()
                self._begin_run()
            if block.episode != self._number:
                self.finish_episode()
                self._begin_episode(block)
            self._logger.log(block)
            self._end = max(self._end, block.ticks["stamp"][-1:].sum())
            for name, times, distances in measure_gap(block, self._partner, self._shift):
                index = rr.TimeColumn(TIMELINE, duration=times)
                columns = rr.Scalars.columns(scalars=distances * 100.0)
                self._stream.send_columns(f"gap/{name}", [index], columns)
        if self._tail.is_complete:
            self._log_end()

    def _log_end(self) -> None:
        """Write how the recording has ended, once."""
        if self._stream is not None and not self._has_ended:
            self._has_ended = True
            text = self._tail.describe_end()
            level = "INFO" if text == "the recording ends" else "WARN"
            self._logger.log_text(self._end, text, level)

    def _begin_episode(self, block: Block) -> None:
        tail, overlay = self._tail, self._overlay
        self._number, self._end = block.episode, 0.0
        self._seeds.append(read_seed(block))
        key = number_seeds(self._seeds)[-1]
        self._partner, problem = [], ""
        try:
            if overlay is not None:
                self._partner = overlay.find_partner(key, block)
        except ConfigError as error:
            problem = str(error)
            self.problems.append(problem)
        self._stream = stream = rr.RecordingStream(APPLICATION)
        self._connect(stream)
        self.count += 1
        seed = "" if key[0] is None else f", seed {key[0]}"
        stream.send_recording_name(f"episode {block.episode + 1}{seed}")
        stream.send_blueprint(make_blueprint(block, live=self._live, gap=bool(self._partner)))
        self._logger = EpisodeLogger(stream, "run", tail.config, tail.header)
        if problem:
            self._logger.log_text(0.0, problem, "WARN")
        if overlay is not None and self._partner:
            stamps = _list_places(self._partner, "odometry")[0]
            self._shift = float(block.ticks["stamp"][:1].sum() - stamps[:1].sum())
            other = overlay.tail
            logger = EpisodeLogger(stream, "other", other.config, other.header, self._shift)
            for part in self._partner:
                logger.log(part)

    def finish_episode(self) -> None:
        """Send all of the episode; idempotent."""
        if self._stream is not None:
            self._stream.flush()
            self._stream.disconnect()
        self._stream = None

    def close(self) -> None:
        """Send all of a recording that isn't written any more."""
        self._log_end()
        self.finish_episode()
        if not self.count:
            raise ConfigError(f"{self._tail.path}: holds no episode")
        if len(self.problems) == self.count:
            raise ConfigError(self.problems[0])


def save_recording(path: Path, other: Path | None, target: Path) -> int:
    """Write a recording to an .rrd file; returns the number of its episodes."""
    tail, overlay = RecordingTail(path), None if other is None else Overlay(other)
    with tempfile.TemporaryDirectory(prefix="acsar-view-", dir=target.parent) as folder:
        parts: list[Path] = []

        def connect(stream: rr.RecordingStream) -> None:
            parts.append(Path(folder) / f"{len(parts)}.rrd")
            stream.save(parts[-1])

        writer = RerunWriter(tail, overlay, connect)
        writer.update()
        writer.close()
        merge_files(parts, target)
    return len(parts)


def show_recording(path: Path, other: Path | None, port: int | None, *, live: bool) -> None:
    """Show a recording until the viewer is closed, or, at the page of a port, until Ctrl-C."""
    tail, overlay = RecordingTail(path), None if other is None else Overlay(other)
    with open_viewer(port) as viewer:
        writer = RerunWriter(tail, overlay, lambda s: s.connect_grpc(viewer.address), live=live)
        try:
            writer.update()
            if not live:
                writer.close()
            if viewer.url:
                text = f"{path}: open {viewer.url} in a browser; Ctrl-C ends it"
                print(escape_unprintable(text), flush=True)
            problem = ""
            while viewer.process.poll() is None:
                time.sleep(POLL_INTERVAL)
                try:
                    if live:
                        writer.update()
                except ConfigError as error:  # another recorder may have begun just now
                    if str(error) != problem:
                        problem = str(error)
                        print_error(f"acsar-gym: {escape_unprintable(problem)}")
        finally:
            writer.finish_episode()
