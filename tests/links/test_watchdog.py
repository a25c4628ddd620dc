"""The watchdog alone, on a pseudo-terminal."""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import time
import tty
from collections.abc import Iterator

import psutil
import pytest
from nursery import first_line, program
from serial_tools import DRIVER, no_leak, wait_until
from watchdog_tools import HASTY, ZEROS

from acsar_gym.errors import LinkError
from acsar_gym.links import watchdog
from acsar_gym.links.watchdog import Watchdog
from acsar_gym.links.watchdog_child import (
    DEATH_ZEROS,
    HANG_ZEROS,
    PAGE_SIZE,
    ZERO_INTERVAL,
    boot_clock,
)
from acsar_gym.protocol import ZERO, encode

pytestmark = [
    pytest.mark.usefixtures("deadline", "nursery"),
    pytest.mark.xdist_group("serial"),
]


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
    with no_leak():
        dog = Watchdog(wire[1], ZEROS, HASTY)
        dog.wait()
        yield dog
        dog.close()
        dog.close()
    assert not psutil.pid_exists(dog.pid)


def heard(descriptor: int, wait: float) -> bytes:
    """What arrives until nothing has come for so long."""
    data = b""
    while select.select([descriptor], [], [], wait)[0]:
        data += os.read(descriptor, 4096)
    return data


def heard_often(descriptor: int, times: int) -> bytes:
    """What arrives until there are so many zero commands."""
    data = b""
    while data.count(ZEROS) < times:
        data += os.read(descriptor, 4096)
    return data


def test_it_trips_once_says_so_for_a_second_and_can_be_armed_again(
    wire: tuple[int, int], dog: Watchdog
) -> None:
    begin = time.monotonic()
    dog.drive()
    said = heard_often(wire[0], 1)
    assert time.monotonic() - begin >= HASTY
    assert dog.tripped
    dog.beat()
    with pytest.raises(LinkError):
        dog.drive()
    said += heard_often(wire[0], HANG_ZEROS - 1)
    assert said + heard(wire[0], 0.2) == ZEROS * HANG_ZEROS
    dog.rearm()
    assert not dog.tripped
    dog.drive()
    assert heard_often(wire[0], 1)


def test_it_repeats_zeros_only_while_the_program_stands(
    wire: tuple[int, int], dog: Watchdog
) -> None:
    dog.stand()
    assert not heard(wire[0], 2 * ZERO_INTERVAL), "before the first reset, while the board starts"
    dog.rearm()
    assert set(heard_often(wire[0], 3).split(ZEROS)) == {b""}


def test_closing_is_silent(wire: tuple[int, int], dog: Watchdog) -> None:
    dog.drive()
    dog.close()
    assert not dog.alive
    assert not dog.tripped
    assert not heard(wire[0], 0.1)


def test_one_that_has_not_run_for_long_is_none(
    dog: Watchdog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine that stood has held up the program too, and doesn't count."""
    monkeypatch.setattr(dog, "_page", memoryview(bytearray(PAGE_SIZE)).cast("d"))  # nobody else's
    now = 100.0

    def drive_until(end: float, step: float) -> None:
        nonlocal now
        while now < end:
            now += step
            dog.drive()

    monkeypatch.setattr(watchdog, "boot_clock", lambda: now)
    drive_until(100.9, step=0.3)
    with pytest.raises(LinkError, match=r"watchdog process hasn't run for 0\.2[0-9] s"):
        drive_until(200.0, step=0.01)
    assert now < 101.3
    assert not dog.alive, "it is replaced at the reset"
    monkeypatch.undo()


def test_a_gap_that_the_program_finds_first_trips(
    wire: tuple[int, int], dog: Watchdog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where both were suspended, and the program goes on before the watchdog."""
    dog.drive()
    later = boot_clock() + 3.0
    monkeypatch.setattr(watchdog, "boot_clock", lambda: later)
    dog.beat()
    assert dog.tripped
    with pytest.raises(LinkError, match=r"nothing was commanded for 30[0-9]{2} ms"):
        dog.drive()
    monkeypatch.undo()
    assert heard_often(wire[0], HANG_ZEROS)


def test_it_makes_way_where_the_port_is_stuck(wire: tuple[int, int], dog: Watchdog) -> None:
    """As where the board takes no bytes: its zeros are the first that it gets."""
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(wire[1], b"x" * 4096)
    dog.drive()
    wait_until(lambda: dog.tripped, "a trip")
    assert heard_often(wire[0], 1)


def test_a_lost_port_does_not_end_it(dog: Watchdog, wire: tuple[int, int]) -> None:
    other = os.open(os.devnull, os.O_RDONLY)
    unwritable = Watchdog(other, ZEROS, 0.05)
    unwritable.wait()
    unwritable.drive()
    wait_until(lambda: unwritable.tripped, "a trip")
    assert unwritable.alive
    unwritable.close()
    os.close(other)


def test_it_insists_until_the_board_answers(wire: tuple[int, int]) -> None:
    dog = Watchdog(wire[1], ZEROS, HASTY)
    dog.wait()
    dog.search("mine")
    said = b""
    while said.count(ZEROS) < 2 * DEATH_ZEROS:
        said += os.read(wire[0], 4096)
    os.write(wire[0], encode(ZERO))
    wait_until(lambda: not psutil.pid_exists(dog.pid) or is_dead(dog.pid), "its end")
    watchdog.end_searches("mine")
    assert not psutil.pid_exists(dog.pid)


def is_dead(process: int) -> bool:
    return psutil.Process(process).status() == psutil.STATUS_ZOMBIE


def test_another_program_may_take_the_port_meanwhile(wire: tuple[int, int]) -> None:
    dog = Watchdog(wire[1], ZEROS, HASTY)
    dog.wait()
    dog.search("mine")
    other = os.open(os.ttyname(wire[1]), os.O_RDWR | os.O_NOCTTY)

    def is_mine() -> bool:
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        return False

    wait_until(is_mine, "the lock")
    heard(wire[0], 0.01)
    wait_until(lambda: is_dead(dog.pid), "its end")
    assert ZEROS not in heard(wire[0], 0.1)
    watchdog.end_searches("mine")
    os.close(other)


def test_it_is_ahead_of_a_program_with_real_time_priority(shared_device: str) -> None:
    """Else a policy that never returns would keep it from the core."""
    code = (
        DRIVER
        + """
from acsar_gym import errors
from acsar_gym.tools.doctor import host as realtime
robot.activate()
try:
    realtime.prepare(priority=10)
except errors.ConfigError:
    print("not allowed", flush=True)
    sys.exit()
robot.deactivate()
robot.activate()
print(os.sched_getparam(robot.link._watch.watchdog.pid).sched_priority, flush=True)
"""
    )
    with program(code, shared_device) as process:
        said = first_line(process)
    if said == "not allowed":
        pytest.skip("real-time priority isn't allowed here")
    assert said == "11"
