"""Examines a serial device: opening, baud rate, and the board behind it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

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
from acsar_gym.links.serial import SerialLink
from acsar_gym.protocol import ZERO, encode
from acsar_gym.recording import Recorder
from acsar_gym.tools.commission.checks import Check
from acsar_gym.worlds import Scene

BAUD_TIMEOUT = 3.0
"""Longest wait for a valid line at each baud rate [s]. Boards take 1 to 3 s to start."""
CONTROL_RATES = (200.0, 100.0, 50.0, 40.0, 20.0, 10.0)
"""Control rates that are tried on a slower wire [Hz]: multiples of a policy's usual 10 Hz."""


class StoppableLink(SerialLink):
    """A link that obeys `acsar-gym estop`, as a Robot does.

    It isn't known yet which commands the board takes, so its zeros, and those of its watchdog, have
    upper-case letters, then lower-case letters without and with a trailing comma.
    """

    def __init__(self, device: str, config: RobotConfig) -> None:
        zeros = [encode(ZERO, trailing_comma=comma) for comma in (False, True)]
        super().__init__(device, config, [zeros[1].upper(), *zeros])
        self.listener = StopListener()
        self.listener.connect()

    def read_now(self) -> bytes:
        """Return what has arrived. LinkError at an emergency stop."""
        if self.listener.is_requested():
            self.stop()
            self.listener.confirm()
            raise EmergencyStopError
        return super().read_now()

    def close(self) -> None:
        """Command zero and close, also for `acsar-gym estop`."""
        try:
            super().close()
        finally:
            self.listener.close()


def at_baud_rate(config: RobotConfig, baud: int) -> RobotConfig:
    """Return a robot at a baud rate, with a lower control rate if the line is too slow for it.

    Args:
        config: Robot configuration.
        baud: Baud rate [bit/s].

    Raises:
        ConfigError: Boards don't use that rate, or it is too slow for the board's feedback.
    """
    # A policy's rate stays if the wire is fast enough.
    slower = [rate for rate in CONTROL_RATES if rate < config.control_rate and baud in BAUD_RATES]
    errors = []
    for rate in (config.control_rate, *slower):
        try:
            return config.with_(baud_rate=baud, control_rate=rate)
        except ConfigError as error:
            errors.append(error)
    raise errors[0]


def examine_device(
    device: str,
    config: RobotConfig,
    examine: Callable[[Link], Iterator[Check]],
    recorder: Recorder | None = None,
) -> Iterator[Check]:
    """Check a device. The first failure of the connection ends the checks.

    Args:
        device: Serial device.
        config: Robot configuration.
        examine: Examines the board behind the open link.
        recorder: Recorder of the wire, which is closed at the end.

    Raises:
        EmergencyStopError: After the last result.
    """
    # It also obeys `acsar-gym estop` before any check has run.
    link: Link = StoppableLink(device, config)
    if recorder is not None:
        link = recorder.watch(link, config)

    # What fails names the row: opening, waiting for a line, or the connection later.
    failing = "first valid line"
    start = time.monotonic()
    try:
        link.open()
        if recorder is not None:
            link.reset(Scene())
        failing = "connection"
        wire = f"{config.baud_rate} baud, {config.control_rate:g} commands/s"
        yield Check("open", "ok", f"{device}, {wire}, held exclusively")
        yield Check("first valid line", "ok", f"after {time.monotonic() - start:.2f} s")
        yield from examine(link)
    except EmergencyStopError as error:
        yield Check("connection", "fail", error.found, error.fix)
        raise
    except LinkError as error:
        # Bytes without a valid line mean a wrong baud rate, so others are tried.
        is_open = failing == "connection"
        is_garbled = isinstance(error, BoardGarbledError) and not is_open
        if not (is_open or isinstance(error, BoardSilentError)):
            failing = "open"
        fix = "see the next row" if is_garbled else error.fix
        yield Check(failing, "fail", error.found, fix)
        if is_garbled:
            link.close()
            yield search_baud_rate(device, config)
    finally:
        link.close()
        if recorder is not None:
            recorder.close()


def search_baud_rate(device: str, config: RobotConfig) -> Check:
    """Try the other baud rates, fastest first. Nothing is commanded but zero."""
    # There are many rates, and a wrong rate is silent until the timeout.
    timeout = min(BAUD_TIMEOUT, config.connect_timeout)
    for baud in sorted(set(BAUD_RATES) - {config.baud_rate}, reverse=True):
        try:
            slower = at_baud_rate(config, baud).with_(connect_timeout=timeout)
        except ConfigError:  # too slow for the feedback rate of the robot's file
            continue
        link = SerialLink(device, slower)
        try:
            link.open()
        except LinkError:
            continue
        finally:
            link.close()
        fix = f"use --baud-rate {baud}, and baud_rate: {baud} in the robot's file"
        return Check("baud rate", "warn", f"valid lines at {baud} baud", fix)

    return Check(
        "baud rate",
        "fail",
        "no valid line at any other baud rate either",
        "look up in the board's program what it sends: it must be like ap12.50,bn08.75,cp15.00,"
        "dn10.25 with CR LF",
    )
