"""Recordings played again: through the twin, and their times without the jitter of the host."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rollout_tools import HIDDEN, driven, random_steps

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid.twin_replay import remove_jitter, replay_commands

ACSAR = RobotConfig.preset("acsar")
PERIOD = 0.02


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

    replay = replay_commands(hidden, log, episode.stamps)
    assert replay.wire.stamped == stamped
    assert replay.poses == pytest.approx(episode.truth, abs=1e-9)
    stamps, speeds = replay.wire.feedback(hidden)
    expected_stamps, expected = log.feedback(hidden)
    assert speeds[: len(expected)].tolist() == expected.tolist()
    assert stamps[: len(expected)] == pytest.approx(expected_stamps, abs=0.001)


@pytest.mark.parametrize("phase", [0.0, 0.0075])
@pytest.mark.parametrize("rate", [100.0, 20.0])
def test_replay_commands_finds_the_boards_phase(phase: float, rate: float) -> None:
    config = ACSAR.with_(firmware={"feedback_rate": rate})
    episode = driven(config, random_steps(1, 2.0, config), phase=phase)
    replay = replay_commands(config, episode.wire, episode.stamps)
    stamps, speeds = episode.wire.feedback(config)
    twin_stamps, twin_speeds = replay.wire.feedback(config)
    nearest = np.abs(twin_stamps[:, None] - stamps).argmin(axis=0)
    assert twin_stamps[nearest] == pytest.approx(stamps, abs=0.001)
    assert np.abs(twin_speeds[nearest] - speeds).max() < 1.0


def test_replay_commands_refuses_a_log_without_commands_and_an_unknown_body() -> None:
    empty = WireLog(np.zeros(0), (), np.zeros(0), ())
    with pytest.raises(ConfigError, match="no commands to replay"):
        replay_commands(ACSAR, empty, np.zeros(0))
    log = WireLog(np.zeros(1), (b"\r\n",), np.zeros(0), ())
    with pytest.raises(ConfigError, match="did you mean 'planar'"):
        replay_commands(ACSAR, log, np.zeros(1), body="planet")
