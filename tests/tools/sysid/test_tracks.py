"""Tracks: true poses, recorded commands sent to a twin, and times without the host's jitter."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sysid_tools import HIDDEN, driven, random_steps, recording

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
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


def test_add_truth_takes_the_poses_of_an_emulators_log(tmp_path: Path) -> None:
    """Of an emulator whose robot had already moved, and that still writes."""
    episode = driven(ACSAR, random_steps(0, 2.0, ACSAR))
    blind = recording(ACSAR, replace(episode, truth=np.full_like(episode.truth, np.nan)))
    path = tmp_path / "log.jsonl"

    stamps = [episode.stamps[0] - ACSAR.period, *episode.stamps]
    poses = np.add((1.0, 2.0, 0.0), np.vstack((np.zeros(3), episode.truth)))

    def write_log(shift: float) -> None:
        events = [
            {"t": stamp + shift, "pose": pose}
            for stamp, pose in zip(stamps, poses.tolist(), strict=True)
        ]
        lines = map(json.dumps, [*events, {"t": 9.0, "rx": ""}])
        path.write_text("\n".join(lines) + '\n{"t": 9', "ascii")

    write_log(0.0)
    track = make_recorded_track(add_truth(blind, path).episodes[0], ACSAR)
    assert track.truth == pytest.approx(make_recorded_track(episode, ACSAR).truth, abs=1e-3)
    write_log(0.5)
    with pytest.raises(ConfigError, match=r"log\.jsonl: is of another time"):
        add_truth(blind, path)


@pytest.mark.parametrize("rate", [0.99, 1.01])
def test_remove_jitter_moves_late_lines_back(rate: float) -> None:
    """Also if some are lost, and if the board's clock jumps."""
    rng = np.random.default_rng(0)
    true = np.delete(5.0 + rate * PERIOD * np.arange(1000), [40, 41, 42, 500])
    true[700:] += 0.007
    late = np.maximum.accumulate(true + rng.exponential(0.002, len(true)))
    assert np.abs(late - true).max() > 0.008
    assert np.quantile(np.abs(remove_jitter(late, PERIOD) - true), 0.95) < 0.0015


def test_remove_jitter_keeps_lines_that_are_not_periodic() -> None:
    stamps = np.cumsum(np.random.default_rng(0).uniform(0.001, 0.1, 200))
    for kept in (stamps, stamps[:2]):
        assert remove_jitter(kept, PERIOD).tolist() == kept.tolist()


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


@pytest.mark.parametrize(("phase", "rate"), [(0.0, 20.0), (0.0075, 100.0)])
def test_replay_commands_finds_the_boards_phase(phase: float, rate: float) -> None:
    config = ACSAR.with_(firmware={"feedback_rate": rate})
    episode = driven(config, random_steps(1, 2.0, config), phase=phase)
    twin, _ = replay_commands(config, episode.wire, episode.stamps)
    away = twin.feedback(config)[0][:, None] - episode.wire.feedback(config)[0]
    assert np.abs(away).min(axis=0).max() < 0.001
