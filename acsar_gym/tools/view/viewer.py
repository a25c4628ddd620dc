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
import urllib.request
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.reading import explain_error

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


class Viewer:
    """A running viewer: a window, or for a port, a page whose data has the next port.

    Attributes: `address`, for `RecordingStream.connect_grpc`; `url`, of the page, "" for a window.
    Its settings are in an empty folder, so that its analytics are off whatever the user's say.
    """

    def __init__(self, folder: Path, port: int | None) -> None:
        program = find_rerun()
        homes = {"XDG_CONFIG_HOME": str(folder), "XDG_DATA_HOME": str(folder)}
        environment = {**os.environ, **homes, "RUST_LOG": "error"}
        options: dict[str, Any] = {"env": environment, "stdout": subprocess.DEVNULL}
        subprocess.run(
            [program, "analytics", "disable"], check=False, stderr=subprocess.DEVNULL, **options
        )
        data_port = _find_port(port + 1 if port else 0)
        command = [program, "--bind", HOST, "--port", str(data_port)]
        self.url = ""
        self._server: ThreadingHTTPServer | None = None
        if port is None:
            command.append("--expect-data-soon")
        else:
            files_port = _find_port(0)
            command += ["--serve-web", "--web-viewer-port", str(files_port)]
            self._server = _serve_page(port, files_port, data_port)
            self.url = f"http://{HOST}:{self._server.server_address[1]}"
        self.address = f"rerun+http://{HOST}:{data_port}/proxy"
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process
        self._process = subprocess.Popen(
            command, start_new_session=True, stderr=self._log, **options
        )
        try:
            self._wait_for(data_port)
        except BaseException:
            self.close()
            raise

    def _wait_for(self, port: int) -> None:
        """Wait until data can be sent."""
        for _ in range(int(START_TIMEOUT / 0.1)):
            if self._process.poll() is not None:
                self._log.seek(0)
                text = self._log.read().decode(errors="replace").strip().splitlines() or ["?"]
                raise ConfigError(
                    f"the viewer doesn't start: {text[-1][:200]}: use --web for a browser, "
                    "or --save FILE.rrd"
                )
            with contextlib.suppress(OSError), socket.create_connection((HOST, port), 1.0):
                return
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(0.1)
        raise ConfigError(f"the viewer doesn't start within {START_TIMEOUT:g} s")

    @property
    def is_open(self) -> bool:
        """Whether nobody has closed its window."""
        return self._process.poll() is None

    def close(self) -> None:
        """End it; idempotent."""
        self._process.terminate()
        self._process.wait()
        self._log.close()
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()


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


@contextlib.contextmanager
def open_viewer(port: int | None) -> Iterator[Viewer]:
    """Open a viewer, as a context manager; see `Viewer`."""
    with tempfile.TemporaryDirectory(prefix="acsar-view-") as folder:
        viewer = Viewer(Path(folder), port)
        try:
            yield viewer
        finally:
            viewer.close()


def merge_files(parts: list[Path], path: Path) -> None:
    """Make one .rrd file of those of several episodes."""
    if len(parts) == 1:
        shutil.move(parts[0], path)
        return
    command = [find_rerun(), "rrd", "merge", *map(str, parts), "-o", str(path)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        raise ConfigError(f"{path}: can't be written: {done.stderr.strip()[-200:]}")
