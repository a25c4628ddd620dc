"""Waits for a newly opened board, and makes the errors for boards that don't answer or stop."""

from __future__ import annotations

import time
from collections.abc import Callable

from acsar_gym.config import BAUD_RATES, RobotConfig
from acsar_gym.errors import BoardGarbledError, BoardSilentError, LinkError
from acsar_gym.links.base import WHILE_WAITING
from acsar_gym.protocol import Decoder, Speeds

LINE_CHARACTERS = frozenset(b"abcdpn0123456789.,+- ")
"""Bytes of a line."""
MAX_SHOWN_BYTES = 40
"""Most received bytes that a message shows."""
BOARD_POLL = 0.01
"""Interval of polling for the first valid line [s]."""


def wait_for_board(read: Callable[[], bytes], device: str, config: RobotConfig) -> None:
    """Wait for the first valid line of the board, for `connect_timeout` at most.

    Args:
        read: returns the bytes that have arrived.
        device: name of the device, for messages.
        config: configuration of the robot.

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


def silence_error(age: float, decoder: Decoder) -> BoardSilentError:
    """Return the error for a board in use that sends no valid feedback.

    Args:
        age: time since the newest valid line [s].
        decoder: what it decoded.
    """
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


def _is_garbled(decoder: Decoder) -> bool:
    """Whether bytes that aren't those of a line have arrived since the newest valid line."""
    return decoder.damaged > 0 or not set(decoder.rest) <= LINE_CHARACTERS


def shown_bytes(data: bytes) -> str:
    """Format received bytes for a message: printable, and at most `MAX_SHOWN_BYTES` of them."""
    return repr(data[:MAX_SHOWN_BYTES])[1:] + ("..." if len(data) > MAX_SHOWN_BYTES else "")


def still_turning_error(waited: float, speeds: Speeds) -> LinkError:
    """Return the error for wheels that turn in spite of a stop command.

    Args:
        waited: time since the stop command [s].
        speeds: wheel speeds [rad/s].
    """
    listed = ", ".join(f"{speed:.2f}" for speed in speeds)
    return LinkError(
        f"the wheels still turn {waited:g} s after the stop command ({listed} rad/s)",
        "check what else commands the board",
    )
