"""Finds the recording that is asked for, and serves its page on loopback."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from acsar_gym import reading
from acsar_gym.errors import ConfigError, LinkError, MissingExtraError, shorten_text
from acsar_gym.links.factory import is_device
from acsar_gym.safety import estop
from acsar_gym.tools.view.session import Session

PAGE_HOST = "127.0.0.1"
PAGE_PORT = 8050
MAX_PORT = 65_535


@contextlib.contextmanager
def serve_page(path: Path, port: int = PAGE_PORT) -> Iterator[Any]:
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

        from acsar_gym.tools.view.app import make_app  # noqa: PLC0415 - optional
    except ImportError:
        raise MissingExtraError("the dashboard", "dashboard") from None

    class Quiet(WSGIRequestHandler):
        """Answers without a line on the terminal for each request."""

        def log_request(self, code: int | str = "-", size: int | str = "-") -> None:
            """Do nothing."""

    with _listening(port) as listener:
        number = listener.getsockname()[1]
        app = make_app(session).server
        server = make_server(
            PAGE_HOST, number, app, threaded=True, request_handler=Quiet, fd=listener.fileno()
        )
        try:
            yield server
        finally:
            server.server_close()


def _listening(port: int) -> socket.socket:
    """Return a socket that listens; ConfigError where the port can't be used."""
    if not 0 <= port <= MAX_PORT:
        raise ConfigError(f"--port {port}: must be 0 to {MAX_PORT}")
    try:
        return socket.create_server((PAGE_HOST, port))
    except OSError as error:
        raise ConfigError(
            f"--port {port}: can't be used on {PAGE_HOST}: {reading.explain_error(error)}; "
            "0 takes any free one"
        ) from None


RECORD_HINT = "start it with --record FILE"


def find_recording(source: str) -> Path:
    """Return the recording that is meant.

    Args:
        source: a recording, or the device of a robot that a program on this computer drives.

    Raises:
        LinkError: nobody drives that robot, or doesn't record it.
        ConfigError: it is a simulated link, which only its recording shows.
    """
    if source in ("bullet", "planar"):
        raise ConfigError(
            f"{source} is simulated by the program that drives it: {RECORD_HINT}, and "
            "view that file"
        )
    if source == "serial":
        raise ConfigError("serial: name the device, which 'acsar-gym estop --list' tells")
    path = Path(source.removeprefix("replay:"))
    is_file = path.suffix == ".mcap" or path.is_file() or path.is_dir()
    return _driven(source) if is_device(source) and not is_file else path


def _driven(device: str) -> Path:
    """Return the file that the driver of a device records to."""
    real = os.path.realpath(device)
    known = estop.list_drivers()
    found = [one for one in known if one.device and os.path.realpath(one.device) == real]
    silent = [str(one.process) for one in known if not one.device]
    where = shorten_text(device)
    if found and found[0].recording:
        return Path(found[0].recording)
    if found:
        raise LinkError(
            f"{where}: process {found[0].process} drives it without a recording", RECORD_HINT
        )
    if silent:
        raise LinkError(
            f"{where}: process {silent[0]} drives a robot, but doesn't answer",
            "name the file that it records to",
        )
    raise LinkError(f"{where}: no program of yours on this computer drives it", RECORD_HINT)
