"""Shows what is recorded live to Foxglove, over a WebSocket on this computer only."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any

from acsar_gym.errors import ConfigError, MissingExtraError
from acsar_gym.reading.bounded import reason
from acsar_gym.recording.encoder import Message
from acsar_gym.recording.topics import ENCODING, SCHEMA_ENCODING, TOPICS
from acsar_gym.recording.typesystem import definition

LOOPBACK = "127.0.0.1"
PORT = 8765
"""The port that viewers try first; another free one where it is taken."""


class LiveView:
    """A server that viewers connect to; messages go to whoever is connected.

    Attributes: `url`, what viewers open.

    Args:
        port: to listen on; 0 for any free one.

    Raises:
        MissingExtraError: foxglove-sdk or rosbags isn't installed.
        ConfigError: the server can't be started.
    """

    def __init__(self, port: int = PORT) -> None:
        try:
            import foxglove  # noqa: PLC0415 - optional
        except ImportError:
            raise MissingExtraError("a live view", "view") from None
        self._context = context = foxglove.Context()  # nothing else keeps it
        self._channels = {
            topic.name: foxglove.Channel(
                topic.name,
                schema=foxglove.Schema(
                    name=topic.kind, encoding=SCHEMA_ENCODING, data=definition(topic.kind)
                ),
                message_encoding=ENCODING,
                context=context,
                metadata=topic.metadata,
            )
            for topic in TOPICS
        }
        self._latched: dict[str, Message] = {}
        self._server = _started(foxglove, context, port)
        self.url = f"ws://{LOOPBACK}:{self._server.port}"

    def add(self, message: Message) -> None:
        """Send a message to the viewers."""
        if message.topic.latched:
            self._latched[message.topic.name] = message
        self._send(message)

    def flush(self) -> None:
        """Send again what viewers need that connected later."""
        for message in self._latched.values():
            self._send(message)

    def _send(self, message: Message) -> None:
        self._channels[message.topic.name].log(message.data, log_time=message.time)

    def close(self, end: Mapping[str, Any]) -> None:
        """Stop the server."""
        self.abandon()

    def abandon(self) -> None:
        """Stop the server."""
        with contextlib.suppress(Exception):
            self._server.stop()
            for channel in self._channels.values():
                channel.close()


def _started(foxglove: Any, context: Any, port: int) -> Any:
    """Start the server, on another port where this one is taken."""
    for number in dict.fromkeys((port, 0)):
        try:
            return foxglove.start_server(
                name="acsar_gym", host=LOOPBACK, port=number, context=context
            )
        except Exception as error:  # noqa: BLE001 - whatever the SDK raises
            problem = error
    raise ConfigError(f"no live view: {reason(problem)}") from None
