"""The parts of the driver's node that need no ROS: commands and joint states of late ticks."""

from __future__ import annotations

import math
import time

import pytest

from acsar_gym.protocol import Speeds
from acsar_gym.tools.ros.driver import CommandInbox, list_states

TIMEOUT = 0.2
FORWARD = (0.2, 0.0, 0.0, 0.0, 0.0, 0.5)


@pytest.fixture
def lines() -> list[str]:
    """Lines that the inbox reports."""
    return []


@pytest.fixture
def inbox(lines: list[str]) -> CommandInbox:
    return CommandInbox(TIMEOUT, "base_link", lines.append)


def test_inbox_keeps_the_newest_twist_until_the_time_out(
    inbox: CommandInbox, lines: list[str]
) -> None:
    assert inbox.current() == (0.0, 0.0)
    inbox.take((1.0,) * 6)
    inbox.take(FORWARD, age=0.1, frame="/base_link")
    assert inbox.current() == (0.2, 0.5)
    time.sleep(1.2 * TIMEOUT)
    assert inbox.current() == (0.0, 0.0)
    assert not lines


@pytest.mark.parametrize(
    ("velocities", "age", "reason"),
    [
        ((*FORWARD[:5], math.nan), 0.0, "isn't finite"),
        (FORWARD, 0.3, "0.30 s behind the clock of this computer"),
        (FORWARD, -0.3, "0.30 s ahead of"),
        (FORWARD, math.nan, "nan s"),
        (FORWARD, 1.7e9, "set use_sim_time: false"),
    ],
)
def test_inbox_refuses_twists_with_a_line(
    velocities: tuple[float, ...],
    age: float,
    reason: str,
    inbox: CommandInbox,
    lines: list[str],
) -> None:
    inbox.take(FORWARD)
    for _ in range(3):
        inbox.take(velocities, age)
        assert inbox.current() == (0.0, 0.0)
    assert len(lines) == 1
    assert lines[0].startswith("cmd_vel: refused ")
    assert reason in lines[0]
    assert inbox.problem == lines[0]
    inbox.take(FORWARD)
    assert inbox.current() == (0.2, 0.5)
    assert not inbox.problem
    inbox.simulated = True
    inbox.take(FORWARD, age=-1.7e9)
    assert "set use_sim_time: true" in inbox.problem


def test_inbox_takes_other_frames_and_reports_once(inbox: CommandInbox, lines: list[str]) -> None:
    for frame in ("odom", "base_footprint", "teleop_twist_joy", "odom"):
        inbox.take(FORWARD, frame=frame)
        assert inbox.current() == (0.2, 0.5)
    assert lines == ["cmd_vel: twists in 'odom' are driven as if in 'base_link'"]


def test_list_states_contains_all_that_odometry_integrated() -> None:
    """Their readers apply each speed from the previous stamp to its own."""
    slow: Speeds = (1.0, 2.0, 2.0, 1.0)
    fast: Speeds = (3.0, 4.0, 4.0, 3.0)
    angles: Speeds = (1.0, 2.0, 3.0, 4.0)
    stamp = 5_000_000_000
    assert list_states([], stamp, fast, angles) == [(stamp, fast, angles)]
    earlier, newest = list_states([(slow, 0.008), (fast, 0.008)], stamp, fast, angles)
    assert newest == (stamp, fast, angles)
    assert earlier[:2] == (stamp - 8_000_000, slow)
    assert earlier[2] == pytest.approx((0.976, 1.968, 2.968, 3.976))
