"""Converts recordings to tables: Parquet, CSV."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, RecordingWarning, explain_error, require_extra, show_value
from acsar_gym.reading import replace_file
from acsar_gym.recording.reader import StoredEpisode, StoredTables, join_truth, read
from acsar_gym.recording.types import Recording

TABLE_FORMATS = ("parquet", "csv")
EXPORTED = ("ticks", "wire", "steps", "scans", "movers")
NAMES = {
    "pose": ("x", "y", "theta"),
    "twist": ("linear", "angular"),
    "speeds": ("speed_a", "speed_b", "speed_c", "speed_d"),
    "angles": ("angle_a", "angle_b", "angle_c", "angle_d"),
    "asked": ("asked_linear", "asked_angular"),
    "sent": ("sent_linear", "sent_angular"),
}
"""Names of the columns that a column with several numbers becomes."""
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
            if name not in writers and len(table):
                path = stack.enter_context(replace_file(folder / f"{name}.{to}"))
                writers[name] = stack.enter_context(make_writer(path, table.schema))
            if len(table):
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
    """Yield names and rows of tables, in parts of moderate size; see `make_tables`."""
    names: dict[str, list[str]] = {}
    for number, episode in enumerate(recording.episodes):
        if not isinstance(episode, StoredEpisode):
            raise ConfigError("only recordings that were read from a file are exported")
        for tables in episode.tables.split():
            for name, columns in _list_tables(tables):
                stamps = columns["stamp"]
                if len(stamps) and names.setdefault(name, list(columns)) != list(columns):
                    raise ConfigError(f"the episodes have different {name}: they fit no table")
                times = np.rint(stamps * 1e9).astype(np.int64) + episode.offset
                yield name, {"episode": np.full(len(stamps), number), "time": times, **columns}


def _list_tables(tables: StoredTables) -> Iterator[tuple[str, TableColumns]]:
    """Yield names and columns of the exported tables."""
    ticks = _list_columns(tables["ticks"])
    yield "ticks", ticks | dict(zip(TRUTH, join_truth(tables).T, strict=True))
    yield "wire", _list_wire(tables)
    steps = _list_columns(tables["steps"])
    for name in ("action", "observation"):
        steps |= _number_columns(name, tables[f"{name}s"])
    yield "steps", steps
    yield "scans", _list_columns(tables["scans"]) | _number_columns("range", tables["ranges"])

    # One row for each mover and control period.
    states = tables["mover_states"]
    periods, count, numbers = states.shape
    yield (
        "movers",
        {
            "stamp": np.repeat(tables["movers"]["stamp"], count),
            "mover": np.tile(np.arange(count), periods),
            **dict(zip(MOVER_STATE, states.reshape(periods * count, numbers).T, strict=True)),
        },
    )


def _list_columns(table: NDArray[Any]) -> TableColumns:
    """The columns of a table; a column with several numbers becomes several columns."""
    columns: TableColumns = {}
    for name in table.dtype.names or ():
        values = table[name]
        columns |= (
            dict(zip(NAMES[name], values.T, strict=True)) if values.ndim > 1 else {name: values}
        )
    return {name: np.ascontiguousarray(values) for name, values in columns.items()}


def _number_columns(name: str, table: NDArray[Any]) -> TableColumns:
    """The columns of a table of plain numbers: action_0, action_1."""
    columns = table.T if table.ndim > 1 else ()
    return {f"{name}_{number}": column for number, column in enumerate(columns)}


def _list_wire(tables: StoredTables) -> TableColumns:
    """A row for each piece of bytes, in the order of time."""
    sent, received = (tables.list_pieces(name) for name in ("sent", "received"))
    stamps = np.concatenate([tables["sent"]["stamp"], tables["received"]["stamp"]])
    directions = ["sent"] * len(sent) + ["received"] * len(received)
    texts = [piece.decode("latin-1") for piece in (*sent, *received)]
    order = np.argsort(stamps, kind="stable")
    return {
        "stamp": stamps[order],
        "direction": np.array(directions, dtype=object)[order],
        "bytes": np.array(texts, dtype=object)[order],
    }
