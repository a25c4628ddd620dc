"""Makes small recordings."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.rosbag2 import CompressionFormat, StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter

from acsar_gym import Link, Robot, RobotConfig, open_link
from acsar_gym.envs.ids import full_id
from acsar_gym.protocol import ZERO, encode
from acsar_gym.recording import Recorder, messages
from acsar_gym.recording.recorder import RecordedLink
from acsar_gym.worlds import Scene


def drive(path: Path, config: RobotConfig, ticks: int = 120, **options: Any) -> Path:
    """Record the planar robot with its LiDAR in curves, and return the path."""
    recorder = Recorder(path, {"command": "test"}, **options)
    with Robot(open_link("planar", config), config, ["lidar"], recorder) as robot:
        for tick in range(ticks):
            robot.drive(0.3, math.sin(tick / 20.0))
    return path


def record_env(path: Path, env_id: str, episodes: int = 2, **options: Any) -> Path:
    """Episodes of an env with random actions, some of them beyond [-1, 1]."""
    env = gymnasium.make(full_id(env_id), link="planar", record=path, **options)
    rng = np.random.default_rng(3)
    for seed in range(episodes):
        env.reset(seed=seed)
        for _ in range(40):
            if env.step(rng.uniform(-0.5, 1.0, 2).astype(np.float32))[2]:
                break
    env.close()
    return path


def record_drive(path: Path, *ways: list[tuple[float, float, int]]) -> Path:
    """One episode for each way, which is a list of (linear, angular, ticks)."""
    recorder = Recorder(path, {"command": "drive"})
    config = RobotConfig.of(None)
    with Robot(open_link("planar", config), config, recorder=recorder) as robot:
        for number, way in enumerate(ways):
            if number:
                robot.reset(Scene())
            for linear, angular, ticks in way:
                for _ in range(ticks):
                    robot.drive(linear, angular)
    return path


JOINTS = messages.JOINT_NAMES
Bag = Sequence[tuple[str, str, int, bytes]]
"""Topic, type, time [ns] and content of each message."""


def make_bag(
    tape: Path,
    topics: Mapping[str, str],
    names: Sequence[str] = JOINTS,
    change: Callable[[str, Any], Any] = lambda topic, content: content,
) -> Bag:
    """Return what a bag of the drive would hold.

    Args:
        tape: A recording of this package.
        topics: Names of topics in the recording, and in the bag.
        names: Names of the wheels' joints.
        change: Called with a topic and its message. Returns the message that is stored.
    """
    store = messages.load_typestore()
    bag = []
    with tape.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.topic not in topics or schema is None:
                continue
            content: Any = store.deserialize_cdr(message.data, schema.name)
            if channel.topic == "/joint_states":
                content.name = list(names)
            content = change(channel.topic, content)
            kind = content.__msgtype__
            data = bytes(store.serialize_cdr(content, kind))
            bag.append((topics[channel.topic], kind, message.log_time, data))
    return sorted(bag, key=lambda message: message[2])


def without_velocities(topic: str, content: Any) -> Any:
    """Joint states with positions only, and stamped twists."""
    if topic == "/joint_states":
        content.velocity = np.zeros(0)
    if topic.startswith("/cmd_vel"):
        return messages.make_message("geometry_msgs/msg/TwistStamped", twist=content)
    return content


def write_mcap(path: Path, bag: Bag) -> Path:
    """Write an MCAP file as rosbag2 does."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "rosbag2")
        channels: dict[str, int] = {}
        for topic, kind, time, data in bag:
            if topic not in channels:
                definition = messages.define(kind)
                schema = writer.register_schema(kind, "ros2msg", definition)
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], time, data, time)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def write_folder(path: Path, bag: Bag, storage: StoragePlugin, packed: Any = None) -> Path:
    """Write a folder of rosbag2, with its metadata.yaml."""
    store = messages.load_typestore()
    writer = FolderWriter(path, version=9, storage_plugin=storage)
    if packed is not None:
        writer.set_compression(packed, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, time, data in bag:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], time, data)
    return path


PERIOD = 0.01
TICKS = 310
"""Periods of a tape: 10 at rest, then the wheels turn."""
TURNING = encode((3.0, 3.0, 3.0, 3.0))


def taped(path: Path, config: RobotConfig) -> Path:
    """The planar robot, recorded: it stands, then its wheels turn."""
    with recorded(open_link("planar", config), path, config) as link:
        link.open()
        link.reset(Scene())
        for tick in range(TICKS):
            link.write(encode(ZERO) if tick < 10 else TURNING)
            link.advance(PERIOD)
        link.close()
    return path


@contextlib.contextmanager
def recorded(link: Link, path: Path, config: RobotConfig | None = None) -> Iterator[RecordedLink]:
    """A link that is recorded inside the block."""
    with Recorder(path) as recorder:
        yield RecordedLink(link, recorder, RobotConfig.of(config))
