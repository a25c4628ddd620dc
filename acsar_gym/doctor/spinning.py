"""Turns one wheel after the other, and hears which encoder answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
LISTEN = 0.3
"""How long the wheel's speed is measured, once it moves [s]."""


@dataclass(frozen=True)
class Answer:
    """How the encoders answered a forward command to one letter.

    Attributes:
        letter: index of the letter that was commanded.
        speeds: mean speeds that the letters a, b, c, d reported [rad/s].
        moving: indices of the letters that reported a turn, the fastest first.
    """

    letter: int
    speeds: Speeds
    moving: tuple[int, ...]

    @property
    def encoder(self) -> int | None:
        """Index of the letter that answered; None if there was none."""
        return self.moving[0] if self.moving else None

    @property
    def sign(self) -> int:
        """1 where it reported a forward turn, -1 a backward one."""
        return -1 if self.moving and self.speeds[self.moving[0]] < 0.0 else 1


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

    ear.hear(command, moves, PATIENCE, order=order)
    heard = ear.hear(command, lambda _: False, LISTEN, order=order)
    stand(ear, speed)
    return _answer(letter, heard or lines[-1:], speed)


def _answer(letter: int, lines: Sequence[Line], speed: float) -> Answer:
    """Return the answer that lines of feedback hold."""
    a, b, c, d = (fmean(line.speeds[k] for line in lines) if lines else 0.0 for k in range(4))
    speeds = (a, b, c, d)
    moving = [k for k in range(4) if abs(speeds[k]) > MOVES * speed]
    return Answer(letter, speeds, tuple(sorted(moving, key=lambda k: -abs(speeds[k]))))


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
