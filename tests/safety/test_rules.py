"""The safety rules as pure functions: one robot, one tick; limits as ROS has them."""

from __future__ import annotations

from typing import Any

import pytest

from acsar_gym import RobotConfig
from acsar_gym.config import SpeedLimits
from acsar_gym.errors import ConfigError
from acsar_gym.safety import rules
from acsar_gym.safety.rules import (
    Reason,
    SafetyMemory,
    limit_velocity,
    read_limits,
)

ACSAR = RobotConfig.preset("acsar")
FENCED = rules.make_rules(ACSAR.with_(geofence={"max_x": 1.0, "min_y": -0.5}, feedback_timeout=0.1))


@pytest.mark.parametrize(
    ("x", "y", "age", "latched", "expected"),
    [
        (0.9, 0.0, 0.0, 0.0, (0, 0)),
        (1.1, 0.0, 0.0, 0.0, (2, 2)),
        (0.9, 0.0, 0.09, 0.0, (0, 3)),
        (0.9, 0.0, 0.09, 2.0, (2, 2)),
        (1.1, 0.0, 0.09, 4.0, (4, 4)),
        (float("nan"), 0.0, 0.0, 0.0, (2, 2)),
    ],
)
def test_what_holds_a_robot(
    x: float, y: float, age: float, latched: float, expected: tuple[int, int]
) -> None:
    assert rules.find_holds(SafetyMemory(latched), x, y, age, FENCED) == expected


def test_a_stop_is_immediate_and_forgets_the_ramp() -> None:
    drove = SafetyMemory(0.0, 0.0, 0.3, 0.2, 0.29, 0.19)
    assert rules.limit_twist(0.0, 0.0, 0.0, 0.0, 0.0, drove, FENCED) == SafetyMemory()
    held = rules.limit_twist(0.3, 0.2, 0.0, 0.0, 0.09, drove, FENCED)
    assert held == SafetyMemory(reason=Reason.STALE_FEEDBACK)
    outside = rules.limit_twist(0.3, 0.2, 2.0, 0.0, 0.0, drove, FENCED)
    assert outside == SafetyMemory(Reason.GEOFENCE, Reason.GEOFENCE)


DT = 0.01


def driven(wanted: list[float], **kind: float) -> list[float]:
    """What is sent, tick by tick, from standstill."""
    numbers, sent = read_limits(SpeedLimits(**kind)), [0.0, 0.0]
    for velocity in wanted:
        sent.append(limit_velocity(velocity, sent[-1], sent[-2], DT, numbers))
    return sent[2:]


@pytest.mark.parametrize(
    ("kind", "wanted", "sent"),
    [
        ({}, [9.0, -9.0, 0.0], [9.0, -9.0, 0.0]),
        ({"max_velocity": 0.5, "min_velocity": -0.1}, [2.0, -2.0], [0.5, -0.1]),
        ({"max_velocity": 0.5}, [2.0, -2.0], [0.5, -0.5]),
        ({"max_acceleration": 2.0}, [0.05] * 4, [0.02, 0.04, 0.05, 0.05]),
        (
            {"max_acceleration": 200.0, "min_acceleration": -5.0},
            [1.0, 0.0, 0.0],
            [1.0, 0.95, 0.9],
        ),
        # As the ROS controller has it: the ramp's slope grows by 2 * jerk * dt^2 a tick.
        ({"max_jerk": 100.0}, [1.0] * 5, [0.02, 0.06, 0.12, 0.2, 0.3]),
    ],
)
def test_limits_of_one_axis(kind: dict[str, float], wanted: list[float], sent: list[float]) -> None:
    assert driven(wanted, **kind) == pytest.approx(sent)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_jazzys_names_tell_speeding_up_and_braking_apart(sign: float) -> None:
    """Forward at 2, braking at 5; backward at 1, braking at 4, as the signs in ROS are or not."""
    there, back = [1.0] * 60 + [0.0] * 30, [-1.0] * 120 + [0.0] * 40
    sent = driven(
        there + back,
        max_acceleration=2.0,
        max_deceleration=-5.0 * sign,
        max_acceleration_reverse=-1.0 * sign,
        max_deceleration_reverse=4.0 * sign,
    )
    assert sent[:2] == pytest.approx([0.02, 0.04])
    assert sent[60:62] == pytest.approx([0.95, 0.9])
    assert sent[90:92] == pytest.approx([-0.01, -0.02])
    assert sent[210:212] == pytest.approx([-0.96, -0.92])


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"linear_limits": {"max_velocity": -1.0}}, "linear_limits.max_velocity"),
        ({"linear_limits": {"max_decelaration": 1.0}}, "did you mean 'max_deceleration'"),
        (
            {"linear_limits": {"max_deceleration": -2.0, "min_acceleration": -2.0}},
            "linear_limits.min_acceleration",
        ),
        ({"geofence": {"min_x": 1.0}}, "geofence"),
        ({"geofence": {"max_x": "far"}}, "geofence.max_x"),
    ],
)
def test_bad_limits_are_one_clear_error(fields: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        RobotConfig(**fields)
