"""Serves the page on loopback."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from acsar_gym.dashboard.session import Session
from acsar_gym.errors import ConfigError, MissingExtraError
from acsar_gym.reading import bounded

LOOPBACK = "127.0.0.1"
PORT = 8050
MOST_PORT = 65_535


@contextlib.contextmanager
def served(path: Path, port: int = PORT) -> Iterator[Any]:
    """Make a server of the dashboard, as a context manager.

    Args:
        path: of the recording.
        port: to listen on, on this computer only; 0 for any free one.

    Yields:
        A werkzeug server, with `port` and `serve_forever()`.

    Raises:
        MissingExtraError: dash isn't installed.
        ConfigError: the recording can't be read, or the port can't be used.
    """
    session = Session(path)
    try:
        from werkzeug.serving import WSGIRequestHandler, make_server  # noqa: PLC0415 - optional

        from acsar_gym.dashboard.app import made  # noqa: PLC0415 - optional
    except ImportError:
        raise MissingExtraError("the dashboard", "dashboard") from None

    class Quiet(WSGIRequestHandler):
        """Answers without a line on the terminal for each request."""

        def log_request(self, code: int | str = "-", size: int | str = "-") -> None:
            """Do nothing."""

    with _listening(port) as listener:
        number = listener.getsockname()[1]
        app = made(session).server
        server = make_server(
            LOOPBACK, number, app, threaded=True, request_handler=Quiet, fd=listener.fileno()
        )
        try:
            yield server
        finally:
            server.server_close()


def _listening(port: int) -> socket.socket:
    """Return a socket that listens; ConfigError where the port can't be used."""
    if not 0 <= port <= MOST_PORT:
        raise ConfigError(f"--port {port}: must be 0 to {MOST_PORT}")
    try:
        return socket.create_server((LOOPBACK, port))
    except OSError as error:
        raise ConfigError(
            f"--port {port}: can't be used on {LOOPBACK}: {bounded.reason(error)}; "
            "0 takes any free one"
        ) from None
