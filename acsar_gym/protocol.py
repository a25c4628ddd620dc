r"""Codec of the serial protocol, without any I/O: speeds to lines, bytes to readings.

A line is `ap12.50,bn08.75,cp15.00,dn10.25,\r\n`: motor letter (a front_right, b front_left,
c rear_left, d rear_right), direction (p forward, n backward), and speed in rad/s with two digits
and two decimals. The last comma is optional. Numbers in feedback may also be unpadded (`ap5.23`,
`ap105.20`, `ap 5.00`, `ap-3.20`), as the robot's own driver reads these as well.
Source: the robot's hardware interface document, sections 2.3 and 5.3.2.

Example:
    >>> from acsar_gym import protocol
    >>> line = protocol.encode((12.5, -8.75, 15.0, -10.25))
    >>> line
    b'ap12.50,bn08.75,cp15.00,dn10.25,\r\n'
    >>> protocol.Decoder().feed(line)[0].speeds
    (12.5, -8.75, 15.0, -10.25)
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from acsar_gym.errors import CommandError

__all__ = ["MAX_SPEED", "WHEELS", "ZERO", "Decoder", "Reading", "Speeds", "encode"]
MOTORS = "abcd"
WHEELS = ("front_right", "front_left", "rear_left", "rear_right")
MAX_SPEED = 99.99  # largest speed of the format [rad/s]
MAX_LINE = 256  # longest accepted line [bytes]. Longer lines are dropped up to the next line end

Speeds = tuple[float, float, float, float]  # [rad/s], in the order of WHEELS
ZERO: Speeds = (0.0, 0.0, 0.0, 0.0)
PRINTED_STEP = 0.01  # resolution of the numbers in a line [rad/s]
ECHO_PROBE = b"dp00.00,cp00.00,bp00.00,ap00.00"
"""A zero command in an order that no feedback has: if it comes back, the board echoes."""

_LINE = b"a%+06.2f,b%+06.2f,c%+06.2f,d%+06.2f"
_LENGTH = len(_LINE % ZERO)
_SIGNS_TO_DIRECTIONS = bytes.maketrans(b"+-", b"pn")

_LETTERS = MOTORS.encode()
_LINE_ENDS = (b"\n", b"\r")
_PADDED = re.compile(rb"([abcd])([pn])([0-9]{2}\.[0-9]{2})")
_UNPADDED = re.compile(rb"([abcd])([pn])( {0,3}[+-]?[0-9]{1,3}\.[0-9]{2,6})")
"""Another number format. It has at least two decimals, since a truncated number has fewer."""
_TRUNCATED_LINE = re.compile(
    rb"(?:[abcd][pn][ +-]*[0-9]+\.[0-9]+,){0,3}(?:[abcd](?:[pn][ +-]*[0-9.]{0,9})?)?"
)
_WHOLE_LINE = re.compile(rb"(?:[abcd][pn][ +-]*[0-9]{1,3}\.[0-9]{2,6},?){4}")
_END_OF_PART = re.compile(rb"[pn]?[ +-]*[0-9.]{0,9}")

SAMPLE_BYTES = 60  # length of the sample of a damaged line, and of a note [bytes]
MAX_NOTES = 8  # number of different notes that are kept
_MAX_CACHED = 5000  # largest number of cached parts per motor
_CACHED_A: dict[bytes, float] = {}  # speeds of parts, which are the same in many lines
_CACHED_B: dict[bytes, float] = {}
_CACHED_C: dict[bytes, float] = {}
_CACHED_D: dict[bytes, float] = {}
_CACHED_PARTS = (_CACHED_A, _CACHED_B, _CACHED_C, _CACHED_D)


def encode(speeds: Sequence[float], *, trailing_comma: bool = True) -> bytes:
    r"""Encode four wheel speeds as one line, for commands and feedback alike.

    Args:
        speeds: Wheel speeds [rad/s] in the order a, b, c, d. They are rounded to two decimals
            and saturate at +-99.99. A speed that rounds to zero becomes `p00.00`.
        trailing_comma: Whether the line has a comma before its end.

    Returns:
        The line with CR LF.

    Raises:
        CommandError: There aren't four speeds, or a speed isn't finite.

    Example:
        >>> encode((12.5, -8.75, 15.0, -10.25), trailing_comma=False)
        b'ap12.50,bn08.75,cp15.00,dn10.25\r\n'
    """
    return encode_line(*check_speeds(speeds), end=line_end(trailing_comma=trailing_comma))


def check_speeds(speeds: Sequence[float]) -> Speeds:
    """Return four wheel speeds [rad/s] as floats. CommandError unless they are finite."""
    if len(speeds) != len(MOTORS):
        raise CommandError(f"a line carries 4 wheel speeds (a, b, c, d), got {len(speeds)}")

    a, b, c, d = map(float, speeds)
    if not math.isfinite(a + b + c + d):  # a quick test, but the sum of finite speeds may overflow
        for wheel, speed in zip(WHEELS, (a, b, c, d), strict=True):
            if not math.isfinite(speed):
                raise CommandError(f"{wheel} speed is {speed}: only finite rad/s can be sent")
    return a, b, c, d


def line_end(*, trailing_comma: bool) -> bytes:
    """Return the end of a line, for `encode_line`."""
    return b",\r\n" if trailing_comma else b"\r\n"


def encode_line(a: float, b: float, c: float, d: float, end: bytes) -> bytes:
    """Encode as `encode` does, but without checks: the speeds [rad/s] must be finite floats."""
    line = _LINE % (a, b, c, d)
    if len(line) > _LENGTH:
        saturated = (min(max(speed, -MAX_SPEED), MAX_SPEED) for speed in (a, b, c, d))
        line = _LINE % tuple(saturated)
    return line.replace(b"-00.00", b"+00.00").translate(_SIGNS_TO_DIRECTIONS) + end


class Reading(NamedTuple):
    """Content of one line."""

    speeds: tuple[float | None, float | None, float | None, float | None]
    """Wheel speeds [rad/s] in the order a, b, c, d. None for missing motors."""

    def over(self, old: Speeds) -> Speeds:
        """Return all four speeds [rad/s]. Missing motors keep the old speeds."""
        a, b, c, d = self.speeds
        return (
            old[0] if a is None else a,
            old[1] if b is None else b,
            old[2] if c is None else c,
            old[3] if d is None else d,
        )


class Decoder:
    r"""Decodes a byte stream that arrives in chunks of any size. Never raises an exception.

    Lines end with CR, LF or CRLF. Invalid parts are refused and counted. The other motors of the
    line are still used. If a motor occurs twice, its last speed counts. Truncated lines aren't
    counted as damaged if the port was opened in the middle of a line, or if a reset of the board
    started a new line. Lines of text start with # and have no valid part. Memory is bounded.

    Attributes:
        lines: Number of lines with at least one valid part.
        refused: Number of refused parts by reason.
        damaged: Number of parts refused since the newest line with a valid part.
        sample: Start of the newest line with a refused part, for messages.
        notes: Different lines of text, the newest last. At most `MAX_NOTES`.

    Example:
        >>> decoder = Decoder()
        >>> decoder.feed(b"ap01.00,bn02.00\r\nap0")
        [Reading(speeds=(1.0, -2.0, None, None))]
        >>> decoder.feed(b"3.00\r\n")
        [Reading(speeds=(3.0, None, None, None))]
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Discard the partial line and all counters."""
        self.lines = 0
        self.refused: Counter[str] = Counter()
        self.damaged = 0
        self.sample = b""
        self.notes: list[str] = []
        self._partial = b""
        self._is_skipping = False
        self._is_first = True

    @property
    def partial(self) -> bytes:
        """The line that hasn't ended yet."""
        return self._partial

    def feed(self, data: bytes) -> list[Reading]:
        """Decode the lines that `data` completes.

        Args:
            data: Bytes as they arrived.

        Returns:
            A reading for each valid line, oldest first.
        """
        if not data:
            return []
        # The usual case, as it is in every tick: one line of four known parts, and nothing before.
        if not (self._partial or self._is_skipping):
            try:
                a, b, c, d, end = data.split(b",")
                speeds = (_CACHED_A[a], _CACHED_B[b], _CACHED_C[c], _CACHED_D[d])
            except (ValueError, KeyError):
                pass
            else:
                if end == b"\r\n":
                    self.lines += 1
                    self.damaged = 0
                    return [tuple.__new__(Reading, (speeds,))]  # twice as fast as the class

        stream = self._partial + data
        lines = stream.splitlines()
        partial = b"" if not lines or stream.endswith(_LINE_ENDS) else lines.pop()

        if lines and self._is_skipping:
            self._is_skipping = False
            lines[0] = b""
        readings = [reading for line in lines if (reading := self._read_line(line))]

        if len(partial) > MAX_LINE and not self._is_skipping:
            self._is_skipping = True
            self._refuse(partial, ["line too long"])
        self._partial = b"" if self._is_skipping else partial
        return readings

    def _read_line(self, line: bytes) -> Reading | None:
        """Decode a line. Four cached parts take the fast path."""
        parts = line.split(b",")
        if not parts[-1]:
            parts.pop()  # after a trailing comma
        try:
            a, b, c, d = parts
            speeds = (_CACHED_A[a], _CACHED_B[b], _CACHED_C[c], _CACHED_D[d])
        except (ValueError, KeyError):
            return self._read_parts(line, parts)

        self.lines += 1
        self.damaged = 0
        return tuple.__new__(Reading, (speeds,))  # twice as fast as the class, in every tick

    def _read_parts(self, line: bytes, parts: list[bytes]) -> Reading | None:
        if not line:
            return None
        is_first = self._is_first and self.lines == 0
        self._is_first = False
        if len(line) > MAX_LINE:
            self._refuse(line, ["line too long"])
            return None

        reading, refusals = _parse_parts(parts)
        if reading is None and line.startswith(b"#"):
            self._keep_note(line)
            return None
        if refusals:
            reading, refusals = _parse_parts(_without_truncated(line, parts, is_first=is_first))
        if refusals:
            self._refuse(line, refusals)
        if reading is not None:
            self.lines += 1
            self.damaged = 0
        return reading

    def _keep_note(self, line: bytes) -> None:
        note = line[1:SAMPLE_BYTES].decode("ascii", "backslashreplace").strip()
        older = [text for text in self.notes if text != note]
        self.notes = [*older, note][-MAX_NOTES:]

    def _refuse(self, line: bytes, reasons: list[str]) -> None:
        self._is_first = False
        self.refused.update(reasons)
        self.damaged += len(reasons)
        self.sample = line[:SAMPLE_BYTES]


def _without_truncated(line: bytes, parts: list[bytes], *, is_first: bool) -> list[bytes]:
    """Return the parts of a line without the remains of a truncated line."""
    # The port was opened in the middle of a line: only the end of its first part arrived.
    if is_first and _END_OF_PART.fullmatch(parts[0]):
        return parts[1:]

    # The board was reset in the middle of a line, and a whole line follows.
    start = line.rfind(line[:1], 1)
    is_truncated = start > 0 and _TRUNCATED_LINE.fullmatch(line, 0, start)
    if is_truncated and _WHOLE_LINE.fullmatch(line, start):
        return line[start:].rstrip(b",").split(b",")
    return parts


def _parse_parts(parts: list[bytes]) -> tuple[Reading | None, list[str]]:
    """Parse parts such as `bn08.75`. Returns a reading or None, and reasons of refusals."""
    speeds: list[float | None] = [None, None, None, None]
    refusals = []
    # An unpadded number next to numbers that are padded with zeros has lost a digit.
    is_padded = any(len(text) == 7 and text[2:3] == b"0" for text in parts)

    for text in parts:
        padded = _PADDED.fullmatch(text)
        match = padded or _UNPADDED.fullmatch(text)
        if match is None or (is_padded and not padded and match[3][:1].isdigit()):
            refusals.append(_explain_refusal(text))
            continue

        letter, direction, digits = match.groups()
        motor = _LETTERS.index(letter)
        value = float(digits)
        speed = 0.0 + value if direction == b"p" else 0.0 - value  # no negative zero
        if padded and len(_CACHED_PARTS[motor]) < _MAX_CACHED:
            _CACHED_PARTS[motor][text] = speed
        if speeds[motor] is not None:
            refusals.append("duplicate motor")
        speeds[motor] = speed

    if all(speed is None for speed in speeds):
        return None, refusals
    a, b, c, d = speeds
    return Reading((a, b, c, d)), refusals


def _explain_refusal(part: bytes) -> str:
    """Return why a part of a line can't be read."""
    if not part:
        return "empty part"
    if part[:1] not in _LETTERS:
        return "unknown motor"
    if part[1:2] not in (b"p", b"n"):
        return "unknown direction"
    return "malformed number"
