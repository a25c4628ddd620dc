r"""Codec of the serial protocol, without any I/O: speeds to lines, bytes to readings.

A line is `ap12.50,bn08.75,cp15.00,dn10.25,\r\n`: motor letter (a front_right, b front_left,
c rear_left, d rear_right), direction (p forward, n backward), speed in rad/s with two digits and
two decimals; the last comma is optional. Feedback may also have unpadded numbers (`ap5.23`,
`ap105.20`, `ap 5.00`, `ap-3.20`), which the robot's own driver reads, too.
Source: the robot's hardware interface document, sections 2.3 and 5.3.2.
"""

from __future__ import annotations

import math
import re
from collections import Counter, deque
from collections.abc import Sequence
from typing import NamedTuple

from acsar_gym.errors import CommandError

__all__ = ["MAX_SPEED", "WHEELS", "ZERO", "Decoder", "EchoDecoder", "Reading", "Speeds", "encode"]
MOTORS = "abcd"
WHEELS = ("front_right", "front_left", "rear_left", "rear_right")
MAX_SPEED = 99.99  # largest speed of the format [rad/s]
MAX_LINE = 256  # longest accepted line [bytes]; longer ones are dropped up to the next line end

Speeds = tuple[float, float, float, float]  # [rad/s], in the order of WHEELS
ZERO: Speeds = (0.0, 0.0, 0.0, 0.0)
PRINTED_STEP = 0.01  # resolution of the wire's numbers [rad/s]

_LINE = b"a%+06.2f,b%+06.2f,c%+06.2f,d%+06.2f"
_LENGTH = len(_LINE % (0.0, 0.0, 0.0, 0.0))
_LETTERS = b"abcd"
_DIRECTIONS = bytes.maketrans(b"+-", b"pn")
_PART = re.compile(rb"([abcd])([pn])([0-9]{2}\.[0-9]{2})")
_ENDS = (b"\n", b"\r")
_TOLERATED = re.compile(rb"([abcd])([pn])( {0,3}[+-]?[0-9]{1,3}\.[0-9]{2,6})")
"""Another number format; at least two decimals, since a cut number has fewer."""
_BEGUN = re.compile(
    rb"(?:[abcd][pn][ +-]*[0-9]+\.[0-9]+,){0,3}(?:[abcd](?:[pn][ +-]*[0-9.]{0,9})?)?"
)
"""A line that ends too early, as where the board was reset meanwhile."""
_WHOLE = re.compile(rb"(?:[abcd][pn][ +-]*[0-9]{1,3}\.[0-9]{2,6},?){4}")
_PART_END = re.compile(rb"[pn]?[ +-]*[0-9.]{0,9}")  # the end of a part
SAMPLE_BYTES = 60  # how much of a damaged line, or of text, is kept for messages [bytes]
MAX_NOTES = 8  # how many different texts are kept
_KNOWN: tuple[dict[bytes, float], ...] = ({}, {}, {}, {})  # cache of parsed parts
_TURNING = re.compile(rb"(?<=[pn])(?!00\.00)[0-9]{2}\.[0-9]{2}")  # the speed of a wheel that turns
_MAX_KNOWN = 5000  # largest number of cached parts per motor
MAX_ECHOES = 100  # how many commands may wait for their echo
FEWEST_ECHOES = 4  # without feedback; a board that is reset sends fewer
ECHO_PROBE = b"dp00.00,cp00.00,bp00.00,ap00.00"  # zeros in an order that no feedback has
ECHO_ZERO = b"an00.00,bn00.00,cn00.00,dn00.00"  # a zero command to a board that echoes


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
    return encode_line(*check_speeds(speeds), line_end(trailing_comma=trailing_comma))


def check_speeds(speeds: Sequence[float]) -> Speeds:
    """Check four wheel speeds [rad/s]; CommandError where they aren't four or not finite."""
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


def encode_line(a: float, b: float, c: float, d: float, end: bytes) -> bytes:
    """Encode as `encode` does, but without checks: the speeds [rad/s] must be finite floats."""
    line = _LINE % (a, b, c, d)
    if len(line) > _LENGTH:
        saturated = (min(max(speed, -MAX_SPEED), MAX_SPEED) for speed in (a, b, c, d))
        line = _LINE % tuple(saturated)
    return line.replace(b"-00.00", b"+00.00").translate(_DIRECTIONS) + end


class Reading(NamedTuple):
    """Content of one line."""

    speeds: tuple[float | None, float | None, float | None, float | None]
    """Wheel speeds [rad/s] in the order a, b, c, d; None for missing motors."""

    def over(self, old: Speeds) -> Speeds:
        """Return all four speeds [rad/s]; missing motors keep the old ones."""
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
    line are still used. If a motor occurs twice, the last one counts. A line isn't damaged but cut
    where the port was opened in mid-line, or where a reset of the board began a new line. Memory is
    bounded by `MAX_LINE`. A line of text, which begins with # and has no valid part, isn't damaged.

    Attributes:
        lines: number of lines with at least one valid part.
        refused: number of refused parts by reason.
        tolerated: number of parts whose number isn't two digits and two decimals.
        cut: number of cut lines.
        sample: beginning of the newest line with a refused part, for messages.
        notes: what lines of text have said, each once, the newest last; at most `MAX_NOTES`.
    """

    def __init__(self) -> None:
        self._partial = b""
        self._skipping = False
        self._first = True
        self._refused_at = -1
        self._refused_before = 0
        self.lines = 0
        self.refused: Counter[str] = Counter()
        self.tolerated = 0
        self.cut = 0
        self.sample = b""
        self.notes: list[str] = []

    def reset(self) -> None:
        """Discard the partial line and all counters."""
        self.__init__()  # type: ignore[misc]

    @property
    def rest(self) -> bytes:
        """The line that hasn't ended yet."""
        return self._partial

    @property
    def damaged(self) -> int:
        """Number of parts refused since the newest line with a valid part."""
        newer = self.lines == self._refused_at
        return sum(self.refused.values()) - self._refused_before if newer else 0

    def feed(self, data: bytes) -> list[Reading]:
        """Decode the lines that `data` completes: one reading for each valid one, oldest first."""
        stream = self._partial + data
        lines = stream.splitlines()
        partial = b"" if not lines or stream.endswith(_ENDS) else lines.pop()
        if lines and self._skipping:
            self._skipping = False
            lines[0] = b""
        readings = [reading for line in lines if line and (reading := self._read_line(line))]
        if len(partial) > MAX_LINE and not self._skipping:
            self._skipping = True
            self._refuse(partial, ["line too long"])
        self._partial = b"" if self._skipping else partial
        return readings

    def _read_line(self, line: bytes) -> Reading | None:
        """Decode one line; four cached parts take the fast path."""
        parts = line.split(b",")
        if not parts[-1] and len(parts) > 1:
            parts.pop()  # a trailing comma
        try:
            a, b, c, d = parts
            speeds = _KNOWN[0][a], _KNOWN[1][b], _KNOWN[2][c], _KNOWN[3][d]
        except (ValueError, KeyError):
            return self._read_parts(line, parts)
        self.lines += 1
        return tuple.__new__(Reading, (speeds,))  # twice as fast as a NamedTuple's own, every tick

    def _read_parts(self, line: bytes, parts: list[bytes]) -> Reading | None:
        first = self._first and self.lines == 0
        self._first = False
        if len(line) > MAX_LINE:
            self._refuse(line, ["line too long"])
            return None
        reading, refused, tolerated = _parse_parts(parts)
        if reading is None and line.startswith(b"#"):
            note = line[1:SAMPLE_BYTES].decode("ascii", "backslashreplace").strip()
            self.notes = [*(one for one in self.notes if one != note), note][-MAX_NOTES:]
            return None
        if refused:  # perhaps only by what belongs to a cut line
            begin = line.rfind(line[:1], 1)
            if first and _PART_END.fullmatch(parts[0]):
                self.cut += 1
                reading, refused, tolerated = _parse_parts(parts[1:])
            elif begin > 0 and _BEGUN.fullmatch(line, 0, begin) and _WHOLE.fullmatch(line, begin):
                self.cut += 1
                parts = line[begin:].rstrip(b",").split(b",")
                reading, refused, tolerated = _parse_parts(parts)
        self.tolerated += tolerated
        if refused:
            self._refuse(line, refused)
        if reading:
            self.lines += 1
        return reading

    def _refuse(self, line: bytes, reasons: list[str]) -> None:
        self._first = False
        if self._refused_at != self.lines:
            self._refused_at = self.lines
            self._refused_before = sum(self.refused.values())
        self.refused.update(reasons)
        self.sample = line[:SAMPLE_BYTES]


class EchoDecoder(Decoder):
    """Decodes what a board sends that also sends commands back, each once or again and again.

    A line that holds a command which was sent, in the order of sending, is an echo, whatever the
    board puts before it or does to its end; it is left out, and the rest of such a line is decoded.
    A line with an invalid part isn't used at all, since it may be a damaged echo.

    Attributes:
        echoes: number of echoes.

    Args:
        sent: commands that were sent before, whose echo may still come.
    """

    def __init__(self, *sent: bytes) -> None:
        super().__init__()
        self._waiting: deque[bytes] = deque(maxlen=MAX_ECHOES)
        self._command = self._newest = b""
        self._repeats = self._echoes_before = 0
        self.echoes = 0
        for line in sent:
            self.expect(line)

    @property
    def only_echoes(self) -> bool:
        """Whether several echoes have come since the newest valid line."""
        return self.echoes >= self._echoes_before + FEWEST_ECHOES

    def mark(self, line: bytes) -> bytes:
        """Change a command so that its echo is unlike feedback, and expect the echo.

        Zeros get the direction n, which feedback of standing wheels doesn't have. Where the same is
        commanded again, one of the wheels that turn gets 0.01 rad/s more and less in turns, so that
        feedback of wheels that turn exactly as commanded isn't taken for an echo.

        Args:
            line: as of `encode`.

        Returns:
            The line to send.
        """
        line = line.replace(b"p00.00", b"n00.00")
        self._repeats = self._repeats + 1 if line == self._command else 0
        self._command = line
        turning = _TURNING.search(line)
        if self._repeats and turning:
            step = 0.01 if self._repeats % 2 else -0.01
            number = b"%05.2f" % min(float(turning[0]) + step, MAX_SPEED)
            line = line[: turning.start()] + number + line[turning.end() :]
        self.expect(line)
        return line

    def expect(self, line: bytes) -> None:
        """Expect the echo of a command, as it was sent."""
        self._waiting.append(line.strip(b",\r\n"))

    def _read_line(self, line: bytes) -> Reading | None:
        """Decode one line, less its echo."""
        echo = next((text for text in self._waiting if text in line), None)
        if echo is not None:
            while self._waiting.popleft() != echo:
                pass
            self._newest = echo
        elif self._newest and self._newest in line:
            echo = self._newest
        if echo is not None:
            self.echoes += 1
            rest = b"".join(line.partition(echo)[::2]).strip(b", ")
            return self._read_line(rest) if _parse_parts(rest.split(b","))[0] else None
        refused = sum(self.refused.values())
        reading = super()._read_line(line)
        if reading is None:
            return None
        if sum(self.refused.values()) > refused:
            self.lines -= 1
            return None
        self._echoes_before = self.echoes
        return reading


def _parse_parts(parts: list[bytes]) -> tuple[Reading | None, list[str], int]:
    """Parse parts such as `bn08.75`: a reading or None, refusals, and how many are tolerated."""
    speeds: list[float | None] = [None, None, None, None]
    refused, tolerated = [], 0
    # Where other numbers are padded with zeros, one that isn't has lost a digit.
    zeros = any(len(part) == 7 and part[2:3] == b"0" for part in parts)
    for part in parts:
        padded = _PART.fullmatch(part)
        match = padded or _TOLERATED.fullmatch(part)
        if match is None or (zeros and not padded and match[3][:1].isdigit()):
            is_motor = part[:1] in _LETTERS
            wrong = "malformed number" if part[1:2] in (b"p", b"n") else "unknown direction"
            refused.append((wrong if is_motor else "unknown motor") if part else "empty part")
            continue
        letter, direction, digits = match.groups()
        motor = _LETTERS.index(letter)
        value = float(digits)
        speed = 0.0 + value if direction == b"p" else 0.0 - value  # no negative zero
        if padded and len(_KNOWN[motor]) < _MAX_KNOWN:
            _KNOWN[motor][part] = speed
        tolerated += not padded
        if speeds[motor] is not None:
            refused.append("duplicate motor")
        speeds[motor] = speed
    a, b, c, d = speeds
    named = not (a is b is c is d is None)
    return Reading((a, b, c, d)) if named else None, refused, tolerated
