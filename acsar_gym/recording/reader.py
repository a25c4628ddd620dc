"""Reads recordings back: what they hold at once, and their tables when they are needed."""

from __future__ import annotations

import hashlib
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, RecordingWarning, escape_unprintable
from acsar_gym.lidar.scan import MAX_STAMP
from acsar_gym.reading import open_file
from acsar_gym.recording.blocks import (
    FORMAT,
    IDENTIFYING_BYTES,
    MAGIC,
    Block,
    Head,
    Header,
    find_block,
    has_end,
    iterate_blocks,
    read_block,
    unpack_table,
)
from acsar_gym.recording.events import DOUBLES, TABLES, Table, Tables
from acsar_gym.recording.types import Episode, Recording

PART_BLOCKS = 20  # blocks of an episode that are exported or shown at once
SHOWN_EPISODES = 20  # most episodes of which a summary has a line


class StoredTables(Tables):
    """The tables of an episode, each of which is read from the file when it is needed.

    Args:
        path: The file.
        places: Where its blocks are in the file.

    Attributes:
        head: How the episode began, and what its newest step was.
        missing: Number of control periods that aren't there.
    """

    def __init__(self, path: Path, places: Sequence[int] = ()) -> None:
        super().__init__()
        self.head = Head()
        self._rows: Counter[str] = Counter()
        self.missing = 0
        self._path = path
        self._places = list(places)
        self._next_period = 0

    def add(self, block: Block) -> None:
        """Note where a block is, and how much it holds."""
        head = block.head
        self._places.append(block.place)
        self._rows.update({name: shape[0] for name, shape in head.tables.items()})
        outcome = head.outcome or self.head.outcome
        self.head = head.model_copy(update={"outcome": outcome})
        if head.periods is not None:
            _, last = head.periods
            # Blocks repeat the number of their first and last period, so a gap is noticed.
            lacking = last + 1 - self._next_period - head.tables.get("exchanges", [0])[0]
            self.missing += max(lacking, 0)
            self._next_period = last + 1

    def count(self, name: str) -> int:
        """Return the number of rows of a table."""
        return self._rows[name]

    def split(self) -> Iterator[StoredTables]:
        """Yield the tables in parts, to read a long episode piece by piece."""
        for first in range(0, len(self._places), PART_BLOCKS):
            tables = StoredTables(self._path, self._places[first : first + PART_BLOCKS])
            tables.head = self.head
            yield tables

    def __missing__(self, name: str) -> Table:
        # A long recording doesn't fit into memory: only the table that is asked for is read.
        parts = []
        with open_file(self._path) as file:  # errors name the file
            for place in self._places:
                block = read_block(file, place)
                # The offset is the wall clock's, so no other recording has it.
                if block is None or block.head.offset != self.head.offset:
                    raise ConfigError("has changed since it was read: read it again")
                if name in block.head.tables:
                    parts.append(unpack_table(block, name))

            # Blocks have a table only if it has rows.
            empty = super().__missing__(name)
            shapes = {table.shape[1:] for table in parts} or {empty.shape[1:]}
            if len(shapes) > 1 or len(shapes.pop()) != empty.ndim - 1:
                raise ConfigError(f"is damaged: {name} of several lengths")
            table = np.concatenate(parts or [empty])
            check_table(name, table)
        self[name] = table
        return table


def check_table(name: str, table: Table) -> None:
    """Raise ConfigError if a table holds numbers that no robot has."""
    problem = ""
    if table.dtype.names:
        # Times that no clock shows would break whatever computes with them.
        stamps = table["stamp"]
        if not (np.abs(stamps) <= MAX_STAMP).all():
            problem = "a time that is out of range"
        elif name in ("ticks", "exchanges") and (np.diff(stamps) < 0.0).any():
            problem = "its times go backwards"
    elif table.dtype == DOUBLES and not (np.abs(table) <= MAX_STAMP).all():
        problem = f"{name} that are out of range"
    elif name == "mover_states" and not (table[..., -1:] > 0.0).all():
        problem = "a mover without a radius"
    elif name == "measurements" and not (table[..., 1:2] >= 0.0).all():
        problem = "a negative distance of the LiDAR"

    if problem:
        raise ConfigError(f"is damaged: {problem}")


def read(path: str | Path) -> Recording:
    """Read a recording. Its tables are read from the file when they are needed.

    Args:
        path: The file, of any length.

    Returns:
        The recording. If the end of the file is missing, it holds what there is, and `cut` is true.
        If some bytes are damaged, it holds the others, and `damages` describes the places.

    Raises:
        ConfigError: The file can't be read, isn't a recording, or all of it is damaged. An episode
            may raise it when its tables are read.

    Warns:
        RecordingWarning: The file is damaged.
    """
    recording = read_quietly(Path(path))
    if recording.damages:
        text = f"{path}: is damaged: {recording.describe_damage()}"
        warnings.warn(escape_unprintable(text), RecordingWarning, stacklevel=2)
    return recording


def read_quietly(path: Path) -> Recording:
    """Read a recording as `read` does, without its warning."""
    damages: list[str] = []
    header: Header | None = None
    dropped: int | None = None
    stored: dict[int, StoredTables] = {}
    with open_file(path) as file:
        # A file of another kind may be huge, and isn't searched to its end.
        is_mcap = file.read(len(MAGIC)) == MAGIC
        if not is_mcap and find_block(file, 0, IDENTIFYING_BYTES) < 0:
            raise ConfigError("isn't a recording: not an MCAP file")
        for block in iterate_blocks(file, damages):
            head = block.head
            header = header or head.header
            dropped = head.dropped
            if head.episode >= 0:
                stored.setdefault(head.episode, StoredTables(path)).add(block)

        # The header is in the first block and in the last.
        if header is None or not stored:
            problem = (
                "holds no episode" if dropped is not None else "is cut before its first episode"
            )
            if header is None:
                problem = (
                    "isn't a recording of acsar_gym (format 1 is read as a ROS 2 bag, with --robot)"
                )
            if damages:
                problem = f"is damaged: {damages[0]}"
            raise ConfigError(problem)
        if header.format != FORMAT:
            raise ConfigError(
                f"is a recording of format {header.format}: this version reads format {FORMAT}"
            )
        # The robot as it was then, whatever its preset is today.
        config = RobotConfig.model_validate(header.config)
        is_cut = dropped is None or not has_end(file)
        file.seek(0)
        digest = hashlib.file_digest(file, "sha256").hexdigest()[:16]

    # Without damage, all that is missing was dropped.
    missing = sum(tables.missing for tables in stored.values())
    dropped = dropped or (0 if damages else missing)
    return Recording(
        header=header.model_dump(),
        sha256=digest,
        config=config,
        episodes=tuple(Episode(tables.head, tables) for tables in stored.values()),
        cut=is_cut,
        dropped=dropped,
        damages=tuple(damages),
        missing=max(missing - dropped, 0),
    )


def summarize(path: Path) -> dict[str, Any]:
    """Sum up a recording, ready for JSON. Raises ConfigError if it can't be read."""
    recording = read_quietly(path)
    episodes = [_summarize_episode(episode) for episode in recording.episodes]
    counts = {name: sum(e.tables.count(name) for e in recording.episodes) for name in TABLES}
    # Hardware has no ground truth.
    contacts = np.concatenate([episode.exchanges["contact"] for episode in recording.episodes])

    header = recording.header
    return {
        "file": str(path),
        "sha256": recording.sha256,
        "whole": not recording.cut,
        "damage": recording.describe_damage(),
        # The last block has the number, and a cut file has no last block.
        "dropped": None if recording.cut and not recording.dropped else recording.dropped,
        "duration": round(sum(episode["duration"] for episode in episodes), 3),
        "about": header["about"],
        "robot": {
            "sha256": header["config_sha256"][:16],
            "base_frame": recording.config.base_frame,
            "simulated": bool(np.isfinite(contacts).any()),
        },
        "versions": header["versions"],
        "created": header["created"],
        "tables": {name: count for name, count in counts.items() if count},
        "episodes": episodes,
    }


def _summarize_episode(episode: Episode) -> dict[str, Any]:
    count = episode.tables.count
    end = episode.exchanges["stamp"].max(initial=episode.start)
    return {
        "ticks": count("ticks"),
        "steps": max(count("steps") - 1, 0),
        "scans": count("scans"),
        "duration": round(float(end) - episode.start, 3),
        "info": dict(episode.info),
    }


def summary_lines(summary: dict[str, Any]) -> list[str]:
    """Return a summary as lines of text."""
    robot = summary["robot"]
    episodes = summary["episodes"]
    states = ["damaged"] * bool(summary["damage"])
    if not (summary["whole"] and states):
        states.append("whole" if summary["whole"] else "cut: what followed is missing")
    lost = f"{summary['dropped'] or 'nothing'} dropped"
    if summary["dropped"] and not summary["whole"]:
        lost = f"at least {lost}"
    elif summary["dropped"] is None:
        lost = "drops unknown"  # the end, which has their number, is missing
    count = f"{len(episodes)} episode{'s' * (len(episodes) != 1)}"
    kind = "simulated" if robot["simulated"] else "real"
    about = ", ".join(f"{name} {_shorten(value)}" for name, value in summary["about"].items())

    lines = [
        f"{summary['file']}: {'; '.join(states)}; {count}, {summary['duration']:.1f} s, {lost}",
        f"{kind} robot, config {robot['sha256']}; file {summary['sha256']}",
        *(line for line in (summary["damage"], about) if line),
    ]
    for number, episode in enumerate(episodes[:SHOWN_EPISODES]):
        lines.append(
            f"episode {number}: {episode['duration']:.1f} s, {episode['ticks']:,} ticks, "
            f"{episode['steps']} steps, {episode['scans']} scans; {_shorten(episode['info'])}"
        )
    if len(episodes) > SHOWN_EPISODES:
        lines.append(f"... and {len(episodes) - SHOWN_EPISODES} more episodes")
    return lines + [f"{name:<20} {count:>9,}" for name, count in summary["tables"].items()]


def _shorten(value: Any) -> str:
    text = " ".join(f"{k}={v}" for k, v in value.items()) if isinstance(value, dict) else str(value)
    return escape_unprintable(text, 100)
