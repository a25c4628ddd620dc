"""Reading recordings that are cut, damaged, foreign, old, or made to do harm."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer
from recording_tools import drive

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError, RecordingWarning
from acsar_gym.recording import read
from acsar_gym.recording.messages import (
    EPISODE,
    EXCHANGES,
    HEADER_RECORD,
    MCAP_MAGIC,
    MOVERS,
    RECORDING_FORMAT,
    WIRE_SENT,
    Topic,
    array_packer,
    make_header,
    pack_octets,
    pack_text,
    seal_text,
)
from acsar_gym.recording.stream import CHUNK, DATA_END, MESSAGE

BEGIN = json.dumps({"episode": 0, "start": 0.0, "offset": 0, "wall": 0, "info": {}})
Add = Callable[[Topic, bytes], None]


@pytest.fixture(scope="module")
def tape(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drive(tmp_path_factory.mktemp("tape") / "tape.mcap", RobotConfig.of(None), 300)


def written(
    path: Path, add: Callable[[Add], None], told: Any = None, name: str = HEADER_RECORD
) -> Path:
    """A file with a header and the messages that `add` adds."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start()
        told = make_header(RobotConfig(), {}) if told is None else told
        writer.add_metadata(name, seal_text("header", told))
        channels: dict[str, int] = {}

        def one(topic: Topic, data: bytes) -> None:
            if topic.name not in channels:
                schema = writer.register_schema(topic.kind, "ros2msg", b"")
                channels[topic.name] = writer.register_channel(
                    topic.name, "cdr", schema, topic.metadata
                )
            writer.add_message(channels[topic.name], 0, data, 0)

        add(one)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def rows(*values: list[float]) -> Callable[[Add], None]:
    """An episode with these exchanges."""

    def add(one: Add) -> None:
        one(EPISODE, pack_text(BEGIN))
        for packed in array_packer("<f8", 11).pack(
            len(values), {"data": np.array(values).reshape(-1, 11)}
        ):
            one(EXCHANGES, packed)

    return add


def beginning(**told: float) -> Callable[[Add], None]:
    """An episode that begins so."""
    return lambda one: one(EPISODE, pack_text(json.dumps(json.loads(BEGIN) | told)))


def refused(path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        read(path)
    said = str(caught.value)
    assert said.startswith(f"{path}: ")
    assert "\n" not in said
    assert len(said) < len(str(path)) + 150
    return said


@pytest.mark.parametrize("share", [0.5, 0.75, 0.99])
def test_a_cut_file_is_read_up_to_its_cut(share: float, tape: Path, tmp_path: Path) -> None:
    whole, cut = read(tape), tmp_path / "cut.mcap"
    data = tape.read_bytes()
    cut.write_bytes(data[: int(share * len(data))])
    found = read(cut)
    assert found.cut
    assert not whole.cut
    (some,), (every,) = found.episodes, whole.episodes
    assert 0 < len(some.stamps) <= len(every.stamps)
    np.testing.assert_array_equal(some.poses, every.poses[: len(some.poses)])
    assert found.config == whole.config == RobotConfig.of(None)


def test_zeros_at_the_end_count_as_cut(tape: Path, tmp_path: Path) -> None:
    """A computer that lost its power may leave them."""
    lost = tmp_path / "lost.mcap"
    data = tape.read_bytes()
    end = data.rindex(b"acsar_gym_end") - 13
    lost.write_bytes(data[:end] + bytes(4096))
    assert read(lost).cut


def test_a_file_that_was_cut_before_its_first_episode_says_so(tape: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    for size, said in (20, "isn't a recording of acsar_gym"), (3500, "is cut before its first"):
        cut.write_bytes(tape.read_bytes()[:size])
        assert said in refused(cut)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "not an MCAP file"),
        (MCAP_MAGIC, "isn't a recording of acsar_gym"),
        (MCAP_MAGIC + b"\x77" * 100, "is damaged"),
        (MCAP_MAGIC + struct.pack("<BQ", MESSAGE, 2**63), "is damaged"),
    ],
    ids=["empty", "magic", "noise", "long"],
)
def test_foreign_files_are_told(content: bytes, said: str, tmp_path: Path) -> None:
    path = tmp_path / "file.mcap"
    path.write_bytes(content)
    assert said in refused(path)


def test_the_recordings_of_others_and_other_formats_are_told(tmp_path: Path) -> None:
    path = tmp_path / "file.mcap"
    no_episode = lambda one: None  # noqa: E731
    assert "isn't a recording of acsar_gym" in refused(written(path, no_episode, name="rosbag2"))
    newer = make_header(RobotConfig(), {}) | {"format": RECORDING_FORMAT + 1}
    assert f"format {RECORDING_FORMAT + 1}: this version reads" in refused(
        written(path, no_episode, newer)
    )
    assert "is no mapping" in refused(written(path, no_episode, [1]))
    whole = make_header(RobotConfig(), {})
    for name in ("config", "about", "versions", "config_sha256", "created"):
        less = {key: value for key, value in whole.items() if key != name}
        for told in (less, whole | {name: [1]}):
            assert f"is damaged: {name}" in refused(written(path, rows(), told)).replace("'", "")
    assert "holds no episode" in refused(written(path, no_episode))
    unknown = make_header(RobotConfig(), {}) | {"config": {"sheels": 3}}
    assert "unknown field" in refused(written(path, rows([0.0] * 11), unknown))


@pytest.mark.parametrize(
    ("add", "said"),
    [
        (lambda one: one(EPISODE, pack_text("{}")), "start"),
        (rows([0.0, 5.0, *[0.0] * 9], [1.0, 4.0, *[0.0] * 9]), "times go backwards"),
        (rows([0.0, np.nan, *[0.0] * 9]), "a time that is out of range"),
        (beginning(start=-1e300), "start = "),
        (beginning(offset=2**70), "offset = "),
        (
            lambda one: (beginning(offset=-(2**62))(one), one(WIRE_SENT, pack_octets(b""))),
            "a time that",
        ),
        (lambda one: (rows()(one), one(EXCHANGES, b"\0" * 16)), "a broken row"),
        (lambda one: (rows()(one), one(WIRE_SENT, b"\xff" * 40)), "a broken array"),
    ],
    ids=["episode", "backwards", "nan", "start", "offset", "wire", "row", "long"],
)
def test_broken_messages_are_told(add: Callable[[Add], None], said: str, tmp_path: Path) -> None:
    assert said in refused(written(tmp_path / "file.mcap", add))


@pytest.mark.parametrize(
    ("movers", "said"),
    [
        ([1.0, 2.0, 0.0, 0.0], "movers that can't be"),
        ([1.0, np.inf, 0.0, 0.0, 0.3], "movers that can't be"),
        ([1.0, 2.0, 0.0, 0.0, 0.3] * 201, "movers that can't be"),
        ([1.0, 2.0, 0.0, 0.0, 0.0], "a mover without a radius"),
    ],
)
def test_movers_that_cannot_be_are_told(movers: list[float], said: str, tmp_path: Path) -> None:
    row = np.array([[0.0, 0.01, 0.0, 0.0, *movers]])

    def add(one: Add) -> None:
        rows([0.0, 0.01, *[0.0] * 9])(one)
        (packed,) = array_packer("<f8", row.shape[1]).pack(1, {"data": row})
        one(MOVERS, packed)

    assert said in refused(written(tmp_path / "file.mcap", add))


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def chunk(data: bytes, size: int | None = None) -> bytes:
    """A chunk of zstd, which says that it unpacks to `size` bytes."""
    packed = zstandard.compress(data)
    head = struct.pack("<QQQI", 0, 0, len(data) if size is None else size, zlib.crc32(data))
    kind = struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(packed))
    return record(CHUNK, head + kind + packed)


def test_chunks_that_unpack_to_more_than_a_recording_has_are_left_out(tmp_path: Path) -> None:
    start = written(tmp_path / "file.mcap", rows([0.0] * 11)).read_bytes()
    start = start[: start.rindex(record(DATA_END, bytes(4))[:9])]
    for bomb in chunk(bytes(60_000_000)), chunk(bytes(60_000_000), 10):
        (tmp_path / "file.mcap").write_bytes(start + 20 * bomb)
        with pytest.warns(RecordingWarning, match="20 damaged places left out"):
            recording = read(tmp_path / "file.mcap")
        assert len(recording.episodes) == 1
