"""Converts recordings to tables (Parquet, CSV) and to data sets for offline learning (Minari)."""

from __future__ import annotations

import contextlib
import csv
import os
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, MissingExtraError, RecordingWarning, show_value
from acsar_gym.reading import explain_error, replace_file
from acsar_gym.recording.reader import read
from acsar_gym.recording.types import Episode, Floats, Recording

EXPORT_FORMATS = ("parquet", "csv", "minari")
MINARI_FOLDER = "MINARI_DATASETS_PATH"
"""Environment variable with the folder in which Minari keeps its data sets."""
TableColumns = dict[str, Any]
"""Arrays of one length by name."""


def export_recording(path: Path, to: str, folder: Path) -> list[Path]:
    """Convert a recording.

    Args:
        path: the recording.
        to: one of FORMATS.
        folder: to write to; made if it isn't there.

    Returns:
        The files or folders that were written.

    Raises:
        ConfigError: the recording can't be read, the folder can't be written, or there are no steps
            of an env for Minari.
        MissingExtraError: pyarrow or minari isn't installed.
    """
    if to not in EXPORT_FORMATS:
        raise ConfigError(f"--to {show_value(to)}: must be one of {', '.join(EXPORT_FORMATS)}")
    recording = read(path)
    if recording.cut:
        how = "is left out" if to == "minari" else "is incomplete"
        last = f"the last episode {how}" if is_incomplete(recording) else "what followed is missing"
        warnings.warn(f"{path}: the file is cut: {last}", RecordingWarning, stacklevel=2)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if to == "minari":
            return [_minari(recording, path, folder)]
        write = _parquet if to == "parquet" else _csv
        return [
            write(folder / name, columns)
            for name, columns in make_tables(recording).items()
            if len(columns["episode"])
        ]
    except OSError as error:
        raise ConfigError(f"{folder}: can't be written: {explain_error(error)}") from None


def make_tables(recording: Recording) -> dict[str, TableColumns]:
    """Return the tables of a recording by name: ticks, wire, steps, scans.

    All have the number of the `episode`, `stamp` on the link's clock [s], and `time` on the wall
    clock of the first reset [ns since 1970], as in the file.
    """
    makers = {"ticks": _ticks, "wire": _wire, "steps": _steps, "scans": _scans}
    found: dict[str, TableColumns] = {}
    for name, make in makers.items():
        parts = [_timed(number, one, make(one)) for number, one in enumerate(recording.episodes)]
        parts = [part for part in parts if len(part["stamp"])] or parts[:1]
        if any(list(part) != list(parts[0]) for part in parts):
            raise ConfigError(f"the episodes have different {name}: they don't fit into one table")
        found[name] = {
            key: np.concatenate([np.asarray(part[key]) for part in parts]) for key in parts[0]
        }
    return found


def _timed(number: int, episode: Episode, columns: TableColumns) -> TableColumns:
    """Add the columns that all tables have."""
    stamps = columns["stamp"]
    times = np.rint(stamps * 1e9).astype(np.int64) + episode.offset
    return {"episode": np.full(len(stamps), number), "time": times, **columns}


def _ticks(episode: Episode) -> TableColumns:
    """One row for each tick."""
    wheels = _named("speed", episode.speeds, "abcd")
    truth = _named("true", episode.truth, ("x", "y", "theta"))
    return {
        "stamp": episode.stamps,
        **_named("", episode.poses, ("x", "y", "theta")),
        **_named("", episode.twists, ("linear", "angular")),
        **wheels,
        **_named("asked", episode.asked, ("linear", "angular")),
        **_named("sent", episode.sent, ("linear", "angular")),
        "reason": episode.reasons,
        "lateness": episode.lateness,
        **truth,
    }


def _wire(episode: Episode) -> TableColumns:
    """One row for each piece of bytes, in the order of time."""
    wire = episode.wire
    stamps = np.concatenate([wire.sent_stamps, wire.got_stamps])
    order = np.argsort(stamps, kind="stable")
    names = np.array(["sent"] * len(wire.sent) + ["received"] * len(wire.got), dtype=object)
    texts = np.array([piece.decode("latin-1") for piece in wire.sent + wire.got], dtype=object)
    return {"stamp": stamps[order], "direction": names[order], "bytes": texts[order]}


def _steps(episode: Episode) -> TableColumns:
    """One row for each observation, with the action that led to it."""
    count = len(episode.step_stamps)
    first = np.full((min(count, 1), episode.actions.shape[1]), np.nan)
    actions = np.concatenate([first, episode.actions])
    rewards = np.concatenate([np.full(min(count, 1), np.nan), episode.rewards])
    return {
        "stamp": episode.step_stamps,
        "step": np.arange(count),
        "reward": rewards,
        **_numbered("action", actions),
        **_numbered("observation", episode.observations),
    }


def _scans(episode: Episode) -> TableColumns:
    """One row for each scan."""
    return {"stamp": episode.scans.stamps, **_numbered("range", episode.scans.ranges)}


def _named(prefix: str, rows: Floats, names: Any) -> TableColumns:
    """The columns of rows by name."""
    lead = f"{prefix}_" if prefix else ""
    return {f"{lead}{name}": rows[:, number] for number, name in enumerate(names)}


def _numbered(prefix: str, rows: NDArray[Any]) -> TableColumns:
    """The columns of rows by number."""
    return {f"{prefix}_{number}": rows[:, number] for number in range(rows.shape[1])}


def _csv(path: Path, columns: TableColumns) -> Path:
    """Write a table as CSV."""
    path = path.with_suffix(".csv")
    with replace_file(path) as new, new.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))
    return path


def _parquet(path: Path, columns: TableColumns) -> Path:
    """Write a table as Parquet."""
    try:
        import pyarrow as pa  # noqa: PLC0415 - optional
        from pyarrow import parquet  # noqa: PLC0415 - optional
    except ImportError:
        raise MissingExtraError("export to Parquet", "export") from None
    path = path.with_suffix(".parquet")
    with replace_file(path) as new:
        parquet.write_table(pa.table(columns), new)
    return path


def _minari(recording: Recording, path: Path, folder: Path) -> Path:
    """Write a data set for Minari; returns its folder."""
    try:
        import minari  # noqa: PLC0415 - optional
        from gymnasium.spaces import Box  # noqa: PLC0415 - only here
        from minari.data_collector import EpisodeBuffer  # noqa: PLC0415 - optional
    except ImportError:
        raise MissingExtraError("export to Minari", "export") from None
    buffers = [EpisodeBuffer(**told) for told in _episodes(recording)]
    if not buffers:
        what = "whole episode" if is_incomplete(recording) else "steps"
        raise ConfigError(f"{path}: holds no {what} of an env: record an env, run or evaluate")
    name = "".join(c if c.isalnum() else "-" for c in path.stem).strip("-") or "recording"
    width = recording.episodes[0].observations.shape[1]
    try:
        with _stored_in(folder):
            minari.create_dataset_from_buffers(
                f"acsar/{name}-v0",
                buffers,
                observation_space=Box(-np.inf, np.inf, (width,), np.float32),
                action_space=Box(-1.0, 1.0, (2,), np.float32),
                data_format="arrow",
                algorithm_name=_policy(recording.header),
                description=f"Recorded by acsar_gym {_version(recording.header)}.",
            )
    except ValueError as error:  # it is there already
        raise ConfigError(f"{folder}: can't be written: {explain_error(error)}") from None
    return folder / "acsar" / f"{name}-v0"


@contextlib.contextmanager
def _stored_in(folder: Path) -> Iterator[None]:
    """Let Minari write to a folder, without its warnings about authors, as a context manager."""
    before = os.environ.get(MINARI_FOLDER)
    os.environ[MINARI_FOLDER] = str(folder.absolute())
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        os.environ.pop(MINARI_FOLDER)
        if before is not None:
            os.environ[MINARI_FOLDER] = before


def is_incomplete(recording: Recording) -> bool:
    """Whether the last episode is incomplete, because the file is cut."""
    return recording.cut and not recording.episodes[-1].terminated


def _episodes(recording: Recording) -> Iterator[dict[str, Any]]:
    """The arguments of Minari's buffers, one for each episode with steps."""
    whole = len(recording.episodes) - is_incomplete(recording)
    for number, one in enumerate(recording.episodes[:whole]):
        count = len(one.actions)
        if not count or len(one.observations) != count + 1 or len(one.rewards) != count:
            continue
        ended = np.zeros(count, bool)
        ended[-1] = True
        terminated = ended & one.terminated
        yield {
            "id": number,
            "seed": seed if isinstance(seed := one.info.get("seed"), int) else None,
            "observations": np.array(one.observations),
            "actions": np.array(one.actions),
            "rewards": one.rewards.tolist(),
            "terminations": terminated.tolist(),
            "truncations": (ended & ~terminated).tolist(),
        }


def _policy(header: Mapping[str, Any]) -> str:
    """What drove, as far as the header tells."""
    policy = header.get("about", {}).get("policy")
    return str(policy.get("file", "unknown")) if isinstance(policy, dict) else "unknown"


def _version(header: Mapping[str, Any]) -> str:
    """The version of this package that recorded."""
    return str(header["versions"].get("acsar_gym", "unknown"))
