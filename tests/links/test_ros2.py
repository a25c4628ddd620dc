"""The parts of the link to ROS 2 that need no ROS. tests/ros drives it."""

from __future__ import annotations

from importlib.util import find_spec
from types import SimpleNamespace

import pytest

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.links.base import Arrivals, Link
from acsar_gym.links.ros2 import SLACK, Ros2Link
from acsar_gym.protocol import ZERO
from acsar_gym.ros.node import MissingRosError
from acsar_gym.wire import Wire

PERIOD = 0.01


@pytest.mark.skipif(find_spec("rclpy") is not None, reason="ROS 2 is installed")
def test_ros2_that_is_missing_is_one_line() -> None:
    with pytest.raises(MissingRosError, match=r"^ROS 2 can't be used here .*setup\.bash") as raised:
        Robot(open_link("ros2")).activate()
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("begin", [0.0, 0.005, 0.0099])
def test_ros2_deadlines_come_to_lie_behind_the_feedback(begin: float) -> None:
    link = Ros2Link("ros2", RobotConfig())
    link._deadline = begin
    for tick in range(300):
        arrived = tick * PERIOD
        if arrived > link._deadline:
            arrived -= PERIOD  # that of the tick before
        link._follow_phase(arrived - link._deadline, PERIOD)
        link._deadline += PERIOD
    phase = (link._deadline - 300 * PERIOD) % PERIOD
    assert phase == pytest.approx(SLACK, abs=1e-4)


def test_ros2_zeros_that_are_not_confirmed_raise_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other robots of the program are stopped after this one, as by a signal."""
    commands: list[list[float]] = []

    def refuse(_: object) -> bool:
        raise RuntimeError("the context has ended")

    link = Ros2Link("ros2", RobotConfig())
    link.command_kind = "wheel_speeds"
    node = SimpleNamespace(make_duration=float, close=lambda: None)
    monkeypatch.setattr(link, "node", node)
    monkeypatch.setattr(link, "_command", SimpleNamespace(data=[]), raising=False)
    publisher = SimpleNamespace(
        publish=lambda command: commands.append(command.data), wait_for_all_acked=refuse
    )
    monkeypatch.setattr(link, "_publisher", publisher)
    with link.held():
        assert commands == [[0.0] * 4]
    link.close()
    assert not link.is_open


class StampedLink(Link):
    """Returns lines with the times at which they were measured."""

    stamped = True
    lateness = 0.0
    arrivals: Arrivals = ()

    def __init__(self, periods: list[list[tuple[float, bytes]]]) -> None:
        self._periods = iter(periods)
        self._now = 0.0

    def write(self, data: bytes) -> None:
        """Take commands."""

    def advance(self, period: float) -> bytes:
        self._now += period
        self.arrivals = next(self._periods)
        return b"".join(line for _, line in self.arrivals)

    def now(self) -> float:
        return self._now


def test_stamped_lines_hold_from_the_stamp_before_to_their_own() -> None:
    line = b"ap%09.6f,bp01.000000,cp01.000000,dp01.000000\r\n"
    link = StampedLink(
        [[(0.007, line % 1)], [], [(0.018, line % 2), (0.0285, line % 3)], [(0.0385, line % 4)]]
    )
    wire = Wire(link, RobotConfig())
    wire.reset()
    shares = [wire.shares(*wire.exchange(ZERO)) for _ in range(4)]
    measured = [[(speeds[0], round(share, 9)) for speeds, share in tick] for tick in shares]
    assert measured == [[(1.0, 0.0)], [], [(2.0, 0.011), (3.0, 0.0105)], [(4.0, 0.01)]]
