"""Faults over a real serial device: the episode goes on soundly, or ends with a reason."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from boards import DamagedLink, FailingLink
from serial_tools import Emulated, no_leak

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import LinkError
from acsar_gym.protocol import ZERO
from acsar_gym.testing import wait_until

pytestmark = pytest.mark.usefixtures("deadline")

SLOW = np.array([0.1, 0.1], np.float32)
STEPS = 3
SILENT = 1.0
LOST = 3.0
FAULTS: dict[str, float | None] = {
    "dropped_lines": None,
    "late_lines": None,
    "damaged": None,
    "silent": SILENT,
    "unplugged": LOST,
}
"""Faults, and the code with which an episode surely ends. None if it may go on."""


def make_env(device: str, fault: str) -> Any:
    config = RobotConfig.preset("acsar").with_(
        connect_timeout=20.0,
        feedback_timeout=1.0 if fault == "silent" else 5.0,
        watchdog_timeout=2.0,
    )
    link = open_link(device, config)
    options: dict[str, Any] = {}
    if fault == "damaged":
        link = DamagedLink(link)
    elif fault in ("silent", "unplugged"):
        link = FailingLink(link, 0.1, silent=fault == "silent")
    else:
        options["faults"] = {fault: 0.3}
    return gymnasium.make("acsar_gym/PointGoal-v0", link=link, robot=config, **options)


def begin(env: Any) -> None:
    """Reset until no fault happens during the reset."""
    for _ in range(20):
        with contextlib.suppress(LinkError):
            observation, info = env.reset(seed=1)
            assert_sound(env, observation, info, truncated=False)
            return
    raise AssertionError("no reset succeeds")


def assert_sound(env: Any, observation: Any, info: dict[str, Any], *, truncated: bool) -> None:
    assert np.isfinite(observation).all()
    assert env.observation_space.contains(observation)
    assert truncated == (info["fault"] > 0.0) == bool(info.get("fault_reason"))
    assert "\n" not in info.get("fault_reason", "")


@contextlib.contextmanager
def ends_with_zero(emulator: Emulated) -> Iterator[None]:
    """Fails if the block doesn't turn wheels, or if its last command isn't zero."""
    earlier = len(emulator.commands())
    with no_leak():
        yield

    def is_stopped() -> bool:
        commands = emulator.commands()[earlier:]
        return set(commands) > {ZERO} and commands[-1] == ZERO

    wait_until(is_stopped, "commands that turn wheels, and then zero")


@pytest.mark.parametrize("fault", FAULTS)
def test_step_with_a_fault_goes_on_or_ends_with_a_reason(
    fault: str, shared_emulator: Emulated
) -> None:
    code = FAULTS[fault]
    with ends_with_zero(shared_emulator):
        env = make_env(shared_emulator.device, fault)
        begin(env)
        steps = 0
        ended = False
        while not ended and (code or steps < STEPS):
            observation, _, _, ended, info = env.step(SLOW)
            assert_sound(env, observation, info, truncated=ended)
            steps += 1
        assert code in (None, info["fault"])

        if ended:
            begin(env)
        env.close()
        del env
