"""A log as the board saw it: its lines, their steps, and which wheel answers which command."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from sysid_tools import ACSAR, drive_wire

from acsar_gym.errors import AcsarError
from acsar_gym.protocol import encode
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid import board_log
from acsar_gym.tools.sysid.board_log import decode_tracks, find_quantum
from acsar_gym.tools.sysid.excitation import plan_excitation
from acsar_gym.tools.sysid.fit import FitProblem, check_wheel_order
from acsar_gym.tools.sysid.response import Rounding

TICKS = np.asarray(0.01 * np.arange(6000), np.float64)
SPEEDS = np.random.default_rng(3).uniform(-11.0, 11.0, 3000)
FORWARD = encode((1.0, 1.0, 1.0, 1.0))


def test_decode_tracks_of_ros_have_no_wire_time() -> None:
    stamps = np.arange(200) / 100.0
    lines = (FORWARD,) * 200
    log = WireLog(stamps, lines, stamps, lines)
    board, ros = decode_tracks([log, replace(log, stamped=True)], ACSAR)
    assert board.arrivals == pytest.approx(stamps + ACSAR.wire_time)
    assert ros.arrivals.tolist() == stamps.tolist()
    assert set(ros.stamps) <= set(stamps)


def test_decode_tracks_leaves_out_lines_after_a_stall() -> None:
    stamps = TICKS[:600].copy()
    stamps[300:] += 0.2
    lines = (FORWARD,) * 600
    (track,) = decode_tracks([WireLog(TICKS[:700], (FORWARD,) * 700, stamps, lines)], ACSAR)
    stalled = (track.stamps > 3.19) & (track.stamps < 3.65)
    assert not stalled.any()
    assert len(track.stamps) > 500


def test_decode_tracks_takes_the_agitated_parts_of_a_long_log(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
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


@pytest.mark.parametrize(("step", "fastest"), [(0.027, 11.0), (1.0, 8.0), (2.0, 12.0)])
def test_find_quantum_sees_through_the_rounding(step: float, fastest: float) -> None:
    speeds = SPEEDS[np.abs(SPEEDS) < fastest]
    exact = step * np.round(speeds / step)
    damaged = np.append(np.round(exact, 2), [7.31] * 10)
    for printed in (np.round(exact, 2), np.trunc(exact * 100.0) / 100.0, damaged):
        quantum = find_quantum(printed)
        assert quantum is not None
        assert quantum.value == pytest.approx(step, abs=1e-3)
        assert quantum.low - 1e-3 <= step <= quantum.high + 1e-3
    assert find_quantum(np.array([2.94, 3.04, 3.13, 5.98, 6.07])) is None  # too few


STEPS = np.resize(plan_excitation(ACSAR, 12.0, 0.01).first, (600, 4))
SWAPPED = {"wheels": {"c": {"encoder": "d"}, "d": {"encoder": "c"}}}
MIRRORED = {"wheels": {"a": {"motor": "b", "motor_sign": -1}, "b": {"motor": "a"}}}
SLOW = {"motor": {"time_constant": 0.3, "deadband": 1.0}, "firmware": {"feedback_rate": 20.0}}
ONE_DEAD = {"motor": {"deadband": (0.0, 20.0, 0.0, 0.0)}}


@pytest.mark.parametrize(
    ("hidden", "message"),
    [
        (SWAPPED, "rear_left answers rear_right's"),
        ({"wheels": {"b": {"sign": -1}}}, "front_left turns backward"),
        (MIRRORED, "front_right answers"),
        (SLOW, ""),
        (ONE_DEAD, ""),
    ],
)
def test_check_wheel_order_names_a_miswired_wheel(hidden: Any, message: str) -> None:
    log = drive_wire(lambda time: STEPS[round(time / 0.01)], ACSAR.with_(**hidden), 5.0)
    with pytest.raises(AcsarError, match=message) if message else nullcontext():
        check_order(log)


@pytest.mark.parametrize("rate", [8.0, 12.0])
def test_check_wheel_order_accepts_a_late_board_with_periodic_commands(rate: float) -> None:
    """Half a period later, the answer has the other sign."""
    late = {"motor": {"time_constant": 0.3}, "firmware": {"command_delay": 0.25}}
    check_order(drive_wire(lambda time: 5.0 * np.sin(rate * time), ACSAR.with_(**late), 5.0))


def check_order(log: WireLog) -> None:
    """Check the wheels of a log, as `identify` does."""
    tracks = decode_tracks([log], ACSAR)
    turning = np.flatnonzero(np.abs(tracks[0].speeds).max(axis=0) > 0.5).tolist()
    check_wheel_order(FitProblem(tracks, turning, ACSAR, Rounding()))
