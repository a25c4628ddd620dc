"""The watchdog of a link: whether there is one, what it allows, and what it stops."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
from nursery import first_line, program
from serial_tools import BRIDGE, DRIVER, TIMEOUT, Emulated, no_leak, wait_until
from watchdog_tools import HASTY, TURNING, ZEROS, children

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import LinkError, SafetyWarning
from acsar_gym.guard import watchdog
from acsar_gym.guard.watchdog_child import BEAT
from acsar_gym.links import guarded
from acsar_gym.links.faults import Faults, FaultyLink
from acsar_gym.links.serial import SerialLink
from acsar_gym.protocol import ZERO, Decoder, encode
from acsar_gym.recording import Recorder
from acsar_gym.worlds import Scene

pytestmark = pytest.mark.usefixtures("deadline", "nursery")


@pytest.fixture
def link(
    shared_device: str, config: RobotConfig, request: pytest.FixtureRequest
) -> Iterator[SerialLink]:
    """Its watchdog trips soon where a test asks for `hasty`, and else never."""
    timeout = HASTY if "hasty" in request.fixturenames else 60.0
    link = SerialLink(shared_device, config.with_(watchdog_timeout=timeout))
    link.open()
    link.reset(Scene())
    yield link
    link.close()


@pytest.fixture
def hasty(link: SerialLink) -> SerialLink:
    return link


@pytest.mark.parametrize("platform", ["any", "Windows"])
def test_none_means_none_and_windows_drives_without(
    platform: str, shared_device: str, config: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    if platform == "Windows":
        monkeypatch.setattr(watchdog, "WATCHDOG_AVAILABLE", False)
    else:
        config = config.with_(watchdog_timeout=None)
    with Robot(open_link(shared_device, config), config) as robot:
        assert isinstance(robot.link, SerialLink)
        assert not robot.link.watchdog.is_alive
        assert not children()
        robot.drive(0.2, 0.0)


def test_a_board_without_a_time_out_and_without_a_watchdog_is_told(
    shared_device: str, config: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At each first reset, as after closing; a watchdog or a time-out alone is enough."""
    config = config.with_(firmware={"command_timeout": None})
    link = open_link(shared_device, config)
    with pytest.warns(SafetyWarning, match="falls out") as said, Robot(link, config):
        pass
    assert "no watchdog" not in str(said[0].message)
    chosen = config.with_(watchdog_timeout=None)
    robot = Robot(open_link(shared_device, chosen), chosen)
    for _ in range(2):
        with pytest.warns(SafetyWarning, match=r"no watchdog \(watchdog_timeout: null\)") as said:
            robot.reset(Scene())
        assert len(said) == 1
        robot.reset(Scene())
        robot.close()
    monkeypatch.setattr(watchdog, "WATCHDOG_AVAILABLE", False)
    recorder = Recorder(tmp_path / "drive.mcap", {})
    with (
        pytest.warns(SafetyWarning, match=r"no watchdog \(not on this system") as said,
        Robot(
            FaultyLink(open_link(shared_device, config), Faults()), config, recorder=recorder
        ) as one,
    ):
        one.drive(0.0, 0.0)
    assert len(said) == 1


@pytest.mark.parametrize("python", ["/bin/false", "/acsar-missing"])
def test_where_it_cannot_start_nothing_drives(
    python: str, shared_device: str, config: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", python)
    link = SerialLink(shared_device, config)
    with no_leak(), pytest.raises(LinkError, match="watchdog can't be started") as caught:
        link.open()
    assert "watchdog_timeout=None" in caught.value.fix
    assert not children()


def test_nothing_is_left_of_it(shared_device: str, config: RobotConfig) -> None:
    """After closing often, and where a link is dropped."""
    link = SerialLink(shared_device, config)
    with no_leak():
        for _ in range(5):
            link.open()
            assert link.watchdog.is_alive
            link.close()
            assert not children()
        link.open()
        del link
        gc.collect()
        assert not children()


def test_it_holds_nothing_but_the_port_and_ignores_the_terminal(link: SerialLink) -> None:
    (dog,) = children()
    held = {file.resolve() for file in Path(f"/proc/{dog.pid}/fd").iterdir()}
    assert Path(link.device) in held
    assert len([path for path in held if str(path).startswith("/dev/pts/")]) == 1
    assert os.getsid(dog.pid) == dog.pid
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP):
        dog.send_signal(number)
    link.reset(Scene())
    assert link.watchdog.is_alive
    assert dog.status() != psutil.STATUS_STOPPED


def test_after_a_trip_only_zeros_go_out_until_the_reset(hasty: SerialLink) -> None:
    begin = time.monotonic()
    hasty.write(TURNING)
    wait_until(lambda: hasty.watchdog.has_tripped, "a trip")
    for _ in range(2):
        with pytest.raises(LinkError, match=r"nothing was commanded for [0-9]+ ms") as caught:
            hasty.write(TURNING)
        pause = float(caught.value.found.removesuffix(" ms").rpartition(" ")[2])
        assert 1000.0 * HASTY <= pause <= 1000.0 * (time.monotonic() - begin) + 1.0
        hasty.write(encode(ZERO))
        hasty.write(b"")
        hasty.advance(0.01)
    hasty.reset(Scene())
    assert not hasty.watchdog.has_tripped
    hasty.write(TURNING)
    hasty.write(encode(ZERO))


def test_no_pause_at_standstill_is_too_long_and_reading_is_a_sign_of_life(link: SerialLink) -> None:
    """A program that listens doesn't hang: `doctor` waits for the board's own time-out."""
    stops: list[Callable[[], None]] = [
        lambda: link.write(encode(ZERO)),
        link.stop,
        lambda: link.reset(Scene()),
    ]
    for stop in stops:
        link.write(TURNING)
        before = link.watchdog.page[BEAT]
        assert before > 0.0
        link.read_now()
        assert link.watchdog.page[BEAT] > before
        stop()
        link.read_now()
        assert link.watchdog.page[BEAT] == 0.0


def test_a_watchdog_that_dies_stops_the_robot_and_comes_back(link: SerialLink) -> None:
    link.write(TURNING)
    (dog,) = children()
    dog.kill()
    wait_until(lambda: not link.watchdog.is_alive, "a dead watchdog")
    with pytest.raises(LinkError, match="has ended"):
        link.write(TURNING)
    link.write(encode(ZERO))
    link.reset(Scene())
    assert link.watchdog.is_alive
    link.write(TURNING)
    assert link.watchdog.pid != dog.pid


def test_a_suspended_watchdog_is_replaced(link: SerialLink) -> None:
    """The link refuses to drive, and the suspended process doesn't keep the port busy."""
    (dog,) = children()
    dog.suspend()
    with pytest.raises(LinkError, match=rf"hasn't run for .* \(PID {dog.pid}\)"):
        while True:
            link.write(TURNING)
            link.advance(0.01)
    link.reset(Scene())
    assert link.watchdog.pid != dog.pid
    link.write(TURNING)
    link.close()
    assert not children()


def test_what_another_thread_writes_goes_out_before_the_zeros_or_not_at_all(
    link: SerialLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[bytes] = []
    writes = threading.Event()
    write = os.write

    def slow(descriptor: int, data: bytes) -> int:
        if data == TURNING:
            writes.set()
            time.sleep(0.1)  # the main thread closes the port meanwhile
        written.append(data)
        return write(descriptor, data)

    def drive() -> None:
        with contextlib.suppress(LinkError):
            while True:
                link.write(TURNING)

    monkeypatch.setattr(os, "write", slow)
    monkeypatch.setattr(guarded, "LOCK_TIMEOUT", TIMEOUT)
    thread = threading.Thread(target=drive)
    thread.start()
    writes.wait()
    link.close()
    thread.join()
    assert written.count(ZEROS) > 2
    last = len(written) - written[::-1].index(TURNING)
    assert ZEROS in written[:last], "the slow write delayed the zeros"
    assert set(written[last:]) == {ZEROS}


def test_nobody_writes_while_the_link_is_held(link: SerialLink) -> None:
    """As before Ctrl-Z suspends the program; the watchdog trips if that takes long."""
    link.write(TURNING)
    page = link.watchdog.page
    before = page[BEAT]
    thread = threading.Thread(target=lambda: link.write(TURNING))
    with link.held():
        thread.start()
        thread.join(0.05)
        assert thread.is_alive()
        assert page[BEAT] == before
    thread.join()
    assert page[BEAT] > before


DRIVE = "robot.activate(); drive(10**9)"


def assert_stopped_after(emulator: Emulated, fault: float) -> None:
    """A zero command came after the fault, and nothing turned wheels after it."""
    wait_until(emulator.is_stopped, "zero as the last command")
    decoder = Decoder()
    driving = [
        reading.speeds != ZERO
        for event in emulator.events()
        for reading in decoder.feed(event.get("rx", "").encode("latin-1"))
        if event["t"] >= fault
    ]
    assert not any(driving[driving.index(False) :])


def test_a_program_behind_a_socket_is_watched_too(emulator: Emulated) -> None:
    with program(BRIDGE, emulator.device) as bridge:
        url = f"socket://127.0.0.1:{first_line(bridge)}"
        with program(DRIVER + DRIVE, url) as process:
            wait_until(emulator.is_driven, "a command that turns the wheels")
            fault = time.monotonic()
            process.kill()
            assert_stopped_after(emulator, fault)
