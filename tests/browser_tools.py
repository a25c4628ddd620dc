"""Headless Chromium over its own protocol: open a page, click, read, look at what it asked for."""

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

from websockets.sync.client import ClientConnection, connect

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
TIMEOUT = 300.0
"""Longest wait for anything [s]."""
OWN = ("data:", "blob:", "chrome:", "about:", "file:", "http://127.0.0.1:")


class Tab:
    """One page; `requests` and `console` have what it has asked for and complained about."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._number = 0
        self.requests: list[str] = []
        self.console: list[str] = []

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol, and return its result."""
        self._number += 1
        told = {"id": self._number, "method": method, "params": parameters}
        self._connection.send(json.dumps(told))
        while True:
            heard = json.loads(self._connection.recv(timeout=TIMEOUT))
            if heard.get("id") == self._number:
                assert "error" not in heard, heard
                found: dict[str, Any] = heard["result"]
                return found
            self._event(heard)

    def _event(self, heard: dict[str, Any]) -> None:
        told = heard.get("params", {})
        if heard["method"] == "Network.requestWillBeSent":
            self.requests.append(told["request"]["url"])
        elif heard["method"] == "Runtime.exceptionThrown":
            self.console.append(json.dumps(told["exceptionDetails"])[:2000])
        elif heard["method"] == "Log.entryAdded" and told["entry"]["level"] == "error":
            self.console.append(f"{told['entry']['text']} {told['entry'].get('url', '')}")
        elif heard["method"] == "Runtime.consoleAPICalled" and told["type"] == "error":
            self.console.append(json.dumps(told["args"])[:2000])

    @property
    def foreign(self) -> list[str]:
        """Requests to anything but this computer."""
        return [url for url in self.requests if not url.startswith(OWN)]

    def run(self, script: str) -> Any:
        """Evaluate JavaScript."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def text(self, selector: str) -> str:
        """The text of an element; empty where there is none."""
        found = self.run(f"(document.querySelector({selector!r}) || {{}}).innerText || ''")
        return str(found)

    def press(self, selector: str) -> float:
        """Press the mouse on an element; the moment just before, of the monotonic clock [s]."""
        box = f"document.querySelector({selector!r}).getBoundingClientRect()"
        x, y = self.run(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({box})")
        where = {"x": x, "y": y, "button": "left", "clickCount": 1}
        moment = time.monotonic()
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, **where)
        return moment

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
        found = self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(found["data"]))
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
        found = re.search(r"DevTools listening on ws://(\S+?)/", log.read_text(errors="replace"))
        if found:
            return found[1]
        assert time.monotonic() < deadline, "the browser doesn't start"
        time.sleep(0.05)


def _tab(address: str) -> str:
    """The address of the browser's page."""
    from urllib.request import urlopen

    with urlopen(f"http://{address}/json", timeout=TIMEOUT) as answer:
        pages = json.load(answer)
    return next(str(one["webSocketDebuggerUrl"]) for one in pages if one["type"] == "page")
