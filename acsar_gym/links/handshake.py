"""Waits for a newly opened board, and explains boards that don't answer or don't stop."""

from __future__ import annotations

import time
from collections.abc import Callable

from acsar_gym.config import BAUD_RATES, BITS_PER_BYTE, RobotConfig
from acsar_gym.errors import BoardGarbledError, BoardSilentError, LinkError
from acsar_gym.links.base import WHILE_WAITING
from acsar_gym.protocol import ECHO_PROBE, Decoder, Speeds, line_end

EXPECTED = "ap12.50,bn08.75,cp15.00,dn10.25"
LINE_CHARACTERS = frozenset(b"abcdpn0123456789.,+- ")  # bytes of a line
MAX_SHOWN_BYTES = 40  # most received bytes that a message shows
BOARD_POLL = 0.01  # interval of polling for lines [s]
ECHO_INTERVAL = 0.03  # interval of the probes whose echo is looked for [s]
ECHO_WAIT = 0.1  # shortest wait for an echo [s]
ECHO_TIMEOUT = 0.5  # longest wait for one [s]
ECHO_LINES = 3  # lines of feedback after which a board without an echo is believed
MIN_VALID_LINES = 3  # so many valid lines prove that the baud rate is right
MAX_RESET_DAMAGE = 10  # a reset board leaves fewer damaged parts, a bad cable more


def wait_for_board(read: Callable[[], bytes], device: str, config: RobotConfig) -> None:
    """Wait for the first valid line of the board, for `connect_timeout` at most.

    Raises:
        BoardSilentError: Nothing arrived, or only the start of a line.
        BoardGarbledError: Bytes arrived, but no valid line.
    """
    decoder = Decoder()
    received = 0
    deadline = time.monotonic() + config.connect_timeout
    while time.monotonic() <= deadline:
        WHILE_WAITING.get()()
        time.sleep(BOARD_POLL)
        data = read()
        received += len(data)
        decoder.feed(data)
        if decoder.lines:
            return

    waited = f"{config.connect_timeout:g} s"
    if not received:
        raise BoardSilentError(
            f"{device}: no byte from the board in {waited}",
            "check its power and cable, and the port's name (acsar-gym doctor lists them)",
        )
    if not _is_garbled(decoder):
        raise BoardSilentError(
            f"{device}: the board stopped in the middle of a line, {received} bytes in {waited}: "
            f"{shown_bytes(decoder.partial)}",
            "press its reset button, and check its power and program",
        )
    # Bytes without a line: most often it is the baud rate.
    other_rates = ", ".join(str(rate) for rate in BAUD_RATES if rate != config.baud_rate)
    raise BoardGarbledError(
        f"{device}: {received} bytes in {waited} at {config.baud_rate} baud, but no valid line: "
        f"{shown_bytes(decoder.sample or decoder.partial)}, expected {EXPECTED}",
        "if that is what its program sends, change the program; otherwise the board probably uses "
        f"another baud_rate ({other_rates}): 'acsar-gym doctor {device}' tries them",
    )


def check_no_echo(
    write: Callable[[bytes], None], read: Callable[[], bytes], device: str, config: RobotConfig
) -> None:
    """Send a zero command that no feedback equals, and look for it in what comes back.

    Raises:
        LinkError: The board sends commands back, so feedback can't be told from commands.
    """
    probe = ECHO_PROBE + line_end(trailing_comma=config.trailing_comma)
    # An echo can't be complete before the probe itself has been sent.
    line_time = len(probe) * BITS_PER_BYTE / config.baud_rate
    decoder = Decoder()
    received = b""

    start = due = time.monotonic()
    while (now := time.monotonic()) - start < ECHO_TIMEOUT:
        # Boards may start after the first probes.
        if now >= due:
            write(probe)
            due = now + ECHO_INTERVAL + 2.0 * line_time
        WHILE_WAITING.get()()
        time.sleep(BOARD_POLL)

        data = read()
        received += data
        decoder.feed(data)
        if ECHO_PROBE in received:
            raise echo_error(device)

        # Feedback without an echo, for longer than an echo takes.
        if decoder.lines >= ECHO_LINES and now - start >= ECHO_WAIT + 2.0 * line_time:
            return


def echo_error(device: str) -> LinkError:
    """Return the error for a board that sends commands back."""
    return LinkError(
        f"{device}: this board echoes: it sends each command back",
        "delete the echo from the board's program, which must send only measured speeds",
    )


def silence_error(age: float, decoder: Decoder) -> BoardSilentError:
    """Return the error for a board in use that has sent no valid feedback for `age` [s]."""
    is_interrupted = bool(decoder.partial or decoder.damaged)
    # Earlier valid lines prove the baud rate, so the board itself has stopped.
    if is_interrupted and decoder.lines >= MIN_VALID_LINES and decoder.damaged < MAX_RESET_DAMAGE:
        return BoardSilentError(
            f"no feedback for {age:.2f} s, the board stopped in the middle of a line after "
            f"{shown_bytes(decoder.partial or decoder.sample)}: it was reset, hangs, or has lost "
            "its power",
            "check its power supply, which motors may draw down, and its program's watchdog",
        )

    if _is_garbled(decoder):
        return BoardGarbledError(
            f"no valid feedback line for {age:.2f} s, but "
            f"{shown_bytes(decoder.sample or decoder.partial)}",
            "check the baud rate and the cable",
        )
    return BoardSilentError(f"no feedback for {age:.2f} s", "check the board's power and the cable")


def still_turning_error(waited: float, speeds: Speeds) -> LinkError:
    """Return the error for wheels that turn in spite of a stop command."""
    listed = ", ".join(f"{speed:.2f}" for speed in speeds)
    return LinkError(
        f"the wheels still turn {waited:g} s after the stop command ({listed} rad/s)",
        "check what else commands the board",
    )


def _is_garbled(decoder: Decoder) -> bool:
    """Whether bytes that aren't those of a line have arrived since the newest valid line."""
    return decoder.damaged > 0 or not set(decoder.partial) <= LINE_CHARACTERS


def shown_bytes(data: bytes) -> str:
    """Format received bytes for a message: printable, and at most `MAX_SHOWN_BYTES` of them."""
    return repr(data[:MAX_SHOWN_BYTES])[1:] + ("..." if len(data) > MAX_SHOWN_BYTES else "")
