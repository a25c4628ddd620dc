"""The watchdog of a link, from its opening to its closing."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
from serial_tools import Emulated, wait_until
from watchdog_tools import HASTY, TURNING, ZEROS, children

from acsar_gym import RobotConfig
from acsar_gym.errors import LinkError
from acsar_gym.links.serial import SerialLink
from acsar_gym.links.watchdog import Watchdog
from acsar_gym.links.watchdog_child import (
    BEAT,
)
from acsar_gym.protocol import ZERO, encode
from acsar_gym.worlds import Scene

pytestmark = [
    pytest.mark.usefixtures("deadline", "nursery"),
    pytest.mark.xdist_group("serial"),
]


def opened(device: str, config: RobotConfig) -> Iterator[SerialLink]:
    link = SerialLink(device, config)
    link.open()
    link.reset(Scene())
    yield link
    link.close()


@pytest.fixture
def link(shared_device: str, config: RobotConfig) -> Iterator[SerialLink]:
    """Its watchdog doesn't trip."""
    yield from opened(shared_device, config.with_(watchdog_timeout=60.0))


@pytest.fixture
def hasty(shared_device: str, config: RobotConfig) -> Iterator[SerialLink]:
    """Its watchdog trips soon."""
    yield from opened(shared_device, config.with_(watchdog_timeout=HASTY))


def dog_of(link: SerialLink) -> Watchdog:
    assert link._watch.watchdog is not None
    return link._watch.watchdog


def test_after_a_trip_only_zeros_go_out_until_the_reset(hasty: SerialLink) -> None:
    begin = time.monotonic()
    hasty.write(TURNING)
    wait_until(lambda: dog_of(hasty).tripped, "a trip")
    for _ in range(2):
        with pytest.raises(LinkError, match=r"nothing was commanded for [0-9]+ ms") as caught:
            hasty.write(TURNING)
        pause = float(caught.value.found.removesuffix(" ms").rpartition(" ")[2])
        assert 1000.0 * HASTY <= pause <= 1000.0 * (time.monotonic() - begin) + 1.0
        assert caught.value.fix.startswith("find what held the program up, then reset; ")
        hasty.write(encode(ZERO))
        hasty.write(b"")
        hasty.advance(0.01)
    hasty.reset(Scene())
    assert not dog_of(hasty).tripped
    hasty.write(TURNING)
    hasty.write(encode(ZERO))


def test_no_pause_at_standstill_is_too_long(link: SerialLink) -> None:
    stops: list[Callable[[], None]] = [
        lambda: link.write(encode(ZERO)),
        link.stop,
        lambda: link.reset(Scene()),
    ]
    page = dog_of(link)._page
    for stop in stops:
        link.write(TURNING)
        assert page[BEAT] > 0.0
        stop()
        assert page[BEAT] == 0.0


def test_a_zero_command_is_repeated_while_the_program_says_nothing(
    emulator: Emulated, config: RobotConfig
) -> None:
    """As at an episode's end: a wire may have swallowed it."""
    link = SerialLink(emulator.device, config)
    link.open()
    link.reset(Scene())
    link.write(TURNING)
    link.stop()
    wait_until(emulator.is_stopped, "zero as the last command")
    said = len(emulator.commands())
    wait_until(lambda: len(emulator.commands()) > said + 5, "repeated zeros")
    assert emulator.is_stopped()
    link.close()


def test_reading_is_a_sign_of_life(link: SerialLink) -> None:
    """A program that listens doesn't hang: `doctor` waits for the board's own time-out."""
    link.write(TURNING)
    page = dog_of(link)._page
    before = page[BEAT]
    link.read_now()
    assert page[BEAT] > before
    link.stop()
    link.read_now()
    assert page[BEAT] == 0.0


def test_periods_longer_than_the_timeout_are_no_pause(
    link: SerialLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert link._watch.nap == pytest.approx(60.0 / 3.0)
    link._watch.nap = 0.01
    beats: list[float] = []
    monkeypatch.setattr(link, "_beat", lambda: beats.append(time.monotonic()))
    link.advance(0.05)
    assert len(beats) > 1
    monkeypatch.undo()


def test_a_watchdog_that_dies_stops_the_robot_and_comes_back(link: SerialLink) -> None:
    link.write(TURNING)
    (dog,) = children()
    dog.kill()
    wait_until(lambda: not link.watched, "a dead watchdog")
    with pytest.raises(LinkError, match="watchdog process has ended"):
        link.write(TURNING)
    link.write(encode(ZERO))
    link.reset(Scene())
    assert link.watched
    link.write(TURNING)
    assert link.watchdog_pid != dog.pid


def test_a_suspended_watchdog_is_none(link: SerialLink) -> None:
    """The link refuses to drive, and what is suspended doesn't keep the port busy."""
    link.write(TURNING)
    (dog,) = children()
    dog.suspend()
    wait_until(lambda: not link.watched, "a suspended watchdog")
    with pytest.raises(LinkError, match=r"watchdog process is suspended \(PID [0-9]+\)") as caught:
        link.write(TURNING)
    assert "reset" in caught.value.fix
    dog.resume()
    with pytest.raises(LinkError, match="is suspended"):
        link.write(TURNING)
    link.reset(Scene())
    assert link.watchdog_pid != dog.pid
    link.write(TURNING)
    (dog,) = children()
    dog.suspend()
    link.close()
    assert not children()
    link.open()
    assert link.watched


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
    page = dog_of(link)._page
    before = page[BEAT]
    thread = threading.Thread(target=lambda: link.write(TURNING))
    with link.held():
        thread.start()
        thread.join(0.05)
        assert thread.is_alive()
        assert page[BEAT] == before
    thread.join()
    assert page[BEAT] > before


def test_the_terminal_s_signals_do_not_reach_it(link: SerialLink) -> None:
    (dog,) = children()
    assert os.getsid(dog.pid) == dog.pid
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP):
        dog.send_signal(number)
    link.reset(Scene())
    assert link.watched
    assert dog.status() != psutil.STATUS_STOPPED


def test_it_holds_nothing_but_the_port(link: SerialLink) -> None:
    (dog,) = children()
    held = {file.resolve() for file in Path(f"/proc/{dog.pid}/fd").iterdir()}
    assert Path(link.device) in held
    assert len([path for path in held if str(path).startswith("/dev/pts/")]) == 1
