"""The safety rules as pure functions: one robot, one tick."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.jit import record_of
from acsar_gym.safety import rules
from acsar_gym.safety.rules import Reason, SafetyMemory, SafetyRules

ACSAR = RobotConfig.preset("acsar")
FENCED = rules.make_rules(ACSAR.with_(geofence={"max_x": 1.0, "min_y": -0.5}, feedback_timeout=0.1))
AT_ONCE: dict[str, Any] = {"max_acceleration": None}
FREE = rules.make_rules(ACSAR.with_(linear_limits=AT_ONCE, angular_limits=AT_ONCE))


@pytest.mark.parametrize(
    ("x", "y", "age", "latched", "expected"),
    [
        (0.9, 0.0, 0.0, 0.0, (0, 0)),
        (1.1, 0.0, 0.0, 0.0, (2, 2)),
        (0.9, -0.6, 0.0, 0.0, (2, 2)),
        (0.9, 0.0, 0.09, 0.0, (0, 3)),
        (1.1, 0.0, 0.09, 0.0, (2, 2)),
        (0.9, 0.0, 0.09, 2.0, (2, 2)),
        (1.1, 0.0, 0.09, 4.0, (4, 4)),
        (float("nan"), 0.0, 0.0, 0.0, (2, 2)),
    ],
)
def test_what_holds_a_robot(
    x: float, y: float, age: float, latched: float, expected: tuple[int, int]
) -> None:
    assert rules.find_holds(SafetyMemory(latched), x, y, age, FENCED) == expected


def test_ages_that_are_sums_of_periods_have_no_luck_at_the_edge() -> None:
    """Eight hundredths are no more than 0.8 of a tenth, however they were added up."""
    for age in (sum([0.01] * 8), 1e3 + 0.08 - 1e3, 0.08):
        assert rules.find_holds(SafetyMemory(), 0.0, 0.0, age, FENCED)[1] == Reason.NONE
        assert (
            rules.find_holds(SafetyMemory(), 0.0, 0.0, age + 0.01, FENCED)[1]
            == Reason.STALE_FEEDBACK
        )
        assert not rules.is_silent(age + 0.02, FENCED)
        assert rules.is_silent(age + 0.03, FENCED)


def test_a_stop_is_immediate_and_forgets_the_ramp() -> None:
    drove = SafetyMemory(0.0, 0.0, 0.3, 0.2, 0.29, 0.19)
    assert rules.limit_twist(0.0, 0.0, 0.0, 0.0, 0.0, drove, FENCED) == SafetyMemory()
    held = rules.limit_twist(0.3, 0.2, 0.0, 0.0, 0.09, drove, FENCED)
    assert held == SafetyMemory(reason=Reason.STALE_FEEDBACK)
    outside = rules.limit_twist(0.3, 0.2, 2.0, 0.0, 0.0, drove, FENCED)
    assert outside == SafetyMemory(Reason.GEOFENCE, Reason.GEOFENCE)


def test_without_limits_a_twist_is_sent_as_it_is_up_to_full_speed() -> None:
    sent = rules.limit_twist(0.1, -9.0, 0.0, 0.0, 0.0, SafetyMemory(), FREE)
    assert (sent.linear, sent.angular) == (0.1, -ACSAR.max_angular)
    assert (
        rules.explain_sent(
            0.1, -9.0, *rules.compute_wheels(sent.linear, sent.angular, FREE), 0.0, FREE
        )[2]
        == Reason.LIMITS
    )


@pytest.mark.parametrize("own", [FENCED, FREE], ids=["fenced", "free"])
def test_one_robot_with_its_memory_in_place_follows_the_same_rules(own: SafetyRules) -> None:
    memory, kept, numbers = SafetyMemory(), record_of(SafetyMemory(), changes=True), record_of(own)
    for linear, angular, x, y, age in np.random.default_rng(0).uniform(-0.1, 1.1, (50, 5)).tolist():
        memory = rules.limit_twist(linear, angular, x, y, age / 10.0, memory, own)
        sides = rules.compute_wheels(memory.linear, memory.angular, own)
        *sent, reason = rules.explain_sent(linear, angular, *sides, memory.reason, own)
        assert rules.update_twist(linear, angular, x, y, age / 10.0, kept, numbers) == sides
        assert kept[0].tolist() == (memory.latched, reason, *memory[2:6], *sent)
        memory = memory._replace(latched=0.0)
        kept["latched"] = 0.0
