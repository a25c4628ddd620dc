"""Rerun's page of a recording, in headless Chromium.

`make test-browser` runs these. Set ACSAR_GYM_SHOTS to a folder to keep the pictures.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from browser_tools import CHROMIUM, TIMEOUT, Tab, browser
from PIL import Image
from recording_tools import drive

from acsar_gym import RobotConfig
from acsar_gym.tools.view.entities import COLOURS

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="chromium isn't installed: apt install chromium"
)
SIZE = (1400, 900)
TIME_BAR_ROW = 886
"""Row of the bar at the lower edge that stands for the time [px]."""


@contextmanager
def opened(folder: Path, *arguments: str, ending: signal.Signals = signal.SIGINT) -> Iterator[Tab]:
    """The page of `acsar-gym view`, which asks nobody else and ends in order."""
    command = [sys.executable, "-m", "acsar_gym", "view", *arguments, "--web", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            address = re.search(r"http://\S+", process.stdout.readline())
            assert address is not None
            with browser(folder) as tab:
                tab.open(address[0], *SIZE)
                tab.wait("document.querySelector('canvas.visible')", "a viewer that has started")
                yield tab
                assert tab.foreign == []
        finally:
            process.send_signal(ending)
            assert process.wait(TIMEOUT) == 0


def count_pixels(tab: Tab, folder: Path, name: str) -> int:
    """How many pixels of the page have about the colour of an entity."""
    with Image.open(tab.shot("viewer", folder)) as picture:
        distances = np.array(picture.convert("RGB"), np.int64) - COLOURS[name]
    return int((np.abs(distances).max(axis=2) < 12).sum())


def wait_for(tab: Tab, folder: Path, name: str, more_than: int) -> int:
    """Wait until there are more pixels of a colour; returns how many."""
    deadline = time.monotonic() + TIMEOUT
    while (count := count_pixels(tab, folder, name)) <= more_than:
        assert time.monotonic() < deadline, f"{count} pixels of {name}"
        time.sleep(0.5)
    return count


def press(tab: Tab, x: float, y: float) -> None:
    for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
        button = "none" if kind == "mouseMoved" else "left"
        tab.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, clickCount=1)
        time.sleep(0.3)


def test_a_recording_is_drawn_up_to_the_time_that_is_chosen(tmp_path: Path) -> None:
    path = drive(tmp_path / "tape.mcap", RobotConfig.of(None), ticks=1000)
    with opened(tmp_path, str(path)) as tab:
        wait_for(tab, tmp_path, "measured", 100)
        press(tab, 20, TIME_BAR_ROW)  # it plays: pause
        press(tab, 400, TIME_BAR_ROW)
        time.sleep(3.0)
        early = count_pixels(tab, tmp_path, "path")
        press(tab, 1100, TIME_BAR_ROW)
        wait_for(tab, tmp_path, "path", early + 100)
