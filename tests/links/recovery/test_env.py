"""An environment whose cable is pulled, between resets and in an episode."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from recovery_tools import CURVE, made, spoken, step_until_fault
from serial_tools import (
    Emulated,
    wait_until,
)

from acsar_gym import RobotConfig
from acsar_gym.errors import (
    CommandError,
    LinkError,
    LinkLostError,
)
from acsar_gym.protocol import ZERO

pytestmark = [
    pytest.mark.usefixtures("deadline", "nursery"),
    pytest.mark.xdist_group("serial"),
]

SILENT, LOST = 1.0, 3.0


def test_an_episode_ends_with_the_reason_and_the_next_begins(env: Any, plugged: Emulated) -> None:
    plugged.pull()
    observation, reward, terminated, truncated, info = step_until_fault(env)
    assert env.observation_space.contains(observation)
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert (info["fault"], info["is_success"]) == (LOST, 0.0)
    assert "lost while in use" in info["fault_reason"]
    for _ in range(2):
        with pytest.raises(LinkError, match=r"call activate\(\) or env.reset\(\) first"):
            env.step(CURVE)
    plugged.plug()
    observation, info = env.reset()
    assert env.observation_space.contains(observation)
    assert info["fault"] == 0.0
    assert "fault_reason" not in info
    assert spoken(plugged) <= {ZERO}
    *_, truncated, info = env.step(CURVE)
    assert not truncated
    assert info["fault"] == 0.0


def test_faults_may_be_raised_instead(plugged: Emulated, config: RobotConfig) -> None:
    env = made(plugged, config, on_fault="raise")
    env.reset(seed=0)
    plugged.pull()
    with pytest.raises(LinkLostError):
        step_until_fault(env)
    plugged.plug()
    env.reset()
    env.step(CURVE)
    env.close()


def test_a_board_that_falls_silent_is_another_fault(
    emulator: Emulated, config: RobotConfig
) -> None:
    env = made(emulator, config.with_(feedback_timeout=1.0))
    env.reset(seed=0)
    env.step(CURVE)
    emulator.pause()
    *_, info = step_until_fault(env)
    assert info["fault"] == SILENT
    assert "no feedback for 1." in info["fault_reason"]
    emulator.resume()
    env.reset()
    assert env.step(CURVE)[-1]["fault"] == 0.0
    env.close()
    wait_until(lambda: emulator.commands()[-1] == ZERO, "zero as the last command")


def test_pulled_between_two_episodes_the_next_reset_recovers(env: Any, plugged: Emulated) -> None:
    plugged.pull()
    plugged.plug()
    env.reset()
    assert env.step(CURVE)[-1]["fault"] == 0.0


def test_pulled_before_a_bad_action_the_action_is_the_error(env: Any, plugged: Emulated) -> None:
    plugged.pull()
    with pytest.raises(CommandError, match="two finite numbers"):
        env.unwrapped.step(np.array([math.nan, 0.0], np.float32))
    plugged.plug()
    env.reset()
    env.step(CURVE)


def test_after_a_reset_that_failed_there_is_no_episode_to_go_on_with(
    plugged: Emulated, config: RobotConfig
) -> None:
    env = made(plugged, config.with_(reconnect_timeout=0.1))
    env.reset(seed=0)
    env.step(CURVE)
    plugged.pull()
    with pytest.raises(LinkError):
        env.reset()
    with pytest.raises(LinkError, match=r"env.reset\(\) first"):
        env.step(CURVE)
    plugged.plug()
    env.reset()
    env.step(CURVE)
    env.close()


def test_closing_an_environment_that_lost_its_cable_is_no_error(
    env: Any, plugged: Emulated
) -> None:
    plugged.pull()
    env.close()
    env.close()
    with pytest.raises(LinkError, match=r"env.reset\(\) first"):
        env.step(CURVE)
