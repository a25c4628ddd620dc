"""Timing of an episode: exact counts, nearest-rank percentiles, round trips."""

from __future__ import annotations

import math

import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.links.lateness import EpisodeStopwatch, first_byte

CONFIG = RobotConfig.preset("acsar")


@pytest.mark.parametrize(("late_after", "late_ticks"), [(None, 3), (0.5, 2)])
def test_lateness_counts_late_ticks(late_after: float | None, late_ticks: int) -> None:
    config = CONFIG if late_after is None else CONFIG.with_(late_after=late_after)
    stopwatch = EpisodeStopwatch(config)
    assert math.isnan(stopwatch.summary().lateness.worst)
    assert stopwatch.tick(9.0) is None  # the deadline of the first tick is the reset's
    for seconds in [1e-4] * 97 + [0.0049, 0.0051, 0.025]:
        assert stopwatch.tick(seconds) == seconds

    late = stopwatch.summary().lateness
    assert (late.ticks, late.late_ticks) == (100, late_ticks)
    assert late.late_share == late_ticks / 100
    assert (late.p99, late.worst) == (0.0051, 0.025)


@pytest.mark.parametrize(
    ("commands", "trips"),
    [
        ([(1.0, 0, 0), (1.01, 1, 0), (1.05, 1, 1), (1.2, 0, 0), (2.0, 1, 0), (2.1, 1, 1)], 2),
        ([(1.0, 1, 0), (1.01, 0, 0), (1.02, 0, 1)], 0),
    ],
    ids=["two starts", "called off"],
)
def test_round_trip_lasts_from_the_command_to_turning_wheels(
    commands: list[tuple[float, int, int]], trips: int
) -> None:
    stopwatch = EpisodeStopwatch(CONFIG)
    for written, drives, turns in commands:
        if stopwatch.commanded(written, 3.0 if turns else 0.0, drives=bool(drives)):
            stopwatch.heard([(written + 0.008, b"ap03.00,\r\n")], written + 0.01)
    assert stopwatch.summary().round_trips == pytest.approx([0.048, 0.108][:trips])


@pytest.mark.parametrize(
    ("arrivals", "stamp"),
    [
        ([], 9.0),
        ([(1.0, b"ap01.00\r\nap0"), (2.0, b"2.00\r"), (3.0, b"\n")], 1.0),
        ([(1.0, b"ap01.00\r\n"), (2.0, b"ap02.00\r\nap"), (3.0, b"03")], 2.0),
    ],
    ids=["unknown", "pieces", "next too"],
)
def test_first_byte_is_that_of_the_newest_whole_line(
    arrivals: list[tuple[float, bytes]], stamp: float
) -> None:
    assert first_byte(arrivals, 9.0) == stamp
