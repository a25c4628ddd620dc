"""Recordings as tables, and their summaries."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from pyarrow import csv

from acsar_gym.errors import ConfigError, RecordingWarning
from acsar_gym.recording import read
from acsar_gym.recording.export import export_recording, iterate_tables
from acsar_gym.recording.reader import summarize, summary_lines


def make_tables(path: Path) -> dict[str, Any]:
    """All tables of a recording by name, as columns by name."""
    parts: dict[str, list[Any]] = {}
    for name, columns in iterate_tables(read(path)):
        if len(columns["stamp"]):
            parts.setdefault(name, []).append(columns)
    return {
        name: {key: np.concatenate([block[key] for block in blocks]) for key in blocks[0]}
        for name, blocks in parts.items()
    }


@pytest.mark.parametrize("to", ["parquet", "csv"])
def test_export_recording_writes_every_number(to: str, tape: Path, tmp_path: Path) -> None:
    tables = make_tables(tape)
    written = export_recording(tape, to, tmp_path / "out")
    assert [path.name for path in written] == [f"{name}.{to}" for name in tables]
    for path in written:
        # pandas before 3.1 reads numbers of CSV files with an error in the last digit.
        frame = pd.read_parquet(path) if to == "parquet" else csv.read_csv(path).to_pandas()
        for name, column in tables[path.stem].items():
            np.testing.assert_array_equal(frame[name].astype(column.dtype), column)


def test_iterate_tables_holds_what_episodes_hold(tape: Path) -> None:
    """A row for each tick, step, piece of bytes, and mover of a control period."""
    tables = make_tables(tape)
    first, second = read(tape).episodes

    def stack(table: str, names: str) -> np.ndarray:
        return np.column_stack([tables[table][name] for name in names.split()])

    ticks = tables["ticks"]
    counts = [len(first.stamps), len(second.stamps)]
    assert ticks["episode"].tolist() == np.repeat([0, 1], counts).tolist()
    assert (np.diff(ticks["time"]) > 0).all()
    truth = stack("ticks", "true_x true_y true_theta")
    poses = stack("ticks", "x y theta")
    np.testing.assert_array_equal(poses, np.concatenate([first.poses, second.poses]))
    np.testing.assert_array_equal(truth, np.concatenate([first.truth, second.truth]))
    assert tables["steps"]["action_1"][1] == first.actions[0, 1]
    assert "observation_70" in tables["steps"]
    assert "range_63" in tables["scans"]

    wire = tables["wire"]
    pieces = wire["bytes"][wire["direction"] == "sent"]
    assert [piece.encode("latin-1") for piece in pieces] == [*first.wire.sent, *second.wire.sent]
    assert (np.diff(wire["stamp"][wire["episode"] == 0]) >= 0.0).all()

    movers = stack("movers", "x y x_rate y_rate radius")
    states = np.concatenate([first.movers.states, second.movers.states])
    np.testing.assert_array_equal(movers, states.reshape(-1, 5))
    rows = stack("movers", "mover stamp")[:4].tolist()
    start, following = first.movers.stamps[:2]
    assert rows == [[0, start], [1, start], [2, start], [0, following]]


def test_export_recording_refuses_what_it_cannot_write(tape: Path) -> None:
    with pytest.raises(ConfigError, match="can't be written"):
        export_recording(tape, "csv", tape / "folder")
    with pytest.raises(ConfigError, match=r"to = 'xlsx': must be one of parquet, csv"):
        export_recording(tape, "xlsx", tape.with_suffix(""))


def test_summarize_counts_what_a_recording_holds(tape: Path, tmp_path: Path) -> None:
    summary = summarize(tape)
    ticks = [len(episode.stamps) for episode in read(tape).episodes]
    assert [episode["ticks"] for episode in summary["episodes"]] == ticks
    assert summary["tables"]["ticks"] == sum(ticks)
    assert summary["episodes"][1]["info"]["seed"] == 1
    assert summary["robot"]["simulated"]
    lines = summary_lines(summary)
    assert "whole; 2 episodes" in lines[0]
    assert lines[0].endswith("nothing dropped")
    cut_summary = summary | {"whole": False, "dropped": 3}
    assert summary_lines(cut_summary)[0].endswith("at least 3 dropped")
    assert any(line.split() == ["steps", "82"] for line in lines)

    cut = tmp_path / "cut.mcap"
    cut.write_bytes(tape.read_bytes()[:-20_000])
    with pytest.warns(RecordingWarning, match="the last episode is incomplete"):
        export_recording(cut, "csv", tmp_path / "tables")
    assert summarize(cut)["dropped"] is None
