"""The definitions of ROS 2 messages, from the library rosbags."""

from __future__ import annotations

from functools import cache
from typing import Any

from acsar_gym.errors import MissingExtraError


@cache
def store() -> Any:
    """Return the messages of ROS 2 Humble; MissingExtraError without rosbags."""
    try:
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - optional
    except ImportError:
        raise MissingExtraError("recording", "record") from None
    return get_typestore(Stores.ROS2_HUMBLE)


def make(kind: str, **fields: Any) -> Any:
    """Make a message, such as "std_msgs/msg/Header"."""
    return store().types[kind](**fields)


def packed(message: Any) -> bytes:
    """Serialise a message in CDR."""
    return bytes(store().serialize_cdr(message, message.__msgtype__))


def definition(kind: str) -> bytes:
    """Return the definition of a type and of all types in it."""
    text: str = store().generate_msgdef(kind, ros_version=2)[0]
    return text.encode()


def time_of(nanoseconds: int) -> Any:
    """Return a builtin_interfaces/Time."""
    seconds, rest = divmod(nanoseconds, 1_000_000_000)
    return make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)


def header(nanoseconds: int, frame: str = "") -> Any:
    """Return a std_msgs/Header."""
    return make("std_msgs/msg/Header", stamp=time_of(nanoseconds), frame_id=frame)
