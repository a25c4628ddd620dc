"""Reads recordings back: what they hold at once, and their tables when they are needed."""

from __future__ import annotations

import hashlib
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, RecordingWarning, escape_unprintable
from acsar_gym.lidar.scan import MAX_STAMP
from acsar_gym.reading import open_file
from acsar_gym.recording.blocks import (
    FORMAT,
    MAGIC,
    Block,
    Head,
    Header,
    has_end,
    iterate_blocks,
    parse_section,
    read_block,
    unpack_table,
)
from acsar_gym.recording.events import DOUBLES, TABLES
from acsar_gym.recording.types import (
    Episode,
    Floats,
    Movers,
    Pieces,
    Recording,
    Revolutions,
    Scans,
    WireLog,
)
from acsar_gym.worlds.crowd import SEEN_NUMBERS

MAX_NUMBER = MAX_STAMP  # largest range, place or time, either sign
LIDAR_TABLES = ("revolutions", "measurements")
EMPTY_SHAPES = {
    "measurements": (3,),
    "mover_states": (0, SEEN_NUMBERS),
    "actions": (2,),
    "observations": (0,),
    "ranges": (0,),
}
COMPACT_PIECES = 100_000  # from this number on, pieces of bytes stay in one buffer
PART_BLOCKS = 20  # blocks of an episode that are exported at once


def read(path: str | Path, *, revolutions: bool = False) -> Recording:
    """Read a recording.

    The tables of an episode are read from the file when they are needed.

    Args:
        path: The file, of any length.
        revolutions: Whether the measurements of a LiDAR are needed, too.

    Returns:
        The recording. If the end of the file is missing, it holds what there is, and `cut` is true.
        If some bytes are damaged, it holds the others, and `damages` describes the places.

    Raises:
        ConfigError: The file can't be read, isn't a recording, or all of it is damaged. An episode
            may raise it when its tables are read.

    Warns:
        RecordingWarning: The file is damaged.
    """
    recording, _ = _read(Path(path), revolutions=revolutions)
    if recording.damages:
        text = f"{path}: is damaged: {recording.describe_damage()}"
        warnings.warn(escape_unprintable(text), RecordingWarning, stacklevel=2)
    return recording


def _read(path: Path, *, revolutions: bool) -> tuple[Recording, list[StoredTables]]:
    """Read a recording; also return the tables of its episodes."""
    damages: list[str] = []
    header: dict[str, Any] | None = None
    dropped: int | None = None
    stored: dict[int, StoredTables] = {}
    with open_file(path) as file:
        for block in iterate_blocks(file, damages):
            head = block.head
            header = header or head.header
            dropped = head.dropped
            if head.episode >= 0:
                if head.episode not in stored:
                    stored[head.episode] = StoredTables(path, head, with_lidar=revolutions)
                stored[head.episode].add(block)

        if header is None or not stored:
            raise ConfigError(_explain_nothing(file, header, damages, is_whole=dropped is not None))
        if header.get("format") != FORMAT:
            shown = str(header.get("format"))[:20]
            raise ConfigError(
                f"is a recording of format {shown}: this version reads format {FORMAT}"
            )
        parse_section(Header, header)
        config = RobotConfig.model_validate(header["config"])
        is_cut = dropped is None or not has_end(file)
        file.seek(0)
        digest = hashlib.file_digest(file, "sha256").hexdigest()[:16]

    missing = sum(tables.missing for tables in stored.values())
    lost = 0 if damages else missing
    recording = Recording(
        header=header,
        sha256=digest,
        config=config,
        episodes=tuple(StoredEpisode.of(tables) for tables in stored.values()),
        cut=is_cut,
        dropped=dropped or lost,
        damages=tuple(damages),
        missing=max(missing - lost - (dropped or 0), 0),
    )
    return recording, list(stored.values())


def _explain_nothing(
    file: IO[bytes], header: Mapping[str, Any] | None, damages: list[str], *, is_whole: bool
) -> str:
    """Describe why a file has no episode."""
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        return "isn't a recording: not an MCAP file"
    if damages:
        return f"is damaged: {damages[0]}"
    if header is None:
        return "isn't a recording of acsar_gym (format 1 is read as a ROS 2 bag, with --robot)"
    return "holds no episode" if is_whole else "is cut before its first episode"


class StoredTables:
    """The tables of an episode, each of which is read from the file when it is needed.

    Args:
        path: The file.
        head: How the episode began.
        with_lidar: Whether the measurements of a LiDAR are there.
        places: Where its blocks are in the file.

    Attributes:
        head: How the episode began.
        rows: Number of rows of each table.
        missing: Number of control periods that aren't there.
        outcome: Whether its newest step terminated and truncated it, and succeeded.
    """

    def __init__(
        self, path: Path, head: Head, *, with_lidar: bool, places: list[int] | None = None
    ) -> None:
        self.head = head
        self.rows: Counter[str] = Counter()
        self.missing = 0
        self.outcome = (False, False, False)
        self._path = path
        self._with_lidar = with_lidar
        self._places = places or []
        self._next_period = 0
        self._loaded: dict[str, NDArray[Any]] = {}

    def add(self, block: Block) -> None:
        """Note where a block is, and how much it holds."""
        self._places.append(block.place)
        self.rows.update({name: shape[0] for name, shape in block.head.tables.items()})
        self.outcome = block.head.outcome or self.outcome
        if block.head.periods is not None:
            _, last = block.head.periods
            lacking = last + 1 - self._next_period - block.head.tables.get("exchanges", [0])[0]
            self.missing += max(lacking, 0)
            self._next_period = last + 1

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self._loaded:
            self._loaded[name] = self._load(name)
        return self._loaded[name]

    def _load(self, name: str) -> NDArray[Any]:
        """Read a table from all blocks; one without a row has the shape of an empty table."""
        empty = np.zeros((0, *EMPTY_SHAPES.get(name, ())), TABLES[name])
        if name in LIDAR_TABLES and not self._with_lidar:
            return empty

        parts = []
        with open_file(self._path) as file:  # errors name the file
            for place in self._places:
                block = read_block(file, place)
                if block is None:
                    raise ConfigError("has changed since it was read: read it again")
                if name in block.head.tables:
                    parts.append(unpack_table(block, name))
            shapes = {array.shape[1:] for array in parts} or {empty.shape[1:]}
            if len(shapes) > 1 or len(shapes.pop()) != empty.ndim - 1:
                raise ConfigError(f"is damaged: {name} of several lengths")
            table = np.concatenate(parts or [empty])
            check_table(name, table)
        return table

    def list_pieces(self, name: str) -> Sequence[bytes]:
        """Return the pieces of bytes of two tables."""
        sizes = self[name]["size"]
        data = self[f"{name}_bytes"].tobytes()
        if sizes.sum() != len(data):
            raise ConfigError(f"{self._path}: is damaged: some bytes of {name} are missing")
        pieces = Pieces(data, sizes)
        return tuple(pieces) if len(pieces) < COMPACT_PIECES else pieces

    def split(self) -> Iterator[StoredTables]:
        """Yield the tables in parts, to read a long episode piece by piece."""
        for first in range(0, len(self._places), PART_BLOCKS):
            places = self._places[first : first + PART_BLOCKS]
            yield StoredTables(self._path, self.head, with_lidar=self._with_lidar, places=places)


def check_table(name: str, table: NDArray[Any]) -> None:
    """Raise ConfigError if a table holds numbers that no robot has."""
    problem = ""

    if table.dtype.names:
        stamps = table["stamp"]
        if not (np.abs(stamps) <= MAX_STAMP).all():
            problem = "a time that is out of range"
        elif name in ("ticks", "exchanges") and (np.diff(stamps) < 0.0).any():
            problem = "its times go backwards"
    elif table.dtype == DOUBLES and not (np.abs(table) <= MAX_NUMBER).all():
        problem = f"{name} that are out of range"
    elif name == "mover_states" and not (table[..., -1:] > 0.0).all():
        problem = "a mover without a radius"
    elif name == "measurements" and not (table[..., 1:2] >= 0.0).all():
        problem = "a negative distance of the LiDAR"
    if problem:
        raise ConfigError(f"is damaged: {problem}")


def join_truth(tables: StoredTables) -> Floats:
    """Return the true poses (n, 3) at the ends of the exchanges of ticks; NaN if unknown."""
    numbers = tables["exchanges"]["number"]
    wanted = tables["ticks"]["exchange"]
    truth = np.full((len(wanted), 3), np.nan)
    if len(numbers):
        places = np.minimum(np.searchsorted(numbers, wanted), len(numbers) - 1)
        is_recorded = numbers[places] == wanted
        truth[is_recorded] = tables["exchanges"]["pose"][places[is_recorded]]
    return truth


def _make_wire(stored: StoredTables) -> WireLog:
    return WireLog(
        sent_stamps=stored["sent"]["stamp"],
        sent=stored.list_pieces("sent"),
        got_stamps=stored["received"]["stamp"],
        got=stored.list_pieces("received"),
        stamped=bool(stored.head.info.get("stamped")),
    )


def _make_scans(stored: StoredTables) -> Scans:
    scans = stored["scans"]
    return Scans(scans["stamp"], stored["ranges"], scans["exchange"])


def _make_movers(stored: StoredTables) -> Movers:
    movers = stored["movers"]
    return Movers(
        exchanges=movers["exchange"],
        stamps=movers["stamp"],
        hits=movers["hit"],
        intrusions=movers["intrusions"],
        states=stored["mover_states"],
    )


def _make_revolutions(stored: StoredTables) -> Revolutions:
    revolutions = stored["revolutions"]
    ends = np.cumsum(revolutions["size"])
    measured = stored["measurements"]
    if (ends[-1] if len(ends) else 0) != len(measured):
        raise ConfigError("is damaged: measurements of the LiDAR are missing")
    parts = np.split(measured, ends[:-1]) if len(ends) else []
    turns = [np.ascontiguousarray(turn.T) for turn in parts]
    return Revolutions(revolutions["stamp"], turns, revolutions["exchange"])


COLUMNS = {
    "stamps": ("ticks", "stamp"),
    "poses": ("ticks", "pose"),
    "twists": ("ticks", "twist"),
    "speeds": ("ticks", "speeds"),
    "asked": ("ticks", "asked"),
    "sent": ("ticks", "sent"),
    "reasons": ("ticks", "reason"),
    "lateness": ("ticks", "lateness"),
    "step_stamps": ("steps", "stamp"),
}
"""Table and column of an episode's fields."""
MAKERS: Mapping[str, Callable[[StoredTables], Any]] = {
    "wire": _make_wire,
    "truth": join_truth,
    "observations": lambda tables: tables["observations"],
    "actions": lambda tables: tables["actions"][tables["steps"]["step"] > 0],
    "rewards": lambda tables: tables["steps"]["reward"][tables["steps"]["step"] > 0],
    "scans": _make_scans,
    "exchanges": lambda tables: tables["exchanges"],
    "revolutions": _make_revolutions,
    "movers": _make_movers,
}
"""How other fields are made."""


class StoredEpisode(Episode):
    """An episode whose fields are read from the file when they are needed.

    Attributes:
        tables: Its tables, whose names and columns are those of `recording.events.TABLES`.
    """

    tables: StoredTables

    @classmethod
    def of(cls, tables: StoredTables) -> StoredEpisode:
        """Make the episode of some tables."""
        head = tables.head
        terminated, truncated, success = tables.outcome
        episode = object.__new__(cls)
        episode.__dict__.update(
            start=head.start,
            offset=head.offset,
            info=head.info,
            terminated=terminated,
            truncated=truncated,
            success=success if tables.rows["steps"] > 1 else None,
            tables=tables,
        )
        return episode

    def __getattr__(self, name: str) -> Any:
        """Make a field that is used for the first time."""
        if "tables" not in self.__dict__ or name not in {*COLUMNS, *MAKERS}:
            raise AttributeError(name)
        if name in COLUMNS:
            table, column = COLUMNS[name]
            value = self.tables[table][column]
        else:
            value = MAKERS[name](self.tables)
        self.__dict__[name] = value
        return value

    def __repr__(self) -> str:
        return f"<episode from {self.start:g} s on>"


def summarize(path: Path) -> dict[str, Any]:
    """Sum up a recording, ready for JSON; ConfigError if it can't be read."""
    recording, stored = _read(path, revolutions=False)
    episodes: list[dict[str, Any]] = []
    counts: Counter[str] = Counter()
    is_simulated = False
    for tables in stored:
        counts.update(tables.rows)
        exchanges = tables["exchanges"]
        is_simulated = is_simulated or bool(np.isfinite(exchanges["contact"]).any())
        end = exchanges["stamp"][-1] if len(exchanges) else tables.head.start
        episodes.append(
            {
                "ticks": tables.rows["ticks"],
                "steps": max(tables.rows["steps"] - 1, 0),
                "scans": tables.rows["scans"],
                "duration": round(float(end - tables.head.start), 3),
                "info": dict(tables.head.info),
            }
        )

    header = recording.header
    return {
        "file": str(path),
        "sha256": recording.sha256,
        "whole": not recording.cut,
        "damage": recording.describe_damage(),
        "dropped": None if recording.cut and not recording.dropped else recording.dropped,
        "duration": round(sum(episode["duration"] for episode in episodes), 3),
        "about": header["about"],
        "robot": {
            "sha256": header["config_sha256"][:16],
            "base_frame": recording.config.base_frame,
            "simulated": is_simulated,
        },
        "versions": header["versions"],
        "created": header["created"],
        "tables": {name: counts[name] for name in TABLES if counts[name]},
        "episodes": episodes,
    }


def summary_lines(summary: dict[str, Any]) -> list[str]:
    """Return a summary as lines of text."""
    about = summary["about"]
    robot = summary["robot"]
    episodes = summary["episodes"]
    kind = "simulated" if robot["simulated"] else "real"
    state = "whole" if summary["whole"] else "cut: what followed is missing"
    if summary["damage"]:
        state = "damaged" if summary["whole"] else f"damaged; {state}"
    count = f"{len(episodes)} episode{'s' if len(episodes) != 1 else ''}"
    lost = "drops unknown"  # the end, which has their number, is missing
    if summary["dropped"] is not None:
        limit = "" if summary["whole"] else "at least "
        lost = f"{limit}{summary['dropped']:,} dropped" if summary["dropped"] else "nothing dropped"

    lines = [
        f"{summary['file']}: {state}; {count}, {summary['duration']:.1f} s, {lost}",
        f"{kind} robot, config {robot['sha256']}; file {summary['sha256']}",
    ]
    if summary["damage"]:
        lines.append(summary["damage"])
    if about:
        lines.append(", ".join(f"{name} {_shorten(value)}" for name, value in about.items()))
    lines += [
        f"episode {number}: {episode['duration']:.1f} s, {episode['ticks']:,} ticks, "
        f"{episode['steps']} steps, {episode['scans']} scans; {_shorten(episode['info'])}"
        for number, episode in enumerate(episodes[:20])
    ]
    if len(episodes) > 20:
        lines.append(f"... and {len(episodes) - 20} more episodes")
    return lines + [f"{name:<20} {count:>9,}" for name, count in summary["tables"].items()]


def _shorten(value: Any) -> str:
    text = " ".join(f"{k}={v}" for k, v in value.items()) if isinstance(value, dict) else str(value)
    return escape_unprintable(text, 100)
