"""Data sets, read back: Minari's by Minari, LeRobot's by what its format says.

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
from acsar_gym.tools.datasets import (
    DemonstrationEpisode,
    Demonstrations,
    write_dataset,
)
from acsar_gym.tools.datasets.lerobot import write_lerobot

FIRST = "chunk-000/file-000.parquet"


@pytest.fixture(scope="module")
def tapes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two episodes of an env, and a drive of a person."""
    folder = tmp_path_factory.mktemp("tapes")
    way = [(0.4, 0.2, 333)]
    return [
        record_env(folder / "my tape.mcap", "point_goal"),
        record_drive(folder / "d.mcap", way),
    ]


def test_minari_reads_the_episodes_back(tapes: list[Path], tmp_path: Path) -> None:
    folder, data = write_dataset(tapes, "minari", tmp_path)
    assert folder == tmp_path / "acsar" / "my-tape-v0"
    found: Any = minari.MinariDataset(folder / "data")
    episodes = list(found.iterate_episodes())
    for episode, one in zip(episodes, data.episodes, strict=True):
        np.testing.assert_array_equal(episode.observations, one.observations)
        np.testing.assert_array_equal(episode.actions, one.actions)
        np.testing.assert_array_equal(episode.rewards, one.rewards)
        assert episode.terminations[-1] == one.terminated != episode.truncations[-1]
        assert not (episode.terminations | episode.truncations)[:-1].any()
    with pytest.raises(ConfigError, match="can't be written"):
        write_dataset(tapes, "minari", tmp_path)


def read_frames(folder: Path) -> dict[str, np.ndarray[Any, Any]]:
    table = parquet.read_table(folder / "data" / FIRST)
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def test_lerobot_has_a_frame_for_each_step(tapes: list[Path], tmp_path: Path) -> None:
    folder, data = write_dataset(tapes, "lerobot", tmp_path / "data")
    frames = read_frames(folder)
    episodes = data.episodes
    lengths = [len(one.actions) for one in episodes]
    seen = np.concatenate([one.observations[:-1] for one in episodes])
    np.testing.assert_array_equal(frames["observation.state"], seen)
    np.testing.assert_array_equal(frames["observation.environment_state"], seen)
    np.testing.assert_array_equal(frames["action"], np.concatenate([e.actions for e in episodes]))
    np.testing.assert_allclose(
        frames["next.reward"], np.concatenate([one.rewards for one in episodes]), atol=1e-6
    )
    assert np.flatnonzero(frames["next.done"]).tolist() == (np.cumsum(lengths) - 1).tolist()
    assert frames["index"].tolist() == list(range(data.steps))
    assert frames["episode_index"].tolist() == np.repeat(range(3), lengths).tolist()
    steps = np.concatenate([np.arange(length) for length in lengths])
    np.testing.assert_array_equal(frames["frame_index"], steps)
    np.testing.assert_allclose(frames["timestamp"], steps / 10.0, atol=1e-6)
    assert not frames["task_index"].any()


def test_times_of_a_long_episode_are_exact(tmp_path: Path) -> None:
    """LeRobot wants them within 0.1 ms of whole steps, which takes more than single precision."""
    steps = 40_000
    episode = DemonstrationEpisode(
        np.zeros((steps + 1, 1), np.float32),
        np.zeros((steps, 2), np.float32),
        np.zeros(steps),
        terminated=False,
    )
    data = Demonstrations("x", ("y",), 10.0, "robot", (1.0, 1.0), "unknown", (episode,))
    times = read_frames(write_lerobot(data, tmp_path / "data"))["timestamp"]
    assert np.abs(np.diff(times) - 0.1).max() < 1e-6
    info = json.loads((tmp_path / "data/meta/info.json").read_text())
    assert info["features"]["timestamp"]["dtype"] == "float64"


def test_lerobots_description_fits_its_frames(tapes: list[Path], tmp_path: Path) -> None:
    """Names and types as `LeRobotDataset` of lerobot 0.4 and 0.6 looks for them."""
    folder, data = write_dataset(tapes, "lerobot", tmp_path / "data")
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == ("v3.0", 10, 3)
    assert (info["total_frames"], info["splits"]) == (data.steps, {"train": "0:3"})
    assert info["data_path"].format(chunk_index=0, file_index=0) == f"data/{FIRST}"
    assert info["features"]["action"]["names"] == ["linear", "angular"]
    assert info["features"]["observation.state"]["names"] == list(data.names)
    schema = parquet.read_schema(folder / "data" / FIRST)
    assert schema.names == list(info["features"])
    for name, feature in info["features"].items():
        kind, size = schema.field(name).type, feature["shape"][0]
        kind = kind.value_type if size > 1 else kind
        assert (
            str(kind).replace("float", "float32").replace("double", "float64") == (feature["dtype"])
        )
        assert size == 1 or schema.field(name).type.list_size == size
    tasks = pd.read_parquet(folder / "meta/tasks.parquet")
    assert tasks.index.tolist() == ["acsar_gym/PointGoal-v0"]
    assert tasks["task_index"].tolist() == [0]
    rows = parquet.read_table(folder / "meta/episodes" / FIRST).to_pylist()
    ends = np.cumsum([0] + [len(one.actions) for one in data.episodes]).tolist()
    spans = [(row["dataset_from_index"], row["dataset_to_index"]) for row in rows]
    assert spans == list(itertools.pairwise(ends))
    assert [row["length"] for row in rows] == np.diff(ends).tolist()
    actions = read_frames(folder)["action"]
    stats = json.loads((folder / "meta/stats.json").read_text())["action"]
    for name in ("min", "max", "mean", "std"):
        expected = getattr(np, name)(actions, axis=0)
        np.testing.assert_allclose(stats[name], expected, atol=1e-6)
        one = getattr(np, name)(actions[ends[1] : ends[2]], axis=0)
        np.testing.assert_allclose(rows[1][f"stats/action/{name}"], one, atol=1e-6)
    np.testing.assert_allclose(stats["q50"], np.median(actions, axis=0), atol=1e-6)
    assert stats["count"] == [data.steps]
    assert set(stats) == {"min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"}


def test_a_data_set_is_not_overwritten(tapes: list[Path], tmp_path: Path) -> None:
    write_dataset(tapes, "lerobot", tmp_path / "data")
    with pytest.raises(ConfigError, match="holds a data set already: give --out another folder"):
        write_dataset(tapes[1:], "lerobot", tmp_path / "data")
    (tmp_path / "data/meta/info.json").unlink()  # as where the export was interrupted
    write_dataset(tapes[1:], "lerobot", tmp_path / "data")
    (tmp_path / "file").touch()
    for to in ("lerobot", "minari"):
        with pytest.raises(ConfigError, match="can't be written"):
            write_dataset(tapes, to, tmp_path / "file" / "folder")
