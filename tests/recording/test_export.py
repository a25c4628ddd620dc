"""Recordings as tables."""

from __future__ import annotations

import csv
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from mover_tools import HALL
from pyarrow import parquet
from recording_tools import drive, record_env

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError, RecordingWarning
from acsar_gym.recording import read, reader
from acsar_gym.recording.export import export_recording, make_tables


@pytest.fixture(scope="module")
def tape(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of an env with a LiDAR."""
    path = tmp_path_factory.mktemp("tape") / "my tape.mcap"
    env = gymnasium.make("acsar_gym/ObstacleGoal-v1", link="planar", record=path)
    for seed in range(2):
        env.reset(seed=seed)
        for _ in range(4):
            env.step(np.array([0.5, 0.1], np.float32))
    env.close()
    return path


def test_parquet_has_every_number(tape: Path, tmp_path: Path) -> None:
    written = export_recording(tape, "parquet", tmp_path / "out")
    assert [path.name for path in written] == [
        f"{name}.parquet" for name in ("ticks", "wire", "steps", "scans")
    ]
    recording = read(tape)
    found = {path.stem: parquet.read_table(path) for path in written}
    poses = np.concatenate([one.poses for one in recording.episodes])
    np.testing.assert_array_equal(found["ticks"]["x"].to_numpy(), poses[:, 0])
    assert found["ticks"]["episode"].to_pylist() == [0] * 40 + [1] * 40
    times = found["ticks"]["time"].to_numpy()
    assert (np.diff(times) > 0).all()
    assert found["wire"]["direction"].to_pylist()[0] == "sent"
    assert found["steps"]["action_0"].to_pylist()[1] == 0.5
    assert "observation_70" in found["steps"].column_names
    assert "range_63" in found["scans"].column_names


def test_each_mover_has_a_row_for_each_control_period(tmp_path: Path) -> None:
    tape = record_env(tmp_path / "tape.mcap", "obstacle_goal", 2, worlds=HALL)
    movers = make_tables(read(tape))["movers"]
    recorded = [episode.movers for episode in read(tape).episodes]
    states = np.concatenate([one.states.reshape(-1, 5) for one in recorded])
    columns = [movers[name] for name in ("x", "y", "x_rate", "y_rate", "radius")]
    np.testing.assert_array_equal(np.column_stack(columns), states)
    assert movers["mover"][:4].tolist() == [0, 1, 2, 0]
    assert movers["stamp"][:4].tolist() == np.repeat(recorded[0].stamps, 3)[:4].tolist()


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_csv_has_the_same(tape: Path, tmp_path: Path) -> None:
    paths = export_recording(tape, "csv", tmp_path)
    rows = rows_of(paths[0])
    recording = read(tape)
    assert len(rows) == 80
    assert float(rows[39]["theta"]) == recording.episodes[0].poses[-1, 2]
    wire = rows_of(paths[1])
    text = "".join(row["bytes"] for row in wire if row["direction"] == "sent")
    sent = b"".join(piece for one in recording.episodes for piece in one.wire.sent)
    assert text.encode("latin-1") == sent


def test_what_cannot_be_exported_says_so(tape: Path, tmp_path: Path) -> None:
    drove = drive(tmp_path / "drove.mcap", RobotConfig.of(None), 5)
    assert "observation_0" not in make_tables(read(drove))["steps"]
    with pytest.raises(ConfigError, match="--to 'xls': must be one of parquet, csv"):
        export_recording(tape, "xls", tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="can't be written"):
        export_recording(tape, "csv", tmp_path / "file" / "folder")


def test_a_summary_tells_what_a_recording_holds(tape: Path, tmp_path: Path) -> None:
    found = reader.summarize(tape)
    assert found["whole"]
    assert found["tables"]["ticks"] == 80
    assert found["episodes"][1]["info"]["seed"] == 1
    assert found["robot"]["simulated"]
    lines = reader.summary_lines(found)
    assert "whole; 2 episodes, 0.9 s, nothing dropped" in lines[0]
    assert any(line.split() == ["scans", "10"] for line in lines)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(tape.read_bytes()[:-200])
    assert reader.summarize(cut)["dropped"] is None
    said = reader.summary_lines(reader.summarize(cut))[0]
    assert "cut: what followed is missing" in said
    assert "drops unknown" in said


def test_a_cut_recording_is_exported_as_far_as_it_goes(tape: Path, tmp_path: Path) -> None:
    whole = tape.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 9 // 10])
    with pytest.warns(RecordingWarning, match="the last episode is incomplete"):
        export_recording(tmp_path / "cut.mcap", "csv", tmp_path / "tables")
