"""Recordings with a flipped bit: what is whole is read, and what isn't is said."""

from __future__ import annotations

import re
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
from recording_tools import record_env

from acsar_gym.errors import RecordingWarning
from acsar_gym.recording import Recording, read
from acsar_gym.recording.reader import summarize, summary_lines
from acsar_gym.recording.replay import ReplayLink
from acsar_gym.recording.stream import CHUNK
from acsar_gym.worlds import Scene

EPISODES = 4


@pytest.fixture(scope="module")
def tape(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_env(tmp_path_factory.mktemp("tape") / "tape.mcap", "point_goal", EPISODES)


def find_records(path: Path, opcode: int) -> list[int]:
    """Where the records of a kind begin."""
    data, place, places = path.read_bytes(), 8, []
    while place < len(data) - 8:
        kind, length = struct.unpack_from("<BQ", data, place)
        places += [place] if kind == opcode else []
        place += 9 + length
    return places


def flip(tape: Path, tmp_path: Path, place: int, bit: int = 4) -> Path:
    """A copy with a flipped bit."""
    path = tmp_path / "bad.mcap"
    data = bytearray(tape.read_bytes())
    data[place] ^= bit
    path.write_bytes(data)
    return path


def read_damaged(path: Path) -> Recording:
    with pytest.warns(RecordingWarning, match="is damaged: [0-9]+ damaged place") as caught:
        recording = read(path)
    assert len(caught) == 1
    assert "\n" not in str(caught[0].message)
    return recording


def content(recording: Recording) -> list[tuple[bytes, ...]]:
    return [
        (one.poses.tobytes(), b"".join(one.wire.sent), one.observations.tobytes())
        for one in recording.episodes
    ]


def test_one_flipped_bit_costs_its_chunk(tape: Path, tmp_path: Path) -> None:
    whole, places = read(tape), find_records(tape, CHUNK)
    recording = read_damaged(flip(tape, tmp_path, places[len(places) // 2] + 200))
    assert len(recording.episodes) == EPISODES
    assert 0 < recording.missing < 100
    ticks = sum(len(one.stamps) for one in recording.episodes)
    assert 0 < sum(len(one.stamps) for one in whole.episodes) - ticks < 100
    same = [one == two for one, two in zip(content(whole), content(recording), strict=True)]
    assert same.count(False) <= 2
    assert not recording.cut
    assert recording.dropped == 0
    found = summarize(flip(tape, tmp_path, places[len(places) // 2] + 200))
    assert found["whole"]
    first, _, damage, *_ = summary_lines(found)
    assert "bad.mcap: damaged; 4 episodes" in first
    assert re.match(r"1 damaged place left out \(a chunk of [0-9,]+ bytes at byte", damage)


def test_a_chunk_with_schemas_channels_and_a_beginning_is_missed_least(
    tape: Path, tmp_path: Path
) -> None:
    whole, places = read(tape), find_records(tape, CHUNK)
    recording = read_damaged(flip(tape, tmp_path, places[0] + 500))
    assert len(recording.episodes) == EPISODES
    assert content(recording)[1:] == content(whole)[1:]
    first, before = recording.episodes[0], whole.episodes[0]
    assert first.info == {}
    assert first.offset == before.offset
    assert before.start < first.start < before.stamps[-1]
    np.testing.assert_array_equal(first.poses, before.poses[-len(first.poses) :])


def test_an_episode_whose_beginning_is_lost_is_not_taken_for_the_one_before(
    tape: Path, tmp_path: Path
) -> None:
    whole = read(tape)
    begins = round(whole.episodes[2].start * 1e9) + whole.episodes[2].offset
    data, damaged = tape.read_bytes(), -1
    for place in find_records(tape, CHUNK):
        first, last = struct.unpack_from("<QQ", data, place + 9)
        if first <= begins <= last:
            damaged = place
    recording = read_damaged(flip(tape, tmp_path, damaged + 300))
    assert len(recording.episodes) == EPISODES
    third, before = recording.episodes[2], whole.episodes[2]
    np.testing.assert_array_equal(third.stamps, before.stamps[-len(third.stamps) :])
    assert len(recording.episodes[1].stamps) <= len(whole.episodes[1].stamps)


def test_no_flipped_bit_goes_unsaid(tape: Path, tmp_path: Path) -> None:
    whole, size = content(read(tape)), tape.stat().st_size
    rng = np.random.default_rng(5)
    for place in [*rng.integers(0, size, 150), *range(30, 130, 3)]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            recording = read(flip(tape, tmp_path, int(place), 1 << int(rng.integers(8))))
        assert content(recording) == whole or len(caught) == 1, place


def test_a_damaged_file_without_its_end_is_read_as_well(tape: Path, tmp_path: Path) -> None:
    path = flip(tape, tmp_path, find_records(tape, CHUNK)[3] + 100)
    path.write_bytes(path.read_bytes()[: -path.stat().st_size // 5])
    recording = read_damaged(path)
    assert recording.cut
    assert len(recording.episodes) >= 3


def test_a_replay_says_why_it_ends(tape: Path, tmp_path: Path) -> None:
    path = flip(tape, tmp_path, find_records(tape, CHUNK)[2] + 100)
    link = ReplayLink(path, compare=False)
    with pytest.warns(RecordingWarning):
        link.open()
    link.reset(Scene())
    with pytest.raises(Exception, match=r"has a gap, .*the file is damaged"):
        for _ in range(1000):
            link.advance(0.01)
