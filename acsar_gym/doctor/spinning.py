"""Turns one wheel after the other, and hears which encoder answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from acsar_gym.doctor.listening import Ear, Line
from acsar_gym.links.handshake import still_turning
from acsar_gym.protocol import MOTORS, ZERO, Speeds

MOVES = 0.4
"""A wheel that has this share of the commanded speed moves."""
STANDS = 0.1
"""A wheel that is slower than this share of the commanded speed stands."""
IN_A_ROW = 3
"""Lines that must agree."""
PATIENCE = 1.5
"""Longest wait for a wheel to start [s]; motors, speed loops and delays take up to 0.5 s."""
PATIENCE_FOR_ONE = 0.7
"""Longest wait for the effect of a single command [s]; many boards stop by themselves soon."""
STOPPING = 3.0
"""Longest wait for wheels to stop [s]."""
FAINT = 0.025
"""A letter that reports less than this share of the commanded speed reports nothing; one in m/s has
0.05 of it on a usual wheel."""
LISTEN = 0.2
"""Length of the windows in which the wheel's speed is measured, once it moves [s]."""
STEADY = 0.03
"""A speed is steady where it changes by less than this share of the commanded speed, or of itself,
from one window to the next."""
SETTLING = 1.5
"""Longest wait for a steady speed [s]."""
LEAST, MOST = 0.7, 1.4
"""A wheel's measured speed is right between these shares of the commanded one."""


@dataclass(frozen=True)
class Answer:
    """How the encoders answered a forward command to one letter.

    Attributes:
        letter: index of the letter that was commanded.
        asked: commanded speed [rad/s].
        speeds: mean speeds that the letters a, b, c, d reported [rad/s].
        moving: indices of the letters that reported a turn, the fastest first.
        stopped: whether they stood again soon, although the command went on; `speeds` are those
            before.
    """

    letter: int
    asked: float
    speeds: Speeds
    moving: tuple[int, ...]
    stopped: bool = False

    @property
    def encoder(self) -> int | None:
        """Index of the letter that answered; None if there was none."""
        return self.moving[0] if self.moving else None

    @property
    def sign(self) -> int:
        """1 where it reported a forward turn, -1 a backward one."""
        return -1 if self.ratio < 0.0 else 1

    @property
    def ratio(self) -> float:
        """Measured by commanded speed, with sign; 0 where no encoder answered."""
        return self.speeds[self.moving[0]] / self.asked if self.moving else 0.0

    @property
    def is_right(self) -> bool:
        """Whether a wheel, if any, turned as fast as commanded, forward or backward."""
        return not self.moving or (LEAST <= abs(self.ratio) <= MOST and not self.stopped)


def alone(letter: int, speed: float) -> Speeds:
    """Return a command for one letter [rad/s]."""
    a, b, c, d = (speed if number == letter else 0.0 for number in range(4))
    return a, b, c, d


def stand(ear: Ear, speed: float) -> None:
    """Command zero until all wheels stand.

    Args:
        ear: hears the board.
        speed: at which wheels turn in these checks [rad/s].

    Raises:
        LinkError: a wheel keeps turning.
    """
    lines: list[Line] = []

    def standing(line: Line) -> bool:
        lines.append(line)
        newest = lines[-IN_A_ROW:]
        return len(newest) == IN_A_ROW and all(
            max(map(abs, one.speeds)) < STANDS * speed for one in newest
        )

    heard = ear.hear(ZERO, standing, STOPPING)
    if not heard or max(map(abs, heard[-1].speeds)) >= STANDS * speed:
        raise still_turning(STOPPING, heard[-1].speeds if heard else ZERO)


def spun(ear: Ear, letter: int, speed: float, order: str = MOTORS) -> Answer:
    """Turn the wheel of one letter until an encoder answers, and stop it.

    Args:
        ear: hears the board.
        letter: index of the letter.
        speed: to command [rad/s].
        order: order of the letters in the command line.
    """
    command = alone(letter, speed)
    lines: list[Line] = []

    def moves(line: Line) -> bool:
        lines.append(line)
        newest = lines[-IN_A_ROW:]
        return len(newest) == IN_A_ROW and any(
            all(abs(one.speeds[k]) > MOVES * speed for one in newest) for k in range(4)
        )

    begun = ear.hear(command, moves, PATIENCE, order=order)[-IN_A_ROW:]
    heard = ear.hear(command, _Steady(speed), SETTLING, order=order)
    stand(ear, speed)
    answer = _answer(letter, _newest(heard, LISTEN) or lines[-1:], speed)
    before = _answer(letter, begun, speed)
    if not answer.moving and max(map(abs, before.speeds)) > MOVES * speed:
        return replace(before, stopped=True)
    return answer


class _Steady:
    """Is true of the line from which on all speeds are steady."""

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self._lines: list[Line] = []

    def __call__(self, line: Line) -> bool:
        lines = self._lines
        lines.append(line)
        newest = _newest(lines, LISTEN)
        before = _newest(lines[: -len(newest)], LISTEN)
        if not before or before[-1].stamp - lines[0].stamp < LISTEN:
            return False
        return all(
            abs(now - then) < STEADY * max(self._speed, abs(now))
            for now, then in zip(_means(newest), _means(before), strict=True)
        )


def _newest(lines: Sequence[Line], lasting: float) -> Sequence[Line]:
    """Return the lines of the last moments [s], at least one if there is one."""
    return [line for line in lines if line.stamp > lines[-1].stamp - lasting]


def _means(lines: Sequence[Line]) -> Speeds:
    """Return the mean speed of each letter [rad/s]."""
    a, b, c, d = (fmean(line.speeds[k] for line in lines) if lines else 0.0 for k in range(4))
    return a, b, c, d


def _answer(letter: int, lines: Sequence[Line], asked: float) -> Answer:
    """Return the answer that lines of feedback hold."""
    speeds = _means(lines)
    least = max(FAINT * asked, MOVES * max(map(abs, speeds)))
    moving = [k for k in range(4) if abs(speeds[k]) > least]
    return Answer(letter, asked, speeds, tuple(sorted(moving, key=lambda k: -abs(speeds[k]))))


def takes_last_value(ear: Ear, letter: int, speed: float, *, comma: bool) -> bool:
    """Return whether the board takes the last value of a line with, or without, a trailing comma.

    It gets one such line only: some boards take a value at the first comma of the next line.

    Args:
        ear: hears the board; its `trailing_comma` is the same afterwards.
        letter: index of a letter whose wheel turns.
        speed: to command [rad/s].
        comma: whether the line has the trailing comma.
    """
    order = MOTORS.replace(MOTORS[letter], "") + MOTORS[letter]
    usual, ear.trailing_comma = ear.trailing_comma, comma
    ear.command(alone(letter, speed), order)
    ear.trailing_comma = usual
    lines = ear.hear(None, lambda line: _turns(line, speed), PATIENCE_FOR_ONE)
    stand(ear, speed)
    return bool(lines) and _turns(lines[-1], speed)


def _turns(line: Line, speed: float) -> bool:
    return max(map(abs, line.speeds)) > STANDS * speed
