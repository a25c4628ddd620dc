r"""Codec of the serial protocol, without any I/O: speeds to lines, bytes to readings.

A line is `ap12.50,bn08.75,cp15.00,dn10.25,\r\n`: motor letter (a front_right, b front_left,
c rear_left, d rear_right), direction (p forward, n backward), speed in rad/s with two digits and
two decimals; the last comma is optional. Commands and encoder feedback have the same format.
Source: the robot's hardware interface document, sections 2.3 and 5.3.2.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from acsar_gym.errors import CommandError

MOTORS = "abcd"
WHEELS = ("front_right", "front_left", "rear_left", "rear_right")
MAX_SPEED = 99.99
"""Largest speed of the format [rad/s]."""
MAX_LINE = 256
"""Longest accepted line [bytes]; longer ones are dropped up to the next line end."""

Speeds = tuple[float, float, float, float]
"""Wheel speeds [rad/s] in the order front_right, front_left, rear_left, rear_right."""
ZERO: Speeds = (0.0, 0.0, 0.0, 0.0)

_LINE = b"a%+06.2f,b%+06.2f,c%+06.2f,d%+06.2f"
_LENGTH = len(_LINE % (0.0, 0.0, 0.0, 0.0))
_DIRECTIONS = bytes.maketrans(b"+-", b"pn")
_PART = re.compile(rb"([abcd])([pn])([0-9]{2}\.[0-9]{2})")
_ENDS = (b"\n", b"\r")
_KNOWN: tuple[dict[bytes, float], ...] = ({}, {}, {}, {})
"""Cache of parsed parts, such as b"ap12.50" -> 12.5, for each motor."""
_MOST_KNOWN = 5000
"""Largest number of cached parts per motor."""


def encode(speeds: Sequence[float], *, trailing_comma: bool = True) -> bytes:
    """Encode four wheel speeds as one line, for commands and feedback alike.

    Args:
        speeds: wheel speeds [rad/s] in the order a, b, c, d. They are rounded to two decimals
            and saturate at +-99.99; what rounds to zero is `p00.00`.
        trailing_comma: whether the line has a comma before its end.

    Returns:
        The line with CR LF.

    Raises:
        CommandError: there aren't four speeds, or one isn't finite.
    """
    return line_of(*finite(speeds), line_end(trailing_comma=trailing_comma))


def finite(speeds: Sequence[float]) -> Speeds:
    """Check four wheel speeds [rad/s], order a, b, c, d.

    Raises:
        CommandError: there aren't four speeds, or one isn't finite.
    """
    if len(speeds) != len(MOTORS):
        raise CommandError(f"a line carries 4 wheel speeds (a, b, c, d), got {len(speeds)}")
    a, b, c, d = map(float, speeds)
    if not math.isfinite(a + b + c + d):  # one check for all; a sum of finite ones may overflow
        for wheel, speed in zip(WHEELS, (a, b, c, d), strict=True):
            if not math.isfinite(speed):
                raise CommandError(f"{wheel} speed is {speed}: only finite rad/s can be sent")
    return a, b, c, d


def line_end(*, trailing_comma: bool) -> bytes:
    """Return the end of a line, for `line_of`."""
    return b",\r\n" if trailing_comma else b"\r\n"


def line_of(a: float, b: float, c: float, d: float, end: bytes) -> bytes:
    """Encode as `encode` does, but without checks: the speeds [rad/s] must be finite floats."""
    line = _LINE % (a, b, c, d)
    if len(line) > _LENGTH:
        saturated = (min(max(speed, -MAX_SPEED), MAX_SPEED) for speed in (a, b, c, d))
        line = _LINE % tuple(saturated)
    return line.replace(b"-00.00", b"+00.00").translate(_DIRECTIONS) + end


class Reading(NamedTuple):
    """Content of one line: speeds [rad/s] in the order a, b, c, d; None for missing motors."""

    speeds: tuple[float | None, float | None, float | None, float | None]

    def over(self, old: Speeds) -> Speeds:
        """Fill in missing motors.

        Args:
            old: speeds [rad/s] that missing motors keep.

        Returns:
            All four speeds [rad/s].
        """
        a, b, c, d = self.speeds
        return (
            old[0] if a is None else a,
            old[1] if b is None else b,
            old[2] if c is None else c,
            old[3] if d is None else d,
        )


class Decoder:
    """Decodes a byte stream that arrives in chunks of any size; never raises an exception.

    Lines end with CR, LF or CRLF. Invalid parts are refused and counted; the other motors of the
    line are still used. If a motor occurs twice, the last one counts. Memory is bounded by
    `MAX_LINE`.

    Attributes:
        lines: number of lines with at least one valid part.
        refused: number of refused parts by reason.
    """

    def __init__(self) -> None:
        self._partial = b""
        self._skipping = False
        self.lines = 0
        self.refused: Counter[str] = Counter()

    def reset(self) -> None:
        """Discard the partial line, and set the counters to zero."""
        self.__init__()  # type: ignore[misc]

    def feed(self, data: bytes) -> list[Reading]:
        """Decode the lines that `data` completes.

        Args:
            data: any part of the byte stream.

        Returns:
            One reading per line that has a valid part, oldest first.
        """
        stream = self._partial + data
        lines = stream.splitlines()
        rest = b"" if not lines or stream.endswith(_ENDS) else lines.pop()
        if lines and self._skipping:
            self._skipping = False
            lines[0] = b""
        self._partial = self._bounded(rest) if rest else b""
        return [reading for line in lines if line and (reading := self._read(line))]

    def _bounded(self, rest: bytes) -> bytes:
        """Keep a partial line, unless it is too long."""
        if len(rest) > MAX_LINE and not self._skipping:
            self._skipping = True
            self.refused["line too long"] += 1
        return b"" if self._skipping else rest

    def _read(self, line: bytes) -> Reading | None:
        """Decode one line; four cached parts take the fast path."""
        parts = line.split(b",")
        if not parts[-1] and len(parts) > 1:
            parts.pop()  # a trailing comma
        try:
            a, b, c, d = parts
            reading = Reading((_KNOWN[0][a], _KNOWN[1][b], _KNOWN[2][c], _KNOWN[3][d]))
        except (ValueError, KeyError):
            return self._read_parts(line, parts)
        self.lines += 1
        return reading

    def _read_parts(self, line: bytes, parts: list[bytes]) -> Reading | None:
        """Decode a line that doesn't consist of four cached parts."""
        if len(line) > MAX_LINE:
            self.refused["line too long"] += 1
            return None
        reading, refused = _parse_parts(parts)
        self.refused.update(refused)
        if reading:
            self.lines += 1
        return reading


def _parse_parts(parts: list[bytes]) -> tuple[Reading | None, tuple[str, ...]]:
    """Parse parts that are new, damaged, incomplete or in another order."""
    speeds: list[float | None] = [None, None, None, None]
    refused = []
    for part in parts:
        found = _parse_part(part)
        if isinstance(found, str):
            refused.append(found)
            continue
        motor, speed = found
        if speeds[motor] is not None:
            refused.append("duplicate motor")
        speeds[motor] = speed
    a, b, c, d = speeds
    named = not (a is b is c is d is None)
    return Reading((a, b, c, d)) if named else None, tuple(refused)


def _parse_part(part: bytes) -> tuple[int, float] | str:
    """Parse a part such as `bn08.75`: (motor index, speed), or the reason why it is refused."""
    match = _PART.fullmatch(part)
    if match:
        motor, direction, digits = match.groups()
        speed = float(digits) if direction == b"p" else 0.0 - float(digits)  # no negative zero
        known = _KNOWN[b"abcd".index(motor)]
        if len(known) < _MOST_KNOWN:
            known[part] = speed
        return b"abcd".index(motor), speed
    if not part:
        return "empty part"
    if part[:1] not in (b"a", b"b", b"c", b"d"):
        return "unknown motor"
    return "unknown direction" if part[1:2] not in (b"p", b"n") else "malformed number"
