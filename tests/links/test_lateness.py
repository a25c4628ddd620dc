"""Timing of an episode: exact counts, nearest-rank percentiles, round trips."""

from __future__ import annotations

import math

import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.links.lateness import EpisodeStopwatch, first_byte

CONFIG = RobotConfig.preset("acsar")


def stopwatch_after(*lateness: float, config: RobotConfig = CONFIG) -> EpisodeStopwatch:
    """A stopwatch after ticks that ended late by these times [s]. The first tick doesn't count."""
    stopwatch = EpisodeStopwatch(config)
    for seconds in (9.0, *lateness):
        stopwatch.tick(seconds, age=0.0)
    return stopwatch


def test_lateness_counts_late_and_missed_ticks() -> None:
    timing = stopwatch_after(*[1e-4] * 98, 0.003, 0.025).summary().lateness
    assert (timing.ticks, timing.late_ticks, timing.missed_ticks) == (100, 2, 2)
    assert timing.late_share == 0.02
    assert (timing.p50, timing.p99, timing.worst) == (1e-4, 0.003, 0.025)
    config = CONFIG.with_(late_after=0.5)
    assert stopwatch_after(0.0049, 0.0051, config=config).summary().lateness.late_ticks == 1


def test_lateness_before_the_first_tick_does_not_count() -> None:
    stopwatch = EpisodeStopwatch(CONFIG)
    assert math.isnan(stopwatch.summary().lateness.worst)
    assert stopwatch.tick(3.0, age=2.0) is None
    assert stopwatch.tick(0.003, age=0.01) == 0.003
    timing = stopwatch.summary()
    assert (timing.lateness.ticks, timing.worst_feedback_age) == (1, 0.01)


START = [(1.0, True, False), (1.03, True, True), (1.04, False, True), (1.2, False, False)]


@pytest.mark.parametrize(
    ("commands", "trips"),
    [
        ([(1.0, False, False), (1.01, True, False), (1.05, True, True)], [0.048]),
        ([*START, (2.0, True, False), (2.05, True, True)], [0.038, 0.058]),
        ([(1.0, True, False), (1.01, False, False), (1.02, False, True)], []),
    ],
    ids=["one start", "two starts", "called off"],
)
def test_round_trip_lasts_from_the_command_to_turning_wheels(
    commands: list[tuple[float, bool, bool]], trips: list[float]
) -> None:
    stopwatch = EpisodeStopwatch(CONFIG)
    for written, drives, turns in commands:
        if stopwatch.commanded(written, 3.0 if turns else 0.0, drives=drives):
            stopwatch.heard([(written + 0.008, b"ap03.00,\r\n")], written + 0.01)
    assert stopwatch.summary().round_trips == pytest.approx(trips)


@pytest.mark.parametrize(
    ("arrivals", "stamp"),
    [
        ([], 9.0),
        ([(1.0, b"ap01.00\r\nap0"), (2.0, b"2.00\r"), (3.0, b"\n")], 1.0),
        ([(1.0, b".00\r\n"), (2.0, b"\n"), (2.5, b"ap"), (3.0, b"02.00\r\n")], 2.5),
        ([(1.0, b"ap01.00\r\n"), (2.0, b"ap02.00\r\nap"), (3.0, b"03")], 2.0),
    ],
    ids=["unknown", "pieces", "after a remainder", "next too"],
)
def test_first_byte_is_that_of_the_newest_whole_line(
    arrivals: list[tuple[float, bytes]], stamp: float
) -> None:
    assert first_byte(arrivals, 9.0) == stamp
