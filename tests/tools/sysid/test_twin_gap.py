"""The gap of twins whose hidden parameters are known."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from rollout_tools import HIDDEN, driven, random_steps, recording

from acsar_gym import RobotConfig
from acsar_gym.config import Measured
from acsar_gym.errors import ConfigError
from acsar_gym.recording.types import Floats, Recording
from acsar_gym.tools.sysid.twin_gap import (
    GAP_METRICS,
    EpisodeReplay,
    TwinGap,
    conclude_gap,
    measure_gap,
)

ACSAR = RobotConfig.preset("acsar")
ROBOT = ACSAR.with_(**HIDDEN)


@cache
def log(seed: int = 0, duration: float = 8.0, extra: float = 0.0) -> Recording:
    """A recording of the hidden robot, whose board takes `extra` seconds for each line."""
    processing = ACSAR.firmware.processing_time + extra
    hidden = ROBOT.with_(firmware={"processing_time": processing})
    episode = driven(hidden, random_steps(seed, duration, hidden), phase=0.0025)
    return recording(ACSAR, episode, name=f"log {seed}")


def measure(*logs: Recording, robot: RobotConfig = ROBOT) -> TwinGap:
    named = list(zip("abc", logs, strict=False))
    return measure_gap(named, ("robot.yaml", robot), ("acsar", ACSAR))


def test_measure_gap_of_the_right_twin_is_a_tenth() -> None:
    gap = measure(*(log(seed) for seed in range(3)))
    preset = gap.figures("before")
    twin = gap.figures("after")
    assert preset["wheel_speed_rms"] > 0.5
    assert twin["wheel_speed_rms"] < 0.01
    assert preset["end_pose"] > 0.005
    assert twin["end_pose"] < 1e-4
    assert preset["time_shift"] == pytest.approx(0.14 - 0.08, abs=0.03)
    assert abs(twin["time_shift"]) < 1e-3
    assert not gap.notes


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"wheels": {"b": {"motor": "b", "sign": -1}}}, r"wheels\.b"),
        ({"wheelbase": 0.35}, "wheelbase is 0.35 m, but 0.22 m in a"),
    ],
)
def test_measure_gap_refuses_logs_of_different_robots(changes: dict[str, Any], field: str) -> None:
    unlike = replace(log(1), config=ACSAR.with_(**changes))
    with pytest.raises(ConfigError, match=f"b: is of another robot: {field}"):
        measure(log(0), unlike)


def test_measure_gap_notes_what_is_odd_about_a_log() -> None:
    odd = replace(log(), cut=True, dropped=3, config=ACSAR.with_(wheel_radius=0.08))
    wire = odd.episodes[0].wire
    sent = wire.sent_stamps + np.where(wire.sent_stamps > 3.0, 0.25, 0.0)
    late = replace(odd.episodes[0], wire=replace(wire, sent_stamps=sent))
    robot = ROBOT.with_(motor_fit="doesn't fit: holds at reversals")
    expected = (
        "robot.yaml: this robot's simulation doesn't fit: holds at reversals",
        "its end is missing",
        "3 ticks are missing",
        "wheel_radius = 0.08",
        "sent for 0.26 s",
    )
    notes = measure(replace(odd, episodes=(late,)), robot=robot).notes
    assert all(text in note for note, text in zip(notes, expected, strict=True))


def test_measure_gap_compares_odometry_without_a_truth() -> None:
    episode = log().episodes[0]
    blind = replace(episode, truth=np.full_like(episode.truth, np.nan))
    gap = measure(recording(ACSAR, blind))
    twin = gap.figures("after")
    assert twin["end_pose"] == twin["end_odometry"] < 1e-4  # odometry of both
    assert twin["yaw_rms"] < 1e-3
    assert "are by odometry of both" in gap.notes[0]


def test_measure_gap_finds_ten_milliseconds_of_delay() -> None:
    gap = measure(*(log(seed, 20.0, extra=0.010) for seed in (3, 4)))
    shift = gap.figures("after")["time_shift"]
    assert shift == pytest.approx(0.020, abs=0.002)  # the answer is late as well


def test_figures_pool_squares_by_duration() -> None:
    replays = [
        EpisodeReplay(
            "a",
            0,
            fitted=False,
            seconds=seconds,
            truth=True,
            figures={"after": dict.fromkeys(GAP_METRICS, size)},
        )
        for seconds, size in ((1.0, 1.0), (3.0, 2.0))
    ]
    replays[1].figures["after"]["time_shift"] = math.nan

    pooled = TwinGap("robot", "acsar", "planar", tuple(replays), ()).figures("after")
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
    assert [replay.fitted for replay in gap.replays] == [True, False]
    assert [replay.log for replay in gap.judged] == ["b"]
    gap = measure(log(0), robot=robot)
    assert len(gap.judged) == 1
    assert "none is held out" in gap.notes[-1]
    assert "1 fitted episode, 8 s" in conclude_gap(gap)


@pytest.mark.parametrize(
    ("field", "damage", "reason"),
    [
        ("stamps", lambda stamps: stamps * 1e6, "is longer than 4 h"),
        ("stamps", lambda stamps: stamps[::-1], "its times go backwards"),
        ("stamps", lambda stamps: stamps[:1], "holds less than 1 s"),
        ("poses", lambda poses: poses * np.nan, "its odometry isn't finite"),
    ],
)
def test_measure_gap_leaves_a_damaged_episode_out(
    field: str, damage: Callable[[Floats], Floats], reason: str
) -> None:
    episode = log().episodes[0]
    fields: dict[str, Any] = {field: damage(getattr(episode, field))}
    damaged = replace(episode, **fields)
    gap = measure(replace(log(), episodes=(damaged, episode)))
    assert gap.notes[0].startswith(f"a #0: left out, {reason}")
    assert [replay.episode for replay in gap.replays] == [1]
    with pytest.raises(ConfigError, match=f"a #0: left out, {reason}"):
        measure(replace(log(), episodes=(damaged,)))
