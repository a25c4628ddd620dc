"""Measures the time from a click on the dashboard's stop button until the board has zero.

The board is emulated, and notes when it reads each byte; the browser is headless Chromium.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
from pathlib import Path

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).parents[1]))

import serial_tools
from browser.test_dashboard import DRAWN, DRIVING, PATIENCE, WIDE
from browser_tools import Tab, browser
from serial_tools import Emulated, program, start, wait_until

from acsar_gym import RobotConfig
from acsar_gym.protocol import ZERO, Decoder
from acsar_gym.tools.view.server import serve_page

PATIENT = RobotConfig.preset("acsar").with_(
    connect_timeout=20.0, feedback_timeout=5.0, watchdog_timeout=2.0
)
"""The ACSAR robot, on a computer that also has a browser to run."""


def zero_after(emulated: Emulated, moment: float) -> float:
    """When the board got its first zero command after a moment of the monotonic clock [s]."""
    decoder = Decoder()
    for event in emulated.events():
        for reading in decoder.feed(event.get("rx", "").encode("latin-1")):
            if reading.speeds == ZERO and event["t"] > moment:
                return float(event["t"])
    raise AssertionError("no zero")


def trial(tab: Tab, folder: Path) -> float:
    """One run that is stopped by a click; time from the click to zero [s]."""
    emulated = start(folder / "board.jsonl")
    path = folder / "live.mcap"
    robot = folder / "robot.yaml"
    robot.write_text(yaml.safe_dump(PATIENT.model_dump()), encoding="utf-8")
    options = ("--link", emulated.device, "--linear", "0.2", "--record", str(path))
    try:
        with program(DRIVING, "drive", *options, "--robot", str(robot)) as process:
            wait_until(emulated.is_driven, "a command that turns the wheels")
            with serve_page(path, 0) as server:
                threading.Thread(target=server.serve_forever, daemon=True).start()
                clicked = clicked_on(tab, f"http://127.0.0.1:{server.port}")
                server.shutdown()
            process.wait(PATIENCE)
            return zero_after(emulated, clicked) - clicked
    finally:
        emulated.end()


def clicked_on(tab: Tab, url: str) -> float:
    """Open the page of a live run and press; the moment just before, of the monotonic clock [s]."""
    tab.open(url, *WIDE)
    tab.wait(DRAWN, "a page that is drawn")
    clicked = tab.press("#stop")
    tab.wait("document.querySelector('#stop-said').innerText", "an answer")
    said = tab.text("#stop-said")
    assert said.startswith("zero is on the wire"), said
    tab.call("Page.navigate", url="about:blank")
    return clicked


def main() -> None:
    """Print the times of some trials."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=10)
    trials = parser.parse_args().trials
    serial_tools.TIMEOUT = PATIENCE
    times = []
    with tempfile.TemporaryDirectory() as profile, browser(Path(profile)) as tab:
        for _ in range(trials):
            with tempfile.TemporaryDirectory() as folder:
                times.append(trial(tab, Path(folder)) * 1e3)
                print(f"{times[-1]:.0f} ms", flush=True)
    print(f"{trials} clicks: median {np.median(times):.0f} ms, worst {max(times):.0f} ms")


if __name__ == "__main__":
    main()
