"""Checks what a standing board sends: how often, in which format, and how much of it is damaged."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from statistics import median

from acsar_gym.config import RobotConfig
from acsar_gym.doctor.checks import Check
from acsar_gym.doctor.listening import Ear, Line
from acsar_gym.links.handshake import shown_bytes
from acsar_gym.protocol import ZERO

LISTEN = 2.0
"""Time during which feedback is counted [s]."""
USUAL = (5, 10, 20, 25, 30, 40, 50, 60, 80, 100, 125, 150, 200)
"""Rates that boards are set to [Hz]."""
NEAR = 0.03
"""A rate that is so close to one of these is that one."""
PADDED = re.compile(rb"(?:[abcd][pn][0-9]{2}\.[0-9]{2},?){1,4}\r?")


def listen(ear: Ear, config: RobotConfig) -> list[Line]:
    """Command zero at the control rate for a while, and return what the board says meanwhile."""
    ear.clear()
    return ear.hear(ZERO, lambda _: False, LISTEN, repeat=config.period)


def rounded(measured: float) -> float:
    """Return the rate that a board was probably set to [Hz]."""
    usual = min(USUAL, key=lambda rate: abs(measured - rate))
    return float(usual) if abs(measured - usual) < NEAR * usual else round(measured, 1)


def checks(ear: Ear, lines: Sequence[Line], config: RobotConfig) -> Iterator[Check]:
    """Say what was found.

    Args:
        ear: has heard the board.
        lines: of `listen`.
        config: of the robot.
    """
    found, expected = ear.rate, config.feedback_rate
    slow = found < 0.9 * expected
    yield Check(
        "feedback rate",
        "warn" if slow else "ok",
        f"{found:.1f} lines/s, {expected:g} expected",
        "set firmware.feedback_rate to what the board sends, or speed the board up" if slow else "",
    )
    yield _format(ear)
    refused = sum(ear.decoder.refused.values())
    sample = f", such as in {shown_bytes(ear.decoder.sample)}" if refused else ""
    yield Check(
        "line quality",
        "warn" if refused else "ok",
        f"{refused} bad parts in {ear.decoder.lines} lines{sample}",
        "check the cable, ground and baud rate" if refused else "",
    )
    turning = [k for k in range(4) if lines and abs(median(x.speeds[k] for x in lines)) > 0.5]
    if turning:
        letters = ", ".join("abcd"[k] for k in turning)
        yield Check(
            "standing",
            "warn",
            f"{letters}: feedback isn't zero while zero is commanded",
            "if that wheel stands, check its encoder; if it turns, what else commands the board",
        )
    if ear.gaps:
        yield resets(ear.gaps)


def _format(ear: Ear) -> Check:
    """Say how the board writes its numbers."""
    newest = ear.raw[-1] if ear.raw else b""
    padded = PADDED.fullmatch(newest) is not None
    comma = "with" if newest.rstrip().endswith(b",") else "without"
    numbers = "two digits and two decimals" if padded else "unpadded numbers, which are read"
    return Check(
        "line format", "ok", f"{numbers}, {comma} a trailing comma: {shown_bytes(newest.rstrip())}"
    )


def resets(gaps: Sequence[float]) -> Check:
    """Say that the board was reset."""
    silent = ", ".join(f"{gap:.1f} s" for gap in gaps)
    return Check(
        "resets",
        "fail",
        f"the board was reset: silent for {silent}",
        "check its power supply, which motors may draw down, and its watchdog",
    )
