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


@pytest.mark.parametrize("rate", [0.99, 1.0, 1.01])
def test_late_lines_are_moved_back(rate: float) -> None:
    rng = np.random.default_rng(0)
    true = 5.0 + rate * PERIOD * np.arange(1000)
    late = np.maximum.accumulate(true + rng.exponential(0.002, 1000))
    assert np.abs(late - true).max() > 0.008
    assert np.quantile(np.abs(remove_jitter(late, PERIOD) - true), 0.99) < 0.0015


def test_lost_lines_and_a_jump_of_the_clock_are_followed() -> None:
    true = PERIOD * np.arange(600)
    true[300:] += 0.007
    kept = np.delete(true, [40, 41, 42, 300, 500])
    errors = np.abs(remove_jitter(kept, PERIOD) - kept)
    assert errors.max() < 0.008
    assert np.median(errors) < 0.001


def test_what_isnt_periodic_stays() -> None:
    stamps = np.cumsum(np.random.default_rng(0).uniform(0.001, 0.1, 200))
    assert remove_jitter(stamps, PERIOD).tolist() == stamps.tolist()
    few = np.array([0.0, 0.02])
    assert remove_jitter(few, PERIOD) is few
    assert remove_jitter(np.zeros(9), PERIOD).tolist() == [0.0] * 9


def test_the_right_twin_repeats_the_log() -> None:
    hidden = ACSAR.with_(**HIDDEN)
    episode = driven(hidden, random_steps(0, 3.0, hidden), start=(1.0, 2.0, 0.0))
    done = replay_commands(hidden, episode.wire, episode.stamps)
    assert b"".join(done.wire.got)[: len(b"".join(episode.wire.got))] == b"".join(episode.wire.got)
    assert done.poses[:, :2] + [1.0, 2.0] == pytest.approx(episode.truth[:, :2], abs=1e-9)


def test_where_nothing_takes_time_on_a_wire_it_takes_none_in_the_twin() -> None:
    hidden = ACSAR.with_(**HIDDEN)
    episode = driven(hidden, random_steps(0, 3.0, hidden))
    log, wire = episode.wire, hidden.wire_time
    ros = replace(
        log, sent_stamps=log.sent_stamps + wire, got_stamps=log.got_stamps - wire, stamped=True
    )
    done = replay_commands(hidden, ros, episode.stamps)
    assert done.wire.stamped
    assert done.poses == pytest.approx(episode.truth, abs=1e-9)
    stamps, speeds = (one[: len(log.got)] for one in done.wire.feedback(hidden))
    assert stamps == pytest.approx(ros.feedback(hidden)[0], abs=0.001)
    assert speeds.tolist() == log.feedback(hidden)[1].tolist()


@pytest.mark.parametrize("phase", [0.0, 0.0025, 0.0075])
@pytest.mark.parametrize("rate", [100.0, 20.0])
def test_the_boards_phase_is_found(phase: float, rate: float) -> None:
    config = ACSAR.with_(firmware={"feedback_rate": rate})
    episode = driven(config, random_steps(1, 2.0, config), phase=phase)
    done = replay_commands(config, episode.wire, episode.stamps)
    stamps, speeds = episode.wire.feedback(config)
    own_stamps, own_speeds = done.wire.feedback(config)
    nearest = np.abs(own_stamps[:, None] - stamps).argmin(axis=0)
    assert own_stamps[nearest] == pytest.approx(stamps, abs=0.001)
    assert np.abs(own_speeds[nearest] - speeds).max() < 1.0


def test_a_log_without_commands_and_an_unknown_body_are_refused() -> None:
    nothing = WireLog(np.zeros(0), (), np.zeros(0), ())
    with pytest.raises(ConfigError, match="no commands to replay"):
        replay_commands(ACSAR, nothing, np.zeros(0))
    one = WireLog(np.zeros(1), (b"\r\n",), np.zeros(0), ())
    with pytest.raises(ConfigError, match="did you mean 'planar'"):
        replay_commands(ACSAR, one, np.zeros(1), body="planet")
