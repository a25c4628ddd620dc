"""Checks of one serial device: opening, feedback, and optionally turning wheels."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from acsar_gym.config import RobotConfig
from acsar_gym.doctor.checks import Check
from acsar_gym.errors import BoardSilentError, LinkError
from acsar_gym.links.serial import SerialLink
from acsar_gym.protocol import MAX_LINE, ZERO, Decoder, Speeds, encode
from acsar_gym.safety.estop import StopListener
from acsar_gym.safety.layer import Safety

LISTEN = 2.0
"""Time during which feedback is counted [s]."""
SPIN = 3.0
"""Wheel speed of the checks that turn wheels [rad/s]."""
POLL = 0.0005
"""Resolution of the round-trip time [s]."""
PATIENCE = 3.0
"""Longest wait for wheels to start or to stop by themselves [s]."""


def examine(device: str, config: RobotConfig, *, spin: bool) -> Iterator[Check]:
    """Check one device; the first failure ends the checks.

    Args:
        device: the serial device.
        config: configuration of the robot.
        spin: whether to turn the wheels, too.

    Yields:
        The results in order.
    """
    link = _Stoppable(device, config)
    begin = time.monotonic()
    try:
        link.open()
    except LinkError as error:
        yield _failed_to_open(error)
        return
    try:
        took = time.monotonic() - begin
        yield Check("open", "ok", f"{device}, {config.baud_rate} baud, held exclusively")
        yield Check("first valid line", "ok", f"after {took:.2f} s")
        yield from _feedback(link, config)
        yield from _moving(link, config) if spin else _standing()
    except LinkError as error:
        yield Check("connection", "fail", error.found, error.fix)
    finally:
        link.close()


class _Stoppable(SerialLink):
    """A link that obeys `acsar-gym estop`, as a Robot does."""

    def __init__(self, device: str, config: RobotConfig) -> None:
        super().__init__(device, config)
        self._listener = StopListener(device, config.name)

    def read_now(self) -> bytes:
        """Return what has arrived; LinkError at an emergency stop."""
        if self._listener.is_requested():
            self.stop()
            self._listener.confirm()
            raise LinkError("emergency stop", "start again when all is well")
        return super().read_now()

    def close(self) -> None:
        super().close()
        self._listener.close()


def _failed_to_open(error: LinkError) -> Check:
    name = "first valid line" if isinstance(error, BoardSilentError) else "open"
    return Check(name, "fail", error.found, error.fix)


def _feedback(link: SerialLink, config: RobotConfig) -> Iterator[Check]:
    """Check the rate of feedback and damaged parts while the robot stands."""
    decoder = Decoder()
    decoder.feed(b"-" * (MAX_LINE + 1))  # skip the rest of an incomplete line
    decoder.refused.clear()
    begin = time.monotonic()
    while time.monotonic() - begin < LISTEN:
        link.write(_line(ZERO, config))
        decoder.feed(link.advance(config.period))
    rate = decoder.lines / (time.monotonic() - begin)
    expected = config.feedback_rate
    slow = rate < 0.9 * expected
    yield Check(
        "feedback rate",
        "warn" if slow else "ok",
        f"{rate:.1f} lines/s, {expected:g} expected",
        "set firmware.feedback_rate to what the board sends, or speed the board up" if slow else "",
    )
    refused = sum(decoder.refused.values())
    yield Check(
        "line quality",
        "warn" if refused else "ok",
        f"{refused} bad parts in {decoder.lines} lines",
        "check the cable, ground and baud rate" if refused else "",
    )


def _standing() -> Iterator[Check]:
    for name in ("command to feedback", "stops when commands stop"):
        yield Check(name, "skip", "needs turning wheels", "lift the robot and add --spin")


def _moving(link: SerialLink, config: RobotConfig) -> Iterator[Check]:
    """Measure the round trip of a command, and the firmware's command time-out."""
    spin = min(Safety(config).bounded((SPIN, SPIN, SPIN, SPIN), (0.0, 0.0, 0.0), 0.0))
    line = _line((spin, spin, spin, spin), config)
    round_trip = _until(link, line, lambda speeds: min(speeds) > 0.0)
    if round_trip is None:
        yield Check(
            "command to feedback",
            "fail",
            "not all wheels turn",
            "check the motors' power and every encoder",
        )
        return
    fine = round_trip < 0.1
    yield Check(
        "command to feedback",
        "ok" if fine else "warn",
        f"{round_trip * 1000.0:.1f} ms from command to its first effect in feedback",
        "" if fine else "raise the baud rate; set the USB adapter's latency timer to 1 ms",
    )
    _until(link, line, lambda speeds: min(speeds) > 0.9 * spin)
    stopped = _until(link, b"", lambda speeds: max(speeds) == 0.0)
    yield Check(
        "stops when commands stop",
        "fail" if stopped is None else "ok",
        "the wheels keep turning" if stopped is None else f"{stopped:.2f} s after the last command",
        "add a command time-out to the firmware" if stopped is None else "",
    )


def _until(link: SerialLink, line: bytes, reached: Callable[[list[float]], bool]) -> float | None:
    """Wait until the absolute speeds of the four wheels satisfy `reached`.

    Args:
        link: the open link.
        line: command that is repeated every 50 ms, to prevent the firmware's time-out; empty
            for none.
        reached: condition on the four absolute speeds [rad/s].

    Returns:
        Seconds until then; None after PATIENCE.
    """
    decoder = Decoder()
    begin = sent = time.monotonic()
    link.reset_input()
    link.write(line)
    while (now := time.monotonic()) - begin < PATIENCE:
        if now - sent > 0.05:
            link.write(line)
            sent = now
        for reading in decoder.feed(link.read_now()):
            if reached([abs(speed or 0.0) for speed in reading.speeds]):
                return time.monotonic() - begin
        time.sleep(POLL)
    return None


def _line(speeds: Speeds, config: RobotConfig) -> bytes:
    return encode(speeds, trailing_comma=config.trailing_comma)
