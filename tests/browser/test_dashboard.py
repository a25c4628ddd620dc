"""The dashboard in headless Chromium: a recording, and a robot that is stopped by its button.

`make test-browser` runs these. Set ACSAR_GYM_SHOTS to a folder to keep the pictures.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import serial_tools
from browser_tools import CHROMIUM, Tab, browser
from recording_tools import drive
from serial_tools import Emulated, RobotFile, program, wait_until

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.recording import Recorder
from acsar_gym.tools.view.server import find_recording, serve_page

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="chromium isn't installed: apt install chromium"),
]
DRIVING = """
import sys
from acsar_gym.tools.cli import main
sys.argv = ["acsar-gym", *sys.argv[1:]]
main()
"""
DRAWN = """['top', 'wheels', 'lateness'].every(name => {
  const graph = document.querySelector(`#${name} .js-plotly-plot`);
  return graph && graph.data && graph.data.length > 2;
}) && document.querySelector('#value-time').innerText != '\\u2013'"""
NOTE_WHAT_IT_SAYS = """said = []; button = document.querySelector('#stop');
new MutationObserver(() => said.push(button.innerText)).observe(
  button, {childList: true, characterData: true, subtree: true}); 0"""
PATIENCE = 300.0
"""Longest wait of this module for other programs [s]: a browser may need all of the computer."""
WIDE, NARROW = (1280, 940), (420, 1750)


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_tools, "TIMEOUT", PATIENCE)


@contextmanager
def serving(path: Path, port: int, over: Path | None = None) -> Iterator[int]:
    """The server of a page; yields its port."""
    with serve_page(path, port, over) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield server.port
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def opened(
    path: Path, folder: Path, size: tuple[int, int] = WIDE, over: Path | None = None
) -> Iterator[Tab]:
    """The page of a recording, once it is drawn."""
    with serving(path, 0, over) as port, browser(folder) as tab:
        tab.open(f"http://127.0.0.1:{port}", *size)
        tab.wait(DRAWN, "a page that is drawn")
        yield tab
        assert tab.foreign == []
        assert tab.console == []


@pytest.mark.parametrize("size", [WIDE, NARROW])
def test_a_recording_is_drawn_and_played(tmp_path: Path, size: tuple[int, int]) -> None:
    path = drive(tmp_path / "tape.mcap", RobotConfig.of(None), ticks=300)
    with opened(path, tmp_path, size) as tab:
        assert tab.text("#state") == "recorded"
        assert tab.run("getComputedStyle(document.querySelector('#stop')).display") == "none"
        assert tab.run("document.documentElement.scrollWidth <= innerWidth")
        tab.run("document.querySelector('#play').click()")
        tab.wait("parseFloat(document.querySelector('#value-time').innerText) > 0.5", "playing")
        tab.wait("document.querySelector('#play').innerText == 'Play'", "the end")
        assert float(tab.text("#value-time")) > 2.9
        tab.shot(f"dashboard_recorded_{size[0]}", tmp_path)


@pytest.mark.parametrize("size", [(1280, 1500), (420, 2900)])
def test_overlay_log_and_camera_follow_the_shown_time(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    pytest.importorskip("pybullet")
    config = RobotConfig.of(None)
    path = drive(tmp_path / "tape.mcap", config, ticks=300)
    other = config.model_copy(update={"wheel_radius": 0.06})
    over = drive(tmp_path / "other.mcap", other, ticks=250)
    with opened(path, tmp_path, size, over) as tab:
        assert not any("/camera/" in one for one in tab.requests)  # nobody looks
        tab.run("document.querySelector('#camera').open = true")
        picture = "document.querySelector('#camera-picture')"
        tab.wait(f"{picture}.naturalWidth == 480", "the first picture")
        assert tab.text("#camera-said") == ""
        first = tab.run(f"{picture}.src")
        tab.press("#log li.later button")
        tab.wait("parseFloat(document.querySelector('#value-time').innerText) > 2.9", "the line")
        assert not tab.run("document.querySelector('#log .later')")
        assert " cm, " in tab.text("#value-gap")
        tab.wait(f"{picture}.src != '{first}' && {picture}.naturalWidth == 480", "the next one")
        assert tab.run("document.documentElement.scrollWidth <= innerWidth")
        tab.shot(f"dashboard_overlay_{size[0]}", tmp_path)


def test_a_run_that_replaces_the_file_is_followed_by_itself(tmp_path: Path) -> None:
    path, config = tmp_path / "tape.mcap", RobotConfig.of(None)
    drive(path, config)
    over = threading.Event()

    def drive_slowly() -> None:
        recorder = Recorder(path)
        with Robot(open_link("planar", config), config, [], recorder) as robot:
            while not over.wait(config.period):
                robot.drive(0.2, 0.1)

    with opened(path, tmp_path) as tab:
        thread = threading.Thread(target=drive_slowly)
        thread.start()
        try:
            tab.wait("document.querySelector('#state').innerText == 'live'", "the new run")
            tab.wait("parseFloat(document.querySelector('#value-time').innerText) > 1", "following")
            assert tab.text("#play") == "Pause"
        finally:
            over.set()
            thread.join()
        tab.wait("document.querySelector('#state').innerText == 'ended'", "the end")
        tab.wait("document.querySelector('#play').innerText == 'Play'", "the end of following")


def test_the_stop_button_stops_a_robot_that_another_process_drives(
    own_emulator: Emulated, robot_file: RobotFile, tmp_path: Path
) -> None:
    path, device = tmp_path / "live.mcap", own_emulator.device
    options = ("--link", device, "--linear", "0.2", "--angular", "0.3", "--record", str(path))
    with program(DRIVING, "drive", *options, "--robot", str(robot_file())) as process:
        wait_until(own_emulator.is_driven, "a command that turns the wheels")
        assert find_recording(device) == path
        with opened(path, tmp_path) as tab:
            assert tab.text("#state") == "live"
            assert float(tab.text("#value-linear_sent")) == pytest.approx(0.2)
            tab.shot("dashboard_live", tmp_path)
            tab.run(NOTE_WHAT_IT_SAYS)
            assert own_emulator.is_driven()
            tab.press("#stop")
            tab.wait("document.querySelector('#stop-said').innerText", "an answer")
            assert tab.text("#stop-said").startswith("zero is on the wire")
            assert tab.run("said")[0].startswith("Stopping")
            assert own_emulator.is_stopped()
            tab.wait("document.querySelector('#state').innerText == 'stopped'", "the state")
            process.wait(PATIENCE)
            tab.wait("document.querySelector('#message').innerText", "what ended it")
            tab.shot("dashboard_stopped", tmp_path)
    assert process.returncode == 3


def test_a_page_whose_server_is_gone_says_so_and_comes_back(tmp_path: Path) -> None:
    path = drive(tmp_path / "tape.mcap", RobotConfig.of(None))
    with browser(tmp_path) as tab:
        with serving(path, 0) as port:
            tab.open(f"http://127.0.0.1:{port}", *WIDE)
            tab.wait(DRAWN, "a page that is drawn")
            tab.wait("performance.getEntriesByName(location + 'alive').length", "a first question")
        tab.wait("document.body.classList.contains('lost')", "what is wrong")
        tab.run("document.querySelector('#stop').click()")
        tab.wait("document.querySelector('#stop-said').innerText", "an answer")
        assert "run acsar-gym estop" in tab.text("#stop-said")
        with serving(path, port):
            tab.wait(f"!document.querySelector('.lost') && {DRAWN}", "the page again")
            assert tab.text("#stop-said") == ""
