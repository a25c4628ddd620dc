"""Robots in ROS that take twists: their controller's separation, and what it makes of commands."""

from __future__ import annotations

import numpy as np
import pytest
from sysid_tools import ACSAR

from acsar_gym import RobotConfig, open_link
from acsar_gym.links import Link
from acsar_gym.links.base import LinkWrapper
from acsar_gym.protocol import ZERO, Decoder, encode
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid.identify import Identification, identify_device
from acsar_gym.tools.sysid.twist_controller import SEPARATION_NAME, resend_twists

HIDDEN = ACSAR.with_(
    motor={"time_constant": 0.15, "gain": [0.94, 1.03, 0.97, 1.05], "deadband": 0.3},
    firmware={"command_delay": 0.04, "command_timeout": 0.4},
)


class TwistLink(LinkWrapper):
    """A simulated robot behind a controller that takes twists, with a separation of its own."""

    commands_sides = True
    stamped = True

    def __init__(self, link: Link, share: float) -> None:
        super().__init__(link)
        self._share = share
        self._decoder = Decoder()

    def write(self, data: bytes) -> None:
        """Send what the controller makes of a command."""
        for reading in self._decoder.feed(data):
            a, b, c, d = reading.over(ZERO)
            middle, turn = (a + b + c + d) / 4.0, self._share * (a + d - b - c) / 4.0
            right, left = middle + turn, middle - turn
            super().write(encode((right, left, left, right)))


def identify(share: float, known: RobotConfig = ACSAR) -> Identification:
    return identify_device(TwistLink(open_link("planar", HIDDEN), share), known, 20.0)


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_a_hidden_robot_is_found_behind_its_controller(share: float) -> None:
    found = identify(share)
    # Of this link, stamps are those of arrivals, and commands take the time of a wire.
    truth = {
        "firmware.command_delay": 0.04 + 2.0 * HIDDEN.wire_time,
        "firmware.command_timeout": 0.4,
        "motor.time_constant": 0.15,
        "motor.deadband": 0.3,
        SEPARATION_NAME: share * ACSAR.effective_separation,
    }
    for finding in found.findings:
        if finding.name == "motor.gain":
            truth[finding.name] = (0.94, 1.03, 0.97, 1.05)["abcd".index(finding.wheel)]
        if finding.name in truth:
            assert finding.low is not None
            assert finding.high is not None
            assert finding.low <= truth[finding.name] <= finding.high, finding
    robot = found.robot()
    assert robot.effective_separation == ACSAR.effective_separation
    expected = None if share == 1.0 else pytest.approx(share * ACSAR.effective_separation, rel=0.01)
    assert robot.ros2.wheel_separation == expected
    assert found.model is not None
    assert not found.model.pattern


def test_what_is_known_of_a_controller_counts() -> None:
    """Commands of a robot's file that names the separation are turned as they should."""
    known = ACSAR.with_(ros2={"wheel_separation": 0.5, "wheel_radii": (0.04, 0.06)})
    assert known.twist_geometry == (0.04, 0.06, 0.5)
    assert ACSAR.twist_geometry == (0.05, 0.05, ACSAR.effective_separation)


def test_a_log_is_sent_again_as_the_controller_took_it() -> None:
    other = ACSAR.with_(ros2={"wheel_separation": 2.0 * ACSAR.effective_separation})
    stamps, lines = np.array([0.5, 0.6]), (encode((3.0, 1.0, 1.0, 3.0)), encode(ZERO))
    log = WireLog(stamps, lines, stamps, lines, stamped=True)
    sent = resend_twists(log, ACSAR, other)
    assert sent.commands(ACSAR)[0].tolist() == stamps.tolist()
    assert sent.commands(ACSAR)[1].tolist() == [[4.0, 0.0, 0.0, 4.0], [0.0] * 4]
    assert sent.got == log.got
    assert resend_twists(log, ACSAR, ACSAR) is log
    board = WireLog(stamps, lines, stamps, lines)
    assert resend_twists(board, ACSAR, other) is board
