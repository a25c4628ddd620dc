"""Makes ROS 2 bags of recordings, as another robot's computer would record them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.rosbag2 import CompressionFormat, StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter

from acsar_gym.recording import messages

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
