"""Logs that can't tell a lag: what hangs on it has no number, and what doesn't has."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from acsar_gym import RobotConfig, open_link
from acsar_gym.recording.types import WireLog
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid.excitation import TappedLink
from acsar_gym.tools.sysid.identify import identify_logs
from acsar_gym.tools.sysid.parameter_findings import COUNTED_NOTE, ParameterFinding

ACSAR = RobotConfig.preset("acsar")
SECONDS = 12.0
PAUSE = (6.0, 8.0)
"""When the pausing driver sends nothing [s]."""

Driven = Callable[[float], float | None]
"""Speed of all wheels at a time, None for no command [rad/s]."""


def slowly(time: float) -> float:
    return 2.0 * math.sin(time)


def constantly(_: float) -> float:
    return 6.0


def squares(time: float) -> float:
    return 1.5 if int(time) % 2 else -1.5


def with_pause(time: float) -> float | None:
    return None if PAUSE[0] < time < PAUSE[1] else 6.0


def log(speed: Driven, true: RobotConfig) -> WireLog:
    """The wire while a robot is driven that isn't the configured one."""
    tapped = TappedLink(open_link("planar", true))
    with Robot(tapped, ACSAR.with_(wheel_check=False)) as robot:
        for tick in range(round(SECONDS / ACSAR.period)):
            asked = speed(tick * ACSAR.period)
            if asked is None:
                robot.listen()
            else:
                robot.tick([asked] * 4)
    return tapped.log


def told(speed: Driven, true: RobotConfig) -> dict[str, ParameterFinding]:
    """What is told, by name; and the resolution, told or not."""
    found = identify_logs([log(speed, true)], ACSAR).findings
    return {one.name: one for one in found if one.told or one.name == "encoder.quantum"}


@pytest.mark.parametrize("lag", [0.15, 0.3])
def test_a_slow_sine_tells_nothing_that_hangs_on_the_lag(lag: float) -> None:
    found = told(slowly, ACSAR.with_(motor={"time_constant": lag, "deadband": 0.3}))
    hanging = {"motor.time_constant", "motor.deadband", "firmware.command_delay", "encoder.window"}
    assert not hanging & set(found)
    gain = found.get("motor.gain")
    assert gain is None or gain.low <= 1.0 <= gain.high  # type: ignore[operator]


def test_constant_speeds_tell_the_gain_without_a_lag() -> None:
    found = told(constantly, ACSAR.with_(motor={"time_constant": 0.3, "gain": 0.96}))
    gain = found["motor.gain"]
    assert gain.value == pytest.approx(0.96, abs=0.005)
    assert gain.low <= 0.96 <= gain.high  # type: ignore[operator]
    assert "motor.time_constant" not in found


def test_the_gain_is_that_of_the_mean_of_two_counts() -> None:
    true = ACSAR.with_(motor={"time_constant": 0.03, "gain": 0.97, "deadband": 0.3})
    assert told(squares, true)["motor.gain"].value == pytest.approx(0.97, abs=0.004)


def test_a_timeout_that_hangs_on_the_lag_is_not_told() -> None:
    true = ACSAR.with_(motor={"time_constant": 0.3}, firmware={"command_timeout": 0.8})
    timeout = told(with_pause, true).get("firmware.command_timeout")
    assert timeout is None or timeout.low <= 0.8 <= timeout.high  # type: ignore[operator]


@pytest.mark.parametrize("speed", [slowly, constantly])
def test_whole_encoder_counts_are_no_resolution(speed: Driven) -> None:
    one = told(speed, ACSAR)["encoder.quantum"]
    assert (one.told, one.value is None or one.note == COUNTED_NOTE) == (False, True)
