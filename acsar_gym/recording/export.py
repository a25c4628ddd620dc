"""Converts recordings to tables: Parquet, CSV."""

from __future__ import annotations

import contextlib
import csv
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, RecordingWarning, explain_error, require_extra, show_value
from acsar_gym.reading import replace_file
from acsar_gym.recording.reader import iterate_blocks, read
from acsar_gym.recording.types import Episode, Recording, WireLog

TABLES = ("ticks", "wire", "steps", "scans", "movers")
BLOCK_ROWS = 5_000  # rows of steps and scans that are written at once
DISORDER = 1.0  # bytes are recorded at most so long after others that came later [s]
TableColumns = dict[str, Any]  # arrays of one length by name
AddRows = Callable[[TableColumns], None]  # writes rows; ConfigError for other columns than before


def export_recording(path: Path, to: str, folder: Path) -> list[Path]:
    """Convert a recording to tables; returns the files that were written.

    Raises:
        ConfigError: the recording can't be read, or the folder can't be written.
        MissingExtraError: pyarrow isn't installed.
    """
    if to not in TABLE_FORMATS:
        raise ConfigError(f"--to {show_value(to)}: must be one of {', '.join(TABLE_FORMATS)}")
    recording = read(path)
    if recording.cut:
        last = "the last episode is incomplete"
        last = last if is_incomplete(recording) else "what followed is missing"
        warnings.warn(f"{path}: the file is cut: {last}", RecordingWarning, stacklevel=2)
    writers: dict[str, AddRows] = {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack:
            for name, columns in iterate_tables(recording):
                if len(columns["episode"]):
                    if name not in writers:
                        table = TABLE_FORMATS[to](folder / f"{name}.{to}")
                        writers[name] = stack.enter_context(table)
                    writers[name](columns)
    except OSError as error:
        raise ConfigError(f"{folder}: can't be written: {explain_error(error)}") from error
    return [folder / f"{name}.{to}" for name in TABLES if name in writers]


def is_incomplete(recording: Recording) -> bool:
    """Whether the last episode is incomplete, because the file is cut."""
    return recording.cut and not recording.episodes[-1].terminated


def make_tables(recording: Recording) -> dict[str, TableColumns]:
    """Return the tables of a recording by name: ticks, wire, steps, scans, movers.

    All have the number of the `episode`, `stamp` on the link's clock [s], and `time` on the wall
    clock of the first reset [ns since 1970]. ConfigError where episodes have different columns.
    """
    parts: dict[str, list[TableColumns]] = {name: [] for name in TABLES}
    for name, columns in iterate_tables(recording):
        parts[name].append(columns)
    tables: dict[str, TableColumns] = {}
    for name, blocks in parts.items():
        filled = [block for block in blocks if len(block["stamp"])] or blocks[:1]
        for block in filled:
            check_columns(name, list(filled[0]), list(block))
        tables[name] = {
            key: np.concatenate([np.asarray(block[key]) for block in filled]) for key in filled[0]
        }
    return tables


def check_columns(name: str, first: Sequence[str], columns: Sequence[str]) -> None:
    """Raise ConfigError where a part of a table has other columns than the first one."""
    if list(columns) != list(first):
        raise ConfigError(f"the episodes have different {name}: they don't fit into one table")


def iterate_tables(recording: Recording) -> Iterator[tuple[str, TableColumns]]:
    """Yield names and rows of tables, in blocks of moderate size; see `make_tables`."""
    for number, episode in enumerate(recording.episodes):
        late = WireRows()
        for block in iterate_blocks(episode):
            yield "ticks", _add_times(number, episode, _list_ticks(block))
            yield "wire", _add_times(number, episode, late.add(block.wire))
            yield "movers", _add_times(number, episode, _list_movers(block))
        yield "wire", _add_times(number, episode, late.finish())
        for name, columns in (("steps", _list_steps(episode)), ("scans", _list_scans(episode))):
            for first in range(0, max(len(columns["stamp"]), 1), BLOCK_ROWS):
                rows = slice(first, first + BLOCK_ROWS)
                block_rows = {key: values[rows] for key, values in columns.items()}
                yield name, _add_times(number, episode, block_rows)


def _add_times(number: int, episode: Episode, columns: TableColumns) -> TableColumns:
    stamps = columns["stamp"]
    times = np.rint(stamps * 1e9).astype(np.int64) + episode.offset
    return {"episode": np.full(len(stamps), number), "time": times, **columns}


def _list_ticks(episode: Episode) -> TableColumns:
    pose, twist = "x y theta", "linear angular"
    return {
        "stamp": episode.stamps,
        **_name_columns("", episode.poses, pose),
        **_name_columns("", episode.twists, twist),
        **_name_columns("speed_", episode.speeds, "a b c d"),
        **_name_columns("asked_", episode.asked, twist),
        **_name_columns("sent_", episode.sent, twist),
        "reason": episode.reasons,
        "lateness": episode.lateness,
        **_name_columns("true_", episode.truth, pose),
    }


class WireRows:
    """Rows of the wire's table, in the order of time over all blocks of an episode."""

    def __init__(self) -> None:
        self._rows = _list_pieces(WireLog(np.zeros(0), (), np.zeros(0), ()))

    def add(self, wire: WireLog) -> TableColumns:
        """Add a block; returns the rows that none of a later one can come before."""
        new = _list_pieces(wire)
        rows = {key: np.concatenate([self._rows[key], new[key]]) for key in new}
        order = np.argsort(rows["stamp"], kind="stable")
        rows = {key: values[order] for key, values in rows.items()}
        stamps = rows["stamp"]
        ready = int(np.searchsorted(stamps, stamps[-1] - DISORDER)) if len(stamps) else 0
        self._rows = {key: values[ready:] for key, values in rows.items()}
        return {key: values[:ready] for key, values in rows.items()}

    def finish(self) -> TableColumns:
        """Return the rows that are left."""
        return self._rows


def _list_pieces(wire: WireLog) -> TableColumns:
    """Rows of the wire's table, those that were sent first."""
    texts = [piece.decode("latin-1") for piece in (*wire.sent, *wire.got)]
    return {
        "stamp": np.concatenate([wire.sent_stamps, wire.got_stamps]),
        "direction": np.array(
            ["sent"] * len(wire.sent) + ["received"] * len(wire.got), dtype=object
        ),
        "bytes": np.array(texts, dtype=object),
    }


def _list_steps(episode: Episode) -> TableColumns:
    count = len(episode.step_stamps)
    none = np.full((min(count, 1), episode.actions.shape[1]), np.nan)
    return {
        "stamp": episode.step_stamps,
        "step": np.arange(count),
        "reward": np.concatenate([none[:, 0], episode.rewards]),
        **_name_columns("action_", np.concatenate([none, episode.actions])),
        **_name_columns("observation_", episode.observations),
    }


def _list_scans(episode: Episode) -> TableColumns:
    scans = episode.scans
    return {"stamp": scans.stamps, **_name_columns("range_", scans.ranges)}


def _list_movers(episode: Episode) -> TableColumns:
    """One row for each mover and control period."""
    movers = episode.movers
    periods, count, numbers = movers.states.shape
    rows = movers.states.reshape(-1, numbers)
    return {
        "stamp": np.repeat(movers.stamps, count),
        "mover": np.tile(np.arange(count), periods),
        **_name_columns("", rows, "x y x_rate y_rate radius"),
    }


def _name_columns(prefix: str, rows: NDArray[Any], names: str = "") -> TableColumns:
    """The columns of rows by name; by number where none are given."""
    column_names = names.split() or map(str, range(rows.shape[1]))
    return {f"{prefix}{name}": rows[:, number] for number, name in enumerate(column_names)}


@contextlib.contextmanager
def open_csv(path: Path) -> Iterator[AddRows]:
    """Write rows to a CSV file, which replaces an older one when it is whole."""
    names: list[str] = []
    with replace_file(path) as new, new.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)

        def add_rows(columns: TableColumns) -> None:
            if not names:
                names.extend(columns)
                writer.writerow(columns)
            check_columns(path.stem, names, list(columns))
            writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))

        yield add_rows


@contextlib.contextmanager
def open_parquet(path: Path) -> Iterator[AddRows]:
    """Write rows to a Parquet file, which replaces an older one when it is whole."""
    with require_extra("export to Parquet", "export"):
        import pyarrow as pa  # noqa: PLC0415 - optional
        from pyarrow import parquet  # noqa: PLC0415 - optional
    writer: Any = None
    with contextlib.ExitStack() as stack:
        new = stack.enter_context(replace_file(path))

        def add_rows(columns: TableColumns) -> None:
            nonlocal writer
            table = pa.table(columns)
            if writer is None:
                writer = stack.enter_context(parquet.ParquetWriter(new, table.schema))
            check_columns(path.stem, writer.schema.names, table.column_names)
            writer.write_table(table)

        yield add_rows


TABLE_FORMATS = {"parquet": open_parquet, "csv": open_csv}
