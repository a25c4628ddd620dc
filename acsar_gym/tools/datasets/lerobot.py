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
from acsar_gym.tools.datasets.demonstrations import Demonstrations

FILE_PATTERN = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
"""How the format numbers its files."""
FIRST_FILE = FILE_PATTERN.format(chunk_index=0, file_index=0)
FILE_INDICES = {
    "data/chunk_index": 0,
    "data/file_index": 0,
    "meta/episodes/chunk_index": 0,
    "meta/episodes/file_index": 0,
}
STATE = "observation.state"
ENVIRONMENT_STATE = "observation.environment_state"
"""The same numbers as STATE: LeRobot's policies want this one if there is no camera."""
QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)
TASK_INDEX = "__index_level_0__"  # how pandas names an index without a name
TASKS_FORMAT = {
    "index_columns": [TASK_INDEX],
    "column_indexes": [],
    "columns": [
        {
            "name": None,
            "field_name": TASK_INDEX,
            "pandas_type": "unicode",
            "numpy_type": "object",
            "metadata": None,
        }
    ],
}
"""Metadata of meta/tasks.parquet, which pandas reads with the task as its index."""
Columns = dict[str, NDArray[Any]]


def write_lerobot(data: Demonstrations, folder: Path, _name: str = "") -> Path:
    """Write a data set into a folder. `LeRobotDataset(NAME, root=folder)` reads it.

    Raises:
        ConfigError: A data set is there already.
        MissingExtraError: pyarrow isn't installed.
    """
    with require_extra("export to LeRobot", "export"):
        import pyarrow as pa  # noqa: PLC0415 - optional
        from pyarrow import parquet  # noqa: PLC0415 - optional

    def write_table(path: str, columns: dict[str, Any], metadata: Any = None) -> None:
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        with replace_file(target) as new:
            parquet.write_table(pa.table(columns).replace_schema_metadata(metadata), new)

    if (folder / "meta/info.json").exists():  # which is written last
        raise ConfigError(f"{folder}: holds a data set already: give --out another folder")
    # Numbers of one feature are a list of fixed length.
    frames = _make_frames(data)
    columns = {
        key: pa.FixedSizeListArray.from_arrays(values.ravel(), values.shape[1])
        if values.ndim > 1
        else pa.array(values)
        for key, values in frames.items()
    }
    rows = _describe_episodes(data, frames)
    write_table(f"data/{FIRST_FILE}", columns)
    write_table(f"meta/episodes/{FIRST_FILE}", {key: [row[key] for row in rows] for key in rows[0]})
    tasks = {"task_index": [0], TASK_INDEX: [data.env_id]}
    write_table("meta/tasks.parquet", tasks, {"pandas": json.dumps(TASKS_FORMAT)})
    for name, content in (("stats", _summarize(frames)), ("info", _make_info(data, frames))):
        text = json.dumps(content, indent=4)
        write_atomically(folder / f"meta/{name}.json", text.encode())
    return folder


def _make_frames(data: Demonstrations) -> Columns:
    """The frames of all episodes."""
    episodes = data.episodes
    lengths = [len(episode.actions) for episode in episodes]
    steps = np.concatenate([np.arange(length) for length in lengths])
    observations = np.concatenate([episode.observations[:-1] for episode in episodes])
    rewards = np.concatenate([episode.rewards for episode in episodes])

    return {
        STATE: observations,
        ENVIRONMENT_STATE: observations,
        "action": np.concatenate([episode.actions for episode in episodes]),
        "next.reward": rewards.astype(np.float32),
        "next.done": steps == np.repeat(lengths, lengths) - 1,
        "timestamp": steps / data.rate,
        "frame_index": steps,
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "index": np.arange(len(steps)),
        "task_index": np.zeros(len(steps), np.int64),
    }


def _describe_episodes(data: Demonstrations, frames: Columns) -> list[dict[str, Any]]:
    """The rows of meta/episodes."""
    rows: list[dict[str, Any]] = []
    first = 0
    for number, episode in enumerate(data.episodes):
        # Readers look up frames by the rows at which an episode starts and ends.
        end = first + len(episode.actions)
        own_frames = {key: values[first:end] for key, values in frames.items()}

        row = {
            "episode_index": number,
            "tasks": [data.env_id],
            "length": end - first,
            "dataset_from_index": first,
            "dataset_to_index": end,
            **FILE_INDICES,
        }
        for key, statistics in _summarize(own_frames).items():
            row |= {f"stats/{key}/{name}": values for name, values in statistics.items()}
        rows.append(row)
        first = end
    return rows


def _summarize(frames: Columns) -> dict[str, dict[str, list[Any]]]:
    """Statistics of each feature, one number for each of its numbers."""
    # Policies of LeRobot scale their inputs by these.
    summary = {}

    for key, values in frames.items():
        # Features of one number have statistics of one number as well.
        rows = values.reshape(len(values), -1).astype(np.float64)
        statistics = {
            "min": rows.min(axis=0),
            "max": rows.max(axis=0),
            "mean": rows.mean(axis=0),
            "std": rows.std(axis=0),
            "count": np.array([len(rows)]),
        }
        for share, numbers in zip(QUANTILES, np.quantile(rows, QUANTILES, axis=0), strict=True):
            statistics[f"q{round(100 * share):02d}"] = numbers
        summary[key] = {name: numbers.tolist() for name, numbers in statistics.items()}
    return summary


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
