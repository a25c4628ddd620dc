"""Percentiles against sorted lists, exact counts, bounded memory."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.links import lateness as lateness_module
from acsar_gym.links.lateness import (
    DurationSpread,
    EpisodeStopwatch,
    LatenessRecord,
    first_byte,
)

Floats = NDArray[np.float64]

CONFIG = RobotConfig.preset("acsar")


def lateness(*seconds: float) -> LatenessRecord:
    record = LatenessRecord(CONFIG)
    for one in seconds:
        record.add(one)
    return record


def test_a_summary_of_a_known_episode() -> None:
    record = lateness(*[1e-4] * 98, 0.003, 0.025)
    timing = record.summary()
    assert (timing.ticks, timing.late_ticks, timing.missed_ticks) == (100, 2, 2)
    assert timing.late_share == 0.02
    assert timing.p50 == 1e-4
    assert timing.p99 == 0.003
    assert timing.worst == 0.025
    spread = record.spread()
    assert (spread.count, spread.p99, spread.worst) == (100, timing.p99, timing.worst)


def test_the_robots_file_says_what_is_late() -> None:
    record = LatenessRecord(CONFIG.with_(late_after=0.5))
    record.add(0.0049)
    record.add(0.0051)
    assert (record.late, record.limit) == (1, 0.005)


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lateness_module, "KEPT_DURATIONS", 100)
    record = LatenessRecord(CONFIG)
    for number in range(1_000):
        record.add(number * 1e-6)
    assert record.count == 1_000
    assert len(pickle.dumps(record)) < 2_500


def trips(*commands: tuple[float, bool, bool]) -> DurationSpread:
    """Round trips of an episode: when commands are written, whether they drive, and whether wheels
    turn by the feedback that comes 8 ms later.
    """
    watch = EpisodeStopwatch(CONFIG)
    for written, drives, turns in commands:
        if watch.commanded(written, 3.0 if turns else 0.0, drives=drives):
            watch.heard([(written + 0.008, b"ap03.00,\r\n")], written + 0.01)
    return watch.summary().round_trip


def test_the_time_before_the_first_tick_is_nobodys_fault() -> None:
    watch = EpisodeStopwatch(CONFIG)
    assert watch.tick(3.0, 2.0) is None
    assert watch.summary().lateness.ticks == 0
    assert watch.tick(0.003, 0.01) == 0.003
    watch.tick(0.025, 0.0)
    timing = watch.summary()
    lateness = timing.lateness
    assert (lateness.ticks, lateness.late_ticks, lateness.missed_ticks) == (2, 2, 2)
    assert (lateness.worst, timing.feedback_age.worst) == (0.025, 0.01)
    assert timing.feedback_age.count == 2


START = [(1.0, True, False), (1.03, True, True), (1.04, False, True), (1.2, False, False)]


@pytest.mark.parametrize(
    ("asked", "count", "worst"),
    [
        (
            [(1.0, False, False), (1.01, True, False), (1.02, True, False), (1.05, True, True)],
            1,
            0.048,
        ),
        ([*START, (2.0, True, False), (2.05, True, True)], 2, 0.058),
        ([(1.0, True, False), (1.01, True, False)], 0, math.nan),  # they never turn
        ([(1.0, False, True), (1.01, True, True)], 0, math.nan),  # they turn already
        ([(1.0, True, False), (1.01, False, False), (1.02, False, True)], 0, math.nan),
        ([(1.0, False, False), (1.01, False, True)], 0, math.nan),  # pushed by hand
    ],
    ids=["one start", "two starts", "dead", "turning", "called off", "pushed"],
)
def test_a_round_trip_begins_with_the_command_and_ends_with_turning_wheels(
    asked: list[tuple[float, bool, bool]], count: int, worst: float
) -> None:
    spread = trips(*asked)
    assert spread.count == count
    assert spread.worst == pytest.approx(worst, nan_ok=True)


@pytest.mark.parametrize(
    ("arrivals", "stamp"),
    [
        ([], 9.0),
        ([(1.0, b"ap01.00,bp01.00\r\n")], 1.0),
        ([(1.0, b"ap01.00\r\nap0"), (2.0, b"2.00\r"), (3.0, b"\n")], 1.0),
        ([(1.0, b"ap01.00\r\n"), (2.0, b"ap02.00\r\n")], 2.0),
        ([(1.0, b".00\r\n"), (2.0, b"\n"), (2.5, b"ap"), (3.0, b"02.00\r\n")], 2.5),
        ([(1.0, b"01.00"), (2.0, b"\r\n")], 1.0),
        ([(1.0, b"ap01.00\r\n"), (2.0, b"ap02")], 1.0),
        ([(1.0, b"ap01.00\r\n"), (2.0, b"ap02.00\r\nap"), (3.0, b"03")], 2.0),
    ],
    ids=["untold", "one", "pieces", "newest", "after a rest", "begun before", "next", "nexts"],
)
def test_a_line_arrives_with_its_first_byte(
    arrivals: list[tuple[float, bytes]], stamp: float
) -> None:
    assert first_byte(arrivals, 9.0) == stamp
