"""Data sets, read back: Minari's by Minari, LeRobot's by what its format prescribes.

LeRobot itself reads one in tests/ecosystem.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pandas as pd
import pytest
from pyarrow import parquet
from recording_tools import record_drive, record_env

from acsar_gym.errors import ConfigError
from acsar_gym.tools.datasets import Demonstrations, write_dataset

FIRST = "chunk-000/file-000.parquet"
Dataset = tuple[Path, Demonstrations]


@pytest.fixture(scope="module")
def tapes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two episodes of an env, and a drive of a person."""
    folder = tmp_path_factory.mktemp("tapes")
    steps = record_env(folder / "my tape.mcap", "point_goal")
    return [steps, record_drive(folder / "drive.mcap", [(0.4, 0.2, 333)])]


@pytest.fixture(scope="module")
def lerobot(tapes: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_dataset(tapes, "lerobot", tmp_path_factory.mktemp("lerobot") / "data")


def test_write_minari_makes_what_minari_reads(tapes: list[Path], tmp_path: Path) -> None:
    folder, data = write_dataset(tapes, "minari", tmp_path)
    assert folder == tmp_path / "acsar" / "my-tape-v0"
    dataset: Any = minari.MinariDataset(folder / "data")
    for episode, steps in zip(dataset.iterate_episodes(), data.episodes, strict=True):
        for name in ("observations", "actions", "rewards"):
            np.testing.assert_array_equal(getattr(episode, name), getattr(steps, name))
        assert episode.terminations[-1] == steps.terminated != episode.truncations[-1]
        assert not (episode.terminations | episode.truncations)[:-1].any()


def read_frames(folder: Path) -> dict[str, np.ndarray[Any, Any]]:
    table = parquet.read_table(folder / "data" / FIRST)
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def test_write_lerobot_makes_a_frame_for_each_step(lerobot: Dataset) -> None:
    folder, data = lerobot
    frames = read_frames(folder)
    for number, episode in enumerate(data.episodes):
        rows = frames["episode_index"] == number
        steps = np.arange(rows.sum())
        columns = {
            "observation.state": episode.observations[:-1],
            "observation.environment_state": episode.observations[:-1],
            "action": episode.actions,
            "next.reward": episode.rewards,
            "next.done": steps == len(steps) - 1,
            "timestamp": steps / 10.0,
            "frame_index": steps,
        }
        for name, column in columns.items():
            np.testing.assert_allclose(frames[name][rows], column, atol=1e-6)

    assert frames["index"].tolist() == list(range(data.steps))
    assert not frames["task_index"].any()


def test_write_lerobot_describes_its_frames(lerobot: Dataset) -> None:
    """Names and types as `LeRobotDataset` of lerobot 0.4 and 0.6 looks for them."""
    folder, data = lerobot
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == ("v3.0", 10, 3)
    assert (info["total_frames"], info["splits"]) == (data.steps, {"train": "0:3"})
    assert info["features"]["action"]["names"] == ["linear", "angular"]
    assert info["features"]["observation.state"]["names"] == list(data.names)
    assert info["features"]["timestamp"]["dtype"] == "float64"  # exact after hours, too
    frames = read_frames(folder)
    assert list(frames) == list(info["features"])
    for name, feature in info["features"].items():
        assert frames[name][0].size == feature["shape"][0]
    kind = parquet.read_schema(folder / "data" / FIRST).field("action").type
    assert (kind.list_size, str(kind.value_type)) == (2, "float")
    assert info["features"]["action"]["dtype"] == "float32"

    tasks = pd.read_parquet(folder / "meta/tasks.parquet")
    assert tasks.index.tolist() == ["acsar_gym/PointGoal-v0"]
    assert tasks["task_index"].tolist() == [0]


def test_write_lerobot_sums_up_all_frames_and_each_episode(lerobot: Dataset) -> None:
    folder, data = lerobot
    rows = parquet.read_table(folder / "meta/episodes" / FIRST).to_pylist()
    ends = np.cumsum([0] + [len(episode.actions) for episode in data.episodes]).tolist()
    spans = [(row["dataset_from_index"], row["dataset_to_index"]) for row in rows]
    assert spans == list(itertools.pairwise(ends))

    actions = read_frames(folder)["action"]
    stats = json.loads((folder / "meta/stats.json").read_text())["action"]
    summaries: dict[str, Any] = {
        "min": np.min,
        "max": np.max,
        "mean": np.mean,
        "std": np.std,
        "q50": np.median,
    }
    for name, summarize in summaries.items():
        np.testing.assert_allclose(stats[name], summarize(actions, axis=0), atol=1e-6)
        expected = summarize(actions[ends[1] : ends[2]], axis=0)
        np.testing.assert_allclose(rows[1][f"stats/action/{name}"], expected, atol=1e-6)
    assert stats["count"] == [data.steps]
    assert set(stats) == {"min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"}


def test_write_dataset_overwrites_nothing(tapes: list[Path], tmp_path: Path) -> None:
    write_dataset(tapes, "lerobot", tmp_path / "data")
    with pytest.raises(ConfigError, match="holds a data set already: give --out another folder"):
        write_dataset(tapes[1:], "lerobot", tmp_path / "data")
    (tmp_path / "data/meta/info.json").unlink()  # as if the export was interrupted
    write_dataset(tapes[1:], "lerobot", tmp_path / "data")

    write_dataset(tapes, "minari", tmp_path)
    with pytest.raises(ConfigError, match="can't be written"):
        write_dataset(tapes, "minari", tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="can't be written"):
        write_dataset(tapes, "lerobot", tmp_path / "file" / "folder")
