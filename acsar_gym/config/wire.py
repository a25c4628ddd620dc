"""The serial line: baud rates and length of a line of the protocol."""

from __future__ import annotations

BAUD_RATES = (9600, 19200, 38400, 57600, 115200)
LINE_BYTES = 33
"""Length of a full line with CR LF, without the optional trailing comma [bytes]."""
BITS_PER_BYTE = 10
"""8N1: a start bit, eight data bits, a stop bit."""


def known_baud(value: int) -> int:
    """Return the baud rate; ValueError for rates that boards don't use."""
    if value not in BAUD_RATES:
        raise ValueError(f"must be one of {', '.join(map(str, BAUD_RATES))}")
    return value
