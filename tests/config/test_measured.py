"""Intervals of measured values in a robot's file."""

from __future__ import annotations

import pytest
from config_tools import config_of, refusal

from acsar_gym import RobotConfig
from acsar_gym.config import Measured

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
        "body.turn_factor",
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


def test_configs_with_intervals_are_still_keys() -> None:
    one, same = (config_of(measured={"wheel_radius": INTERVAL}) for _ in range(2))
    assert {one, same} == {one}
    assert one != config_of()
