"""The watchdog of a link: whether there is one, what it allows, and what it stops."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import psutil
import pytest
from processes import HASTY, TURNING, ZEROS, children, first_line, program
from serial_tools import BRIDGE, DRIVER, TIMEOUT, Emulated, no_leak, wait_until

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import LinkError, SafetyWarning
from acsar_gym.guard import watchdog
from acsar_gym.guard.watchdog_child import BEAT
from acsar_gym.links import guarded, serial
from acsar_gym.links.serial import SerialLink
from acsar_gym.protocol import ZERO, encode
from acsar_gym.worlds import Scene

pytestmark = pytest.mark.usefixtures("deadline")


hasty = pytest.mark.parametrize("watchdog_timeout", [HASTY])


@pytest.fixture
def watchdog_timeout() -> float:
    """The watchdog trips soon in a test that is marked as `hasty`, otherwise never."""
    return 60.0


@pytest.fixture
def link(shared_device: str, config: RobotConfig, watchdog_timeout: float) -> Iterator[SerialLink]:
    link = SerialLink(shared_device, config.with_(watchdog_timeout=watchdog_timeout))
    link.open()
    link.reset(Scene())
    yield link
    link.close()


@pytest.mark.parametrize(
    ("is_posix", "timeout", "warning"),
    [
        (True, 60.0, "^this robot's board doesn't stop by itself"),
        (True, None, r"no watchdog \(watchdog_timeout: null\)"),
        (False, 60.0, r"no watchdog \(not on this system"),
    ],
)
def test_first_reset_warns_if_nothing_stops_the_board(
    is_posix: bool,
    timeout: float | None,
    warning: str,
    shared_device: str,
    config: RobotConfig,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(watchdog, "WATCHDOG_AVAILABLE", is_posix)
    config = config.with_(firmware={"command_timeout": None}, watchdog_timeout=timeout)
    robot = Robot(open_link(shared_device, config), config)
    for _ in range(2):  # also after closing
        with pytest.warns(SafetyWarning, match=warning):
            robot.reset(Scene())
        robot.reset(Scene())
        robot.close()


def test_link_that_fails_or_is_closed_or_dropped_leaves_no_process(
    shared_device: str, config: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = SerialLink(shared_device, config)
    with no_leak():
        monkeypatch.setattr(sys, "executable", "/bin/false")
        with pytest.raises(LinkError, match=r"watchdog can't be started .*watchdog_timeout=None"):
            link.open()
        assert not children()

        monkeypatch.undo()
        for _ in range(5):
            link.open()
            assert link.watchdog.is_alive
            link.close()
            assert not children()
        link.open()
        del link
        gc.collect()
        assert not children()


def test_watchdog_holds_only_the_port_and_ignores_the_terminal(link: SerialLink) -> None:
    (dog,) = children()
    files = {file.resolve() for file in Path(f"/proc/{dog.pid}/fd").iterdir()}
    assert [str(file) for file in files if str(file).startswith("/dev/pts/")] == [link.device]
    assert os.getsid(dog.pid) == dog.pid

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP):
        dog.send_signal(number)
    link.reset(Scene())
    assert link.watchdog.is_alive
    assert dog.status() != psutil.STATUS_STOPPED


@hasty
def test_link_sends_only_zeros_between_a_trip_and_the_reset(link: SerialLink) -> None:
    start = time.monotonic()
    link.write(TURNING)
    wait_until(lambda: link.watchdog.has_tripped, "a trip")
    for _ in range(2):
        with pytest.raises(LinkError, match=r"nothing was commanded for [0-9]+ ms") as caught:
            link.write(TURNING)
        pause = float(caught.value.found.split()[-2])
        assert HASTY <= pause / 1000.0 <= time.monotonic() - start + 0.001
        link.write(encode(ZERO))
        link.advance(0.01)

    link.reset(Scene())
    assert not link.watchdog.has_tripped
    link.write(TURNING)
    link.write(encode(ZERO))


@pytest.mark.parametrize("stop", ["write", "stop", "reset"])
def test_heartbeat_of_reading_and_standstill_needs_none(stop: str, link: SerialLink) -> None:
    link.write(TURNING)
    beat = link.watchdog.page[BEAT]
    assert beat > 0.0
    link.read_now()
    assert link.watchdog.page[BEAT] > beat

    stops = {"write": (encode(ZERO),), "stop": (), "reset": (Scene(),)}
    getattr(link, stop)(*stops[stop])
    link.read_now()
    assert link.watchdog.page[BEAT] == 0.0


@hasty
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP])
def test_watchdog_that_is_dead_or_suspended_stops_the_robot_and_is_replaced(
    end: signal.Signals, link: SerialLink
) -> None:
    link.write(TURNING)
    (dog,) = children()
    dog.send_signal(end)
    with pytest.raises(LinkError, match=r"has ended|hasn't run for"):
        for _ in range(200):
            link.write(TURNING)
            link.advance(0.01)

    link.write(encode(ZERO))
    link.reset(Scene())
    assert link.watchdog.is_alive
    assert link.watchdog.pid != dog.pid
    link.write(TURNING)


def test_close_and_the_command_of_another_thread_is_sent_before_the_zeros_or_not_at_all(
    link: SerialLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[bytes] = []
    is_writing = threading.Event()
    write = os.write

    def write_slowly(descriptor: int, data: bytes) -> int:
        if data == TURNING:
            is_writing.set()
            time.sleep(0.1)  # the main thread closes the port meanwhile
        written.append(data)
        return write(descriptor, data)

    def drive() -> None:
        with contextlib.suppress(LinkError):
            while True:
                link.write(TURNING)

    monkeypatch.setattr(os, "write", write_slowly)
    monkeypatch.setattr(guarded, "LOCK_TIMEOUT", TIMEOUT)
    thread = threading.Thread(target=drive)
    thread.start()
    is_writing.wait()
    link.close()
    thread.join()

    newest = len(written) - written[::-1].index(TURNING)
    assert ZEROS in written[:newest], "the slow write delayed the zeros"
    assert set(written[newest:]) == {ZEROS}


def test_held_no_thread_writes_while_the_link_is_held(link: SerialLink) -> None:
    """As before Ctrl-Z suspends the program. The watchdog trips if that takes long."""
    link.write(TURNING)
    beat = link.watchdog.page[BEAT]
    thread = threading.Thread(target=lambda: link.write(TURNING))
    with link.held():
        thread.start()
        thread.join(0.05)
        assert thread.is_alive()
        assert link.watchdog.page[BEAT] == beat
    thread.join()
    assert link.watchdog.page[BEAT] > beat


def test_watchdog_behind_a_socket(emulator: Emulated) -> None:
    with program(BRIDGE, emulator.device) as bridge:
        url = f"socket://127.0.0.1:{first_line(bridge)}"
        with program(f"{DRIVER}robot.activate(); drive(10**9)", url) as process:
            wait_until(emulator.is_driven, "a command that turns the wheels")
            process.kill()
            wait_until(emulator.is_stopped, "zero as the last command")


def test_close_leaves_no_bytes_in_the_port(
    link: SerialLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If they can't leave, the kernel waits when the port is closed, by default 30 s."""
    drain = Mock(wraps=link.port.drain)
    monkeypatch.setattr(link.port, "drain", drain)
    link.close()
    assert drain.call_count == 2, "for both zeros"


def test_close_that_is_interrupted_again_and_again_ends_the_watchdog(
    link: SerialLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(link, "_send_stop", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        link.close()
    assert not link.is_open
    assert not children()


def test_close_sends_zeros_before_a_log_that_fails(
    link: SerialLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    send = Mock(wraps=link.port.try_write)
    monkeypatch.setattr(link.port, "try_write", send)
    monkeypatch.setattr(serial.LOG, "debug", Mock(side_effect=RuntimeError("no log")))
    with pytest.raises(RuntimeError, match="no log"):
        link.close()
    send.assert_called()
