"""Rerun's viewer: as a window, as a page on this computer only, or a file instead."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import socket
import subprocess
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import IO, Any, NamedTuple

from acsar_gym.errors import ConfigError, explain_error, require_extra

HOST = "127.0.0.1"
CONTENT_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    f"connect-src 'self' http://{HOST}:{{port}}"
)
"""What a browser may load for the page: nothing from elsewhere."""
FOREIGN_LINKS = re.compile(rb"<link\b[^>]*https://[^>]*>")
START_TIMEOUT = 60.0


def find_rerun() -> str:
    """Return the path of Rerun's program; MissingExtraError where it isn't installed."""
    with require_extra("the viewer", "view"):
        import rerun_cli  # noqa: PLC0415 - optional
    names = ("rerun.exe", "rerun", "Rerun.app/Contents/MacOS/Rerun")
    folder = Path(rerun_cli.__path__[0])
    return str(next((folder / name for name in names if (folder / name).is_file()), "rerun"))


class Viewer(NamedTuple):
    """A running viewer."""

    address: str
    """For `RecordingStream.connect_grpc`."""
    url: str
    """Of its page; "" for a window."""
    process: subprocess.Popen[bytes]


@contextlib.contextmanager
def open_viewer(port: int | None) -> Iterator[Viewer]:
    """Open a window, or for a port a page, whose data has the next port; closes it afterwards.

    Its settings are in an empty folder, so that its analytics are off whatever the user's say.
    """
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="acsar-view-"))
        log = stack.enter_context(tempfile.TemporaryFile())
        homes = {"XDG_CONFIG_HOME": folder, "XDG_DATA_HOME": folder}
        environment = {**os.environ, **homes, "RUST_LOG": "error"}
        options: dict[str, Any] = {"env": environment, "stdout": subprocess.DEVNULL, "stderr": log}
        program = find_rerun()
        subprocess.run([program, "analytics", "disable"], check=False, **options)
        data_port = _find_port(port + 1 if port else 0)
        command = [program, "--bind", HOST, "--port", str(data_port)]
        url = ""
        if port is None:
            command.append("--expect-data-soon")
        else:
            files_port = _find_port(0)
            command += ["--serve-web", "--web-viewer-port", str(files_port)]
            server = _serve_page(port, files_port, data_port)
            stack.callback(server.server_close)
            stack.callback(server.shutdown)
            url = f"http://{HOST}:{server.server_address[1]}"
        process = subprocess.Popen(command, start_new_session=True, **options)
        stack.callback(process.wait)
        stack.callback(process.terminate)
        _wait_for(process, data_port, log)
        yield Viewer(f"rerun+http://{HOST}:{data_port}/proxy", url, process)


def _wait_for(process: subprocess.Popen[bytes], port: int, log: IO[bytes]) -> None:
    """Wait until data can be sent to a viewer."""
    deadline = time.monotonic() + START_TIMEOUT
    while process.poll() is None and time.monotonic() < deadline:
        with contextlib.suppress(OSError), socket.create_connection((HOST, port), 1.0):
            return
        time.sleep(0.1)
    log.seek(0)
    lines = log.read().decode(errors="replace").strip().splitlines()
    why = lines[-1][:200] if lines else f"not within {START_TIMEOUT:g} s"
    raise ConfigError(
        f"the viewer doesn't start: {why}: use --web for a browser, or --save FILE.rrd"
    )


@contextlib.contextmanager
def _explain_port(port: int) -> Iterator[None]:
    """Say which port can't be used."""
    if not 0 <= port < 2**16:
        raise ConfigError(f"--port {port}: must be 0 to {2**16 - 2}")
    try:
        yield
    except OSError as error:
        why = f"can't be used on {HOST}: {explain_error(error)}; 0 takes any free one"
        raise ConfigError(f"--port {port}: {why}") from error


def _find_port(port: int) -> int:
    """The port, or a free one for 0; ConfigError where it can't be used."""
    with _explain_port(port), socket.create_server((HOST, port)) as listener:
        return int(listener.getsockname()[1])


def _serve_page(port: int, files_port: int, data_port: int) -> ThreadingHTTPServer:
    """Serve the viewer's page, whose browser asks nobody else: for fonts, updates, analytics."""
    page = f"/?url=rerun%2Bhttp://{HOST}:{data_port}/proxy&persist=false&hide_welcome_screen"
    policy = CONTENT_POLICY.format(port=data_port)

    class PageHandler(BaseHTTPRequestHandler):
        """Passes on the viewer's files."""

        def do_GET(self) -> None:
            """Send a file of the viewer, under a policy of this package."""
            if self.path == "/":
                self.send_response(302)
                self.send_header("Location", page)
                self.end_headers()
                return
            try:
                address = f"http://{HOST}:{files_port}{self.path}"
                with urllib.request.urlopen(address) as answer:
                    kind, body = answer.headers["Content-Type"], answer.read()
            except OSError:
                self.send_error(404)
                return
            if kind.startswith("text/html"):
                body = FOREIGN_LINKS.sub(b"", body)
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Content-Security-Policy", policy)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: Any) -> None:
            """Print nothing."""

    with _explain_port(port):
        server = ThreadingHTTPServer((HOST, port), PageHandler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server


def merge_files(parts: list[Path], path: Path) -> None:
    """Make one .rrd file of those of several episodes."""
    if len(parts) == 1:
        shutil.move(parts[0], path)
        return
    command = [find_rerun(), "rrd", "merge", *map(str, parts), "-o", str(path)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        raise ConfigError(f"{path}: can't be written: {done.stderr.strip()[-200:]}")
