"""What a log can tell, before anything is fitted."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from acsar_gym import RobotConfig
from acsar_gym.protocol import encode
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid import excitation
from acsar_gym.tools.sysid.identifiability import Identifiability, check_identifiability
from acsar_gym.tools.sysid.identify import identify_logs
from acsar_gym.tools.sysid.tracks import BoardTrack

Floats = NDArray[np.float64]
DELAY, TIMEOUT = ("firmware.command_delay", ""), ("firmware.command_timeout", "")


def ticks(count: int) -> Floats:
    """100 a second [s]."""
    return np.asarray(np.arange(count) * 0.01, np.float64)


def known(commands: Floats, pause: float = 0.0) -> Identifiability:
    """Judge a log of perfect wheels, 100 commands a second, with a pause in the middle."""
    stamps = ticks(len(commands))
    stamps[len(stamps) // 2 :] += pause
    held_out = np.zeros(len(stamps), bool)
    numbers = np.arange(len(stamps))
    return check_identifiability(
        [BoardTrack(stamps, commands, stamps, commands, held_out, numbers)]
    )


def manoeuvre(duration: float = 20.0) -> Floats:
    plan = excitation.plan_excitation(RobotConfig.preset("acsar"), duration, 0.01)
    return np.concatenate((plan.before, plan.after))


def test_the_manoeuvre_tells_everything() -> None:
    assert known(manoeuvre(), pause=2.2).missing == {}
    assert known(manoeuvre(12.0), pause=2.2).missing == {}


def test_a_log_without_steps_tells_no_lag_and_no_delay() -> None:
    smooth = np.tile(6.0 * np.sin(np.arange(2000)[:, None] * 0.002), (1, 4))
    found = known(smooth)
    assert "no steps" in found.missing["motor.time_constant", "b"]
    assert "no steps" in found.missing[DELAY]
    assert found.can("motor.gain", "b")


def test_a_deadband_needs_a_lag() -> None:
    found = known(np.tile(2.0 * np.sin(ticks(1200))[:, None], (1, 4)))
    assert "hangs on the lag" in found.missing["motor.deadband", "a"]


def test_a_log_without_reversal_tells_no_deadband() -> None:
    found = known(np.abs(manoeuvre()), pause=2.2)
    assert "no reversal" in found.missing["motor.deadband", "c"]
    assert found.can("motor.time_constant", "c")


def test_a_log_without_slow_speeds_tells_no_deadband() -> None:
    fast = manoeuvre()
    found = known(np.where(np.abs(fast) < 1.6, 0.0, fast), pause=2.2)
    assert "no staircase" in found.missing["motor.deadband", "a"]


def test_a_log_without_pause_tells_no_timeout() -> None:
    assert "no pause" in known(manoeuvre()).missing[TIMEOUT]


def test_a_short_log_tells_nothing_of_wheels() -> None:
    found = known(manoeuvre()[:200])
    for name in ("motor.time_constant", "motor.gain", "motor.acceleration", "motor.deadband"):
        assert "2.0 s of log" in found.missing[name, "d"]
    assert "2.0 s of log" in found.missing[DELAY]
    assert not found.can(*TIMEOUT)


def test_a_wheel_that_never_turned_is_named() -> None:
    commands = manoeuvre()
    stamps = ticks(len(commands))
    speeds = commands * [1.0, 1.0, 0.0, 1.0]
    numbers, held_out = np.arange(len(stamps)), np.zeros(len(stamps), bool)
    found = check_identifiability([BoardTrack(stamps, commands, stamps, speeds, held_out, numbers)])
    assert found.missing["motor.gain", "c"] == "this wheel never turned"
    assert found.can("motor.gain", "a")


@pytest.mark.parametrize("duration", [0.3, 2.0])
def test_what_cannot_be_told_has_no_number(duration: float) -> None:
    commands = manoeuvre()[: round(100 * duration)]
    stamps = ticks(len(commands))
    lines = tuple(encode(row) for row in commands.tolist())
    found = identify_logs(
        [WireLog(stamps, lines, stamps + 0.005, lines)], RobotConfig.preset("acsar")
    )
    for one in found.findings:
        if one.name.startswith("motor.") or one.name in (DELAY[0], TIMEOUT[0], "encoder.window"):
            assert (one.value, one.low, one.high, one.told) == (None, None, None, False)
            assert "s of log" in one.note
    assert found.robot().motor == found.config.motor
