"""Finds the recording that `acsar-gym view` is asked for, and serves its page on loopback."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from acsar_gym.errors import ConfigError, LinkError, require_extra, shorten_text
from acsar_gym.guard import estop
from acsar_gym.links.factory import is_device
from acsar_gym.physics.bodies import BODIES
from acsar_gym.reading import explain_error
from acsar_gym.tools.view.session import Session

PAGE_HOST = "127.0.0.1"
PAGE_PORT = 8050
MAX_PORT = 65_535
RECORD_HINT = "start it with --record FILE"


def find_recording(source: str) -> Path:
    """Return the recording that is meant.

    Args:
        source: a recording, or the device of a robot that a program on this computer drives.

    Raises:
        LinkError: nobody drives that robot, or doesn't record it.
        ConfigError: it is a simulated link, which only its recording shows.
    """
    if source in BODIES:
        simulated = f"{source} is simulated by the program that drives it"
        raise ConfigError(f"{simulated}: {RECORD_HINT}, and view that file")
    if source == "serial":
        raise ConfigError("serial: name the device, which 'acsar-gym estop --list' tells")
    path = Path(source.removeprefix("replay:"))
    if not is_device(source) or path.suffix == ".mcap" or path.is_file() or path.is_dir():
        return path
    real, where = os.path.realpath(source), shorten_text(source)
    known = estop.list_drivers()
    found = [one for one in known if one.device and os.path.realpath(one.device) == real]
    silent = [str(one.process) for one in known if not one.device]
    if found and found[0].recording:
        return Path(found[0].recording)
    if found:
        process = f"process {found[0].process}"
        raise LinkError(f"{where}: {process} drives it without a recording", RECORD_HINT)
    if silent:
        raise LinkError(
            f"{where}: process {silent[0]} drives a robot, but doesn't answer",
            "name the file that it records to",
        )
    raise LinkError(f"{where}: no program of yours on this computer drives it", RECORD_HINT)


@contextlib.contextmanager
def serve_page(path: Path, port: int = PAGE_PORT, over: Path | None = None) -> Iterator[Any]:
    """Make a server of the dashboard, as a context manager.

    Args:
        path: of the recording.
        port: to listen on, on this computer only; 0 for any free one.
        over: another recording, which is drawn over it.

    Yields:
        A werkzeug server, with `port` and `serve_forever()`.

    Raises:
        MissingExtraError: dash isn't installed.
        ConfigError: the recording can't be read, or the port can't be used.
    """
    session = Session(path, over)
    with require_extra("the dashboard", "dashboard"):
        from werkzeug.serving import WSGIRequestHandler, make_server  # noqa: PLC0415 - optional

        from acsar_gym.tools.view.app import make_app  # noqa: PLC0415 - optional

    class QuietHandler(WSGIRequestHandler):
        """Answers without a line on the terminal for each request."""

        def log_request(self, code: int | str = "-", size: int | str = "-") -> None:
            """Do nothing."""

    if not 0 <= port <= MAX_PORT:
        raise ConfigError(f"--port {port}: must be 0 to {MAX_PORT}")
    try:
        listener = socket.create_server((PAGE_HOST, port))
    except OSError as error:
        why = f"can't be used on {PAGE_HOST}: {explain_error(error)}; 0 takes any free one"
        raise ConfigError(f"--port {port}: {why}") from error
    with listener:
        server = make_server(
            PAGE_HOST,
            listener.getsockname()[1],
            make_app(session).server,
            threaded=True,
            request_handler=QuietHandler,
            fd=listener.fileno(),
        )
        try:
            yield server
        finally:
            server.server_close()
            session.close()
