"""Writes data sets in the format v3.0 of LeRobot (https://huggingface.co/docs/lerobot).

A frame is one env step: what the agent saw before it, and the action that it took then. All frames
are in one Parquet file, and the description of all episodes in another.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.reading import replace_file, write_atomically
from acsar_gym.tools.datasets.demonstrations import DemonstrationEpisode, Demonstrations

FILE_PATTERN = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
"""How the format numbers its files."""
FIRST_FILE = FILE_PATTERN.format(chunk_index=0, file_index=0)
STATE, ENVIRONMENT_STATE = "observation.state", "observation.environment_state"
"""Both are the whole observation: LeRobot's policies want the second one where no camera is."""
QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)
Columns = dict[str, NDArray[Any]]


def write_lerobot(data: Demonstrations, folder: Path, _name: str = "") -> Path:
    """Write a data set into a folder; `LeRobotDataset(NAME, root=folder)` reads it.

    Raises:
        ConfigError: a data set is there already.
        MissingExtraError: pyarrow isn't installed.
    """
    with require_extra("export to LeRobot", "export"):
        import pyarrow as pa  # noqa: PLC0415 - optional
        from pyarrow import parquet  # noqa: PLC0415 - optional
    if (folder / "meta/info.json").exists():  # which is written last
        raise ConfigError(f"{folder}: holds a data set already: give --out another folder")

    def write_table(path: str, columns: dict[str, Any], metadata: Any = None) -> None:
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        with replace_file(target) as new:
            parquet.write_table(pa.table(columns).replace_schema_metadata(metadata), new)

    frames, rows, first = [], [], 0
    for number, episode in enumerate(data.episodes):
        frames.append(_make_frames(episode, number, first, data.rate))
        rows.append(_describe_episode(frames[-1], number, first, data.env_id))
        first += len(episode.actions)
    table = {key: np.concatenate([each[key] for each in frames]) for key in frames[0]}
    columns = {
        key: pa.FixedSizeListArray.from_arrays(values.ravel(), values.shape[1])
        if values.ndim > 1
        else pa.array(values)
        for key, values in table.items()
    }
    write_table(f"data/{FIRST_FILE}", columns)
    write_table(f"meta/episodes/{FIRST_FILE}", {key: [row[key] for row in rows] for key in rows[0]})
    write_table("meta/tasks.parquet", *_make_tasks(data.env_id))
    _write_json(folder / "meta/stats.json", _summarize(table))
    _write_json(folder / "meta/info.json", _make_info(data, table))  # last: now it is whole
    return folder


def _make_frames(episode: DemonstrationEpisode, number: int, first: int, rate: float) -> Columns:
    """The frames of an episode; `first` is the index of its first frame in the data set."""
    count = len(episode.actions)
    steps = np.arange(count)
    return {
        STATE: episode.observations[:-1],
        ENVIRONMENT_STATE: episode.observations[:-1],
        "action": episode.actions,
        "next.reward": episode.rewards.astype(np.float32),
        "next.done": steps == count - 1,
        "timestamp": steps / rate,
        "frame_index": steps,
        "episode_index": np.full(count, number),
        "index": first + steps,
        "task_index": np.zeros(count, np.int64),
    }


def _describe_episode(frames: Columns, number: int, first: int, task: str) -> dict[str, Any]:
    """The row of an episode in meta/episodes."""
    count = len(frames["index"])
    statistics = {
        f"stats/{key}/{name}": values
        for key, numbers in _summarize(frames).items()
        for name, values in numbers.items()
    }
    return {
        "episode_index": number,
        "tasks": [task],
        "length": count,
        "data/chunk_index": 0,
        "data/file_index": 0,
        "dataset_from_index": first,
        "dataset_to_index": first + count,
        **statistics,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }


def _summarize(frames: Columns) -> dict[str, dict[str, list[Any]]]:
    """Statistics of each feature, one number for each of its numbers."""
    summary = {}
    for key, values in frames.items():
        rows = values.reshape(len(values), -1).astype(np.float64)
        least, *quantiles, most = np.quantile(rows, [0.0, *QUANTILES, 1.0], axis=0)
        summary[key] = {
            "min": least.tolist(),
            "max": most.tolist(),
            "mean": rows.mean(axis=0).tolist(),
            "std": rows.std(axis=0).tolist(),
            "count": [len(rows)],
            **{
                f"q{round(100 * share):02d}": numbers.tolist()
                for share, numbers in zip(QUANTILES, quantiles, strict=True)
            },
        }
    return summary


def _make_tasks(task: str) -> tuple[dict[str, Any], dict[str, str]]:
    """Columns and metadata of meta/tasks.parquet, which pandas reads with the task as its index."""
    index = "__index_level_0__"
    kinds = {"task_index": ("int64", "int64"), index: ("unicode", "object")}
    columns = [
        {"name": None if key == index else key, "field_name": key, "pandas_type": kind}
        | {"numpy_type": numpy_kind, "metadata": None}
        for key, (kind, numpy_kind) in kinds.items()
    ]
    about = {"index_columns": [index], "column_indexes": [], "columns": columns}
    return {"task_index": [0], index: [task]}, {"pandas": json.dumps(about)}


def _make_info(data: Demonstrations, frames: Columns) -> dict[str, Any]:
    """meta/info.json."""
    names = {STATE: data.names, ENVIRONMENT_STATE: data.names, "action": ("linear", "angular")}
    features = {
        key: {
            "dtype": values.dtype.name,
            "shape": [values.shape[1] if values.ndim > 1 else 1],
            "names": list(names[key]) if key in names else None,
        }
        for key, values in frames.items()
    }
    return {
        "codebase_version": "v3.0",
        "robot_type": data.robot or None,
        "total_episodes": len(data.episodes),
        "total_frames": data.steps,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": int(data.rate) if data.rate.is_integer() else data.rate,
        "splits": {"train": f"0:{len(data.episodes)}"},
        "data_path": f"data/{FILE_PATTERN}",
        "video_path": None,
        "features": features,
    }


def _write_json(path: Path, content: dict[str, Any]) -> None:
    write_atomically(path, json.dumps(content, indent=4).encode())
