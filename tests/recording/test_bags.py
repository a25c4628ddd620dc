"""ROS 2 bags of other robots, read as recordings."""

from __future__ import annotations

import re
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from recording_tools import (
    JOINTS,
    Bag,
    drive,
    make_bag,
    without_velocities,
    write_folder,
    write_mcap,
)
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError, RecordingWarning
from acsar_gym.recording import Recording, messages, read
from acsar_gym.recording.bag_files import ZSTD_MAGIC
from acsar_gym.recording.bags import is_recording, open_recording
from acsar_gym.recording.writer import RecordingWriter
from acsar_gym.tools.sysid.twin_gap import measure_gap

TOPICS = {"/joint_states": "/joint_states", "/cmd_vel_sent": "/cmd_vel", "/scan": "/scan"}
ODOMETRY = {"/odom": "/base/odom", "/cmd_vel_sent": "/base/cmd_vel", "/scan": "/scan"}
ROBOT = RobotConfig.of(None)


@pytest.fixture(scope="module")
def tape(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drive(tmp_path_factory.mktemp("tape") / "tape.mcap", ROBOT, 500)


@pytest.fixture(scope="module")
def bag(tape: Path) -> Bag:
    return make_bag(tape, TOPICS)


@pytest.fixture
def file(bag: Bag, tmp_path: Path) -> Path:
    return write_mcap(tmp_path / "bag.mcap", bag)


def read_bag(path: Path, robot: RobotConfig = ROBOT, topics: tuple[str, ...] = ()) -> Recording:
    return read(open_recording(path, robot, topics))


def assert_same_drive(path: Path, tape: Path, off: float = 0.011, **options: Any) -> Recording:
    """Speeds, way, commands and scans of a bag are those that were recorded."""
    recording = read_bag(path, **options)
    (episode,) = recording.episodes
    (drove,) = read(tape).episodes
    rows = len(episode.stamps)
    assert len(drove.stamps) - 1 <= rows <= len(drove.stamps)
    np.testing.assert_allclose(episode.speeds, drove.speeds[-rows:], atol=off)
    np.testing.assert_allclose(episode.poses[-1, :2], drove.poses[-1, :2], atol=0.02)
    np.testing.assert_allclose(np.diff(episode.stamps), np.diff(drove.stamps[-rows:]), atol=2e-9)
    commands = episode.wire.commands(ROBOT)[1]
    np.testing.assert_allclose(commands[-300:], drove.wire.commands(ROBOT)[1][-301:-1], atol=0.011)

    assert np.isnan(episode.truth).all()
    assert len(episode.scans.stamps) > 40
    nearest = len(drove.scans.stamps) - len(episode.scans.stamps)
    np.testing.assert_allclose(episode.scans.ranges, drove.scans.ranges[nearest:], atol=1e-4)
    return recording


def test_open_recording_reads_an_mcap_file(tape: Path, file: Path) -> None:
    assert is_recording(tape)
    assert not is_recording(file)
    assert open_recording(tape, ROBOT) == tape
    recording = assert_same_drive(file, tape)
    again = read_bag(file, ROBOT.with_(name="x"))
    assert recording.header["source"] in recording.sources & again.sources


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_open_recording_reads_a_folder(
    storage: StoragePlugin, tape: Path, bag: Bag, tmp_path: Path
) -> None:
    folder = write_folder(tmp_path / "bag", bag, storage)
    (folder / "metadata.yaml").unlink()  # as of a program that was killed
    (file,) = folder.iterdir()
    assert_same_drive(folder, tape)
    assert_same_drive(file, tape)


def test_open_recording_reads_files_by_their_numbers(tape: Path, bag: Bag, tmp_path: Path) -> None:
    """Number 10 follows number 9, unlike in the order of names."""
    for number in range(12):
        piece = bag[number * len(bag) // 12 : (number + 1) * len(bag) // 12]
        write_mcap(tmp_path / f"bag_{number}.mcap", piece)
    assert_same_drive(tmp_path, tape)


@pytest.mark.parametrize(
    ("topics", "off"), [(TOPICS, 1.0), (ODOMETRY, 0.1)], ids=["positions", "odometry"]
)
def test_open_recording_takes_speeds_from(
    topics: dict[str, str], off: float, tape: Path, tmp_path: Path
) -> None:
    """Positions of joints without velocities, and an odometry."""
    bag = make_bag(tape, topics, change=without_velocities)
    assert_same_drive(write_mcap(tmp_path / "bag.mcap", bag), tape, off)


def test_open_recording_takes_two_wheels_for_their_sides(tape: Path, tmp_path: Path) -> None:
    names = ("right_wheel_joint", "left_wheel_joint", "arm_1", "arm_2")
    path = write_mcap(tmp_path / "bag.mcap", make_bag(tape, TOPICS, names))
    robot = ROBOT.with_(ros2={"joints": {"right": names[0], "left": names[1]}})
    (episode,) = read_bag(path, robot).episodes
    np.testing.assert_array_equal(episode.speeds, episode.speeds[:, [0, 1, 1, 0]])
    assert abs(episode.poses[-1, 0]) > 0.5


def test_open_recording_keeps_the_wiring_of_the_robot(file: Path) -> None:
    first = {"motor": "b", "encoder": "b", "sign": -1}
    crossed = ROBOT.with_(wheels={"a": first, "b": {"motor": "a", "encoder": "a"}})
    (episode,) = read_bag(file, crossed).episodes
    _, speeds = episode.wire.feedback(crossed)
    np.testing.assert_allclose(speeds, episode.speeds, atol=0.006)


def test_open_recording_explains_what_a_bag_lacks(tape: Path, tmp_path: Path) -> None:
    odd = write_mcap(tmp_path / "odd.mcap", make_bag(tape, TOPICS, ("a", "b", "c", "d")))
    scans = write_mcap(tmp_path / "scans.mcap", make_bag(tape, {"/scan": "/scan"}))
    broken = tmp_path / "bad.db3"
    broken.write_bytes(b"no database" * 100)
    for path, text in (
        (odd, r"odd.mcap: has no wheel speeds, .*joints are a, b, c"),
        (scans, r"it has /scan \(sensor_msgs/msg/LaserScan\)"),
        (broken, "isn't a ROS 2 bag"),
    ):
        with pytest.raises(ConfigError, match=text):
            read_bag(path)
    broken.with_name("bad.db3-wal").touch()
    with pytest.raises(ConfigError, match=r"bad.db3: can't be read: file is not a database"):
        read_bag(broken)
    with pytest.raises(ConfigError, match="is a ROS 2 bag: name its robot with --robot"):
        open_recording(scans, None)

    blind = write_mcap(tmp_path / "blind.mcap", make_bag(tape, {"/joint_states": "/joint_states"}))
    with pytest.raises(ConfigError, match="left out, holds no commands, or no feedback"):
        measure_gap([("blind", read_bag(blind))], ("robot", ROBOT), ("robot", ROBOT))


def test_open_recording_warns_of_a_cut_bag(file: Path) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: len(data) * 3 // 4])
    with pytest.warns(RecordingWarning, match=r"bag\.mcap: the file is cut"):
        open_recording(file, ROBOT)


@pytest.mark.parametrize("length", [2**62, 2**63], ids=["memory", "integer"])
def test_open_recording_explains_a_broken_chunk(file: Path, length: int) -> None:
    """Its content would be longer than the memory."""
    head, name, content = file.read_bytes().partition(b"zstd")
    file.write_bytes(head + name + length.to_bytes(8, "little") + content[8:])
    with pytest.raises(ConfigError, match=r"bag.mcap: has no wheel speeds, .* it has no messages"):
        open_recording(file, ROBOT)


States = Callable[[float], tuple[list[float], list[float]]]
"""Returns positions and velocities of the joints at a time."""


def write_joints(path: Path, rate: float, states: States) -> Path:
    """A bag of ten seconds."""
    kind = "sensor_msgs/msg/JointState"
    bag = []
    for number in range(round(10.0 * rate)):
        positions, velocities = map(np.array, states(number / rate))
        message = messages.make_message(
            kind, name=list(JOINTS), position=positions, velocity=velocities
        )
        data = bytes(messages.load_typestore().serialize_cdr(message, kind))
        bag.append(("/joint_states", kind, round(number / rate * 1e9), data))
    return write_mcap(path, bag)


def with_zeros(stamp: float) -> tuple[list[float], list[float]]:
    """A joint_state_publisher, whose positions are zero, runs beside the robot's publisher."""
    is_zero = round(100.0 * stamp) % 5 == 2
    return ([0.0] * 4, []) if is_zero else ([2.0 * stamp] * 4, [2.0] * 4)


def test_open_recording_explains_a_full_disk(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(RecordingWriter, "write", fail)
    with pytest.raises(ConfigError, match=r"bag.mcap: can't be written: No space left on device"):
        read_bag(file)


@pytest.mark.parametrize(
    ("states", "count"),
    [
        (with_zeros, "200"),
        (lambda stamp: (with_zeros(stamp)[0], []), "200"),
        (lambda stamp: ([], [150.0 if stamp == 5.0 else 2.0] * 4), "1 too"),
    ],
)
def test_open_recording_leaves_out_what_cannot_be_right(
    states: States, count: str, tmp_path: Path
) -> None:
    path = write_joints(tmp_path / "bag.mcap", 100.0, states)
    with pytest.warns(RecordingWarning, match=f"of /joint_states were left out: {count}"):
        (episode,) = read_bag(path).episodes
    np.testing.assert_allclose(episode.speeds[1:], 2.0, atol=1e-6)


def test_open_recording_refuses_wrapping_positions_at_a_low_rate(tmp_path: Path) -> None:
    """At 5 Hz a wheel at 20 rad/s turns by more than half a turn between two messages."""
    turning = write_joints(tmp_path / "turning.mcap", 5.0, lambda stamp: ([20.0 * stamp] * 4, []))
    (episode,) = read_bag(turning).episodes
    np.testing.assert_allclose(episode.speeds, 20.0)

    wrapped = write_joints(
        tmp_path / "wrapped.mcap", 5.0, lambda stamp: ([20.0 * stamp % 6.283185307179586] * 4, [])
    )
    with pytest.raises(ConfigError, match=r"positions without velocities, 5\.0 times a second"):
        read_bag(wrapped)


def test_open_recording_reads_what_sqlite_wrote_last(tape: Path, bag: Bag, tmp_path: Path) -> None:
    """A recorder that was killed leaves it in a file beside the bag."""
    (file,) = write_folder(tmp_path / "bag", bag, StoragePlugin.SQLITE3).glob("*.db3")
    live = tmp_path / "live.db3"
    crashed = tmp_path / "crashed"
    crashed.mkdir()
    with closing(sqlite3.connect(live)) as database, closing(sqlite3.connect(file)) as source:
        database.execute("pragma journal_mode=wal")
        database.execute("pragma wal_autocheckpoint=0")
        database.executescript("\n".join(source.iterdump()))
        for end in ("", "-wal"):
            shutil.copy(f"{live}{end}", crashed / f"bag.db3{end}")

    content = {path: path.read_bytes() for path in crashed.iterdir()}
    assert_same_drive(crashed / "bag.db3", tape)
    assert_same_drive(crashed, tape)
    assert content == {path: path.read_bytes() for path in crashed.iterdir()}


def test_open_recording_unpacks_files_and_messages(
    tape: Path, bag: Bag, file: Path, tmp_path: Path
) -> None:
    packed = tmp_path / "packed.mcap.zstd"
    packed.write_bytes(zstandard.compress(file.read_bytes()))
    assert_same_drive(packed, tape)
    packed.write_bytes(zstandard.compress(bytes(100_000_000)))
    with pytest.raises(ConfigError, match="unpacks to more than a bag holds"):
        read_bag(packed)
    packed.write_bytes(zstandard.compress(b"no bag"))
    with pytest.raises(ConfigError, match=f"^{re.escape(str(packed))}: isn't a ROS 2 bag"):
        read_bag(packed)

    topic, kind, time, data = bag[0]
    broken = write_mcap(tmp_path / "broken.mcap", [(topic, kind, time, ZSTD_MAGIC + data)])
    with pytest.raises(ConfigError, match=r"broken.mcap: /\w+ can't be unpacked"):
        read_bag(broken)

    folder = write_folder(tmp_path / "bag", bag, StoragePlugin.MCAP, CompressionMode.MESSAGE)
    metadata = folder / "metadata.yaml"
    text = re.sub("storage_identifier: .*", "storage_identifier: ''", metadata.read_text())
    metadata.write_text(text)
    assert_same_drive(folder, tape)


def test_open_recording_chooses_a_robot(tape: Path, tmp_path: Path) -> None:
    bag = [
        message
        for name in ("/robot1", "/robot2")
        for message in make_bag(tape, {topic: f"{name}{to}" for topic, to in TOPICS.items()})
    ]
    path = write_mcap(tmp_path / "two.mcap", sorted(bag, key=lambda message: message[2]))
    with pytest.raises(ConfigError, match=r"several topics with joint states: /robot1/joint_sta"):
        read_bag(path)
    with pytest.raises(ConfigError, match="has no topic '/robot3'"):
        read_bag(path, topics=("/robot3",))
    assert_same_drive(path, tape, topics=("/robot1",))
