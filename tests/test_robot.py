"""The driver's lifecycle and bookkeeping, on simulated links."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from board_like import LikeABoard

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import (
    BoardGarbledError,
    BoardSilentError,
    CommandError,
    LinkError,
    WheelError,
)
from acsar_gym.protocol import ZERO
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


def test_the_time_until_the_first_command_is_late_in_no_table(tmp_path: Path) -> None:
    """The first tick's deadline is that of the reset, and a policy may be loaded in between."""
    link, file = ScriptedLink(then=STILL), tmp_path / "drive.mcap"
    link.lateness = 0.2
    with Robot(link, ACSAR, recorder=Recorder(file)) as robot:
        robot.drive(0.1, 0.0)
        link.lateness = 0.003
        robot.drive(0.1, 0.0)
        assert robot.timing is not None
        assert robot.timing.lateness.worst == 0.003
    (episode,) = read(file).episodes
    assert episode.lateness.tolist() == pytest.approx([math.nan, 0.003], nan_ok=True)


def test_activating_twice_is_once_and_the_last_command_is_zero() -> None:
    robot, link = standing()
    robot.activate()
    assert link.opened == 1
    robot.tick((5.0, 5.0, 5.0, 5.0))
    robot.deactivate()
    robot.deactivate()
    assert link.closed == 1
    assert link.commands[-1] == ZERO


def test_an_exception_in_the_block_stops_the_wheels() -> None:
    link = ScriptedLink(then=STILL)
    with pytest.raises(ZeroDivisionError), Robot(link, RobotConfig()) as robot:
        robot.tick((5.0, 5.0, 5.0, 5.0))
        raise ZeroDivisionError
    assert link.commands[-1] == ZERO
    assert link.closed == 1


@pytest.mark.parametrize(
    "bad",
    [
        *((math.nan, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (math.inf,) * 4),
        *((math.nan, 0.0), (0.0, math.inf)),
    ],
)
def test_what_must_not_be_sent_stops_the_wheels(bad: tuple[float, ...]) -> None:
    robot, link = standing()
    with pytest.raises(CommandError):
        robot.drive(*bad) if len(bad) == 2 else robot.tick(bad)
    assert link.commands[-1] == ZERO
    assert link.closed == 1
    with pytest.raises(LinkError, match="activate"):
        robot.tick(ZERO)


def test_the_newest_line_wins_and_a_missing_motor_keeps_its_value() -> None:
    robot, _ = standing(LINE.replace(b"0", b"1") + LINE + b"ap0", b"9.00\r\n", b"bn07.00\r\n")
    seen = []
    for _ in range(3):
        robot.tick(ZERO)
        seen.append(robot.speeds)
    assert seen == [(1.0, 2.0, 3.0, 4.0), (9.0, 2.0, 3.0, 4.0), (9.0, -7.0, 3.0, 4.0)]


def test_between_lines_the_last_reading_is_held_and_ages() -> None:
    robot, _ = standing(LINE, then=b"")
    robot.tick(ZERO)
    ages = []
    for _ in range(3):
        robot.tick(ZERO)
        ages.append(robot.feedback_age)
    assert ages == pytest.approx([0.01, 0.02, 0.03])
    assert robot.odometry.wheel_positions == pytest.approx((0.04, 0.08, 0.12, 0.16))


def test_silence_ends_with_an_error_and_a_stop() -> None:
    robot, link = standing(then=b"")
    with pytest.raises(BoardSilentError, match=r"no feedback for 0\.5"):
        for _ in range(100):
            robot.tick((5.0, 5.0, 5.0, 5.0))
    assert 50 <= len(link.written) <= 55
    assert link.commands[-1] == ZERO
    assert link.closed == 1


def test_silence_ends_with_a_stop_while_nothing_is_commanded_too() -> None:
    robot, link = standing(then=b"")
    robot.tick((5.0, 5.0, 5.0, 5.0))
    with pytest.raises(BoardSilentError):
        for _ in range(100):
            robot.listen()
    assert link.commands[-1] == ZERO
    assert link.closed == 1


def test_garbage_is_silence_with_another_name_and_is_shown() -> None:
    robot, _ = standing(then=b"\x80\x81,nonsense\r\n")
    with pytest.raises(BoardGarbledError, match=r"'\\x80\\x81,nonsense'.*baud rate"):
        for _ in range(100):
            robot.tick(ZERO)


def test_a_reset_waits_for_standstill() -> None:
    robot, link = standing(LINE, LINE, LINE)
    commands = len(link.written)
    robot.reset(Scene())
    assert len(link.written) - commands == 5
    assert robot.odometry.pose == (0.0, 0.0, 0.0)
    assert robot.odometry.wheel_positions == ZERO


def test_wheels_that_never_stop_are_an_error() -> None:
    link = ScriptedLink(then=LINE)
    with pytest.raises(LinkError, match="still turn"):
        Robot(link, RobotConfig()).activate()
    assert link.closed == 1


def test_after_a_pause_every_line_has_its_share_of_the_time() -> None:
    robot, link = standing(LINE.replace(b"p0", b"p1") + 9 * LINE)
    link.pause = 0.99
    robot.tick(ZERO)
    assert robot.odometry.wheel_positions == pytest.approx((2.0, 3.0, 4.0, 5.0))
    assert robot.speeds == (1.0, 2.0, 3.0, 4.0)


def test_a_round_trip_begins_with_the_command_and_no_sooner() -> None:
    """Whatever the program does between the reset and the first command doesn't count."""
    trips = []
    for pause in (0.0, 0.3):
        link: Any = LikeABoard(open_link("planar", ACSAR))
        with Robot(link, ACSAR) as robot:
            if pause:
                link.advance(pause)
            begin = link.now()
            for _ in range(30):
                robot.drive(0.3, 0.0)
            assert robot.wire.start == pytest.approx(begin)
            assert robot.wire.stamp == pytest.approx(begin + 0.3)
            assert robot.timing is not None
            (trip,) = robot.timing.round_trips
            trips.append(trip)
    assert trips[0] == pytest.approx(trips[1], abs=1e-9)
    assert 0.02 < trips[0] < 0.08


class RealBoard(ScriptedLink):
    """A scripted board whose wheels are real for the driver."""

    is_real = True
    lateness = 0.0


def test_an_error_of_a_wheel_quotes_what_the_board_reports() -> None:
    link = RealBoard(then=b"# a cut: stalled\r\n" + STILL)
    with Robot(link, ACSAR) as robot, pytest.raises(WheelError, match="reports a cut: stalled"):
        for _ in range(200):
            robot.drive(0.3, 0.0)
