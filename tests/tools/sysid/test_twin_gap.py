"""The gap of twins whose hidden parameters are known."""

from __future__ import annotations

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
from acsar_gym.recording.types import Recording
from acsar_gym.tools.sysid.board_log import Floats
from acsar_gym.tools.sysid.twin_gap import TwinGap, conclude_gap, measure_gap

ACSAR = RobotConfig.preset("acsar")
ROBOT = ACSAR.with_(**HIDDEN)
BEFORE = ("acsar", ACSAR)


@cache
def log(seed: int = 0, duration: float = 8.0, extra: float = 0.0) -> Recording:
    """A recording of the hidden robot, whose board takes `extra` seconds for each line."""
    processing = ACSAR.firmware.processing_time + extra
    hidden = ROBOT.with_(firmware={"processing_time": processing})
    episode = driven(hidden, random_steps(seed, duration, hidden), phase=0.0025)
    return recording(ACSAR, episode, name=f"log {seed}")


@cache
def fitted() -> TwinGap:
    """The gap of the right twin."""
    logs = [(f"{seed}.mcap", log(seed)) for seed in range(3)]
    return measure_gap(logs, ("robot.yaml", ROBOT), BEFORE)


def measure_one(one: Recording, robot: RobotConfig = ROBOT) -> TwinGap:
    return measure_gap([("a", one)], ("robot.yaml", robot), BEFORE)


def test_the_right_twin_has_a_tenth_of_the_gap() -> None:
    before, after = fitted().figures("before"), fitted().figures("after")
    assert before["wheel_speed_rms"] > 0.5
    assert after["wheel_speed_rms"] < 0.01
    assert before["end_pose"] > 0.005
    assert after["end_pose"] < 1e-4
    assert before["time_shift"] == pytest.approx(0.14 - 0.08, abs=0.03)
    assert abs(after["time_shift"]) < 1e-3


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"wheels": {"b": {"motor": "b", "sign": -1}}}, r"wheels\.b"),
        ({"baud_rate": 57600}, "baud_rate"),
        ({"wheelbase": 0.35}, "wheelbase"),
    ],
)
def test_logs_of_different_robots_are_refused(changes: dict[str, Any], field: str) -> None:
    other = replace(log(1), config=ACSAR.with_(**changes))
    with pytest.raises(ConfigError, match=f"b: is of another robot: {field}"):
        measure_gap([("a", log(0)), ("b", other)], ("robot.yaml", ROBOT), BEFORE)


def test_what_is_odd_about_a_log_is_noted() -> None:
    odd = replace(log(), cut=True, dropped=3, config=ACSAR.with_(wheel_radius=0.08))
    wire = odd.episodes[0].wire
    sent = wire.sent_stamps + np.where(wire.sent_stamps > 3.0, 0.25, 0.0)
    late = replace(odd.episodes[0], wire=replace(wire, sent_stamps=sent))
    interval = Measured(low=0.13, high=0.15, method="identify", logs=("0" * 16,))
    robot = ROBOT.with_(measured={"motor.time_constant.a": interval})
    notes = measure_one(replace(odd, episodes=(late,)), robot).notes
    told = ("its end is missing", "3 ticks are missing", "wheel_radius = 0.08", "sent for 0.26 s")
    assert [part in note for note, part in zip(notes, told, strict=True)] == [True] * 4


def test_robots_whose_model_doesnt_fit_are_noted() -> None:
    robot = ROBOT.with_(motor_fit="doesn't fit: holds at reversals")
    assert not measure_one(log()).notes
    (note,) = measure_one(log(), robot).notes
    assert note == "robot.yaml: this robot's simulation doesn't fit: holds at reversals"


def test_truth_is_left_out_where_it_isnt_known() -> None:
    known = log()
    blind = replace(known.episodes[0], truth=np.full_like(known.episodes[0].truth, np.nan))
    gap = measure_one(recording(ACSAR, blind))
    assert not gap.replays[0].recorded.known
    assert gap.figures("after")["end_pose"] < 1e-4  # the right twin, by odometry as the robot
    assert gap.figures("after")["end_pose"] == gap.figures("after")["end_odometry"]
    assert gap.figures("after")["yaw_rms"] < 1e-3
    assert "are by odometry of both" in gap.notes[0]


def test_ten_milliseconds_of_delay_are_found() -> None:
    logs = [(f"{seed}", log(seed, 20.0, extra=0.010)) for seed in (3, 4)]
    gap = measure_gap(logs, ("robot.yaml", ROBOT), BEFORE)
    shift = gap.figures("after")["time_shift"]
    assert shift == pytest.approx(0.020, abs=0.002)  # the answer is late, too


@pytest.mark.parametrize("fits", [True, False])
def test_fitted_logs_dont_count(*, fits: bool) -> None:
    """Nor where the model didn't fit, and values have no intervals."""
    hashes = (log(0).sha256,)
    interval = Measured(low=0.13, high=0.15, method="identify", logs=hashes)
    told: dict[str, Any] = {"measured": {"motor.time_constant.a": interval}}
    if not fits:
        told = {"motor_fit": "doesn't fit: holds at reversals", "motor_fit_logs": hashes}
    robot = ("robot.yaml", ROBOT.with_(**told))
    logs = [(f"{seed}.mcap", log(seed)) for seed in range(2)]
    gap = measure_gap(logs, robot, BEFORE)
    assert [replay.fitted for replay in gap.replays] == [True, False]
    assert [replay.log for replay in gap.judged] == ["1.mcap"]
    gap = measure_gap(logs[:1], robot, BEFORE)
    assert len(gap.judged) == 1
    assert "none is held out" in gap.notes[-1]
    assert "fitted episode" in conclude_gap(gap)


def test_a_short_log_is_refused() -> None:
    with pytest.raises(ConfigError, match="a #0: left out, holds less than 1 s"):
        measure_one(log(0, 0.5))
    with pytest.raises(ConfigError, match="a: holds no episode"):
        measure_one(recording(ACSAR))


@pytest.mark.parametrize(
    ("moved", "said"),
    [
        (lambda stamps: stamps * 1e6, "is longer than 4 h"),
        (lambda stamps: stamps[::-1], "its times go backwards"),
        (lambda stamps: stamps[:1], "holds less than 1 s"),
    ],
)
def test_a_damaged_episode_is_left_out(moved: Callable[[Floats], Floats], said: str) -> None:
    whole = log(0).episodes[0]
    odd = replace(log(0), episodes=(replace(whole, stamps=moved(whole.stamps)), whole))
    gap = measure_one(odd)
    assert gap.notes[0].startswith(f"a #0: left out, {said}")
    assert [replay.episode for replay in gap.replays] == [1]
