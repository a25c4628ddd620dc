"""Percentiles against sorted lists, exact counts, bounded memory."""

from __future__ import annotations

import contextlib
import math
import pickle
import random

import gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.links import Link, open_link
from acsar_gym.links import lateness as lateness_module
from acsar_gym.links.base import ForwardingLink
from acsar_gym.links.lateness import (
    DurationRecord,
    DurationSpread,
    EpisodeStopwatch,
    LatenessRecord,
    first_byte,
)
from acsar_gym.tools.evaluation.episodes import run_episodes
from acsar_gym.tools.policies import OnnxPolicy
from acsar_gym.worlds import Scene

Floats = NDArray[np.float64]

CONFIG = RobotConfig.preset("acsar")


def lateness(*seconds: float) -> LatenessRecord:
    record = LatenessRecord(CONFIG)
    for one in seconds:
        record.add(one)
    return record


@given(st.lists(st.floats(0.0, 1e6), min_size=1), st.floats(0.0, 100.0))
def test_percentiles_and_extremes_are_exact(seconds: list[float], q: float) -> None:
    durations = DurationRecord()
    for one in seconds:
        durations.add(one)
    rank = max(1, math.ceil(q / 100.0 * len(seconds)))
    assert durations.percentile(q) in sorted(seconds)[max(rank - 2, 0) : rank + 1]
    assert (durations.count, durations.worst) == (len(seconds), max(seconds))


def test_nothing_recorded_is_nan() -> None:
    timing = LatenessRecord(CONFIG).summary()
    assert (timing.ticks, timing.late_ticks, timing.missed_ticks) == (0, 0, 0)
    assert all(map(math.isnan, (timing.p50, timing.p99, timing.worst)))
    assert timing.late_share == 0.0
    assert DurationRecord().spread().count == 0


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


class LateLink(ForwardingLink):
    """A simulated robot whose host is late: some ticks end late, and the next ones are shorter.

    Args:
        link: to the robot.
        share: of the ticks that are late.
        lateness: of each of them [s].
    """

    def __init__(self, link: Link, share: float, lateness: float) -> None:
        super().__init__(link)
        self._share, self._lateness = share, lateness

    def reset(self, scene: Scene) -> None:
        super().reset(scene)
        self._rng, self._late = random.Random(0), 0.0

    def advance(self, period: float) -> bytes:
        before = self._late
        self._late = self._lateness if self._rng.random() < self._share else 0.0
        return super().advance(period + self._late - before)


def find_odometry_errors(share: float, lateness: float) -> Floats:
    """Odometry errors of 60 drives whose ticks are late [m]."""
    config = CONFIG.with_(firmware={"loop_rate": 1000.0, "feedback_rate": 200.0})  # steps of 1 ms
    link = LateLink(open_link("planar", config), share, lateness)
    env = gymnasium.make("acsar_gym/PointGoal-v0", link=link, robot=config)
    with contextlib.closing(env):
        policy = OnnxPolicy("point_goal")
        return np.array([one.odometry_error for one in run_episodes(env, policy, 60, seed=0)])


@pytest.mark.slow
def test_odometry_does_not_tell_ticks_that_are_not_late() -> None:
    """Whatever their share; the limit of `--late-share`, 1 %, is for later ones."""
    exact = find_odometry_errors(0.0, 0.0)
    print(f"error of odometry: {exact.mean() * 1e3:.1f} mm")
    worst = {}
    for share in (0.01, 0.1, 0.5, 1.0):
        for lateness in (0.001, 0.002, 0.005, 0.01):
            changes = 1e3 * (find_odometry_errors(share, lateness) - exact)
            worst[share, lateness] = most = np.abs(changes).max()
            late = f"{share:4.0%} of the ticks {lateness * 1e3:2.0f} ms late"
            print(f"{late}: {changes.mean():+.2f} mm, at most {most:.1f} mm")
    unnoticed = max(one for (_, lateness), one in worst.items() if lateness <= CONFIG.late_tick)
    assert unnoticed < 2.0 < max(worst.values())


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
