"""The watchdog itself: what it does when, without processes, and on a pseudo-terminal."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import subprocess
import tty
from collections.abc import Callable, Iterator

import psutil
import pytest
from processes import HASTY, ZEROS, first_line, program
from serial_tools import no_leak, wait_until

from acsar_gym.errors import LinkError
from acsar_gym.guard import watchdog
from acsar_gym.guard.watchdog import Watchdog
from acsar_gym.guard.watchdog_child import (
    BEAT,
    DEATH_ZEROS,
    HANG_ZEROS,
    PAGE_SIZE,
    STOOD,
    TRIPPED,
    ProgramWatch,
    boot_clock,
)

pytestmark = pytest.mark.usefixtures("deadline")

WATCH_TIMEOUT = 0.15


@pytest.fixture
def zeros() -> list[float]:
    """Zero commands that `check` has sent."""
    return []


@pytest.fixture
def page() -> memoryview[float]:
    return memoryview(bytearray(PAGE_SIZE)).cast("d")


Check = Callable[[float], float]


@pytest.fixture
def check(zeros: list[float], page: memoryview[float]) -> Check:
    """Let it look at a time. It returns when it looks again."""
    return ProgramWatch(page, WATCH_TIMEOUT, lambda: zeros.append(0.0)).check


def test_watchdog_trips_after_a_gap_in_which_it_was_suspended(
    check: Check, zeros: list[float], page: memoryview[float]
) -> None:
    """As when a container is paused, or the computer's lid is closed."""
    page[BEAT] = 100.0
    check(100.01)
    check(105.0)
    assert len(zeros) == 1
    assert page[TRIPPED] == pytest.approx(5.0)
    page[BEAT] = 105.01
    check(105.02)
    assert page[TRIPPED], "until the reset"


def test_watchdog_repeats_zeros_while_the_program_sends_nothing(
    check: Check, zeros: list[float], page: memoryview[float]
) -> None:
    check(100.0)
    assert not zeros, "before the first reset"
    page[STOOD] = 100.0
    for step in range(50):
        check(100.0 + 0.01 * step)
    assert len(zeros) == 4
    page[BEAT] = 100.5
    check(100.55)
    assert len(zeros) == 4


@pytest.fixture
def wire() -> Iterator[tuple[int, int]]:
    """Master and slave."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(slave, False)
    yield master, slave
    os.close(master)
    os.close(slave)


@pytest.fixture
def dog(wire: tuple[int, int]) -> Iterator[Watchdog]:
    """A watchdog that watches this process."""
    with no_leak():
        dog = Watchdog(ZEROS, HASTY)
        dog.start(wire[1])
        dog.wait_ready()
        pid = dog.pid or 0
        yield dog
        dog.close()
        dog.close()
    assert not psutil.pid_exists(pid)


def read_until_quiet(descriptor: int) -> bytes:
    data = b""
    while select.select([descriptor], [], [], 2.0 * HASTY)[0]:
        data += os.read(descriptor, 4096)
    return data


def test_watchdog_trips_commands_zero_and_can_be_armed_again(
    wire: tuple[int, int], dog: Watchdog
) -> None:
    for _ in range(2):
        dog.allow_drive()
        assert read_until_quiet(wire[0]) == ZEROS * HANG_ZEROS
        with pytest.raises(LinkError):
            dog.allow_drive()
        dog.rearm()


def test_watchdog_that_has_not_run_for_long_lets_nothing_drive(
    dog: Watchdog, page: memoryview[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine that stalled has held up the program as well, and doesn't count."""
    monkeypatch.setattr(dog, "page", page)  # which no process updates
    now = 100.0
    monkeypatch.setattr(watchdog, "boot_clock", lambda: now)

    def drive_until(end: float, step: float) -> None:
        nonlocal now
        while now < end:
            now += step
            dog.allow_drive()

    drive_until(100.5, step=0.4 * HASTY)
    assert dog.is_alive
    with pytest.raises(LinkError, match=r"hasn't run for 0\.5[0-9] s"):
        drive_until(200.0, step=0.01)
    assert now < 101.1
    assert not dog.is_alive, "it is replaced at the reset"


def test_watchdog_gap_that_the_program_finds_first_trips(
    wire: tuple[int, int], dog: Watchdog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when both were suspended, and the program goes on before the watchdog."""
    dog.allow_drive()
    later = boot_clock() + 3.0
    monkeypatch.setattr(watchdog, "boot_clock", lambda: later)
    dog.beat()
    assert dog.has_tripped
    with pytest.raises(LinkError, match=r"30[0-9]{2} ms"):
        dog.allow_drive()
    monkeypatch.undo()
    assert read_until_quiet(wire[0]) == ZEROS * HANG_ZEROS


def test_watchdog_makes_way_if_the_port_is_stuck(wire: tuple[int, int], dog: Watchdog) -> None:
    """As when the board takes no bytes: its zeros are the first that the board gets."""
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(wire[1], b"x" * 4096)
    dog.allow_drive()
    wait_until(lambda: dog.has_tripped, "a trip")
    assert ZEROS in read_until_quiet(wire[0])


STARTING = """
import os, sys
from acsar_gym.guard.watchdog import Watchdog
port = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
dog = Watchdog(bytes.fromhex(sys.argv[2]), 60.0)
dog.start(port)
dog.wait_ready()
print(dog.pid, flush=True)
os.read(0, 1)
os._exit(1)
"""


def test_watchdog_commands_zero_after_the_program_died(
    wire: tuple[int, int],
) -> None:
    with program(STARTING, os.ttyname(wire[1]), ZEROS.hex()) as process:
        pid = int(first_line(process))
        process.kill()
        assert read_until_quiet(wire[0]) == ZEROS * DEATH_ZEROS
        wait_until(lambda: not psutil.pid_exists(pid), "its end")


def test_close_does_not_wait_for_a_process_that_a_driver_holds(
    dog: Watchdog, monkeypatch: pytest.MonkeyPatch
) -> None:
    def hold(timeout: float | None = None) -> int:
        assert timeout is not None, "waits for ever"
        raise subprocess.TimeoutExpired("watchdog", timeout)

    process = dog._process
    with monkeypatch.context() as patch:
        patch.setattr(process, "wait", hold)
        dog.close()
    process.wait()


def test_start_with_too_many_open_files_does_not_advise_to_drive_without(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse() -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(socket, "socketpair", refuse)
    with pytest.raises(LinkError, match=r"Too many open files.*: close some, or allow more"):
        Watchdog(ZEROS, HASTY).start(0)
