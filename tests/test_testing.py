"""acsar_gym.testing: boards for tests of users."""

from __future__ import annotations

import pytest

from acsar_gym import Robot, RobotConfig, open_link, protocol
from acsar_gym.errors import LinkError
from acsar_gym.testing import EmulatedBoard, ScriptedLink, emulated_board, wait_until

PATIENT = RobotConfig().with_(connect_timeout=20.0, feedback_timeout=5.0, watchdog_timeout=2.0)


def test_scripted_link_answers_what_is_written() -> None:
    link = ScriptedLink(protocol.encode((1.0, 2.0, 3.0, 4.0)), then=protocol.encode)
    with Robot(link, RobotConfig()) as robot:
        for _ in range(100):
            robot.drive(0.1, 0.0)
        assert robot.odometry.twist[0] == pytest.approx(0.1, abs=1e-3)
    assert link.commands[-1] == protocol.ZERO
    assert (link.opened, link.closed) == (1, 1)


@pytest.mark.usefixtures("deadline")
def test_emulated_board_is_driven_pulled_and_plugged() -> None:
    with emulated_board(PATIENT) as board:
        assert isinstance(board, EmulatedBoard)
        with Robot(open_link(board.device, PATIENT), PATIENT) as robot:
            for _ in range(50):
                robot.drive(0.2, 0.0)
            wait_until(board.is_driven, "a command that turns wheels")
        wait_until(lambda: board.is_stopped() and board.stands(), "a robot that stands")
        assert board.poses()[-1][0] > 0.01
        board.pull()
        board.pull()
        assert board.device == ""
        board.plug()
        assert board.device.startswith("/dev/")


def test_emulated_board_and_wait_until_fail_in_one_line() -> None:
    with (
        pytest.raises(LinkError, match="the emulator didn't start"),
        emulated_board(body="balloon"),
    ):
        pass
    with pytest.raises(LinkError, match=r"rain: not within 0\.1 s"):
        wait_until(lambda: False, "rain", 0.1)
