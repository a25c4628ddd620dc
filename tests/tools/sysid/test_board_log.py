"""A log as the board saw it: its lines, their steps, and which wheel answers which command."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from sysid_tools import ACSAR, drive_wire

from acsar_gym.errors import AcsarError
from acsar_gym.protocol import encode
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid import board_log
from acsar_gym.tools.sysid.board_log import (
    BoardTrack,
    Floats,
    check_wheel_order,
    decode_tracks,
    find_quantum,
)
from acsar_gym.tools.sysid.excitation import plan_excitation

TICKS = np.asarray(0.01 * np.arange(6000), np.float64)
SPEEDS = np.random.default_rng(3).uniform(-11.0, 11.0, 3000)
FORWARD = encode((1.0, 1.0, 1.0, 1.0))


def test_nothing_takes_time_on_a_wire_that_isnt_there() -> None:
    stamps = np.arange(200) / 100.0
    lines = (FORWARD,) * 200
    log = WireLog(stamps, lines, stamps, lines)
    board, ros = decode_tracks([log, replace(log, stamped=True)], ACSAR)
    assert board.arrivals == pytest.approx(stamps + ACSAR.wire_time)
    assert ros.arrivals.tolist() == stamps.tolist()
    assert set(ros.stamps) <= set(stamps)
    assert (board.in_ros, ros.in_ros) == (False, True)


def test_of_a_long_log_the_agitated_parts_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(board_log, "PIECE_TIME", 5.0)
    monkeypatch.setattr(board_log, "MOST_PIECES", 2)
    stamps = TICKS[:3000]
    calm = (FORWARD,) * 1000
    agitated = tuple(encode((speed,) * 4) for speed in SPEEDS[:1000].tolist())
    lines = (*calm, *agitated, *calm)
    tracks = decode_tracks([WireLog(stamps, lines, stamps, lines)], ACSAR)
    assert len(tracks) == 2
    assert all(9.9 < track.stamps[0] < track.stamps[-1] < 20.1 for track in tracks)
    assert any(np.abs(track.arrivals[0] - track.stamps[0]) > 1.9 for track in tracks)
    assert all(0.1 < track.held_out.mean() < 0.3 for track in tracks)


@pytest.mark.parametrize("step", [0.027, 0.0871, 0.3])
def test_a_step_is_found_under_the_rounding_to_two_decimals(step: float) -> None:
    exact = step * np.round(SPEEDS / step)
    damaged = np.append(np.round(exact, 2), [7.31] * 10)
    for printed in (np.round(exact, 2), np.trunc(exact * 100.0) / 100.0, damaged):
        found = find_quantum(printed)
        assert found is not None
        assert found.value == pytest.approx(step, abs=1e-3)
        assert found.low - 1e-3 <= step <= found.high + 1e-3


@pytest.mark.parametrize(("step", "fastest"), [(1.0, 8.0), (0.5, 6.0), (2.0, 12.0)])
def test_few_speeds_show_a_step_that_is_no_chance(step: float, fastest: float) -> None:
    speeds = SPEEDS[np.abs(SPEEDS) < fastest]
    found = find_quantum(step * np.trunc(speeds / step))
    assert found is not None
    assert found.value == pytest.approx(step, abs=1e-3)
    assert find_quantum(np.array([2.94, 3.04, 3.13, 5.98, 6.07])) is None


def manoeuvre() -> Floats:
    plan = plan_excitation(ACSAR, 12.0, 0.01)
    return np.concatenate((plan.before, plan.after))


def wave(speed: float, rate: float) -> Floats:
    """The same sine for all wheels."""
    return np.tile(speed * np.sin(rate * TICKS[:500, None]), (1, 4))


def drive(commands: Floats, **hidden: Any) -> list[BoardTrack]:
    """Drive a hidden robot with these wheel speeds for five seconds."""
    log = drive_wire(lambda time: commands[round(time / 0.01)], ACSAR.with_(**hidden), 5.0)
    return decode_tracks([log], ACSAR)


@pytest.mark.parametrize(
    ("wheels", "message"),
    [
        ({"a": {"motor": "b"}, "b": {"motor": "a"}}, "front_right answers front_left's"),
        ({"c": {"encoder": "d"}, "d": {"encoder": "c"}}, "rear_left answers rear_right's"),
        ({"b": {"sign": -1}}, "front_left turns backward"),
        ({"a": {"motor": "b", "motor_sign": -1}, "b": {"motor": "a"}}, "front_right answers"),
    ],
)
def test_a_miswired_wheel_is_named(wheels: Any, message: str) -> None:
    with pytest.raises(AcsarError, match=message):
        check_wheel_order(drive(manoeuvre(), wheels=wheels))


SLOW = {
    "motor": {"time_constant": 0.3, "deadband": 1.0},
    "firmware": {"feedback_rate": 20.0, "command_delay": 0.04},
}
ONE_DEAD = {"motor": {"deadband": (0.0, 20.0, 0.0, 0.0)}}


@pytest.mark.parametrize("hidden", [SLOW, ONE_DEAD], ids=["slow", "one dead"])
@pytest.mark.parametrize("pattern", [(1, 1, 1, 1), (1, -1, -1, 1), None])
def test_a_robot_that_is_wired_right_is_not_blamed(pattern: Any, hidden: Any) -> None:
    commands = manoeuvre() if pattern is None else wave(5.0, 5.0) * pattern
    check_wheel_order(drive(commands, **hidden))
