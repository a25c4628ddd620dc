"""Recordings that don't fit into memory, made small here: what is kept is made less."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mover_tools import HALL
from recording_tools import drive, record_env

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.recording import Recording, read, reader
from acsar_gym.recording.export import export_recording, make_tables
from acsar_gym.recording.reader import RecordedEpisode, iterate_blocks

FIELDS = (
    *("stamps", "poses", "twists", "speeds", "asked", "sent", "reasons", "lateness", "truth"),
    *("observations", "actions", "rewards", "step_stamps"),
)


@pytest.fixture(scope="module")
def tape(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of an env with a LiDAR, among people."""
    path = tmp_path_factory.mktemp("tape") / "tape.mcap"
    return record_env(path, "obstacle_goal", 2, worlds=HALL)


@pytest.fixture
def little(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory for next to nothing."""
    monkeypatch.setattr(reader, "KEPT_BYTES", 10_000)
    monkeypatch.setattr(reader, "CACHED_BYTES", 20_000)
    monkeypatch.setattr(reader, "BLOCK_BYTES", 15_000)


def assert_equal(found: Recording, whole: Recording) -> None:
    assert found.sha256 == whole.sha256
    assert found.dropped == whole.dropped == 0
    for one, every in zip(found.episodes, whole.episodes, strict=True):
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(one, name), getattr(every, name))
        for name in ("start", "offset", "info", "terminated", "truncated", "success"):
            assert getattr(one, name) == getattr(every, name)
        assert list(one.wire.sent) == list(every.wire.sent)
        assert one.wire.sent[3:5] == every.wire.sent[3:5]
        assert one.wire.got[-1] == every.wire.got[-1]
        np.testing.assert_array_equal(one.wire.got_stamps, every.wire.got_stamps)
        np.testing.assert_array_equal(one.exchanges.truth, every.exchanges.truth)
        np.testing.assert_array_equal(one.scans.ranges, every.scans.ranges)
        np.testing.assert_array_equal(one.movers.states, every.movers.states)
        assert len(one.movers.stamps) == len(one.exchanges.stamps)
        turns, all_turns = one.revolutions, every.revolutions
        np.testing.assert_array_equal(turns.stamps, all_turns.stamps)
        assert len(turns.measured) == len(all_turns.measured) > 0
        for turn, other in zip(turns.measured, all_turns.measured, strict=True):
            np.testing.assert_array_equal(turn, other)


@pytest.mark.usefixtures("little")
def test_a_long_recording_is_read_piece_by_piece(tape: Path) -> None:
    found = read(tape, revolutions=True)
    assert all(isinstance(one, RecordedEpisode) for one in found.episodes)
    assert not any("poses" in one.__dict__ for one in found.episodes)
    with pytest.MonkeyPatch.context() as enough:
        enough.setattr(reader, "KEPT_BYTES", 10**9)
        whole = read(tape, revolutions=True)
        assert not isinstance(whole.episodes[0], RecordedEpisode)
    assert_equal(found, whole)
    in_memory = sum("poses" in one.__dict__ for one in found.episodes)
    assert in_memory <= 1  # others were forgotten for it
    assert not hasattr(found.episodes[0], "wheels")
    moved = replace(found.episodes[0], poses=np.zeros((2, 3)))
    assert moved.poses.shape == (2, 3)
    np.testing.assert_array_equal(moved.stamps, found.episodes[0].stamps)
    assert len(repr(found.episodes[0])) < 200  # and it isn't read for that


@pytest.mark.usefixtures("little")
def test_memory_doesnt_grow_with_the_length(tmp_path: Path) -> None:
    """What is kept of a drive is the same for one of twice the length."""
    kept = []
    for number, ticks in enumerate((500, 1000)):
        path = drive(tmp_path / f"{number}.mcap", RobotConfig.of(None), ticks)
        (episode,) = read(path).episodes
        blocks = list(map(len, (block.stamps for block in iterate_blocks(episode))))
        assert sum(blocks) == ticks
        kept.append(max(blocks))
        assert "wire" not in episode.__dict__
        assert "poses" not in episode.__dict__
    assert kept[1] < 1.5 * kept[0]
    assert kept[1] < 200


@pytest.mark.usefixtures("little")
def test_a_long_recording_is_exported_as_a_short_one(tape: Path, tmp_path: Path) -> None:
    found = make_tables(read(tape))
    paths = export_recording(tape, "csv", tmp_path / "little")
    with pytest.MonkeyPatch.context() as enough:
        enough.setattr(reader, "KEPT_BYTES", 10**9)
        whole = make_tables(read(tape))
        for path in export_recording(tape, "csv", tmp_path / "whole"):
            assert path.read_bytes() == (tmp_path / "little" / path.name).read_bytes()
    names = ("ticks.csv", "wire.csv", "steps.csv", "scans.csv", "movers.csv")
    assert tuple(path.name for path in paths) == names
    for name, columns in whole.items():
        for key, values in columns.items():
            np.testing.assert_array_equal(found[name][key], values)


@pytest.mark.usefixtures("little")
def test_a_file_that_changes_meanwhile_is_told(tape: Path, tmp_path: Path) -> None:
    path = tmp_path / "tape.mcap"
    path.write_bytes(tape.read_bytes())
    recording = read(path)
    path.write_bytes(tape.read_bytes()[:-1])
    with pytest.raises(ConfigError, match=r"tape\.mcap: has changed since it was read"):
        _ = recording.episodes[0].poses


@pytest.mark.usefixtures("little")
def test_a_long_recording_can_be_copied(tape: Path) -> None:
    recording = read(tape)
    again: Recording = pickle.loads(pickle.dumps(recording))  # noqa: S301 - our own
    np.testing.assert_array_equal(again.episodes[1].poses, recording.episodes[1].poses)
