"""Recordings as tables, and their summaries."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from mover_tools import HALL
from pyarrow import parquet
from recording_tools import drive, record_env

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError, RecordingWarning
from acsar_gym.recording import read
from acsar_gym.recording.export import export_recording, make_tables
from acsar_gym.recording.reader import summarize, summary_lines


@pytest.fixture(scope="module")
def tape(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of an env with a LiDAR, among people."""
    path = tmp_path_factory.mktemp("tape") / "my tape.mcap"
    return record_env(path, "obstacle_goal", 2, worlds=HALL)


def test_export_recording_writes_every_number_as_parquet(tape: Path, tmp_path: Path) -> None:
    written = export_recording(tape, "parquet", tmp_path / "out")
    names = ("ticks", "wire", "steps", "scans", "movers")
    assert [path.name for path in written] == [f"{name}.parquet" for name in names]
    recording = read(tape)
    tables = {path.stem: parquet.read_table(path) for path in written}
    poses = np.concatenate([episode.poses for episode in recording.episodes])
    np.testing.assert_array_equal(tables["ticks"]["x"].to_numpy(), poses[:, 0])
    counts = [len(episode.stamps) for episode in recording.episodes]
    assert tables["ticks"]["episode"].to_pylist() == np.repeat([0, 1], counts).tolist()
    assert (np.diff(tables["ticks"]["time"].to_numpy()) > 0).all()
    assert tables["wire"]["direction"].to_pylist()[0] == "sent"
    action = recording.episodes[0].actions[0, 1]
    assert tables["steps"]["action_1"].to_pylist()[1] == action
    assert "observation_70" in tables["steps"].column_names
    assert "range_63" in tables["scans"].column_names


def test_make_tables_has_a_row_for_each_mover_and_period(tape: Path) -> None:
    movers = make_tables(read(tape))["movers"]
    recorded = [episode.movers for episode in read(tape).episodes]
    states = np.concatenate([part.states.reshape(-1, 5) for part in recorded])
    columns = [movers[name] for name in ("x", "y", "x_rate", "y_rate", "radius")]
    np.testing.assert_array_equal(np.column_stack(columns), states)
    assert movers["mover"][:4].tolist() == [0, 1, 2, 0]
    assert movers["stamp"][:4].tolist() == np.repeat(recorded[0].stamps, 3)[:4].tolist()


def read_rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_export_recording_writes_the_same_as_csv(tape: Path, tmp_path: Path) -> None:
    paths = export_recording(tape, "csv", tmp_path)
    recording = read(tape)
    rows = read_rows(paths[0])
    assert float(rows[39]["theta"]) == recording.episodes[0].poses[39, 2]
    assert float(rows[39]["true_x"]) == recording.episodes[0].truth[39, 0]
    wire = read_rows(paths[1])
    for direction in ("sent", "got"):
        pieces = [
            row["bytes"]
            for row in wire
            if row["direction"] == {"sent": "sent", "got": "received"}[direction]
        ]
        logs = [getattr(episode.wire, direction) for episode in recording.episodes]
        assert "".join(pieces).encode("latin-1") == b"".join(sum(logs, ()))
    stamps = [float(row["stamp"]) for row in wire if row["episode"] == "0"]
    assert stamps == sorted(stamps)


def test_export_recording_refuses_what_it_cannot_write(tape: Path, tmp_path: Path) -> None:
    plain = drive(tmp_path / "plain.mcap", RobotConfig.of(None), 5)
    assert "observation_0" not in make_tables(read(plain))["steps"]
    with pytest.raises(ConfigError, match="--to 'xls': must be one of parquet, csv"):
        export_recording(tape, "xls", tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="can't be written"):
        export_recording(tape, "csv", tmp_path / "file" / "folder")


def test_summarize_counts_what_a_recording_holds(tape: Path, tmp_path: Path) -> None:
    summary = summarize(tape)
    assert summary["whole"]
    assert summary["tables"]["ticks"] == sum(len(part.stamps) for part in read(tape).episodes)
    assert summary["episodes"][1]["info"]["seed"] == 1
    assert summary["robot"]["simulated"]
    lines = summary_lines(summary)
    assert "whole; 2 episodes" in lines[0]
    assert lines[0].endswith("nothing dropped")
    assert any(line.split() == ["steps", "82"] for line in lines)

    cut = tmp_path / "cut.mcap"
    cut.write_bytes(tape.read_bytes()[:-200])
    assert summarize(cut)["dropped"] is None
    headline = summary_lines(summarize(cut))[0]
    assert "cut: what followed is missing" in headline
    assert "drops unknown" in headline


def test_export_recording_goes_as_far_as_a_cut_file(tape: Path, tmp_path: Path) -> None:
    whole = tape.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 9 // 10])
    with pytest.warns(RecordingWarning, match="the last episode is incomplete"):
        export_recording(tmp_path / "cut.mcap", "csv", tmp_path / "tables")
