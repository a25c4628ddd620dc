"""The gap of twins whose hidden parameters are known."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from sysid_tools import HIDDEN, driven, random_steps, recording

from acsar_gym import RobotConfig
from acsar_gym.config import Measured
from acsar_gym.errors import ConfigError
from acsar_gym.recording.types import Recording
from acsar_gym.tools.sysid.twin_gap import (
    GAP_METRICS,
    TwinGap,
    conclude_gap,
    measure_gap,
)

ACSAR = RobotConfig.preset("acsar")
ROBOT = ACSAR.with_(**HIDDEN)


@cache
def log(seed: int = 0) -> Recording:
    """A recording of the hidden robot."""
    episode = driven(ROBOT, random_steps(seed, 8.0, ROBOT), phase=0.0025)
    return recording(ACSAR, episode, name=f"log {seed}")


def measure(*logs: Recording, robot: RobotConfig = ROBOT) -> TwinGap:
    named = list(zip("abc", logs, strict=False))
    return measure_gap(named, ("robot.yaml", robot), ("acsar", ACSAR))


def test_measure_gap_of_the_right_twin_is_a_tenth() -> None:
    gap = measure(*(log(seed) for seed in range(3)))
    preset = gap.figures("before")
    twin = gap.figures("after")
    assert preset["wheel_speed_rms"] > 0.5 > 50.0 * twin["wheel_speed_rms"]
    assert preset["end_pose"] > 0.005 > 50.0 * twin["end_pose"]
    assert preset["time_shift"] == pytest.approx(0.14 - 0.08, abs=0.03)
    assert abs(twin["time_shift"]) < 1e-3
    assert not gap.notes


def test_measure_gap_refuses_logs_of_different_robots() -> None:
    for changes, field in (
        ({"baud_rate": 57600}, "baud_rate is 57600, but 115200 in a"),
        ({"wheelbase": 0.35}, "wheelbase is 0.35 m, but 0.22 m in a"),
    ):
        unlike = replace(log(1), config=ACSAR.with_(**changes))
        with pytest.raises(ConfigError, match=f"b: is of another robot: {field}"):
            measure(log(0), unlike)


def test_measure_gap_notes_what_is_odd_about_a_log() -> None:
    (episode,) = log().episodes
    sent = episode.wire.sent_stamps + 0.25 * (episode.wire.sent_stamps > 3.0)
    late = replace(episode, wire=replace(episode.wire, sent_stamps=sent))
    config = ACSAR.with_(wheel_radius=0.08)
    odd = replace(log(), cut=True, dropped=3, config=config, episodes=(late,))
    robot = ROBOT.with_(motor_fit="doesn't fit: holds at reversals")

    expected = (
        "robot.yaml: this robot's simulation doesn't fit: holds at reversals",
        "its end is missing",
        "3 ticks are missing",
        "wheel_radius = 0.08",
        "sent for 0.26 s",
    )
    notes = measure(odd, robot=robot).notes
    assert all(text in note for note, text in zip(notes, expected, strict=True))


def test_measure_gap_compares_odometry_without_a_truth() -> None:
    episode = log().episodes[0]
    blind = replace(episode, truth=np.full_like(episode.truth, np.nan))
    gap = measure(recording(ACSAR, blind))
    twin = gap.figures("after")
    assert twin["end_pose"] < 1e-4
    assert twin["yaw_rms"] < 1e-3
    assert "are by odometry of both" in gap.notes[0]


def test_figures_pool_squares_by_duration() -> None:
    (replay,) = measure(log()).logs
    figures = {"after": dict.fromkeys(GAP_METRICS, 1.0)}
    short = replace(replay, seconds=1.0, figures=figures)
    doubled = {"after": dict.fromkeys(GAP_METRICS, 2.0) | {"time_shift": math.nan}}
    long = replace(replay, seconds=3.0, figures=doubled)

    pooled = replace(measure(log()), logs=[short, long]).figures("after")
    assert pooled["wheel_speed_rms"] == pytest.approx(math.sqrt(13.0 / 4.0))
    assert (pooled["end_pose"], pooled["time_shift"]) == (1.5, 1.0)


@pytest.mark.parametrize("fits", [True, False])
def test_measure_gap_judges_held_out_logs(*, fits: bool) -> None:
    """Also if the model didn't fit, and values have no intervals."""
    hashes = (log(0).sha256,)
    interval = Measured(low=0.13, high=0.15, method="identify", logs=hashes)
    changes: dict[str, Any] = {"measured": {"motor.time_constant.a": interval}}
    if not fits:
        changes = {"motor_fit": "doesn't fit: holds at reversals", "motor_fit_logs": hashes}
    robot = ROBOT.with_(**changes)
    gap = measure(log(0), log(1), robot=robot)
    assert [replay.fitted for replay in gap.logs] == [True, False]
    assert [replay.log for replay in gap.judged] == ["b"]
    gap = measure(log(0), robot=robot)
    assert len(gap.judged) == 1
    assert "none is held out" in gap.notes[-1]
    assert "1 fitted episode, 8 s" in conclude_gap(gap)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"stamps": np.arange(1000) * 1e6}, "is longer than 4 h"),
        ({"stamps": -np.arange(1000.0)}, "its times go backwards"),
        ({"poses": np.full((1000, 3), np.nan)}, "its odometry isn't finite"),
    ],
)
def test_measure_gap_leaves_a_damaged_episode_out(changes: dict[str, Any], reason: str) -> None:
    episode = log().episodes[0]
    damaged = replace(episode, **changes)
    gap = measure(replace(log(), episodes=(damaged, episode)))
    assert gap.notes[0].startswith(f"a #0: left out, {reason}")
    assert [replay.episode for replay in gap.logs] == [1]
    with pytest.raises(ConfigError, match=f"a #0: left out, {reason}"):
        measure(replace(log(), episodes=(damaged,)))
