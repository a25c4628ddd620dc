"""Open-loop replay: a twin with the right parameters repeats what was recorded."""

from __future__ import annotations

import numpy as np
import pytest
from rollout_tools import HIDDEN, driven, random_steps

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.recording.replay import replay_commands
from acsar_gym.recording.types import WireLog

ACSAR = RobotConfig.preset("acsar")


def test_the_right_twin_repeats_the_log() -> None:
    hidden = ACSAR.with_(**HIDDEN)
    episode = driven(hidden, random_steps(0, 3.0, hidden), start=(1.0, 2.0, 0.0))
    done = replay_commands(hidden, episode.wire, episode.stamps)
    assert b"".join(done.wire.got)[: len(b"".join(episode.wire.got))] == b"".join(episode.wire.got)
    assert done.poses[:, :2] + [1.0, 2.0] == pytest.approx(episode.truth[:, :2], abs=1e-9)


@pytest.mark.parametrize("phase", [0.0, 0.0025, 0.005, 0.0075])
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


def test_bullet_replays_too() -> None:
    pytest.importorskip("pybullet")
    episode = driven(ACSAR, [(4.0, 4.0, 4.0, 4.0)] * 50)
    done = replay_commands(ACSAR, episode.wire, episode.stamps, body="bullet")
    assert done.poses[-1] == pytest.approx(episode.truth[-1], abs=0.01)


def test_a_log_without_commands_and_an_unknown_body_are_refused() -> None:
    nothing = WireLog(np.zeros(0), (), np.zeros(0), ())
    with pytest.raises(ConfigError, match="no commands to replay"):
        replay_commands(ACSAR, nothing, np.zeros(0))
    one = WireLog(np.zeros(1), (b"\r\n",), np.zeros(0), ())
    with pytest.raises(ConfigError, match="did you mean 'planar'"):
        replay_commands(ACSAR, one, np.zeros(1), body="planet")
