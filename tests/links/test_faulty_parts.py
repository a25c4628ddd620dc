"""Encoders, wheels, boards, supplies and cables that fail."""

from __future__ import annotations

import math
from typing import Any

import pytest
from fault_tools import (
    PERIOD,
    TURNING,
    Board,
    board_lines,
    drive,
    on_board,
    planar,
    readings,
    sent,
)

from acsar_gym import Link, Robot, RobotConfig
from acsar_gym.errors import BoardSilentError, LinkLostError, PortNotFoundError
from acsar_gym.links.faults import FaultyLink
from acsar_gym.protocol import ZERO, Decoder
from acsar_gym.worlds import Scene

pytestmark = pytest.mark.usefixtures("deadline")

AS_TURNED = (3.0, 3.0, 3.0, 3.0)


def test_a_stuck_encoder_repeats_its_reading() -> None:
    link, _ = on_board(stuck_encoders="b", wheel_faults_at=0.05)
    stuck = [speeds[1] for speeds in readings(drive(link, 10))]
    assert stuck == [1.0, 2.0, 3.0, 4.0, *[4.0] * 6]
    link, _ = on_board(stuck_encoders="b")
    assert {speeds[1] for speeds in readings(drive(link, 10))} == {0.0}


def test_a_reversed_encoder_says_the_opposite(config: RobotConfig) -> None:
    link, _ = on_board(reversed_encoders="d")
    assert {speeds[2:] for speeds in readings(drive(link, 10))} == {(4.0, -5.0)}
    assert link.wheels.reversed == "d"
    link = planar(config, reversed_encoders="b")
    with Robot(link, config) as robot:
        for _ in range(50):
            robot.tick(AS_TURNED)
        assert robot.speeds == pytest.approx((3.0, -3.0, 3.0, 3.0), abs=0.2)


def test_a_dead_wheel_really_stands(config: RobotConfig) -> None:
    with Robot(planar(config, dead_wheels="ad"), config) as robot:
        for _ in range(100):
            robot.tick(AS_TURNED)
        assert robot.speeds == pytest.approx((0.0, 3.0, 3.0, 0.0), abs=0.2)
        assert robot.link.truth is not None
        assert robot.link.truth.pose[2] < -0.1  # the right wheels drag it around


def test_wheels_are_drawn_anew_with_every_episode() -> None:
    link, _ = on_board(dead_wheels=1)
    seen = set()
    for _ in range(60):
        link.reset(Scene())
        seen.add(link.wheels.dead)
    assert seen == {"a", "b", "c", "d"}


@pytest.mark.parametrize("name", ["board_reset", "brown_out"])
def test_a_board_that_is_down_says_and_hears_nothing(name: str) -> None:
    link, board = on_board(0, **{f"{name}_at": 0.5, "reset_time": 0.4, "brown_out_time": 0.4})
    heard = drive(link, 200)
    assert heard[:49] == sent(49)
    assert not any(heard[49:89])
    assert heard[89:] == sent(200)[89:]
    assert link.injected == {name: 1}
    obeyed = [speeds for _, data in board.heard[50:90] for speeds in [r.speeds for r in feed(data)]]
    assert set(obeyed) == {ZERO}
    assert board_lines(board)[-110:] == sent(200)[-110:]


def feed(data: bytes) -> list[Any]:
    return list(Decoder().feed(data))


def test_a_reset_lasts_two_seconds_and_ends_at_rest(config: RobotConfig) -> None:
    link = planar(config, board_reset_at=1.0)
    link.open()
    link.reset(Scene())
    heard = []
    for _ in range(500):
        link.write(TURNING)
        heard.append(link.advance(PERIOD))
    silent = [tick for tick, piece in enumerate(heard) if not piece and tick > 5]
    assert (silent[0], silent[-1], len(silent)) == (99, 298, 200)
    assert feed(heard[98])[0].speeds == pytest.approx(AS_TURNED, abs=0.2)
    assert feed(heard[299])[0].speeds == ZERO
    assert feed(heard[-1])[0].speeds == pytest.approx(AS_TURNED, abs=0.2)
    link.close()


def test_the_rate_of_resets() -> None:
    link, _ = on_board(board_reset_rate=2.0, reset_time=0.1)
    for _ in range(2):
        drive(link, 10_000)
        assert link.injected["board_reset"] / 100.0 == pytest.approx(1.0 / 0.6, abs=0.4)


def test_a_rate_goes_on_after_the_first_time() -> None:
    link, _ = on_board(brown_out_at=0.0, brown_out_rate=5.0, brown_out_time=0.05)
    assert not any(drive(link, 4))
    drive(link, 1000, reset=False)
    assert link.injected["brown_out"] > 20


def test_silence_is_an_error_and_a_dip_is_none(config: RobotConfig) -> None:
    config = config.with_(feedback_timeout=0.5)
    with Robot(planar(config, brown_out_at=0.5), config) as robot:
        ages = []
        for _ in range(200):
            robot.drive(0.3, 0.0)
            ages.append(robot.feedback_age)
        assert max(ages) == pytest.approx(0.3, abs=0.02)
        assert robot.odometry.twist[0] == pytest.approx(0.3, abs=0.02)
    robot = Robot(planar(config, board_reset_at=0.5), config)
    robot.activate()
    with pytest.raises(BoardSilentError, match="no feedback for"):
        for _ in range(200):
            robot.drive(0.3, 0.0)
    assert not robot.active
    robot.reset(Scene())
    robot.drive(0.3, 0.0)
    robot.deactivate()


def test_a_pulled_cable_is_a_lost_link(config: RobotConfig) -> None:
    link = planar(config, unplug_at=0.5, replug_time=0.7)
    robot = Robot(link, config)
    robot.activate()
    for _ in range(100):
        robot.drive(0.0, 0.0)
    start = link.now()
    with pytest.raises(LinkLostError, match="robot0: lost while in use"):
        for _ in range(200):
            robot.drive(0.3, 0.0)
    assert link.now() == pytest.approx(start + 0.5)
    assert link.injected == {"unplug": 1}
    for use in (lambda: link.write(TURNING), lambda: link.advance(PERIOD)):
        with pytest.raises(LinkLostError, match="open"):
            use()
    with pytest.raises(LinkLostError):
        link.reset(Scene())
    link.open()
    assert link.now() == pytest.approx(start + 1.2)
    assert link.device == "robot1"
    robot.reset(Scene())
    for _ in range(40):
        robot.drive(0.3, 0.0)
    assert robot.odometry.pose[0] > 0.05
    with pytest.raises(LinkLostError, match="robot1"):
        for _ in range(20):
            robot.drive(0.3, 0.0)


def test_a_cable_that_stays_out() -> None:
    link, board = on_board(unplug_at=0.1, replug_time=math.inf)
    with pytest.raises(LinkLostError):
        drive(link, 50)
    assert board.closed == 1
    for _ in range(2):
        with pytest.raises(PortNotFoundError, match="/dev/board0: no such device"):
            link.open()
    link.close()
    link.close()
    assert board.opened == 1


def test_another_device_takes_the_place_of_the_pulled_one() -> None:
    boards = [Board(), Board()]
    boards[1].device = "/dev/board1"
    link = FaultyLink(boards[0], {"unplug_at": 0.1}, relink=lambda: boards[1])
    with pytest.raises(LinkLostError, match="board0"):
        drive(link, 50)
    assert boards[1].opened == 0
    drive(link, 5)
    assert link.device == "/dev/board1"
    assert board_lines(boards[1]) == sent(5)
    assert boards[0].closed == 1


def test_a_device_that_cannot_be_opened_leaves_the_cable_out() -> None:
    class Missing(Board):
        def open(self) -> None:
            raise PortNotFoundError("/dev/board1: no such device")

    made: list[Link] = [Missing(), Board()]
    link = FaultyLink(Board(), {"unplug_at": 0.0}, relink=lambda: made.pop(0))
    with pytest.raises(LinkLostError):
        drive(link, 1)
    with pytest.raises(PortNotFoundError, match="board1"):
        link.open()
    with pytest.raises(LinkLostError):
        link.write(TURNING)
    link.open()
    link.advance(PERIOD)


def test_the_rate_of_unplugging() -> None:
    link, board = on_board(unplug_rate=2.0, replug_time=0.0)
    lasted = []
    for _ in range(300):
        with pytest.raises(LinkLostError):
            drive(link, 100_000)
        lasted.append(board.clock - 10.0)
    assert sum(lasted) / 300 == pytest.approx(0.5, abs=0.1)
