"""Intervals of measured values in a robot's file."""

from __future__ import annotations

import pytest
from config_tools import config_of, refusal

from acsar_gym import RobotConfig
from acsar_gym.config import Measured, update_measured

INTERVAL = {"low": 0.09, "high": 0.11, "method": "identify"}


@pytest.mark.parametrize(
    "name",
    [
        "motor.time_constant",
        "motor.time_constant.a",
        "wheel_separation_multiplier",
        "right_wheel_radius_multiplier",
        "firmware.command_delay",
        "firmware.command_timeout",
        "encoder.quantum",
        "body.friction",
    ],
)
def test_every_number_can_have_an_interval(name: str) -> None:
    measured = config_of(measured={name: INTERVAL}).measured[name]
    assert measured == Measured(low=0.09, high=0.11, method="identify")


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("motor.time_constant.e", "unknown field 'motor.time_constant.e'; did you mean"),
        ("motor.tiem_constant", "did you mean 'motor.time_constant'?"),
        ("firmware.command_timeout.a", "did you mean 'firmware.command_timeout'?"),
        ("zz", "unknown field 'zz'; for example 'motor.gain.a'"),
        ("motor", "unknown field 'motor'"),
        ("odom_frame", "unknown field 'odom_frame'"),
    ],
)
def test_an_interval_of_something_else_is_refused(name: str, found: str) -> None:
    message = refusal(RobotConfig, {"measured": {name: INTERVAL}})
    assert message.startswith("measured: ")
    assert found in message


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"low": 0.2}, "measured: low = 0.2: must be at most high = 0.11"),
        ({"high": "much"}, "measured.high = 'much': must be a valid number"),
        ({"logs": ["0123"]}, "measured.logs.0 = '0123': "),
        ({"log": []}, "unknown field 'measured.log'; did you mean 'logs'?"),
    ],
)
def test_a_malformed_interval_is_one_error(changes: dict[str, object], found: str) -> None:
    assert found in refusal(Measured, INTERVAL | changes)


@pytest.mark.parametrize(
    ("name", "ends", "found"),
    [
        ("wheel_radius", (-1.0, 0.06), "measured.wheel_radius.low = -1: must be greater than 0"),
        ("motor.gain.a", (-1.0, 2.0), "measured.motor.gain.a.low = -1: must be greater than 0"),
        ("motor.gain", (0.9, 101.0), "measured.motor.gain.high = 101: must be less than or equal"),
        ("body.turn_factor", (1.0, 1.1), "measured.body.turn_factor.low = 1: must be greater"),
        ("firmware.command_delay", (0.0, 2.0), "measured.firmware.command_delay.high = 2: must"),
        ("watchdog_timeout", (0.0, 1.0), "measured.watchdog_timeout.low = 0: must be greater"),
    ],
)
def test_an_interval_that_no_robot_can_have_names_the_field(
    name: str, ends: tuple[float, float], found: str
) -> None:
    low, high = ends
    interval = {"low": low, "high": high, "method": "x"}
    assert refusal(RobotConfig, {"measured": {name: interval}}).startswith(found)


def test_an_interval_for_all_wheels_ends_those_of_single_ones_and_the_reverse() -> None:
    old, new = (Measured(low=1.0, high=2.0, method=name) for name in ("old", "new"))
    single = {"motor.gain.a": old, "motor.gain.c": old, "motor.deadband.a": old}
    every = {"motor.gain": new, "motor.deadband.a": old}
    assert update_measured(single, {"motor.gain": new}) == every
    rest = {f"motor.gain.{wheel}": new for wheel in "abd"}
    found = {"motor.gain.c": old, **rest, "motor.deadband.a": old}
    assert update_measured(every, {"motor.gain.c": old}) == found


def test_a_new_value_without_an_interval_ends_the_old_one() -> None:
    old = Measured(low=1.0, high=2.0, method="old")
    assert update_measured({"wheel_radius": old, "motor.gain.b": old}, {"wheel_radius": None}) == {
        "motor.gain.b": old
    }
    assert update_measured({"motor.gain.b": old}, {"motor.gain": None}) == {}


def test_configs_with_intervals_are_still_keys() -> None:
    one, same = (config_of(measured={"wheel_radius": INTERVAL}) for _ in range(2))
    assert {one, same} == {one}
    assert one != config_of()
