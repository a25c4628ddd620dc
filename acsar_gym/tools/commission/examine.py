"""Checks of one serial device: opening, baud rate, feedback, and optionally turning wheels."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from statistics import median

from acsar_gym.config import BAUD_RATES, RobotConfig
from acsar_gym.errors import (
    BoardGarbledError,
    BoardSilentError,
    ConfigError,
    EmergencyStopError,
    LinkError,
)
from acsar_gym.guard.estop import StopListener
from acsar_gym.links.base import Link
from acsar_gym.links.handshake import echo_error, shown_bytes
from acsar_gym.links.serial import SerialLink
from acsar_gym.protocol import MOTORS, ZERO, encode
from acsar_gym.recording import Recorder
from acsar_gym.tools.commission.checks import Check, warn_if
from acsar_gym.tools.commission.wiring import Commission, report_resets
from acsar_gym.tools.sysid.board import BoardProbe
from acsar_gym.worlds import Scene

BAUD_TIMEOUT = 3.0
"""Longest wait for a valid line at each rate [s]; boards take 1 to 3 s to start."""
USUAL_RATES = (200.0, 100.0, 50.0, 40.0, 25.0, 20.0, 10.0, 5.0, 2.0, 1.0)
"""Control rates that are tried on a slower wire [Hz]."""
USUAL_POLICY_RATE = 10.0
"""Usual rate of a policy; a control rate must be a multiple of it [Hz]."""
PADDED_LINE = re.compile(rb"(?:[abcd][pn][0-9]{2}\.[0-9]{2},?){1,4}")
TURNING_SPEED = 0.5
"""Wheels that are said to be faster than this turn [rad/s]."""


def at_baud_rate(config: RobotConfig, baud: int) -> RobotConfig:
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
            if rate >= config.control_rate or rate % USUAL_POLICY_RATE or baud not in BAUD_RATES:
                continue
            try:
                return config.with_(baud_rate=baud, control_rate=rate)
            except ConfigError:
                continue
        raise error from error


def search_baud_rate(device: str, config: RobotConfig) -> Check:
    """Try the other baud rates, fastest first, and say which one gives valid lines.

    Nothing is commanded but zero.
    """
    for baud in sorted(set(BAUD_RATES) - {config.baud_rate}, reverse=True):
        timeout = min(BAUD_TIMEOUT, config.connect_timeout)
        try:
            link = SerialLink(device, at_baud_rate(config, baud).with_(connect_timeout=timeout))
        except ConfigError:  # too slow for the feedback rate that the robot's file says
            continue
        try:
            link.open()
        except LinkError:
            continue
        finally:
            link.close()
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


def examine_device(
    device: str,
    config: RobotConfig,
    commission: Commission | None = None,
    recorder: Recorder | None = None,
) -> Iterator[Check]:
    """Check one device; the first failure of the connection ends the checks.

    Args:
        device: the serial device.
        config: configuration of the robot.
        commission: turns the wheels, too, and takes what was found; None: the robot stands.
        recorder: records the wire; closed at the end.

    Raises:
        EmergencyStopError: after the last result.
    """
    link: Link = StoppableLink(device, config)
    if recorder is not None:
        link = recorder.watch(link, config)
    begin = time.monotonic()
    is_open = False
    try:
        link.open()
        if recorder is not None:
            link.reset(Scene())
        is_open = True
        took = time.monotonic() - begin
        wire = f"{config.baud_rate} baud, {config.control_rate:g} commands/s"
        yield Check("open", "ok", f"{device}, {wire}, held exclusively")
        yield Check("first valid line", "ok", f"after {took:.2f} s")
        yield from examine_board(link, config, commission)
    except EmergencyStopError as error:
        yield Check("connection", "fail", error.found, error.fix)
        raise
    except LinkError as error:
        name = "first valid line" if isinstance(error, BoardSilentError) else "open"
        garbled = isinstance(error, BoardGarbledError) and not is_open
        yield Check(
            "connection" if is_open else name,
            "fail",
            error.found,
            "see the next row" if garbled else error.fix,
        )
        if garbled:
            link.close()
            yield search_baud_rate(device, config)
    finally:
        link.close()
        if recorder is not None:
            recorder.close()


def examine_board(
    link: Link, config: RobotConfig, commission: Commission | None
) -> Iterator[Check]:
    """Check the board behind an open link.

    Raises:
        LinkError: the board is lost or silent, or its wheels keep turning.
    """
    probe = BoardProbe(link, config)
    if probe.has_echo():
        error = echo_error(link.device)
        yield Check("echo", "fail", error.found, error.fix)
        return
    yield from check_feedback(probe, config)
    if commission is None:
        for name in ("wiring", "command to feedback", "stops when commands stop"):
            yield Check(name, "skip", "needs turning wheels", "lift the robot and add --spin")
    elif not probe.gaps:
        yield from commission.run(probe, config)


def check_feedback(probe: BoardProbe, config: RobotConfig) -> Iterator[Check]:
    """Command zero at the control rate for a while, and say what the board sends meanwhile."""
    lines = probe.measure_feedback(config.period)
    expected = config.feedback_rate
    yield warn_if(
        probe.rate < 0.9 * expected,
        "feedback rate",
        f"{probe.rate:.1f} lines/s, {expected:g} expected",
        "set firmware.feedback_rate to what the board sends, or speed the board up",
    )
    newest = probe.newest_line
    padded = PADDED_LINE.fullmatch(newest) is not None
    numbers = "two digits and two decimals" if padded else "unpadded numbers, which are read"
    comma = "with" if newest.endswith(b",") else "without"
    found = f"{numbers}, {comma} a trailing comma: {shown_bytes(newest)}"
    yield Check("line format", "ok", found)
    refused = sum(probe.decoder.refused.values())
    sample = f", such as in {shown_bytes(probe.decoder.sample)}" if refused else ""
    yield warn_if(
        refused > 0,
        "line quality",
        f"{refused} bad parts in {probe.decoder.lines} lines{sample}",
        "check the cable, ground and baud rate",
    )
    turning = [k for k in range(4) if abs(median(x.speeds[k] for x in lines)) > TURNING_SPEED]
    if turning:
        letters = ", ".join(MOTORS[k] for k in turning)
        yield Check(
            "standing",
            "warn",
            f"{letters}: feedback isn't zero while zero is commanded",
            "if that wheel stands, check its encoder; if it turns, what else commands the board",
        )
    if probe.gaps:
        yield report_resets(probe.gaps)


class StoppableLink(SerialLink):
    """A link that obeys `acsar-gym estop`, as a Robot does.

    Its zero commands, and those of its watchdog, come in upper case, then without and with a
    trailing comma, as it isn't known yet which of them the board takes.
    """

    def __init__(self, device: str, config: RobotConfig) -> None:
        zeros = [encode(ZERO, trailing_comma=comma) for comma in (False, True)]
        super().__init__(device, config, [zeros[1].upper(), *zeros])
        self.listener = StopListener()
        self.listener.connect()

    def read_now(self) -> bytes:
        """Return what has arrived; LinkError at an emergency stop."""
        if self.listener.is_requested():
            self.stop()
            self.listener.confirm()
            raise EmergencyStopError
        return super().read_now()

    def __reduce__(self) -> tuple[type[StoppableLink], tuple[object, ...]]:
        """Copy and pickle as a closed link to the same device."""
        return StoppableLink, (self.device, self._config)

    def close(self) -> None:
        """Command zero and close, also for `acsar-gym estop`."""
        try:
            super().close()
        finally:
            self.listener.close()
