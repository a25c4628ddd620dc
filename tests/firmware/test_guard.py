"""Motors that their encoders contradict are cut, and no others."""

from __future__ import annotations

from pathlib import Path

import pytest
from firmware_tools import CHIPS, Ran, Script

from acsar_gym.protocol import ZERO, Speeds

REVERSED = ("--way", "-1,1,1,1")
CONTRARY = "# a cut: turns against its motor"
STALLED = "# a cut: stalled, or no encoder"
AT_ONCE = 0.2
"""From a wheel that turns the wrong way to a motor without current [s]."""
TURNS = 0.5
"""A wheel faster than this turns, whatever its gears' play [rad/s]."""
STALL = 1.0
"""STALL_MS of config.h [s]."""


def all_at(speed: float) -> Speeds:
    return speed, speed, speed, speed


def off_since(ran: Ran, wheel: int) -> float:
    """When a motor had current for the last time [s]."""
    return max(time for time, duty in ran.states("duty") if duty[wheel])


@pytest.mark.parametrize("speed", [0.3, 1.0, -1.0, 20.0])
def test_guard_cuts_the_motor_of_a_reversed_encoder_at_once(
    chip: str, tmp_path: Path, speed: float
) -> None:
    script = Script(chip, REVERSED)
    script.command(0.1, 2.0, all_at(speed))
    ran = script.run(2.0, tmp_path)

    states = ran.states("speeds")
    turned = next(time for time, speeds in states if abs(speeds[0]) > TURNS)
    assert off_since(ran, 0) - turned < AT_ONCE
    assert ran.at(1.9, "speeds") == pytest.approx((0.0, speed, speed, speed), abs=0.1)
    assert ran.feedback()[-1][1][0] == 0.0  # the host sees a wheel that stands
    assert set(ran.notes()) == {CONTRARY}  # and why, at once and every second
    assert len(ran.notes()) == 2
    if abs(speed) == 1.0:  # without the guard: 15.4 rad/s for as long as it was commanded
        assert max(abs(speeds[0]) for _, speeds in states) < 7.0


def test_guard_cuts_a_contrary_motor_until_zero_is_commanded(
    script: Script, tmp_path: Path
) -> None:
    script.options = REVERSED
    script.command(0.1, 0.8, all_at(1.0))
    script.command(0.8, 1.6, all_at(-1.0))
    script.command(1.6, 1.7, ZERO)
    script.command(1.7, 2.2, all_at(1.0))
    on = [time for time, duty in script.run(2.2, tmp_path).states("duty") if duty[0]]
    assert not [time for time in on if 0.4 < time < 1.7]
    assert [time for time in on if time > 1.7]


def test_guard_cuts_a_stalled_motor_until_zero_or_the_other_way_is_commanded(
    script: Script, tmp_path: Path
) -> None:
    script.order(0.5, "turn 0 0")
    script.command(0.1, 3.0, all_at(4.0))
    script.command(3.0, 3.2, ZERO)
    script.command(3.2, 6.0, all_at(4.0))
    script.order(6.0, "free 0")  # the way that it was commanded stays cut
    script.command(6.0, 6.5, all_at(4.0))
    script.command(6.5, 7.5, all_at(-4.0))
    ran = script.run(7.5, tmp_path)

    off = [time for time, duty in ran.states("duty") if time > 0.2 and duty[0] == 0.0]
    assert 0.5 + STALL < off[0] < 0.5 + STALL + 0.3
    assert ran.at(2.9, "duty")[0] == 0.0
    assert ran.at(3.6, "duty")[0] > 0.4
    assert ran.at(6.4, "speeds") == pytest.approx((0.0, 4.0, 4.0, 4.0), abs=0.1)
    assert ran.at(7.4, "speeds") == pytest.approx(all_at(-4.0), abs=0.1)
    assert set(ran.notes()) == {STALLED}


@pytest.mark.parametrize("lag", [0.08, 0.3, 1.0])
@pytest.mark.parametrize("speed", [3.0, 30.0])
def test_guard_spares_a_heavy_wheel_that_reverses(tmp_path: Path, lag: float, speed: float) -> None:
    script = Script(CHIPS[0], ("--lag", f"{lag},{lag},{lag},{lag}", "--gain", "1,0.6,1.3,1"))
    for number in range(4):
        start = 0.1 + 0.8 * number
        script.command(start, start + 0.8, all_at(speed if number % 2 == 0 else -speed))
    assert script.run(3.3, tmp_path).notes() == []


@pytest.mark.parametrize("load", [-14.0, -6.0, 6.0, 14.0])
@pytest.mark.parametrize("speed", [0.3, 5.0])
def test_guard_spares_a_robot_that_rolls_down_a_slope(
    chip: str, tmp_path: Path, load: float, speed: float
) -> None:
    """Up and down, standing and driving: what the wheel would do without its motor [rad/s]."""
    script = Script(chip)
    script.order(0.05, f"load 0 {load}")
    script.command(0.1, 1.5, all_at(speed))
    script.command(1.5, 2.0, ZERO)
    script.command(2.0, 3.5, all_at(-speed))
    ran = script.run(3.5, tmp_path)
    assert ran.notes() == []
    assert ran.at(1.4, "speeds")[0] == pytest.approx(speed, abs=0.5)
    assert ran.at(3.4, "speeds")[0] == pytest.approx(-speed, abs=0.5)


@pytest.mark.parametrize("speed", [-7.0, -3.0, -0.5, 4.0, 20.0])
def test_guard_spares_a_wheel_that_a_hand_turns(chip: str, tmp_path: Path, speed: float) -> None:
    """While it is at rest, and while it drives, suddenly, and faster and faster for 0.3 s."""
    script = Script(chip)
    script.command(0.1, 1.0, ZERO)
    script.order(0.2, f"turn 0 {speed}")
    script.order(0.9, "free 0")
    script.command(1.0, 5.0, all_at(1.0))
    script.order(2.0, f"turn 0 {speed}")
    script.order(2.6, "free 0")
    for tick in range(30):
        script.order(3.5 + tick / 100, f"turn 0 {1.0 + (speed - 1.0) * tick / 29}")
    script.order(3.8, "free 0")
    ran = script.run(5.0, tmp_path)
    assert ran.notes() == []
    assert ran.at(4.9, "speeds")[0] == pytest.approx(1.0, abs=0.1)
