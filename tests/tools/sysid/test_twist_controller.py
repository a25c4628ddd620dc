"""Robots in ROS that take twists: their controller's separation, and what it makes of commands."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from sysid_tools import ACSAR

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.kinematics import compute_sides, compute_twist
from acsar_gym.links import Link
from acsar_gym.links.base import LinkWrapper
from acsar_gym.protocol import ZERO, Decoder, encode
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid.board_log import Estimate
from acsar_gym.tools.sysid.calibration import Geometry
from acsar_gym.tools.sysid.calibration_fit import GeometryFit, make_calibrated_config
from acsar_gym.tools.sysid.identify import identify_device
from acsar_gym.tools.sysid.twist_controller import SEPARATION_NAME, resend_twists

HIDDEN = ACSAR.with_(
    motor={"time_constant": 0.15, "gain": [0.94, 1.03, 0.97, 1.05], "deadband": 0.3},
    firmware={"command_delay": 0.04, "command_timeout": 0.4},
)


class TwistLink(LinkWrapper):
    """A robot behind a controller that takes twists by a separation of its own.

    Args:
        robot: Robot that is simulated; its controller has its radius.
        sender: Robot by whose geometry commands become twists.
        share: Separation of the controller, as a share of the robot's.
    """

    commands_sides = True
    stamped = True

    def __init__(self, robot: RobotConfig, sender: RobotConfig, share: float = 1.0) -> None:
        super().__init__(open_link("planar", robot))
        self._sent = sender.twist_geometry
        self._taken = (*robot.wheel_radii, share * robot.effective_separation)
        self._decoder = Decoder()

    def write(self, data: bytes) -> None:
        """Send what the controller makes of a command."""
        for reading in self._decoder.feed(data):
            linear, angular = compute_twist(*reading.over(ZERO), *self._sent)
            right, left = compute_sides(linear, angular, *self._taken, math.inf)
            super().write(encode((right, left, left, right)))


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_a_hidden_robot_is_found_behind_its_controller(share: float) -> None:
    found = identify_device(TwistLink(HIDDEN, ACSAR, share), ACSAR, 20.0)
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


@pytest.mark.parametrize(
    ("ros2", "taken"),
    [
        ({"wheel_separation": 2.0 * ACSAR.effective_separation}, [4.0, 0.0, 0.0, 4.0]),
        ({"wheel_radii": (0.1, 0.1)}, [1.5, 0.5, 0.5, 1.5]),
    ],
)
def test_a_log_is_sent_again_as_the_controller_took_it(
    ros2: dict[str, Any], taken: list[float]
) -> None:
    other = ACSAR.with_(ros2=ros2)
    stamps, lines = np.array([0.5, 0.6]), (encode((3.0, 1.0, 1.0, 3.0)), encode(ZERO))
    log = WireLog(stamps, lines, stamps, lines, stamped=True)
    sent = resend_twists(log, ACSAR, other)
    assert sent.commands(ACSAR)[0].tolist() == stamps.tolist()
    assert sent.commands(ACSAR)[1].tolist() == [taken, [0.0] * 4]
    assert sent.got == log.got
    assert resend_twists(log, ACSAR, ACSAR) is log
    board = WireLog(stamps, lines, stamps, lines)
    assert resend_twists(board, ACSAR, other) is board


def steady_speed(link: Link, config: RobotConfig) -> float:
    """Mean speed of the wheels on one command, without its first second [rad/s]."""
    speeds = []
    with Robot(link, config) as robot:
        for _ in range(200):
            robot.tick((5.0, 5.0, 5.0, 5.0))
            speeds.append(robot.speeds)
    return float(np.mean(speeds[100:]))


def test_a_calibrated_radius_takes_its_error_out_of_the_gain() -> None:
    """The twin answers as the robot, and it does so if users follow the advice, too."""
    guessed = ACSAR.with_(wheel_radius=0.0485)
    identified = identify_device(TwistLink(ACSAR, guessed), guessed, 20.0).robot()
    assert identified.motor.of_wheel(0).gain == pytest.approx(0.97, abs=0.005)

    radius = Estimate(0.05, 0.0499, 0.0501)
    fit = GeometryFit(Geometry(0.05, 0.0, 1.5), {"wheel_radius": radius}, (), (), 1.0)
    calibrated = make_calibrated_config(fit, identified, in_ros=True)
    advised = calibrated.with_(ros2={"wheel_radii": None, "wheel_separation": None})
    for config in (calibrated, advised):
        driven = steady_speed(TwistLink(ACSAR, config), config)
        simulated = steady_speed(open_link("planar", config), config)
        assert simulated == pytest.approx(driven, rel=0.005)
    assert driven == pytest.approx(5.0, rel=0.005)
