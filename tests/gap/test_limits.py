"""Limits for continuous integration."""

from __future__ import annotations

import math

import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.tools.sysid.twin_gap import find_exceeded, parse_limits

KNOWN = ("wheel_speed_rms", "end_pose")


def test_limits_are_names_and_numbers() -> None:
    assert parse_limits(["wheel_speed_rms=0.5", "end_pose=1e-2"], KNOWN) == {
        "wheel_speed_rms": 0.5,
        "end_pose": 0.01,
    }


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("wheel_sped_rms=1", "did you mean 'wheel_speed_rms'"),
        ("end_pose", "must be METRIC=VALUE"),
        ("end_pose=", "must be METRIC=VALUE"),
        ("end_pose=-1", "must be METRIC=VALUE"),
        ("end_pose=nan", "must be METRIC=VALUE"),
        ("end_pose=inf", "must be METRIC=VALUE"),
    ],
)
def test_other_limits_are_refused(given: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        parse_limits([given], KNOWN)


def test_a_limit_is_kept_up_to_its_value() -> None:
    assert find_exceeded({"end_pose": 0.01}, {"end_pose": 0.01}) == []
    assert find_exceeded({"end_pose": 0.01}, {"end_pose": -0.011}) == [
        "end_pose = 0.011: over the limit of 0.01"
    ]


def test_what_cant_be_measured_isnt_within_the_limit() -> None:
    assert find_exceeded({"end_pose": 0.01}, {"end_pose": math.nan}) == [
        "end_pose: couldn't be measured, the limit is 0.01"
    ]
