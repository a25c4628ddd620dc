"""Converts recordings to tables: Parquet, CSV."""

from __future__ import annotations

import csv
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, RecordingWarning, require_extra, show_value
from acsar_gym.reading import explain_error, replace_file
from acsar_gym.recording.reader import read
from acsar_gym.recording.types import Episode, Recording

TABLE_FORMATS = ("parquet", "csv")
TableColumns = dict[str, Any]
"""Arrays of one length by name."""


def export_recording(path: Path, to: str, folder: Path) -> list[Path]:
    """Convert a recording to tables.

    Args:
        path: the recording.
        to: one of TABLE_FORMATS.
        folder: to write to; made if it isn't there.

    Returns:
        The files or folders that were written.

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
    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, columns in make_tables(recording).items():
            if len(columns["episode"]):
                written.append(folder / f"{name}.{to}")
                (_write_parquet if to == "parquet" else _write_csv)(written[-1], columns)
    except OSError as error:
        raise ConfigError(f"{folder}: can't be written: {explain_error(error)}") from None
    return written


def is_incomplete(recording: Recording) -> bool:
    """Whether the last episode is incomplete, because the file is cut."""
    return recording.cut and not recording.episodes[-1].terminated


def make_tables(recording: Recording) -> dict[str, TableColumns]:
    """Return the tables of a recording by name: ticks, wire, steps, scans.

    All have the number of the `episode`, `stamp` on the link's clock [s], and `time` on the wall
    clock of the first reset [ns since 1970], as in the file.

    Raises:
        ConfigError: the episodes have different columns.
    """
    found = [_list_columns(episode) for episode in recording.episodes]
    tables: dict[str, TableColumns] = {}
    for name in found[0]:
        parts = []
        for number, (episode, columns) in enumerate(zip(recording.episodes, found, strict=True)):
            stamps = columns[name]["stamp"]
            times = np.rint(stamps * 1e9).astype(np.int64) + episode.offset
            episodes = np.full(len(stamps), number)
            parts.append({"episode": episodes, "time": times, **columns[name]})
        parts = [part for part in parts if len(part["stamp"])] or parts[:1]
        if any(list(part) != list(parts[0]) for part in parts):
            raise ConfigError(f"the episodes have different {name}: they don't fit into one table")
        tables[name] = {
            key: np.concatenate([np.asarray(part[key]) for part in parts]) for key in parts[0]
        }
    return tables


def _list_columns(episode: Episode) -> dict[str, TableColumns]:
    """The columns of each table: ticks, pieces of bytes, observations with what led to them."""
    pose, twist, wire, count = "x y theta", "linear angular", episode.wire, len(episode.step_stamps)
    ticks = {
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
    stamps = np.concatenate([wire.sent_stamps, wire.got_stamps])
    order = np.argsort(stamps, kind="stable")
    names = np.array(["sent"] * len(wire.sent) + ["received"] * len(wire.got), dtype=object)
    texts = np.array([piece.decode("latin-1") for piece in wire.sent + wire.got], dtype=object)
    none = np.full((min(count, 1), episode.actions.shape[1]), np.nan)
    steps = {
        "stamp": episode.step_stamps,
        "step": np.arange(count),
        "reward": np.concatenate([none[:, 0], episode.rewards]),
        **_name_columns("action_", np.concatenate([none, episode.actions])),
        **_name_columns("observation_", episode.observations),
    }
    return {
        "ticks": ticks,
        "wire": {"stamp": stamps[order], "direction": names[order], "bytes": texts[order]},
        "steps": steps,
        "scans": {"stamp": episode.scans.stamps, **_name_columns("range_", episode.scans.ranges)},
    }


def _name_columns(prefix: str, rows: NDArray[Any], names: str = "") -> TableColumns:
    """The columns of rows by name; by number where none are given."""
    found = names.split() or map(str, range(rows.shape[1]))
    return {f"{prefix}{name}": rows[:, number] for number, name in enumerate(found)}


def _write_csv(path: Path, columns: TableColumns) -> None:
    with replace_file(path) as new, new.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


def _write_parquet(path: Path, columns: TableColumns) -> None:
    with require_extra("export to Parquet", "export"):
        import pyarrow as pa  # noqa: PLC0415 - optional
        from pyarrow import parquet  # noqa: PLC0415 - optional
    with replace_file(path) as new:
        parquet.write_table(pa.table(columns), new)
