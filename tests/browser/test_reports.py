"""The HTML page in headless Chromium: drawn whole, without network.

`make test-browser` runs these. Set ACSAR_GYM_SHOTS to a folder to keep the pictures.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from benchmark_tools import cell, driven, result_of
from websockets.sync.client import ClientConnection, connect

from acsar_gym.tools.benchmark import report

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
TIMEOUT = 300.0
"""Longest wait for anything [s]."""
OWN = ("data:", "blob:", "chrome:", "about:", "file:", "http://127.0.0.1:")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="chromium isn't installed: apt install chromium"
)


class Tab:
    """One page. `requests` and `console` have what it has asked for and complained about."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._number = 0
        self.requests: list[str] = []
        self.console: list[str] = []

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol, and return its result."""
        self._number += 1
        request = {"id": self._number, "method": method, "params": parameters}
        self._connection.send(json.dumps(request))
        while True:
            heard = json.loads(self._connection.recv(timeout=TIMEOUT))
            if heard.get("id") == self._number:
                assert "error" not in heard, heard
                result: dict[str, Any] = heard["result"]
                return result
            self._event(heard)

    def _event(self, heard: dict[str, Any]) -> None:
        parameters = heard.get("params", {})
        if heard["method"] == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])
        elif heard["method"] == "Runtime.exceptionThrown":
            self.console.append(json.dumps(parameters["exceptionDetails"])[:2000])
        elif heard["method"] == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            entry = parameters["entry"]
            self.console.append(f"{entry['text']} {entry.get('url', '')}")
        elif heard["method"] == "Runtime.consoleAPICalled" and parameters["type"] == "error":
            self.console.append(json.dumps(parameters["args"])[:2000])

    @property
    def foreign(self) -> list[str]:
        """Requests to anything but this computer."""
        return [url for url in self.requests if not url.startswith(OWN)]

    def run(self, script: str) -> Any:
        """Evaluate JavaScript."""
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait(self, script: str, what: str) -> None:
        """Wait until JavaScript is true."""
        deadline = time.monotonic() + TIMEOUT
        while not self.run(f"Boolean({script})"):
            assert time.monotonic() < deadline, f"{what}: not within {TIMEOUT:g} s"
            time.sleep(0.1)

    def open(self, url: str, width: int, height: int) -> None:
        """Open a page in a window of this size [px]."""
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.call("Page.navigate", url=url)

    def shot(self, name: str, folder: Path) -> Path:
        """Save a picture of what is to be seen, in ACSAR_GYM_SHOTS if that is set."""
        path = Path(os.environ.get("ACSAR_GYM_SHOTS", folder)) / f"{name}.png"
        result = self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(result["data"]))
        return path


@contextlib.contextmanager
def browser(folder: Path) -> Iterator[Tab]:
    """Start a browser with a fresh profile in `folder`, which can't resolve any name."""
    command = [
        str(CHROMIUM),
        *("--headless=new", "--no-sandbox", "--hide-scrollbars", "--use-angle=swiftshader"),
        *("--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),  # Rerun's viewer needs WebGL
        *("--no-first-run", "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"),
        *("--remote-debugging-port=0", f"--user-data-dir={folder / 'profile'}", "about:blank"),
    ]

    with (folder / "chromium.log").open("w") as log:
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=log, start_new_session=True
        )
        try:
            port = _port(folder / "chromium.log")
            with connect(_tab(port), max_size=None, open_timeout=TIMEOUT) as connection:
                yield Tab(connection)
        finally:
            process.terminate()
            process.wait(TIMEOUT)


def _port(log: Path) -> str:
    """Where the browser listens."""
    deadline = time.monotonic() + TIMEOUT
    while True:
        result = re.search(r"DevTools listening on ws://(\S+?)/", log.read_text(errors="replace"))
        if result:
            return result[1]
        assert time.monotonic() < deadline, "the browser doesn't start"
        time.sleep(0.05)


def _tab(address: str) -> str:
    """The address of the browser's page."""
    from urllib.request import urlopen

    with urlopen(f"http://{address}/json", timeout=TIMEOUT) as answer:
        pages = json.load(answer)
    return next(str(page["webSocketDebuggerUrl"]) for page in pages if page["type"] == "page")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a benchmark with several agents, links and conditions."""
    scores = (0.9, 0.0, 0.5, 0.7)
    cells = {
        cell(agent, kind, seed, link, condition): driven(scores)
        for agent, kind, seed in (
            ("packaged", "learned", None),
            ("own", "learned", 0),
            ("own", "learned", 1),
            *((name, "baseline", None) for name in ("navfn", "dwa", "dwa_movers", "orca")),
        )
        for link, condition in (
            ("planar", "nominal"),
            ("bullet", "nominal"),
            ("planar", "dropped-5"),
        )
    }

    path = tmp_path_factory.mktemp("pages") / "benchmark.html"
    report.write_benchmark_page(path, result_of(cells))
    return path


@pytest.mark.parametrize("width", [1300, 1000])
def test_page_is_drawn_and_no_table_is_cut(width: int, page: Path, tmp_path: Path) -> None:
    """At 1300 pixels nothing has to be scrolled."""
    with browser(tmp_path) as tab:
        tab.open(page.as_uri(), width, 2000)
        tab.wait("document.querySelectorAll('figure svg').length >= 1", "a plot that is drawn")
        assert tab.run("[...document.querySelectorAll('td')].every(c => c.innerText != 'NaN')")
        cards = "[...document.querySelectorAll('.card')]"
        assert tab.run(f"{cards}.every(c => getComputedStyle(c).overflowX == 'auto')")
        if width == 1300:
            assert tab.run(f"{cards}.every(c => c.scrollWidth <= c.clientWidth)")
        assert tab.run("document.documentElement.scrollWidth <= innerWidth")
        shot = pytest.importorskip("PIL.Image").open(tab.shot(f"page_{width}", tmp_path))
        assert len(set(shot.convert("RGB").resize((300, 500)).getdata())) > 100
        assert (tab.console, tab.foreign) == ([], [])
