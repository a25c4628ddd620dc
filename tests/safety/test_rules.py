"""The safety rules as pure functions of one robot and one tick, with limits as in ROS."""

from __future__ import annotations

import pytest

from acsar_gym import RobotConfig
from acsar_gym.config import SpeedLimits
from acsar_gym.errors import ConfigError
from acsar_gym.safety import rules
from acsar_gym.safety.rules import Reason, SafetyMemory

FENCED = rules.make_rules(RobotConfig(geofence={"max_x": 1.0, "min_y": -0.5}, feedback_timeout=0.1))
DT = 0.01


@pytest.mark.parametrize(
    ("x", "age", "latched", "expected"),
    [
        (0.9, 0.0, 0.0, (0, 0)),
        (1.1, 0.0, 0.0, (2, 2)),
        (0.9, 0.09, 0.0, (0, 3)),
        (0.9, 0.09, 2.0, (2, 2)),
        (1.1, 0.09, 4.0, (4, 4)),
        (float("nan"), 0.0, 0.0, (2, 2)),
    ],
)
def test_find_holds(x: float, age: float, latched: float, expected: tuple[int, int]) -> None:
    assert rules.find_holds(SafetyMemory(latched), x, 0.0, age=age, rules=FENCED) == expected


def test_limit_twist_stops_at_once_and_forgets_the_ramp() -> None:
    memory = SafetyMemory(linear=0.3, angular=0.2, past_linear=0.29, past_angular=0.19)

    def limit(linear: float, x: float, age: float) -> SafetyMemory:
        return rules.limit_twist(linear, 0.0, x, y=0.0, age=age, memory=memory, rules=FENCED)

    assert limit(0.0, x=0.0, age=0.0) == SafetyMemory()
    assert limit(0.3, x=0.0, age=0.09) == SafetyMemory(reason=Reason.STALE_FEEDBACK)
    assert limit(0.3, x=2.0, age=0.0) == SafetyMemory(Reason.GEOFENCE, Reason.GEOFENCE)


def send(wanted: list[float], **limits: float) -> list[float]:
    """Return what is sent, tick by tick, from standstill."""
    axis = rules.read_limits(SpeedLimits(**limits))
    sent = [0.0, 0.0]
    for velocity in wanted:
        sent.append(rules.limit_velocity(velocity, sent[-1], sent[-2], dt=DT, axis=axis))
    return sent[2:]


@pytest.mark.parametrize(
    ("limits", "wanted", "sent"),
    [
        ({}, [9.0, -9.0, 0.0], [9.0, -9.0, 0.0]),
        ({"max_velocity": 0.5, "min_velocity": -0.1}, [2.0, -2.0], [0.5, -0.1]),
        ({"max_acceleration": 2.0}, [0.05] * 4, [0.02, 0.04, 0.05, 0.05]),
        ({"max_acceleration": 2e2, "min_acceleration": -5.0}, [1.0, 0.0, 0.0], [1.0, 0.95, 0.9]),
        # As in the ROS controller, the ramp's slope grows by 2 * jerk * dt^2 a tick.
        ({"max_jerk": 100.0}, [1.0] * 5, [0.02, 0.06, 0.12, 0.2, 0.3]),
    ],
)
def test_limit_velocity(limits: dict[str, float], wanted: list[float], sent: list[float]) -> None:
    assert send(wanted, **limits) == pytest.approx(sent)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_limit_velocity_in_both_directions(sign: float) -> None:
    """As ROS 2 Jazzy: forward at 2, braking at 5. Backward at 1, braking at 4, with any sign."""
    sent = send(
        [1.0] * 60 + [0.0] * 30 + [-1.0] * 120 + [0.0] * 2,
        max_acceleration=2.0,
        max_deceleration=-5.0 * sign,
        max_acceleration_reverse=-1.0 * sign,
        max_deceleration_reverse=4.0 * sign,
    )
    assert sent[:2] == pytest.approx([0.02, 0.04])
    assert sent[60:62] == pytest.approx([0.95, 0.9])
    assert sent[90:92] == pytest.approx([-0.01, -0.02])
    assert sent[210:212] == pytest.approx([-0.96, -0.92])


def test_limits_that_contradict_each_other_are_an_error() -> None:
    with pytest.raises(ConfigError, match=r"linear_limits\.min_acceleration"):
        RobotConfig(linear_limits={"max_deceleration": -2.0, "min_acceleration": -2.0})
    with pytest.raises(ConfigError, match="geofence"):
        RobotConfig(geofence={"min_x": 1.0})  # away from where the robot starts
