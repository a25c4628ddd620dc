"""Joint states to wheel speeds: any order, other joints, no velocities, and what is refused."""

from __future__ import annotations

import math
from array import array

import pytest

from acsar_gym.ros.joints import JointReader

FOUR = ("fr", "fl", "rl", "rr")
SPEEDS = (1.0, 2.0, 3.0, 4.0)
NAN = math.nan


def test_joint_speeds_are_found_by_name_among_other_joints() -> None:
    reader = JointReader(FOUR)
    assert reader.read(["arm", "arm"], [], [NAN, 1.0, 2.0], 5.0) is None
    names = ["arm", "rr", "fl", "gripper", "fr", "rl"]
    got = reader.read(names, array("d"), array("d", [9.0, 4.0, 2.0, NAN, 1.0, 3.0]), 0.0)
    assert got == SPEEDS
    assert (reader.reason, reader.refused) == ("", {})
    sides = JointReader(("r", "l", "l", "r"))
    assert sides.read(["l", "r"], [], [2.0, 1.0], 0.0) == (1.0, 2.0, 2.0, 1.0)


WITHOUT_VELOCITIES = pytest.mark.parametrize("velocities", [[], [NAN] * 4])


@WITHOUT_VELOCITIES
def test_joint_positions_replace_missing_velocities(velocities: list[float]) -> None:
    reader = JointReader(FOUR)
    turned = [100.5, -0.5, 0.0, 1.0]
    assert reader.read(FOUR, [100.0, 0.0, 0.0, 0.0], velocities, 1.0) is None
    assert not reader.refused
    assert reader.read(FOUR, turned, velocities, 1.5) == (1.0, -1.0, 0.0, 2.0)
    assert reader.read(["arm"], [7.0], [], 1.6) is None
    assert reader.read(FOUR, turned, [NAN, 1.0, 1.0, 1.0], 1.7) is None
    assert reader.read(FOUR, [101.5, *turned[1:]], velocities, 2.5) == (1.0, 0.0, 0.0, 0.0)


@WITHOUT_VELOCITIES
def test_joint_messages_without_velocities_are_refused_once_there_were_some(
    velocities: list[float],
) -> None:
    """A joint_state_publisher beside the robot's own node publishes zeros without velocities."""
    reader = JointReader(FOUR)
    assert reader.read(FOUR, [0.0] * 4, velocities, 0.5) is None
    assert reader.read(FOUR, [5.0] * 4, SPEEDS, 1.0) == SPEEDS
    assert reader.read(FOUR, [0.0] * 4, velocities, 1.01) is None
    assert reader.refused == {"no velocities": 1}
    assert "a second node publishes the wheels" in reader.reason
    assert reader.read(FOUR, [5.1] * 4, SPEEDS, 1.02) == SPEEDS


@pytest.mark.parametrize(("speed", "first"), [(-8.0, 0.0), (25.0, -math.pi)])
def test_joint_positions_may_wrap_at_full_turns(speed: float, first: float) -> None:
    reader = JointReader(FOUR)
    for message in range(500):
        position = (0.02 * speed * message - first) % math.tau + first
        speeds = reader.read(FOUR, [position] * 4, [], 0.02 * message)
        assert message == 0 or speeds == pytest.approx((speed,) * 4)


def test_joint_encoders_that_were_reset_are_refused_once() -> None:
    reader = JointReader(FOUR)
    for stamp, turned in ((0.0, 900.0), (0.1, 0.0), (0.2, 0.3)):
        got = reader.read(FOUR, [turned, 0.0, 0.0, 0.0], [], stamp)
    assert got == pytest.approx((3.0, 0.0, 0.0, 0.0))
    assert reader.refused == {"too fast": 1}


@pytest.mark.parametrize(
    ("kind", "names", "velocities", "stamp"),
    [
        ("joint missing", FOUR[:3], SPEEDS[:3], 2.0),
        ("joint repeated", [*FOUR, "rl"], [1.0] * 5, 2.0),
        ("wrong length", FOUR, SPEEDS[:3], 2.0),
        ("not finite", FOUR, [1.0, 1.0, NAN, 1.0], 2.0),
        ("no numbers", FOUR, [], 2.0),
        ("stamp", FOUR, SPEEDS, 1.0),
        ("too fast", FOUR, [1.0, 1.0, 1.0, -1001.0], 2.0),
    ],
)
def test_joint_messages_that_are_bad_are_refused_with_one_line(
    kind: str, names: list[str], velocities: list[float], stamp: float
) -> None:
    reader = JointReader(FOUR)
    assert reader.read(FOUR, [], SPEEDS, 1.0) == SPEEDS
    assert reader.read(names, [], velocities, stamp) is None
    assert reader.refused == {kind: 1}
    assert reader.reason.isprintable()
    assert reader.read(FOUR, [], SPEEDS, 3.0) == SPEEDS
    assert reader.reason == ""
