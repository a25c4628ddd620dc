"""The serial wire: its baud rates, and how many bytes a line takes."""

from __future__ import annotations

BAUD_RATES = (9600, 19200, 38400, 57600, 115200)
LINE_BYTES = 33
"""Length of a full line with its line end, without the optional trailing comma."""
BITS_PER_BYTE = 10
"""8N1: a start bit, eight data bits, a stop bit."""


def known_baud(value: int) -> int:
    """The baud rate; ValueError where boards don't use it."""
    if value not in BAUD_RATES:
        raise ValueError(f"must be one of {', '.join(map(str, BAUD_RATES))}")
    return value
