"""A board that isn't ours: the program of an 8-bit microcontroller, in integers and milliseconds.

Speeds are whole hundredths of rad/s, a loop of 10 ms moves them by a twelfth of what is missing
(cut towards zero, as C divides), the newest command counts for 500 ms, and 1.5 s pass after a
reset before the first line. So the lag is -10 ms / ln(1 - 1/12) = 114.9 ms, and a wheel never comes
nearer to its target than 0.11 rad/s.

`IntegerLink` runs it in simulated time, with 1 ms of resolution and the time that bytes take on the
wire.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from acsar_gym.links.base import Link
from acsar_gym.worlds import Scene

BYTES_PER_MILLISECOND = 11.52
"""Of a wire at 115200 baud."""
BOOT = 1500
"""Silence after a reset [ms]."""
LOOP = 10
"""Period of the board's loop [ms]."""
FEEDBACK = 20
"""From one line to the next [ms]."""
REPEAT_PERIOD = 3000
"""How often old measurements are printed, if they are [ms]."""


@dataclass(frozen=True)
class BoardProgram:
    """Its constants: speeds in hundredths of rad/s, times in ms."""

    divisor: int = 12
    """A loop moves a wheel's speed by this part of what is missing."""
    fraction: int = 1
    """Parts of a hundredth that speeds are kept in."""
    gain: tuple[int, ...] = (100, 100, 100, 100)
    """Of each wheel, in percent."""
    deadband: int = 0
    """Smaller targets don't turn a wheel."""
    quantum: int = 1
    """Speeds are printed in whole multiples of this."""
    delay: int = 0
    """From a command's arrival until it counts."""
    repeat: int = 0
    """Every 3 s it goes on printing what it measured last for this long."""
    timeout: int = 500
    """From the newest command to the time-out. 0 for none."""
    ends: bytes = b",\r\n"
    """What ends a value."""
    padded: bool = True
    """Whether speeds are printed as `05.00`. Otherwise as `5.00`."""

    @property
    def lag(self) -> float:
        """Time constant of its arithmetic [s]."""
        return -1e-3 * LOOP / math.log(1.0 - 1.0 / self.divisor)


SLOWER = BoardProgram(divisor=24, deadband=90, quantum=12)
"""Its lag is 234.9 ms."""
SIBLING = BoardProgram(deadband=90, fraction=16, quantum=12, ends=b",", padded=False)
"""A board as code of sibling robots has it, which takes a value at its comma."""


def divide(a: int, b: int) -> int:
    """Divide as C does, towards zero."""
    return int(a / b)


class IntegerBoard:
    """The board: bytes in, a millisecond, bytes out."""

    def __init__(self, program: BoardProgram) -> None:
        self.program = program
        self.time = 0
        """Since the reset [ms]."""
        self._text = b""
        self._commands: deque[tuple[int, int, int]] = deque()
        """When each counts, its wheel, its target."""
        self._heard = -(10**6)
        self._targets = [0] * 4
        self._speeds = [0] * 4
        self._measured: tuple[int, ...] = ()

    def run_millisecond(self, data: bytes) -> bytes:
        """Let a millisecond pass, in which these bytes arrive. Returns what the board prints."""
        self.time += 1
        if self.time < BOOT:
            return b""
        for byte in data:
            self._take_byte(byte)
        line = b"" if self.time % FEEDBACK else self._print_line()
        if self.time % LOOP == 0:
            self._run_loop()
        return line

    def _take_byte(self, byte: int) -> None:
        """Take a number at its end."""
        if byte not in self.program.ends:
            self._text = (self._text + bytes([byte]))[-16:]
            return
        text = self._text.strip()
        self._text = b""
        digits = text[2:].replace(b".", b"")
        if len(text) == 7 and text[:1] in b"abcd" and text[1:2] in b"pn" and digits.isdigit():
            target = -int(digits) if text[1:2] == b"n" else int(digits)
            self._commands.append((self.time + self.program.delay, b"abcd".index(text[:1]), target))

    def _run_loop(self) -> None:
        """Move the wheels."""
        program = self.program
        while self._commands and self._commands[0][0] <= self.time:
            self._heard, wheel, target = self._commands.popleft()
            self._targets[wheel] = target
        if program.timeout and self.time - self._heard > program.timeout:
            self._targets = [0] * 4

        for wheel, target in enumerate(self._targets):
            aim = divide(target * program.gain[wheel], 100)
            aim = 0 if abs(aim) < program.deadband else aim
            speed = self._speeds[wheel]
            self._speeds[wheel] = speed + divide(aim * program.fraction - speed, program.divisor)

        if self.time % REPEAT_PERIOD >= program.repeat or not self._measured:
            self._measured = tuple(divide(speed, program.fraction) for speed in self._speeds)

    def _print_line(self) -> bytes:
        """Print what was measured, as integers and their hundredths."""
        parts = []
        for letter, speed in zip("abcd", self._measured, strict=False):
            size = abs(speed) // self.program.quantum * self.program.quantum
            sign = "n" if speed < 0 else "p"
            whole = f"{size // 100:0{2 if self.program.padded else 1}d}"
            parts.append(f"{letter}{sign}{whole}.{size % 100:02d},")
        return ("".join(parts) + "\r\n").encode() if parts else b""


class IntegerLink(Link):
    """The board at the end of a wire, in simulated time: a `Link`.

    Args:
        program: Constants of the board.
        phase: Time by which the host's clock is ahead of the board's [ms].
    """

    arrivals: list[tuple[float, bytes]] = []  # noqa: RUF012 - set by each reset

    def __init__(self, program: BoardProgram, phase: float = 0.0) -> None:
        self._program = program
        self._phase = phase
        self.reset(Scene())

    def open(self) -> None:
        """Nothing to open."""

    def close(self) -> None:
        """Nothing to close."""

    def reset(self, _: Scene) -> None:
        """Reset the board, and wait until it has booted."""
        self._board = IntegerBoard(self._program)
        self._now = self._phase
        self._inbound: deque[tuple[float, int]] = deque()
        self._outbound: deque[tuple[float, int]] = deque()
        self._free = [0.0, 0.0]  # when each direction of the wire is free [ms]
        self.arrivals = []
        self.advance(1e-3 * BOOT)

    def now(self) -> float:
        """Return the host's time [s]."""
        return 1e-3 * self._now

    def write(self, data: bytes) -> None:
        """Send bytes to the board."""
        self._send(0, self._inbound, data, self._now)

    def advance(self, period: float) -> bytes:
        """Let a period pass, and return what arrived."""
        self._now += 1e3 * period
        while self._board.time + 1 <= self._now:
            time = self._board.time + 1
            heard = []
            while self._inbound and self._inbound[0][0] <= time:
                heard.append(self._inbound.popleft()[1])
            self._send(1, self._outbound, self._board.run_millisecond(bytes(heard)), time)

        self.arrivals = []
        piece = bytearray()
        while self._outbound and self._outbound[0][0] <= self._now:
            stamp, byte = self._outbound.popleft()
            piece.append(byte)
            if byte == ord("\n") or not self._outbound or self._outbound[0][0] > self._now:
                self.arrivals.append((1e-3 * stamp, bytes(piece)))
                piece.clear()
        return b"".join(data for _, data in self.arrivals)

    def _send(self, way: int, queue: deque[tuple[float, int]], data: bytes, begin: float) -> None:
        """Put bytes on the wire, each of which takes its time."""
        for byte in data:
            self._free[way] = max(self._free[way], begin) + 1.0 / BYTES_PER_MILLISECOND
            queue.append((self._free[way], byte))
