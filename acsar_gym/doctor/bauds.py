"""Finds the baud rate of a board that sends no valid line at the configured one."""

from __future__ import annotations

from acsar_gym.config import BAUD_RATES, RobotConfig
from acsar_gym.config.robot import USUAL_RATES
from acsar_gym.doctor.checks import Check
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.links.serial import SerialLink

PATIENCE = 3.0
"""Longest wait for a valid line at each rate [s]; boards take 1 to 3 s to start."""
POLICY_RATE = 10.0
"""Usual rate of a policy; a control rate must be a multiple of it [Hz]."""


def at(config: RobotConfig, baud: int) -> RobotConfig:
    """Return a robot at a baud rate; a line that is too slow for its control rate lowers that, too.

    Args:
        config: the robot.
        baud: baud rate [bit/s].

    Raises:
        ConfigError: boards don't use that rate, or it is too slow for the board's feedback.
    """
    try:
        return config.with_(baud_rate=baud)
    except ConfigError as error:
        for rate in USUAL_RATES:
            if rate >= config.control_rate or rate % POLICY_RATE or baud not in BAUD_RATES:
                continue
            try:
                return config.with_(baud_rate=baud, control_rate=rate)
            except ConfigError:
                continue
        raise error from None


def search(device: str, config: RobotConfig) -> Check:
    """Try the other baud rates, fastest first, and say which one gives valid lines.

    Args:
        device: the serial device, closed.
        config: of the robot, whose own rate gave none.
    """
    for baud in sorted(BAUD_RATES, reverse=True):
        if baud != config.baud_rate and _answers(device, config, baud):
            return Check(
                "baud rate",
                "warn",
                f"valid lines at {baud} baud",
                f"use --baud-rate {baud}, and baud_rate: {baud} in the robot's file",
            )
    return Check(
        "baud rate",
        "fail",
        "no valid line at any other baud rate either",
        "look up in the board's program what it sends: it must be like ap12.50,bn08.75,cp15.00,"
        "dn10.25 with CR LF",
    )


def _answers(device: str, config: RobotConfig, baud: int) -> bool:
    """Whether a valid line arrives at a baud rate; nothing is commanded but zero."""
    try:
        tried = at(config, baud).with_(connect_timeout=min(PATIENCE, config.connect_timeout))
    except ConfigError:  # too slow for the feedback rate that the robot's file says
        return False
    link = SerialLink(device, tried)
    try:
        link.open()
    except LinkError:
        return False
    finally:
        link.close()
    return True
