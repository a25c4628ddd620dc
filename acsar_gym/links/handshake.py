"""Waits for a newly opened board, and makes the errors for boards that don't answer or stop."""

from __future__ import annotations

import re
import time
from collections.abc import Callable

from acsar_gym.config import BAUD_RATES, BITS_PER_BYTE, RobotConfig
from acsar_gym.errors import BoardGarbledError, BoardSilentError, LinkError
from acsar_gym.links.base import WHILE_WAITING
from acsar_gym.protocol import ECHO_PROBE, Decoder, EchoDecoder, Speeds, line_end

LINE_CHARACTERS = frozenset(b"abcdpn0123456789.,+- ")  # bytes of a line
MAX_SHOWN_BYTES = 40  # most received bytes that a message shows
BOARD_POLL = 0.01  # interval of polling for the first valid line [s]
ECHO_INTERVAL = 0.03  # interval of the commands whose echo is looked for [s]
ECHO_WAIT, ECHO_TIMEOUT = 0.1, 0.5
"""How long an echo may take, at least, and the longest wait for lines without one [s]."""
ECHO_LINES = 3  # a board that has sent so many lines meanwhile doesn't echo
FEWEST_VALID, FEWEST_REFUSED = 3, 10
"""A board that has sent so many valid lines has the right baud rate; one that then sends fewer
refused parts than these before it is silent was reset, where a bad cable goes on."""
FORMATS: tuple[tuple[str, bytes, bytes], ...] = (
    ("upper-case letters", rb"[ABCDPN]", b"lower"),
    ("equals signs or colons", rb"(?<=[abcdpn])[=:] *", b""),
    ("signs instead of p and n", rb"(?<=[abcd])\+", b"p"),
    ("signs instead of p and n", rb"(?<=[abcd])-", b"n"),
    ("no p or n", rb"(?<=[abcd])(?=[0-9])", b"p"),
    ("decimal commas", rb"(?<=[0-9]),(?=[0-9])", b"."),
    ("other separators than commas", rb"(?<=[0-9]) *[;:|\t ] *(?=[abcd]|$)", b","),
    ("one decimal", rb"(?<=[0-9]\.[0-9])(?![0-9])", b"0"),
    ("no decimals", rb"(?<=[0-9])(?=,|$)(?<![.0-9][0-9][0-9])", b".00"),
)
"""What a line may have instead of the wire's format, and how it is mended."""
TWO_WHEELS = re.compile(rb"(?:[rl][pn][0-9. ]+,?){2}")  # a line of a relative of this protocol


def wait_for_board(read: Callable[[], bytes], device: str, config: RobotConfig) -> None:
    """Wait for the first valid line of the board, for `connect_timeout` at most.

    Raises:
        BoardSilentError: nothing arrived, or only the beginning of a line.
        BoardGarbledError: bytes arrived, but no valid line.
    """
    decoder, heard = Decoder(), 0
    waited, baud = config.connect_timeout, config.baud_rate
    deadline = time.monotonic() + waited
    while time.monotonic() <= deadline:
        WHILE_WAITING.get()()
        time.sleep(BOARD_POLL)
        data = read()
        heard += len(data)
        decoder.feed(data)
        if decoder.lines:
            return
    if differs := describe_format(decoder.sample):
        raise BoardSilentError(
            f"{device}: the board's lines have {differs}: {shown_bytes(decoder.sample)}",
            "its program must write them like ap12.50,bn08.75,cp15.00,dn10.25",
        )
    if _is_garbled(decoder):
        others = ", ".join(str(rate) for rate in BAUD_RATES if rate != baud)
        raise BoardGarbledError(
            f"{device}: {heard} bytes in {waited:g} s at {baud} baud, but no valid line, such as "
            f"{shown_bytes(decoder.sample or decoder.rest)}",
            "if that isn't what its program sends, the board probably uses another baud_rate "
            f"({others}): 'acsar-gym doctor {device}' tries them",
        )
    if heard:
        raise BoardSilentError(
            f"{device}: the board stopped in mid-line, {heard} bytes in {waited:g} s: "
            f"{shown_bytes(decoder.rest)}",
            "press its reset button, and check its power and program",
        )
    raise BoardSilentError(
        f"{device}: no byte from the board in {waited:g} s",
        "check its power and cable, and the port's name (acsar-gym doctor lists them)",
    )


def find_echo(
    write: Callable[[bytes], None], read: Callable[[], bytes], device: str, config: RobotConfig
) -> bool:
    """Find whether a board sends commands back; BoardSilentError where it sends nothing else."""
    decoder, feedback = EchoDecoder(), 0
    probe = ECHO_PROBE + line_end(trailing_comma=config.trailing_comma)
    line = len(probe) * BITS_PER_BYTE / config.baud_rate
    begin = now = due = time.monotonic()
    while now - begin <= config.connect_timeout:
        if now >= due:
            write(probe)
            decoder.expect(probe)
            due = now + ECHO_INTERVAL + 2.0 * line
        WHILE_WAITING.get()()
        time.sleep(BOARD_POLL)
        before = decoder.echoes
        lines = len(decoder.feed(read()))
        feedback = feedback + lines if before or not decoder.echoes else 0  # what came before it
        now = time.monotonic()
        if decoder.echoes and feedback:
            return True
        waited = feedback >= ECHO_LINES and now - begin >= ECHO_WAIT + 2.0 * line
        if not decoder.echoes and (waited or now - begin >= ECHO_TIMEOUT):
            return False
    raise BoardSilentError(
        f"{device}: this board echoes, and sends nothing else: each command comes back, and no "
        "feedback",
        "its program must send the measured speeds as well",
    )


def silence_error(age: float, decoder: Decoder) -> BoardSilentError:
    """Return the error for a board in use that sends no valid feedback."""
    if isinstance(decoder, EchoDecoder) and decoder.only_echoes:
        return BoardSilentError(
            f"no feedback for {age:.2f} s but this board's echo of the commands, or what equals it",
            "check the board's program; where it doesn't echo, take echo: true out of the robot's "
            "file",
        )
    begun = decoder.rest or decoder.damaged
    if decoder.lines >= FEWEST_VALID and begun and decoder.damaged < FEWEST_REFUSED:
        newest = shown_bytes(decoder.rest or decoder.sample)
        return BoardSilentError(
            f"no feedback for {age:.2f} s, the board stopped in mid-line after {newest}: it was "
            "reset, hangs, or has lost its power",
            "check its power supply, which motors may draw down, and its program's watchdog",
        )
    if _is_garbled(decoder):
        received = shown_bytes(decoder.sample or decoder.rest)
        return BoardGarbledError(
            f"no valid feedback line for {age:.2f} s, but {received}",
            "check the baud rate and the cable",
        )
    if decoder.rest:
        return BoardSilentError(
            f"no feedback for {age:.2f} s, the board stopped in mid-line after "
            f"{shown_bytes(decoder.rest)}",
            "check the board's power and its program",
        )
    return BoardSilentError(f"no feedback for {age:.2f} s", "check the board's power and the cable")


def describe_format(line: bytes) -> str:
    """Say in what a line differs from the wire's format, if that is all; empty for another one."""
    line = line.strip()
    if TWO_WHEELS.fullmatch(line):
        return "two wheels, r and l, where this robot has four, a to d"
    names = []
    for name, pattern, mended in FORMATS:
        before = line
        line = line.lower() if mended == b"lower" else re.sub(pattern, mended, line)
        names += [name] if line != before and name not in names else []
    readings = Decoder().feed(line + b"\n")
    return " and ".join(names) if readings and None not in readings[0].speeds else ""


def _is_garbled(decoder: Decoder) -> bool:
    """Whether bytes that aren't those of a line have arrived since the newest valid line."""
    return decoder.damaged > 0 or not set(decoder.rest) <= LINE_CHARACTERS


def shown_bytes(data: bytes) -> str:
    """Format received bytes for a message: printable, and at most `MAX_SHOWN_BYTES` of them."""
    return repr(data[:MAX_SHOWN_BYTES])[1:] + ("..." if len(data) > MAX_SHOWN_BYTES else "")


def still_turning_error(waited: float, speeds: Speeds) -> LinkError:
    """Return the error for wheels that turn in spite of a stop command."""
    listed = ", ".join(f"{speed:.2f}" for speed in speeds)
    return LinkError(
        f"the wheels still turn {waited:g} s after the stop command ({listed} rad/s)",
        "check what else commands the board",
    )
