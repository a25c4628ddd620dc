"""What a log can tell, before anything is fitted; and which wheels are wired wrong."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from sysid_tools import ACSAR, drive_wire

from acsar_gym.errors import AcsarError
from acsar_gym.tools.sysid.board_log import (
    BoardTrack,
    Floats,
    Identifiability,
    check_identifiability,
    check_wheel_order,
    decode_track,
)
from acsar_gym.tools.sysid.excitation import plan_excitation

TICKS = np.asarray(0.01 * np.arange(6000), np.float64)
SLOW = {
    "motor": {"time_constant": 0.3, "deadband": 1.0},
    "firmware": {"feedback_rate": 20.0, "command_delay": 0.04},
}

ONE_DEAD = {"motor": {"deadband": (0.0, 20.0, 0.0, 0.0)}}


def judge(
    commands: Floats, pause: float = 0.0, turning: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
) -> Identifiability:
    """Judge a log of perfect wheels, 100 commands a second, with a pause in the middle."""
    stamps = TICKS[: len(commands)].copy()
    stamps[len(stamps) // 2 :] += pause
    held_out, numbers = np.zeros(len(stamps), bool), np.arange(len(stamps))
    track = BoardTrack(stamps, commands, stamps, commands * turning, held_out, numbers)
    return check_identifiability([track])


def manoeuvre(duration: float = 20.0) -> Floats:
    plan = plan_excitation(ACSAR, duration, 0.01)
    return np.concatenate((plan.before, plan.after))


def wave(speed: float, rate: float, count: int) -> Floats:
    """The same slow sine for all wheels."""
    return np.tile(speed * np.sin(rate * TICKS[:count, None]), (1, 4))


def test_the_manoeuvre_tells_everything() -> None:
    assert judge(manoeuvre(), pause=2.2).missing == {}
    assert judge(manoeuvre(12.0), pause=2.2).missing == {}


FAST = manoeuvre()


@pytest.mark.parametrize(
    ("commands", "missing", "reason", "known"),
    [
        (wave(6.0, 0.2, 2000), "motor.time_constant", "no steps", "motor.gain"),
        (wave(2.0, 1.0, 1200), "motor.deadband", "hangs on the lag", "motor.gain"),
        (np.abs(FAST), "motor.deadband", "no reversal", "motor.time_constant"),
        (
            np.where(np.abs(FAST) < 1.6, 0.0, FAST),
            "motor.deadband",
            "no staircase",
            "motor.time_constant",
        ),
        (FAST, "firmware.command_timeout", "no pause", "motor.deadband"),
        (FAST[:200], "firmware.command_delay", "2.0 s of log", "firmware.feedback_rate"),
    ],
)
def test_what_is_missing_is_said(commands: Floats, missing: str, reason: str, known: str) -> None:
    def wheel(name: str) -> str:
        return "b" if name.startswith("motor.") else ""

    found = judge(commands)
    assert reason in found.missing[missing, wheel(missing)]
    assert found.can(known, wheel(known))


def test_a_wheel_that_never_turned_is_named() -> None:
    found = judge(manoeuvre(), turning=(1.0, 1.0, 0.0, 1.0))
    assert "never turned" in found.missing["motor.gain", "c"]
    assert found.can("motor.gain", "a")


def drive(commands: Floats, **hidden: Any) -> list[BoardTrack]:
    """Drive a hidden robot with these wheel speeds for five seconds."""
    log = drive_wire(lambda time: commands[round(time / 0.01)], ACSAR.with_(**hidden), 5.0)
    track = decode_track(log, ACSAR)
    assert track is not None
    return [track]


@pytest.mark.parametrize(
    ("wheels", "said"),
    [
        ({"a": {"motor": "b"}, "b": {"motor": "a"}}, "front_right answers front_left's"),
        ({"c": {"encoder": "d"}, "d": {"encoder": "c"}}, "rear_left answers rear_right's"),
        ({"b": {"sign": -1}}, "front_left turns backward"),
        ({"a": {"motor": "b", "motor_sign": -1}, "b": {"motor": "a"}}, "front_right answers"),
    ],
)
def test_a_miswired_wheel_is_named(wheels: Any, said: str) -> None:
    with pytest.raises(AcsarError, match=said):
        check_wheel_order(drive(manoeuvre(12.0), wheels=wheels))


@pytest.mark.parametrize("hidden", [SLOW, ONE_DEAD], ids=["slow", "one dead"])
@pytest.mark.parametrize("pattern", [(1, 1, 1, 1), (1, -1, -1, 1), None])
def test_a_robot_that_is_wired_right_is_not_blamed(pattern: Any, hidden: Any) -> None:
    commands = manoeuvre(12.0) if pattern is None else wave(5.0, 5.0, 500) * pattern
    check_wheel_order(drive(commands, **hidden))
