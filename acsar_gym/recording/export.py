"""Converts recordings to tables: Parquet, CSV."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from acsar_gym.errors import (
    ConfigError,
    RecordingWarning,
    explain_error,
    require_extra,
    show_value,
)
from acsar_gym.reading import replace_file
from acsar_gym.recording.events import Table, split_columns
from acsar_gym.recording.reader import read
from acsar_gym.recording.types import Episode, Recording, split_pieces

TRUTH = ("true_x", "true_y", "true_theta")
MOVER_STATE = ("x", "y", "x_rate", "y_rate", "radius")
FORMATS = ("parquet", "csv")
DIRECTIONS = ("sent", "received")
TableColumns = dict[str, Any]
"""Arrays of one length by name."""


def export_recording(path: Path, to: str, folder: Path) -> list[Path]:
    """Convert a recording to tables.

    Args:
        path: The recording.
        to: Format, "parquet" or "csv".
        folder: Folder of the tables, which is made if it isn't there.

    Returns:
        The files that were written.

    Raises:
        ConfigError: The recording can't be read, or the folder can't be written.
        MissingExtraError: pyarrow isn't installed.
    """
    if to not in FORMATS:
        raise ConfigError(f"to = {show_value(to)}: must be one of {', '.join(FORMATS)}")
    recording = read(path)
    if recording.cut:
        loss = "the last episode is incomplete"
        loss = loss if recording.is_incomplete else "what followed is missing"
        warnings.warn(f"{path}: the file is cut: {loss}", RecordingWarning, stacklevel=2)
    with require_extra("export of tables", "export"):
        import pyarrow as pa  # noqa: PLC0415 - optional
        from pyarrow import csv, parquet  # noqa: PLC0415 - optional

    # Written in parts, so that a long drive needs little memory.
    make_writer = parquet.ParquetWriter if to == "parquet" else csv.CSVWriter
    writers: dict[str, Any] = {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack:
            # A file is opened with its first rows, whose columns are those of the file.
            for name, columns in iterate_tables(recording):
                table = pa.table(columns)
                if not len(table):
                    continue
                if name not in writers:
                    new = stack.enter_context(replace_file(folder / f"{name}.{to}"))
                    writers[name] = stack.enter_context(make_writer(new, table.schema))
                writers[name].write_table(table)
    except OSError as error:
        raise ConfigError(f"{folder}: can't be written: {explain_error(error)}") from error
    return [folder / f"{name}.{to}" for name in writers]


def iterate_tables(recording: Recording) -> Iterator[tuple[str, TableColumns]]:
    """Yield names and rows of tables, in parts of moderate size: ticks, wire, steps, scans, movers.

    All have the number of the `episode`, `stamp` on the link's clock [s], and `time` on the wall
    clock of the first reset [ns since 1970].

    Raises:
        ConfigError: The episodes have different columns.
    """
    names: dict[str, list[str]] = {}
    for number, episode in enumerate(recording.episodes):
        for piece in episode.split():
            for name, columns in _list_tables(piece):
                stamps = columns["stamp"]
                if len(stamps) and names.setdefault(name, list(columns)) != list(columns):
                    raise ConfigError(f"the episodes have different {name}: they fit no table")
                times = np.rint(stamps * 1e9).astype(np.int64) + episode.offset
                yield name, {"episode": np.full(len(stamps), number), "time": times, **columns}


def _list_tables(part: Episode) -> Iterator[tuple[str, TableColumns]]:
    """Yield names and columns of the exported tables."""
    tables = part.tables
    # Odometry and truth are next to each other, so that plots compare them.
    truth = dict(zip(TRUTH, part.truth.T, strict=True))
    yield "ticks", split_columns(tables["ticks"]) | truth

    # A row for each piece of bytes, in the order of time.
    pieces = [piece for name in DIRECTIONS for piece in split_pieces(tables, name)]
    stamps = np.concatenate([tables[name]["stamp"] for name in DIRECTIONS])
    order = np.argsort(stamps, kind="stable")
    directions = np.repeat(DIRECTIONS, [len(tables[name]) for name in DIRECTIONS])
    texts = [pieces[row].decode("latin-1") for row in order]
    yield "wire", {"stamp": stamps[order], "direction": directions[order], "bytes": texts}

    numbers = _number("action", tables["actions"]) | _number("observation", tables["observations"])
    yield "steps", split_columns(tables["steps"]) | numbers
    yield "scans", split_columns(tables["scans"]) | _number("range", tables["ranges"])

    # One row for each mover and control period.
    periods, count, size = part.movers.states.shape
    stamps = np.repeat(part.movers.stamps, count)
    movers = {"stamp": stamps, "mover": np.tile(np.arange(count), periods)}
    states = part.movers.states.reshape(-1, size).T
    yield "movers", movers | dict(zip(MOVER_STATE, states, strict=True))


def _number(name: str, table: Table) -> TableColumns:
    """The columns of a table of plain numbers: action_0, action_1."""
    return {f"{name}_{number}": column for number, column in enumerate(table.T)}
