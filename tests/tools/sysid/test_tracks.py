"""Tracks: true poses, recorded commands sent to a twin, and times without the host's jitter."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rollout_tools import HIDDEN, driven, random_steps, recording

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid.tracks import (
    add_truth,
    make_recorded_track,
    remove_jitter,
    replay_commands,
)

ACSAR = RobotConfig.preset("acsar")
PERIOD = 0.02


def test_make_recorded_track_has_the_drivers_odometry() -> None:
    episode = driven(ACSAR, random_steps(0, 4.0, ACSAR))
    track = make_recorded_track(episode, ACSAR)
    assert np.ptp(episode.poses[:, 2]) > 0.5
    assert track.odometry[:, :2] == pytest.approx(episode.poses[:, :2], abs=0.01)
    turned = np.unwrap(episode.poses[:, 2])
    assert track.odometry[:, 2] == pytest.approx(turned, abs=0.05)
    assert track.twists[-1] == pytest.approx(episode.twists[-1])


def test_add_truth_takes_the_poses_of_an_emulators_log(tmp_path: Path) -> None:
    """Of an emulator whose robot had already moved, and that still writes."""
    episode = driven(ACSAR, random_steps(0, 2.0, ACSAR))
    blind = recording(ACSAR, replace(episode, truth=np.full_like(episode.truth, np.nan)))
    path = tmp_path / "log.jsonl"

    def write_log(shift: float) -> None:
        events = [{"t": episode.stamps[0] - ACSAR.period + shift, "pose": [1.0, 2.0, 0.0]}]
        for stamp, pose in zip(episode.stamps.tolist(), episode.truth.tolist(), strict=True):
            moved = [pose[0] + 1.0, pose[1] + 2.0, pose[2]]
            events += [{"t": stamp + shift, "pose": moved}, {"t": stamp, "rx": ""}]
        path.write_text("".join(f"{json.dumps(event)}\n" for event in events) + '{"t": 9', "ascii")

    write_log(0.0)
    track = make_recorded_track(add_truth(blind, path).episodes[0], ACSAR)
    assert track.truth == pytest.approx(make_recorded_track(episode, ACSAR).truth, abs=1e-3)
    write_log(0.5)
    with pytest.raises(ConfigError, match=r"log\.jsonl: is of another time"):
        add_truth(blind, path)


@pytest.mark.parametrize("rate", [0.99, 1.01])
def test_remove_jitter_moves_late_lines_back(rate: float) -> None:
    rng = np.random.default_rng(0)
    true = 5.0 + rate * PERIOD * np.arange(1000)
    late = np.maximum.accumulate(true + rng.exponential(0.002, 1000))
    assert np.abs(late - true).max() > 0.008
    assert np.quantile(np.abs(remove_jitter(late, PERIOD) - true), 0.99) < 0.0015


def test_remove_jitter_follows_lost_lines_and_a_jump_of_the_clock() -> None:
    true = PERIOD * np.arange(600)
    true[300:] += 0.007
    kept = np.delete(true, [40, 41, 42, 300, 500])
    errors = np.abs(remove_jitter(kept, PERIOD) - kept)
    assert errors.max() < 0.008
    assert np.median(errors) < 0.001


def test_remove_jitter_keeps_lines_that_are_not_periodic() -> None:
    stamps = np.cumsum(np.random.default_rng(0).uniform(0.001, 0.1, 200))
    assert remove_jitter(stamps, PERIOD).tolist() == stamps.tolist()
    few = np.array([0.0, 0.02])
    assert remove_jitter(few, PERIOD) is few


@pytest.mark.parametrize("stamped", [False, True])
def test_replay_commands_repeats_the_log_with_the_right_twin(*, stamped: bool) -> None:
    hidden = ACSAR.with_(**HIDDEN)
    episode = driven(hidden, random_steps(0, 3.0, hidden))
    wire = hidden.wire_time if stamped else 0.0
    log = replace(
        episode.wire,
        sent_stamps=episode.wire.sent_stamps + wire,
        got_stamps=episode.wire.got_stamps - wire,
        stamped=stamped,
    )

    twin, poses = replay_commands(hidden, log, episode.stamps)
    assert twin.stamped == stamped
    assert poses == pytest.approx(episode.truth, abs=1e-9)
    stamps, speeds = twin.feedback(hidden)
    expected_stamps, expected = log.feedback(hidden)
    assert speeds[: len(expected)].tolist() == expected.tolist()
    assert stamps[: len(expected)] == pytest.approx(expected_stamps, abs=0.001)


@pytest.mark.parametrize(("phase", "rate"), [(0.0, 20.0), (0.0075, 100.0), (0.0075, 20.0)])
def test_replay_commands_finds_the_boards_phase(phase: float, rate: float) -> None:
    config = ACSAR.with_(firmware={"feedback_rate": rate})
    episode = driven(config, random_steps(1, 2.0, config), phase=phase)
    twin, _ = replay_commands(config, episode.wire, episode.stamps)
    stamps, speeds = episode.wire.feedback(config)
    twin_stamps, twin_speeds = twin.feedback(config)
    nearest = np.abs(twin_stamps[:, None] - stamps).argmin(axis=0)
    assert twin_stamps[nearest] == pytest.approx(stamps, abs=0.001)
    assert np.abs(twin_speeds[nearest] - speeds).max() < 1.0


def test_replay_commands_refuses_a_log_without_commands() -> None:
    with pytest.raises(ConfigError, match="no commands to replay"):
        replay_commands(ACSAR, WireLog.of((), ()), np.zeros(0))
