"""Converts recordings to tables: Parquet, CSV."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from acsar_gym.errors import ConfigError, RecordingWarning, explain_error, require_extra, show_value
from acsar_gym.reading import replace_file
from acsar_gym.recording.events import Table, Tables, split_columns
from acsar_gym.recording.reader import join_truth, read, split_pieces
from acsar_gym.recording.types import Recording

TABLE_FORMATS = ("parquet", "csv")
EXPORTED = ("ticks", "wire", "steps", "scans", "movers")
TRUTH = ("true_x", "true_y", "true_theta")
MOVER_STATE = ("x", "y", "x_rate", "y_rate", "radius")
TableColumns = dict[str, Any]
"""Arrays of one length by name."""


def export_recording(path: Path, to: str, folder: Path) -> list[Path]:
    """Convert a recording to tables.

    Args:
        path: The recording.
        to: Format, of `TABLE_FORMATS`.
        folder: Folder of the tables, which is made if it isn't there.

    Returns:
        The files that were written.

    Raises:
        ConfigError: The recording can't be read, or the folder can't be written.
        MissingExtraError: pyarrow isn't installed.
    """
    if to not in TABLE_FORMATS:
        raise ConfigError(f"--to {show_value(to)}: must be one of {', '.join(TABLE_FORMATS)}")
    recording = read(path)
    if recording.cut:
        state = "the last episode is incomplete"
        state = state if is_incomplete(recording) else "what followed is missing"
        warnings.warn(f"{path}: the file is cut: {state}", RecordingWarning, stacklevel=2)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return _write_tables(recording, to, folder)
    except OSError as error:
        raise ConfigError(f"{folder}: can't be written: {explain_error(error)}") from error


def _write_tables(recording: Recording, to: str, folder: Path) -> list[Path]:
    with require_extra("export of tables", "export"):
        import pyarrow as pa  # noqa: PLC0415 - optional
        from pyarrow import csv, parquet  # noqa: PLC0415 - optional

    make_writer = parquet.ParquetWriter if to == "parquet" else csv.CSVWriter
    writers: dict[str, Any] = {}
    with contextlib.ExitStack() as stack:
        for name, columns in iterate_tables(recording):
            table = pa.table(columns)
            if not len(table):
                continue
            if name not in writers:
                path = stack.enter_context(replace_file(folder / f"{name}.{to}"))
                writers[name] = stack.enter_context(make_writer(path, table.schema))
            writers[name].write_table(table)
    return [folder / f"{name}.{to}" for name in EXPORTED if name in writers]


def is_incomplete(recording: Recording) -> bool:
    """Whether the last episode is incomplete, because the file is cut."""
    return recording.cut and not recording.episodes[-1].terminated


def make_tables(recording: Recording) -> dict[str, TableColumns]:
    """Return the tables of a recording by name: ticks, wire, steps, scans, movers.

    All have the number of the `episode`, `stamp` on the link's clock [s], and `time` on the wall
    clock of the first reset [ns since 1970].

    Raises:
        ConfigError: The episodes have different columns.
    """
    parts: dict[str, list[TableColumns]] = {}
    for name, columns in iterate_tables(recording):
        parts.setdefault(name, []).append(columns)
    tables: dict[str, TableColumns] = {}
    for name, blocks in parts.items():
        filled = [block for block in blocks if len(block["stamp"])] or blocks[:1]
        tables[name] = {key: np.concatenate([b[key] for b in filled]) for key in filled[0]}
    return tables


def iterate_tables(recording: Recording) -> Iterator[tuple[str, TableColumns]]:
    """Yield names and rows of tables, in parts of moderate size. See `make_tables`."""
    names: dict[str, list[str]] = {}
    for number, episode in enumerate(recording.episodes):
        for tables in episode.tables.split():
            for name, columns in _list_tables(tables):
                stamps = columns["stamp"]
                if len(stamps) and names.setdefault(name, list(columns)) != list(columns):
                    raise ConfigError(f"the episodes have different {name}: they fit no table")
                times = np.rint(stamps * 1e9).astype(np.int64) + episode.offset
                yield name, {"episode": np.full(len(stamps), number), "time": times, **columns}


def _list_tables(tables: Tables) -> Iterator[tuple[str, TableColumns]]:
    """Yield names and columns of the exported tables."""
    truth = dict(zip(TRUTH, join_truth(tables).T, strict=True))
    yield "ticks", split_columns(tables["ticks"]) | truth
    yield "wire", _list_wire(tables)
    numbers = _number("action", tables["actions"]) | _number("observation", tables["observations"])
    yield "steps", split_columns(tables["steps"]) | numbers
    yield "scans", split_columns(tables["scans"]) | _number("range", tables["ranges"])

    # One row for each mover and control period.
    states = tables["mover_states"]
    periods, count, size = states.shape
    stamps = np.repeat(tables["movers"]["stamp"], count)
    movers = {"stamp": stamps, "mover": np.tile(np.arange(count), periods)}
    yield "movers", movers | dict(zip(MOVER_STATE, states.reshape(-1, size).T, strict=True))


def _number(name: str, table: Table) -> TableColumns:
    """The columns of a table of plain numbers: action_0, action_1."""
    return {f"{name}_{number}": column for number, column in enumerate(table.T)}


def _list_wire(tables: Tables) -> TableColumns:
    """A row for each piece of bytes, in the order of time."""
    rows = [
        (stamp, direction, piece.decode("latin-1"))
        for direction in ("sent", "received")
        for stamp, piece in zip(
            tables[direction]["stamp"].tolist(), split_pieces(tables, direction), strict=True
        )
    ]
    rows.sort(key=lambda row: row[0])
    return {
        "stamp": np.array([stamp for stamp, _, _ in rows], np.float64),
        "direction": [direction for _, direction, _ in rows],
        "bytes": [text for _, _, text in rows],
    }
