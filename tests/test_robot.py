"""The driver's lifecycle and bookkeeping, on simulated links."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from boards import LikeABoard

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import (
    BoardGarbledError,
    BoardSilentError,
    CommandError,
    LinkError,
    WheelError,
)
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.recording import Recorder, read
from acsar_gym.testing import ScriptedLink
from acsar_gym.worlds import Scene

ACSAR = RobotConfig.preset("acsar")

LINE = b"ap01.00,bp02.00,cp03.00,dp04.00\r\n"
STILL = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"


def standing(*answers: bytes, then: bytes = STILL) -> tuple[Robot, ScriptedLink]:
    link = ScriptedLink(STILL, STILL, *answers, then=then)
    robot = Robot(link, RobotConfig())
    robot.activate()
    return robot, link


def assert_stopped(link: ScriptedLink) -> None:
    """The last command is zero, and the link was closed once."""
    assert link.commands[-1] == ZERO
    assert link.closed == 1


def test_drive_is_never_late_with_its_first_command(tmp_path: Path) -> None:
    """The first tick's deadline is that of the reset, and a policy may be loaded in between."""
    link = ScriptedLink(then=STILL)
    file = tmp_path / "drive.mcap"
    link.lateness = 0.2
    with Robot(link, ACSAR, recorder=Recorder(file)) as robot:
        robot.drive(0.1, 0.0)
        link.lateness = 0.003
        robot.drive(0.1, 0.0)
        assert robot.timing is not None
        assert robot.timing.lateness.worst == 0.003
    (episode,) = read(file).episodes
    assert episode.lateness.tolist() == pytest.approx([math.nan, 0.003], nan_ok=True)


def test_activate_twice_is_once_and_the_last_command_is_zero() -> None:
    robot, link = standing()
    robot.activate()
    assert link.opened == 1
    robot.tick((5.0, 5.0, 5.0, 5.0))
    robot.deactivate()
    robot.deactivate()
    assert_stopped(link)


def test_exit_after_an_exception_stops_the_wheels() -> None:
    link = ScriptedLink(then=STILL)
    with pytest.raises(ZeroDivisionError), Robot(link, RobotConfig()) as robot:
        robot.tick((5.0, 5.0, 5.0, 5.0))
        raise ZeroDivisionError
    assert_stopped(link)


@pytest.mark.parametrize("bad", [(math.nan, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, math.inf)])
def test_tick_refuses_bad_commands_and_stops_the_wheels(bad: tuple[float, ...]) -> None:
    robot, link = standing()
    with pytest.raises(CommandError):
        robot.drive(*bad) if len(bad) == 2 else robot.tick(bad)
    assert_stopped(link)
    with pytest.raises(LinkError, match="activate"):
        robot.tick(ZERO)


def tick_thrice(robot: Robot) -> list[tuple[Speeds, float]]:
    """Wheel speeds and their age after each tick."""
    results = []
    for _ in range(3):
        robot.tick(ZERO)
        results.append((robot.speeds, robot.feedback_age))
    return results


def test_tick_takes_the_newest_line_and_keeps_missing_motors() -> None:
    robot, _ = standing(LINE.replace(b"0", b"1") + LINE + b"ap0", b"9.00\r\n", b"bn07.00\r\n")
    rear = (3.0, 4.0)
    speeds = [(1.0, 2.0, *rear), (9.0, 2.0, *rear), (9.0, -7.0, *rear)]
    assert tick_thrice(robot) == [(row, 0.0) for row in speeds]


def test_tick_holds_the_last_reading_which_ages() -> None:
    robot, _ = standing(LINE, then=b"")
    robot.tick(ZERO)
    assert [age for _, age in tick_thrice(robot)] == pytest.approx([0.01, 0.02, 0.03])
    assert robot.odometry.wheel_positions == pytest.approx((0.04, 0.08, 0.12, 0.16))


@pytest.mark.parametrize("listens", [False, True])
def test_silence_ends_with_an_error_and_a_stop(listens: bool) -> None:
    robot, link = standing(then=b"")
    robot.tick((5.0, 5.0, 5.0, 5.0))
    ticks = 0
    with pytest.raises(BoardSilentError, match=r"no feedback for 0\.5"):
        while ticks < 100:
            ticks += 1
            robot.listen() if listens else robot.tick((5.0, 5.0, 5.0, 5.0))
    assert 45 <= ticks <= 55
    assert_stopped(link)


def test_tick_shows_garbage() -> None:
    robot, _ = standing(then=b"\x80\x81,nonsense\r\n")
    with pytest.raises(BoardGarbledError, match=r"'\\x80\\x81,nonsense'.*baud rate"):
        for _ in range(100):
            robot.tick(ZERO)


def test_reset_waits_for_standstill() -> None:
    robot, link = standing(LINE, LINE, LINE)
    commands = len(link.written)
    robot.reset(Scene())
    assert len(link.written) - commands == 5
    assert robot.odometry.pose == (0.0, 0.0, 0.0)
    assert robot.odometry.wheel_positions == ZERO


def test_activate_refuses_wheels_that_never_stop() -> None:
    link = ScriptedLink(then=LINE)
    with pytest.raises(LinkError, match="still turn"):
        Robot(link, RobotConfig()).activate()
    assert link.closed == 1


def test_tick_after_a_pause_gives_each_line_its_share_of_the_time() -> None:
    robot, link = standing(LINE.replace(b"p0", b"p1") + 9 * LINE)
    link.pause = 0.99
    robot.tick(ZERO)
    assert robot.odometry.wheel_positions == pytest.approx((2.0, 3.0, 4.0, 5.0))
    assert robot.speeds == (1.0, 2.0, 3.0, 4.0)


def test_round_trip_starts_with_the_command() -> None:
    """Whatever the program does between the reset and the first command doesn't count."""
    trips = []
    for pause in (0.0, 0.3):
        link: Any = LikeABoard(open_link("planar", ACSAR))
        with Robot(link, ACSAR) as robot:
            if pause:
                link.advance(pause)
            start = link.now()
            for _ in range(30):
                robot.drive(0.3, 0.0)

            assert robot.wire.start == pytest.approx(start)
            assert robot.wire.stamp == pytest.approx(start + 0.3)
            assert robot.timing is not None
            (trip,) = robot.timing.round_trips
            trips.append(trip)
    assert trips[0] == pytest.approx(trips[1], abs=1e-9)
    assert 0.02 < trips[0] < 0.08


def test_wheel_error_quotes_the_boards_report() -> None:
    link = LikeABoard(ScriptedLink(then=b"# a cut: stalled\r\n" + STILL))
    with Robot(link, ACSAR) as robot, pytest.raises(WheelError, match="reports a cut: stalled"):
        for _ in range(200):
            robot.drive(0.3, 0.0)
