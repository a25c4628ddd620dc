"""How long lines are on their way between driver and board, and the firmware's loops."""

from __future__ import annotations

import numpy as np

from acsar_gym.config import BITS_PER_BYTE, LINE_BYTES, RobotConfig
from acsar_gym.jit import jit


def substep(config: RobotConfig) -> float:
    """Period of the firmware loop, which is also the step of the physics [s]."""
    return 1.0 / config.firmware.loop_rate


def line_time(config: RobotConfig) -> float:
    """Duration of a line on the wire [s]."""
    return (LINE_BYTES + config.trailing_comma) * BITS_PER_BYTE / config.baud_rate


def wire_time(config: RobotConfig) -> float:
    """Time from sending a line until it is used, without extra latency or delay [s]."""
    return line_time(config) + config.firmware.processing_time


@jit
def whole_loops(time: float, dt: float) -> float:
    """Firmware loops until something is used that is there after `time` [s]."""
    loops: float = np.ceil(time / dt - 1e-6)
    return loops


def wire_loops(config: RobotConfig, command_delay: float = 0.0) -> int:
    """Firmware loops from sending a line until it is used, without extra latency."""
    return int(whole_loops(wire_time(config) + command_delay, substep(config)))
