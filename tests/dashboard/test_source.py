"""Which recording is meant, and the stop of the process that makes it."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from acsar_gym.cli import app
from acsar_gym.dashboard import stopping
from acsar_gym.dashboard.server import served
from acsar_gym.dashboard.source import recording_of
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.safety.estop import StopListener

pytestmark = [pytest.mark.xdist_group("serial"), pytest.mark.usefixtures("deadline")]


@pytest.fixture(autouse=True)
def place(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of this test alone; paths of sockets must be short."""
    with tempfile.TemporaryDirectory(prefix="acsar-", dir="/tmp") as base:
        monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", base)
        yield Path(base)


@pytest.fixture
def driving() -> Iterator[list[str]]:
    """This process as a driver of /dev/ttyX that records; the list gets its stops."""
    listener, stops = StopListener("/dev/ttyX", "rover", "/data/a b\tc.mcap"), list[str]()
    over = threading.Event()

    def loop() -> None:
        while not over.wait(0.001):
            if listener.is_requested():
                stops.append("zero")
                listener.confirm()

    thread = threading.Thread(target=loop)
    thread.start()
    yield stops
    over.set()
    thread.join()
    listener.close()


def test_a_device_is_the_recording_of_whoever_drives_it(driving: list[str]) -> None:
    assert recording_of("/dev/ttyX") == Path("/data/a b\tc.mcap")
    with pytest.raises(LinkError, match="no program of yours on this computer drives it: start"):
        recording_of("/dev/ttyY")
    assert driving == []


def test_a_driver_that_records_nothing_is_named() -> None:
    listener = StopListener("/dev/ttyX")
    over = threading.Event()

    def loop() -> None:
        while not over.wait(0.001):
            listener.is_requested()

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        with pytest.raises(LinkError, match=f"process {os.getpid()} drives it without a recording"):
            recording_of("/dev/ttyX")
    finally:
        over.set()
        thread.join()
        listener.close()


def test_files_are_themselves_and_simulations_need_one() -> None:
    assert recording_of("drive.mcap") == Path("drive.mcap")
    assert recording_of("replay:drive.mcap") == Path("drive.mcap")
    with pytest.raises(ConfigError, match="planar is simulated by the program that drives it"):
        recording_of("planar")


def test_stopped_means_that_the_control_loop_said_so(driving: list[str]) -> None:
    assert stopping.can_stop(os.getpid())
    found = stopping.stop(os.getpid())
    assert found.state == "stopped"
    assert found.said.startswith("zero is on the wire")
    assert driving == ["zero"]


def test_without_a_driver_nothing_is_called_stopped() -> None:
    assert not stopping.can_stop(os.getpid())
    assert not stopping.can_stop(0)
    assert stopping.stop(os.getpid()).state == "nobody"
    assert stopping.stop(0).state == "nobody"


def test_a_driver_that_hangs_is_not_called_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("acsar_gym.safety.estop.ANSWER", 0.05)
    listener = StopListener("/dev/ttyX")
    try:
        found = stopping.stop(os.getpid())
    finally:
        listener.close()
    assert found.state == "unanswered"
    assert "watchdog" in found.said


def test_the_page_is_on_loopback_and_a_port_in_use_is_told(tape: Path) -> None:
    with served(tape, port=0) as server:
        assert server.server_address[0] == "127.0.0.1"
        with pytest.raises(ConfigError, match=f"--port {server.port}: can't be used on 127.0.0.1"):
            served(tape, server.port).__enter__()
    for port in (-1, 70_000):
        with pytest.raises(ConfigError, match=f"--port {port}: must be 0 to 65535"):
            served(tape, port).__enter__()


@pytest.mark.parametrize(
    ("source", "code", "said"),
    [
        ("nothing.mcap", 2, "nothing.mcap: there is no such file"),
        ("/dev/ttyNONE", 3, "no program of yours on this computer drives it"),
        ("bullet", 2, "bullet is simulated"),
    ],
)
def test_the_command_says_what_is_wrong_in_one_line(
    source: str,
    code: int,
    said: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("sys.argv", ["acsar-gym", "view", source])
    with pytest.raises(SystemExit) as ended:
        app.main()
    out, error = capsys.readouterr()
    assert (ended.value.code, out) == (code, "")
    assert error.startswith("acsar-gym: ")
    assert said in error
    assert error.count("\n") == 1
