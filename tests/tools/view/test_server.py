"""Which recording is meant, and the stop of the process that makes it."""

from __future__ import annotations

import os
import socket
import tempfile
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from recording_tools import begun

from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.guard.estop import StopListener
from acsar_gym.tools.view import session
from acsar_gym.tools.view.server import find_recording, serve_page
from acsar_gym.tools.view.session import BROKEN, STOPPED, Session, StopAnswer

pytestmark = pytest.mark.usefixtures("deadline")


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
    assert find_recording("/dev/ttyX") == Path("/data/a b\tc.mcap")
    with pytest.raises(LinkError, match="/dev/ttyY"):
        find_recording("/dev/ttyY")
    assert driving == []


def test_files_are_themselves_and_simulations_need_one() -> None:
    for name in ("drive.mcap", "replay:drive.mcap", "/data/drive.mcap"):
        assert find_recording(name) == Path(name.removeprefix("replay:"))
    for name in ("planar", "serial"):
        with pytest.raises(ConfigError, match=name):
            find_recording(name)


def test_stopped_means_that_the_control_loop_said_so(driving: list[str]) -> None:
    assert session.can_stop_process(os.getpid())
    found = session.stop_process(os.getpid())
    assert found.state == "stopped"
    assert found.said.startswith("zero is on the wire")
    assert driving == ["zero"]


def test_a_program_that_waits_for_its_robot_is_called_stopped_and_zero_is_not(place: Path) -> None:
    listener = StopListener("/dev/ttyX")
    with ThreadPoolExecutor(1) as person:
        found = person.submit(session.stop_process, os.getpid())
        while not found.done():
            if listener.is_requested():
                listener.confirm(connected=False)
    listener.close()
    assert found.result().state == "stopped"
    assert found.result().said.startswith("the program isn't connected to the robot")


def test_without_a_driver_nothing_is_called_stopped() -> None:
    assert not session.can_stop_process(os.getpid())
    assert not session.can_stop_process(0)
    assert session.stop_process(os.getpid()).state == "nobody"
    assert session.stop_process(0).state == "nobody"


def test_a_driver_that_hangs_is_not_called_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("acsar_gym.guard.estop.ANSWER_TIMEOUT", 0.05)
    listener = StopListener("/dev/ttyX")
    try:
        found = session.stop_process(os.getpid())
    finally:
        listener.close()
    assert found.state == "unanswered"
    assert "watchdog" in found.said


def silent(place: Path, process: int) -> socket.socket:
    """The socket of a process that hangs."""
    found = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    found.bind(str(place / f"acsar_gym-{os.getuid()}" / f"{process}-1"))
    return found


def test_others_that_hang_are_not_waited_for(
    driving: list[str], place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with silent(place, 1):
        found = session.stop_process(os.getpid())
        assert (found.state, driving) == ("stopped", ["zero"])
        monkeypatch.setattr("acsar_gym.guard.estop.ANSWER_TIMEOUT", 0.5)
        with pytest.raises(LinkError, match="process 1"):
            find_recording("/dev/ttyY")


def test_a_driver_that_ends_without_an_answer_has_nothing_to_stop(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acsar_gym.guard.estop.ANSWER_TIMEOUT", 0.3)
    StopListener("/dev/ttyX").close()  # makes the folder
    with silent(place, os.getpid()) as killed:
        ending = threading.Timer(0.05, os.unlink, [killed.getsockname()])
        ending.start()
        assert session.stop_process(os.getpid()).state == "nobody"
        ending.join()


def test_a_second_click_does_not_take_back_what_was_confirmed(tape: Path) -> None:
    session = Session(tape)
    session.stopped = StopAnswer("stopped", "zero is on the wire")
    assert session.stop().state == "stopped"  # this process drives nothing any more
    assert session.state == STOPPED


def test_a_robot_whose_recording_is_gone_can_be_stopped(
    tape: Path, tmp_path: Path, driving: list[str]
) -> None:
    path = tmp_path / "live.mcap"
    path.write_bytes(begun(tape))
    session = Session(path)
    path.unlink()
    session.poll()
    assert session.state == BROKEN
    assert session.can_stop
    assert session.stop().state == "stopped"
    assert driving == ["zero"]


def test_the_page_is_on_loopback_and_a_port_in_use_is_told(tape: Path) -> None:
    with serve_page(tape, port=0) as server:
        assert server.server_address[0] == "127.0.0.1"
        with pytest.raises(ConfigError, match=f"--port {server.port}"):
            serve_page(tape, server.port).__enter__()
    for port in (-1, 70_000):
        with pytest.raises(ConfigError, match=f"--port {port}"):
            serve_page(tape, port).__enter__()
