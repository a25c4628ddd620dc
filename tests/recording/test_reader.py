"""Reading recordings that are cut, damaged, foreign, or made to do harm."""

from __future__ import annotations

import json
import re
import warnings
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.writer import Writer
from recording_tools import drive

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError, LinkLostError, RecordingWarning
from acsar_gym.protocol import encode
from acsar_gym.recording import Recording, read
from acsar_gym.recording.blocks import (
    FORMAT,
    MAGIC,
    MEDIA_TYPE,
    NAME,
    iterate_blocks,
    pack_block,
)
from acsar_gym.recording.events import TABLES
from acsar_gym.recording.messages import make_header
from acsar_gym.recording.reader import summarize, summary_lines
from acsar_gym.recording.replay import ReplayLink
from acsar_gym.recording.types import WireLog
from acsar_gym.worlds import Scene

OPENING: dict[str, Any] = {"episode": 0, "start": 0.0, "offset": 0, "info": {}}
Tables = Mapping[str, np.ndarray]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "tape.mcap"


def assert_part_of(recording: Recording, original: Recording) -> None:
    """Everything that was read is what was written."""
    episodes = {episode.offset: episode for episode in original.episodes}
    for episode in recording.episodes:
        full = episodes[episode.offset]
        kept = np.isin(full.stamps, episode.stamps)
        np.testing.assert_array_equal(episode.poses, full.poses[kept])
        np.testing.assert_array_equal(episode.truth, full.truth[kept])


@pytest.mark.parametrize("share", [0.5, 0.75, 0.99])
@pytest.mark.parametrize("zeros", [0, 4096], ids=["cut", "zeros"])
def test_read_a_cut_file_up_to_its_cut(
    share: float, zeros: int, tape: Path, tmp_path: Path
) -> None:
    """A computer that lost its power may leave zeros at the end."""
    cut = tmp_path / "cut.mcap"
    data = tape.read_bytes()
    cut.write_bytes(data[: int(share * len(data))] + bytes(zeros))
    recording = read(cut)
    original = read(tape)
    assert recording.cut
    assert recording.config == original.config
    assert len(recording.episodes[0].stamps) > 0
    assert_part_of(recording, original)


def flip(tape: Path, tmp_path: Path, place: int, bit: int = 4) -> Path:
    """A copy with a flipped bit."""
    path = tmp_path / "bad.mcap"
    data = bytearray(tape.read_bytes())
    data[place] ^= bit
    path.write_bytes(data)
    return path


def find_blocks(tape: Path) -> list[int]:
    with tape.open("rb") as file:
        return [block.place for block in iterate_blocks(file, [])]


def test_read_reports_each_flipped_bit(tape: Path, tmp_path: Path) -> None:
    """In the exact data and in the messages for other programs."""
    original = read(tape)
    size = tape.stat().st_size
    rng = np.random.default_rng(5)
    header = find_blocks(tape)[0] + 500
    ends = [*range(0, 60, 3), header, *range(size - 40, size, 3)]
    for place in [*rng.integers(0, size, 200).tolist(), *ends]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            recording = read(flip(tape, tmp_path, place, 1 << int(rng.integers(8))))
        assert len(caught) == 1 or recording.cut, place
        assert_part_of(recording, original)


def test_read_leaves_out_a_damaged_block(tape: Path, tmp_path: Path) -> None:
    original = read(tape)
    path = flip(tape, tmp_path, find_blocks(tape)[3] + 2000)  # in the first episode
    with pytest.warns(RecordingWarning, match=r"is damaged: 1 damaged place left out .*recover"):
        recording = read(path)
    assert recording.missing > 0
    assert recording.dropped == 0
    assert_part_of(recording, original)
    second = recording.episodes[1]
    assert second.wire.sent == original.episodes[1].wire.sent
    np.testing.assert_array_equal(second.movers.states, original.episodes[1].movers.states)

    headline, _, damage, *_ = summary_lines(summarize(path))
    assert "bad.mcap: damaged; 2 episodes" in headline
    assert re.match(r"1 damaged place left out \([0-9,]+ bytes from byte [0-9,]+ on", damage)
    link = ReplayLink(path, compare=False)
    with pytest.warns(RecordingWarning):
        link.open()
    link.reset(Scene())
    with pytest.raises(LinkLostError, match=r"has a gap, .*the file is damaged"):
        for _ in range(1000):
            link.advance(0.01)


def assert_refused(path: Path, text: str) -> None:
    """The error is one line that names the file."""
    with pytest.raises(ConfigError) as caught:
        _ = [(episode.stamps, episode.truth, episode.movers) for episode in read(path).episodes]
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert text in message
    assert "\n" not in message


def test_read_refuses_files_without_an_episode(tape: Path, path: Path) -> None:
    for size, text in (
        (0, "not an MCAP file"),
        (len(MAGIC), "isn't a recording of acsar_gym"),
        (find_blocks(tape)[1] + 9, "is cut before its first episode"),
    ):
        path.write_bytes(tape.read_bytes()[:size])
        assert_refused(path, text)


def write_blocks(path: Path, *blocks: bytes, **header: Any) -> Path:
    """A file whose checksums are right, with these blocks after the header and before the end."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        first = json.dumps({"header": make_header(RobotConfig(), {}) | header})
        place = 0

        for block in (first.encode() + b"\n", *blocks, b'{"dropped": 0}\n'):
            file.flush()
            checksum = zlib.crc32(path.read_bytes()[place:])
            line, _, data = block.partition(b"\n")
            head = json.dumps({**json.loads(line), "before": checksum})
            writer.add_attachment(0, 0, NAME, MEDIA_TYPE, head.encode() + b"\n" + data)
            file.flush()
            place = file.tell()
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def make_block(tables: Tables | None = None, **head: Any) -> bytes:
    return pack_block({"before": 0, **OPENING, **head}, tables or {})


def make_exchanges(*stamps: float) -> Tables:
    table = np.zeros(len(stamps), TABLES["exchanges"])
    table["stamp"] = stamps
    return {"exchanges": table}


MOVER = np.array([[[1.0, 2.0, 0.0, 0.0, 0.3]]])


@pytest.mark.parametrize(
    ("block", "text"),
    [
        (make_block(start=-1e300), "start = "),
        (make_block(make_exchanges(5.0, 4.0)), "times go backwards"),
        (make_block(make_exchanges(np.nan)), "a time that is out of range"),
        (make_block({"mover_states": MOVER + np.inf}), "out of range"),
        (make_block({"mover_states": MOVER * 0.0}), "a mover without a radius"),
        (make_block({"wheels": np.zeros(3)}), "an unknown table"),
        (make_block(make_exchanges(1.0))[:-20], "can't be unpacked"),
    ],
)
def test_read_refuses_broken_blocks(block: bytes, text: str, tmp_path: Path) -> None:
    assert_refused(write_blocks(tmp_path / "file.mcap", block), text)


def test_read_refuses_a_broken_table_each_time(path: Path) -> None:
    (episode,) = read(write_blocks(path, make_block(make_exchanges(5.0, 4.0)))).episodes
    for _ in range(2):
        with pytest.raises(ConfigError, match="times go backwards"):
            assert len(episode.exchanges)


def test_read_takes_blocks_of_this_format_only(path: Path) -> None:
    sound = read(write_blocks(path, make_block(make_exchanges(0.5, 1.0))))
    assert not sound.damages
    assert sound.episodes[0].exchanges["stamp"].tolist() == [0.5, 1.0]
    foreign = write_blocks(path, make_block(), format=FORMAT + 1)
    assert_refused(foreign, f"format {FORMAT + 1}: this version reads format {FORMAT}")


@pytest.mark.parametrize("declared", [3, 60_000_000], ids=["short", "long"])
def test_read_bounds_what_a_file_unpacks_to(declared: int, tmp_path: Path) -> None:
    """Neither what a block declares nor what its compressed data declare is believed."""
    packed = zstandard.compress(bytes(60_000_000))
    line = {**OPENING, "before": 0, "tables": {"sent_bytes": [declared, len(packed)]}}
    block = json.dumps(line).encode() + b"\n" + packed
    path = write_blocks(tmp_path / "file.mcap", *([block] * 20))
    with pytest.raises(ConfigError, match=r"unpacks to more|another size"):
        _ = read(path).episodes[0].wire


def test_read_takes_a_table_when_it_is_needed(tmp_path: Path) -> None:
    """From the same file."""
    path = drive(tmp_path / "tape.mcap", RobotConfig.of(None), 300)
    (episode,) = read(path).episodes
    assert not episode.tables
    assert len(episode.poses) == 300
    assert [len(part.poses) for part in read(path).episodes[0].split()] == [300]
    path.write_bytes(path.read_bytes()[:-50_000])
    with pytest.raises(ConfigError, match=r"tape\.mcap: has changed since it was read"):
        _ = episode.wire


def test_read_takes_no_table_of_another_recording(tmp_path: Path) -> None:
    """It may have a sound block at the same place."""
    offsets = (10**18, 2 * 10**18)
    files = [tmp_path / f"{offset}.mcap" for offset in offsets]
    for file, offset in zip(files, offsets, strict=True):
        write_blocks(file, make_block(make_exchanges(0.5), offset=offset))
    (episode,) = read(files[0]).episodes
    files[1].replace(files[0])
    with pytest.raises(ConfigError, match=r"\.mcap: has changed since it was read"):
        _ = episode.exchanges


def test_read_searches_no_huge_file_of_another_kind(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(2**40)
    assert_refused(path, "isn't a recording: not an MCAP file")


def test_wire_log_decodes_lines_with_the_stamps_of_their_last_bytes() -> None:
    """A wheel that a line doesn't name keeps its speed."""
    lines = encode((1.0, 2.0, -3.0, 4.0)), encode((5.0, 6.0, 7.0, 8.0))
    stream = b"".join(lines) + b"bp09.00\r\n"
    pieces = (stream[:7], stream[7:40], stream[40:])
    log = WireLog(np.array([0.5]), lines[:1], np.array([1.0, 1.001, 1.003]), pieces)
    stamps, speeds = log.feedback(RobotConfig())
    assert stamps.tolist() == [1.001, 1.003, 1.003]
    expected = [[1.0, 2.0, -3.0, 4.0], [5.0, 6.0, 7.0, 8.0], [5.0, 9.0, 7.0, 8.0]]
    assert speeds.tolist() == expected
    stamps, speeds = log.commands(RobotConfig())
    assert stamps.tolist() == [0.5]
    assert speeds.tolist() == expected[:1]
    assert WireLog.of((), ()).commands(RobotConfig())[1].shape == (0, 4)
