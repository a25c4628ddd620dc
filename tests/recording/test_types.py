"""Logs of a wire's bytes."""

from __future__ import annotations

import numpy as np

from acsar_gym import RobotConfig
from acsar_gym.protocol import encode
from acsar_gym.recording.types import WireLog

LINES = (encode((1.0, 2.0, -3.0, 4.0)), encode((5.0, 6.0, 7.0, 8.0)))


def test_feedback_has_the_stamp_of_a_lines_last_byte() -> None:
    stream = b"".join(LINES)
    pieces = (stream[:7], stream[7:40], stream[40:])
    log = WireLog(np.array([0.5]), LINES[:1], np.array([1.0, 1.001, 1.003]), pieces)
    stamps, speeds = log.feedback(RobotConfig())
    assert stamps.tolist() == [1.001, 1.003]
    assert speeds.tolist() == [[1.0, 2.0, -3.0, 4.0], [5.0, 6.0, 7.0, 8.0]]
    stamps, speeds = log.commands(RobotConfig())
    assert stamps.tolist() == [0.5]
    assert speeds.tolist() == [[1.0, 2.0, -3.0, 4.0]]


def test_feedback_keeps_the_speed_of_a_wheel_that_a_line_does_not_name() -> None:
    log = WireLog(np.zeros(0), (), np.array([0.1, 0.2]), (LINES[0], b"bp09.00\r\n"))
    assert log.feedback(RobotConfig())[1].tolist()[1] == [1.0, 9.0, -3.0, 4.0]
    assert log.commands(RobotConfig())[1].shape == (0, 4)
