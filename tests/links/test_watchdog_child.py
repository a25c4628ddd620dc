"""When the watchdog looks and what it does, without processes."""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest
from watchdog_tools import TURNING, ZEROS

from acsar_gym.links.watchdog_child import (
    BEAT,
    HANG_ZEROS,
    PAGE_SIZE,
    REPEAT_INTERVAL,
    STOOD,
    TRIPPED,
    ProgramWatch,
)
from acsar_gym.protocol import ZERO, Decoder

pytestmark = [
    pytest.mark.usefixtures("deadline", "nursery"),
    pytest.mark.xdist_group("serial"),
]

TIMEOUT_OF_DOG = 0.15


class Clock:
    """A watch over a page of its own, asked at chosen times."""

    def __init__(self) -> None:
        self.page = memoryview(bytearray(PAGE_SIZE)).cast("d")
        self.zeros = 0
        self.taken = False
        self.watch = ProgramWatch(self.page, -1, os.getpid(), TIMEOUT_OF_DOG, self)
        self.watch._due = 0.0

    def stop(self, wanted: Callable[[], bool] = lambda: True) -> bool:
        self.zeros += wanted()
        return True

    def find(self) -> bool:
        raise AssertionError("nothing is lost")

    answers = find

    def share(self) -> None:
        raise AssertionError("nothing is shared")

    def look(self, now: float) -> float:
        due = self.watch._look(now)
        self.watch._due = due
        return due


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_it_looks_again_when_the_newest_sign_is_too_old(clock: Clock) -> None:
    clock.page[BEAT] = 100.0
    assert clock.look(100.01) == 100.15
    clock.page[BEAT] = 100.14
    assert clock.look(100.15) == pytest.approx(100.29)
    assert clock.zeros == 0
    assert clock.look(100.29) == pytest.approx(100.34)
    assert clock.zeros == 1
    assert clock.page[TRIPPED] == pytest.approx(0.15)


def test_a_gap_in_which_it_was_suspended_itself_trips_too(clock: Clock) -> None:
    """As where a container is paused, or the computer's lid is closed."""
    clock.page[BEAT] = 100.0
    clock.look(100.01)
    clock.look(105.0)
    assert clock.zeros == 1
    assert clock.page[TRIPPED] == pytest.approx(5.0)
    clock.page[BEAT] = 105.01
    clock.look(105.02)
    assert clock.page[TRIPPED], "until the reset"


def test_a_gap_that_the_program_found_is_answered_with_zeros(clock: Clock) -> None:
    for gap in (3.0, 4.0):
        clock.zeros = 0
        clock.page[TRIPPED] = gap
        for repeat in range(2 * HANG_ZEROS):
            clock.look(100.0 + repeat * REPEAT_INTERVAL)
        assert clock.zeros == HANG_ZEROS


def test_zeros_are_repeated_only_while_the_program_says_nothing(clock: Clock) -> None:
    clock.look(100.0)
    assert clock.zeros == 0
    clock.page[STOOD] = 100.0
    for milliseconds in range(0, 1000, 10):
        if milliseconds < 500:  # the program itself commands zero
            clock.page[STOOD] = 100.0 + 0.001 * milliseconds
        clock.look(100.0 + 0.001 * milliseconds)
        assert milliseconds > 500 or not clock.zeros
    assert clock.zeros == 5
    clock.page[BEAT] = 101.0
    clock.look(101.05)
    assert clock.zeros == 5


def test_what_it_writes_is_whole_and_starts_with_a_line_end() -> None:
    for cut in range(len(TURNING) + 1):
        assert Decoder().feed(TURNING[:cut] + ZEROS)[-1].speeds == ZERO
