"""The watchdog alone: what it does when, without processes, and on a pseudo-terminal."""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import time
import tty
from collections.abc import Callable, Iterator

import psutil
import pytest
from nursery import first_line, program
from serial_tools import DRIVER, no_leak, wait_until
from watchdog_tools import HASTY, TURNING, ZEROS

from acsar_gym.errors import LinkError
from acsar_gym.guard import watchdog
from acsar_gym.guard.watchdog import Watchdog
from acsar_gym.guard.watchdog_child import (
    BEAT,
    DEATH_ZEROS,
    HANG_ZEROS,
    PAGE_SIZE,
    REPEAT_INTERVAL,
    STOOD,
    TRIPPED,
    ProgramWatch,
    SharedPort,
    boot_clock,
)
from acsar_gym.protocol import ZERO, Decoder, encode

pytestmark = pytest.mark.usefixtures("deadline", "nursery")

TIMEOUT_OF_DOG = 0.15


class Counting(SharedPort):
    """Counts zero commands."""

    def __init__(self) -> None:
        self.zeros = 0

    def stop_robot(self, wanted: Callable[[], bool] = lambda: True) -> bool:
        self.zeros += wanted()
        return True


@pytest.fixture
def port() -> Counting:
    return Counting()


@pytest.fixture
def page() -> memoryview[float]:
    return memoryview(bytearray(PAGE_SIZE)).cast("d")


Check = Callable[[float], float]


@pytest.fixture
def check(port: Counting, page: memoryview[float]) -> Check:
    """Have it look at a time; returns when it looks again."""
    return ProgramWatch(page, -1, os.getpid(), TIMEOUT_OF_DOG, port).check


def test_it_looks_again_when_the_newest_sign_is_too_old(
    check: Check, port: Counting, page: memoryview[float]
) -> None:
    page[BEAT] = 100.0
    assert check(100.01) == 100.15
    page[BEAT] = 100.14
    assert check(100.15) == pytest.approx(100.29)
    assert port.zeros == 0
    assert check(100.29) == pytest.approx(100.34)
    assert port.zeros == 1
    assert page[TRIPPED] == pytest.approx(0.15)


def test_a_gap_in_which_it_was_suspended_itself_trips_too(
    check: Check, port: Counting, page: memoryview[float]
) -> None:
    """As where a container is paused, or the computer's lid is closed."""
    page[BEAT] = 100.0
    check(100.01)
    check(105.0)
    assert port.zeros == 1
    assert page[TRIPPED] == pytest.approx(5.0)
    page[BEAT] = 105.01
    check(105.02)
    assert page[TRIPPED], "until the reset"


def test_a_gap_that_the_program_found_is_answered_with_zeros(
    check: Check, port: Counting, page: memoryview[float]
) -> None:
    for gap in (3.0, 4.0):
        port.zeros = 0
        page[TRIPPED] = gap
        for repeat in range(2 * HANG_ZEROS):
            check(100.0 + repeat * REPEAT_INTERVAL)
        assert port.zeros == HANG_ZEROS


def test_zeros_are_repeated_only_while_the_program_says_nothing(
    check: Check, port: Counting, page: memoryview[float]
) -> None:
    check(100.0)
    assert port.zeros == 0
    for milliseconds in range(0, 1000, 10):
        now = 100.0 + 0.001 * milliseconds
        if milliseconds < 500:  # the program itself commands zero
            page[STOOD] = now
        check(now)
        assert milliseconds > 500 or not port.zeros
    assert port.zeros == 5
    page[BEAT] = 101.0
    check(101.05)
    assert port.zeros == 5


def test_what_it_writes_is_whole_and_starts_with_a_line_end() -> None:
    for cut in range(len(TURNING) + 1):
        assert Decoder().feed(TURNING[:cut] + ZEROS)[-1].speeds == ZERO


@pytest.fixture
def wire() -> Iterator[tuple[int, int]]:
    """Master and slave."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(slave, False)
    yield master, slave
    os.close(master)
    os.close(slave)


def watch(port: int, timeout: float = HASTY) -> tuple[Watchdog, int]:
    """A watchdog that watches this process, and its PID."""
    dog = Watchdog(ZEROS, timeout)
    dog.start(port)
    dog.wait_ready()
    assert dog.pid is not None
    return dog, dog.pid


@pytest.fixture
def dog(wire: tuple[int, int]) -> Iterator[Watchdog]:
    with no_leak():
        dog, pid = watch(wire[1])
        yield dog
        dog.close()
        dog.close()
    assert not psutil.pid_exists(pid)


def read_until_quiet(descriptor: int, wait: float) -> bytes:
    """What arrives until nothing has come for so long."""
    data = b""
    while select.select([descriptor], [], [], wait)[0]:
        data += os.read(descriptor, 4096)
    return data


def read_zeros(descriptor: int, times: int) -> bytes:
    """What arrives until there are so many zero commands."""
    data = b""
    while data.count(ZEROS) < times:
        data += os.read(descriptor, 4096)
    return data


def test_it_trips_once_says_so_for_a_second_and_can_be_armed_again(
    wire: tuple[int, int], dog: Watchdog
) -> None:
    begin = time.monotonic()
    dog.allow_drive()
    said = read_zeros(wire[0], 1)
    assert time.monotonic() - begin >= HASTY
    assert dog.has_tripped
    dog.beat()
    with pytest.raises(LinkError):
        dog.allow_drive()
    said += read_zeros(wire[0], HANG_ZEROS - 1)
    assert said + read_until_quiet(wire[0], 0.2) == ZEROS * HANG_ZEROS
    dog.rearm()
    assert not dog.has_tripped
    dog.allow_drive()
    assert read_zeros(wire[0], 1)


@pytest.mark.parametrize(("timeout", "stall", "longest"), [(0.15, 0.14, 0.2), (HASTY, 0.3, HASTY)])
def test_one_that_has_not_run_for_long_is_none(
    timeout: float,
    stall: float,
    longest: float,
    wire: tuple[int, int],
    page: memoryview[float],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A machine that stood has held up the program too, and doesn't count."""
    dog, _ = watch(wire[1], timeout)
    monkeypatch.setattr(dog, "page", page)  # nobody else's
    now = 100.0

    def drive_until(end: float, step: float) -> None:
        nonlocal now
        while now < end:
            now += step
            dog.allow_drive()

    monkeypatch.setattr(watchdog, "boot_clock", lambda: now)
    drive_until(100.0 + 2.9 * stall, step=stall)
    stood = now
    with pytest.raises(LinkError, match=rf"hasn't run for {longest}[0-9] s"):
        drive_until(200.0, step=0.01)
    assert now < stood + longest + 0.1
    assert not dog.is_alive, "it is replaced at the reset"
    monkeypatch.undo()
    dog.close()


def test_a_gap_that_the_program_finds_first_trips(
    wire: tuple[int, int], dog: Watchdog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where both were suspended, and the program goes on before the watchdog."""
    dog.allow_drive()
    later = boot_clock() + 3.0
    monkeypatch.setattr(watchdog, "boot_clock", lambda: later)
    dog.beat()
    assert dog.has_tripped
    with pytest.raises(LinkError, match=r"30[0-9]{2} ms"):
        dog.allow_drive()
    monkeypatch.undo()
    assert read_zeros(wire[0], HANG_ZEROS)


def test_it_makes_way_where_the_port_is_stuck(wire: tuple[int, int], dog: Watchdog) -> None:
    """As where the board takes no bytes: its zeros are the first that it gets."""
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(wire[1], b"x" * 4096)
    dog.allow_drive()
    wait_until(lambda: dog.has_tripped, "a trip")
    assert read_zeros(wire[0], 1)


def test_a_lost_port_does_not_end_it() -> None:
    other = os.open(os.devnull, os.O_RDONLY)
    unwritable, _ = watch(other, 0.05)
    unwritable.allow_drive()
    wait_until(lambda: unwritable.has_tripped, "a trip")
    assert unwritable.is_alive
    unwritable.close()
    os.close(other)


def test_it_insists_until_the_board_answers(wire: tuple[int, int]) -> None:
    dog, pid = watch(wire[1])
    dog.search("mine")
    read_zeros(wire[0], 2 * DEATH_ZEROS)
    os.write(wire[0], encode(ZERO))
    wait_until(lambda: psutil.Process(pid).status() == psutil.STATUS_ZOMBIE, "its end")
    watchdog.end_searches("mine")
    assert not psutil.pid_exists(pid)


def test_another_program_may_take_the_port_meanwhile(wire: tuple[int, int]) -> None:
    dog, pid = watch(wire[1])
    dog.search("mine")
    other = os.open(os.ttyname(wire[1]), os.O_RDWR | os.O_NOCTTY)

    def is_mine() -> bool:
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        return False

    wait_until(is_mine, "the lock")
    read_until_quiet(wire[0], 0.01)
    wait_until(lambda: psutil.Process(pid).status() == psutil.STATUS_ZOMBIE, "its end")
    assert ZEROS not in read_until_quiet(wire[0], 0.1)
    watchdog.end_searches("mine")
    os.close(other)


def test_it_is_ahead_of_a_program_with_real_time_priority(shared_device: str) -> None:
    """Else a policy that never returns would keep it from the core."""
    code = """
from acsar_gym import errors
from acsar_gym.tools.commission import host
robot.activate()
try:
    host.prepare_realtime(priority=10)
except errors.ConfigError:
    print("not allowed", flush=True)
    sys.exit()
robot.deactivate()
robot.activate()
print(os.sched_getparam(robot.link.watchdog.pid).sched_priority, flush=True)
"""
    with program(DRIVER + code, shared_device) as process:
        said = first_line(process)
    if said == "not allowed":
        pytest.skip("real-time priority isn't allowed here")
    assert said == "11"
