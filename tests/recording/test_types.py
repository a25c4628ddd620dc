"""Logs of a wire's bytes."""

from __future__ import annotations

import numpy as np

from acsar_gym import RobotConfig
from acsar_gym.protocol import encode
from acsar_gym.recording.types import WireLog

LINES = (encode((1.0, 2.0, -3.0, 4.0)), encode((5.0, 6.0, 7.0, 8.0)))


def test_wire_log_decodes_lines_with_the_stamps_of_their_last_bytes() -> None:
    """A wheel that a line doesn't name keeps its speed."""
    stream = b"".join(LINES) + b"bp09.00\r\n"
    pieces = (stream[:7], stream[7:40], stream[40:])
    log = WireLog(np.array([0.5]), LINES[:1], np.array([1.0, 1.001, 1.003]), pieces)
    stamps, speeds = log.feedback(RobotConfig())
    assert stamps.tolist() == [1.001, 1.003, 1.003]
    expected = [[1.0, 2.0, -3.0, 4.0], [5.0, 6.0, 7.0, 8.0], [5.0, 9.0, 7.0, 8.0]]
    assert speeds.tolist() == expected
    stamps, speeds = log.commands(RobotConfig())
    assert stamps.tolist() == [0.5]
    assert speeds.tolist() == expected[:1]
    assert WireLog.of((), ()).commands(RobotConfig())[1].shape == (0, 4)
