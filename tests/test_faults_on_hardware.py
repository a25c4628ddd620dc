"""Every injected fault over a real serial device: the episode goes on soundly, or ends with why."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from serial_tools import Emulated, no_leak

from acsar_gym import RobotConfig
from acsar_gym.errors import LinkError
from acsar_gym.protocol import ZERO
from acsar_gym.testing import wait_until

pytestmark = pytest.mark.usefixtures("deadline")

SLOW = np.array([0.1, 0.1], np.float32)
STEPS = 3
SOON = 0.1
"""When what happens once does so, from the first command that turns wheels on [s]."""
SILENT, LOST = 1.0, 3.0
LINES = ("dropped_lines", "duplicated_lines", "cut_lines", "corrupted_lines", "late_lines")
FAULTS: list[tuple[str, dict[str, Any], float | None]] = [
    *((name, {name: 0.3}, None) for name in LINES),
    ("garbage", {"garbage_rate": 30.0}, None),
    ("dead", {"dead_wheels": "d"}, None),
    ("brown_out", {"brown_out_at": SOON, "brown_out_time": 0.1}, None),
    ("board_reset", {"board_reset_at": SOON, "reset_time": 60.0}, SILENT),
    ("unplug", {"unplug_at": SOON, "replug_time": 0.1}, LOST),
]
"""What goes wrong, and the code with which an episode surely ends; None where it may go on."""


def made(emulator: Emulated, faults: dict[str, Any]) -> Any:
    patience = 1.0 if "reset_time" in faults else 5.0
    config = RobotConfig.preset("acsar").with_(
        connect_timeout=20.0, feedback_timeout=patience, watchdog_timeout=2.0
    )
    return gymnasium.make(
        "acsar_gym/PointGoal-v0", link=emulator.device, robot=config, faults=faults
    )


def begin(env: Any) -> None:
    """Reset; where a fault falls into that it is an error, and the next reset does it."""
    for _ in range(20):
        with contextlib.suppress(LinkError):
            observation, info = env.reset(seed=1)
            assert_sound(env, observation, info, truncated=False)
            return
    raise AssertionError("no reset succeeds")


def happened(env: Any, fault: str) -> bool:
    """Whether the fault was injected in this episode."""
    link = env.unwrapped.robot.link
    return bool(link.injected[fault] or getattr(link.wheels, fault, ""))


def assert_sound(env: Any, observation: Any, info: dict[str, Any], *, truncated: bool) -> None:
    assert np.isfinite(observation).all()
    assert env.observation_space.contains(observation)
    assert truncated == (info["fault"] > 0.0) == bool(info.get("fault_reason"))
    assert "\n" not in info.get("fault_reason", "")


@contextlib.contextmanager
def stopped_at_last(emulator: Emulated) -> Iterator[None]:
    """Fails where the block doesn't turn wheels, or where its last command isn't zero."""
    before = len(emulator.commands())
    with no_leak():
        yield

    def stopped() -> bool:
        commands = emulator.commands()[before:]
        return set(commands) > {ZERO} and commands[-1] == ZERO

    wait_until(stopped, "commands that turn wheels, and then zero")


@pytest.mark.parametrize(("fault", "faults", "code"), FAULTS, ids=[name for name, *_ in FAULTS])
def test_the_episode_goes_on_or_ends_with_a_reason_and_the_board_is_stopped(
    fault: str, faults: dict[str, Any], code: float | None, shared_emulator: Emulated
) -> None:
    with stopped_at_last(shared_emulator):
        env = made(shared_emulator, faults)
        begin(env)
        steps, ended = 0, False
        while not ended and (code or steps < STEPS or not happened(env, fault)):
            observation, _, _, ended, info = env.step(SLOW)
            assert_sound(env, observation, info, truncated=ended)
            steps += 1
        assert happened(env, fault)
        assert code in (None, info["fault"])
        if ended:
            begin(env)
        env.close()
        del env
