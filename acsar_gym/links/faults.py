"""The configuration of faults between a driver and its board, and their effect on lines.

`links/fault_injection.py` applies them.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, Self, get_args

import numpy as np

from acsar_gym.errors import ConfigError, shown, suggestion
from acsar_gym.protocol import MAX_LINE, MOTORS

Direction = Literal["feedback", "commands", "both"]
Wheels = str | int
"""Letters such as "ad" name motors; a number is how many, drawn anew in every episode."""

HIGHEST_RATE = 1000.0
"""Highest rate of any event [1/s]."""
LONGEST = 60.0
"""Longest duration of any fault [s]."""
LARGEST_BURST = 4096
"""Longest burst of garbage [bytes]."""

EPSILON = 1e-9
"""Tolerance for comparing times that are sums of periods [s]."""
STOPPED = b"p00.00"

_PART = re.compile(rb"(?<![^,\r\n])([abcd])([pn])([0-9]{2}\.[0-9]{2})(?![^,\r\n])")


@dataclass(frozen=True, slots=True)
class Faults:
    """Shares of lines, rates of events, and wheels that fail. By default there are no faults.

    An event with a rate comes at random, on average so many times a second; `*_at` is the time of
    the first one [s]. Faults of wheels, encoders, board, supply and cable begin with the drive:
    their clock starts anew after every reset, with the first command that turns wheels. Faults of
    lines and garbage occur at all times.

    A batch knows `dropped_lines`, `late_lines`, `lateness`, `episodes` and `direction`, and loses
    the same lines as the single env.

    Raises ConfigError for values out of range.
    """

    episodes: float = 1.0
    """Share of episodes that have faults; the others have none."""
    direction: Direction = "both"
    """Where lines have faults and garbage appears: "feedback", "commands" or "both"."""

    dropped_lines: float = 0.0
    """Share of lines that never arrive."""
    duplicated_lines: float = 0.0
    """Share of lines that arrive twice."""
    cut_lines: float = 0.0
    """Share of lines that lose their tail, line end included, so that the next line is appended
    to them."""
    corrupted_lines: float = 0.0
    """Share of lines in which one to three bytes arrive with one bit flipped."""
    late_lines: float = 0.0
    """Share of lines that are delayed by `lateness`, and all lines behind them with them."""
    lateness: float = 0.05
    """Delay of a late line [s], rounded up to whole periods."""
    garbage_rate: float = 0.0
    """Bursts of random bytes per second [1/s]."""
    garbage_bytes: int = 64
    """Length of a burst [bytes]."""

    stuck_encoders: Wheels = 0
    """Encoders that repeat the reading they had at `wheel_faults_at`; at the start that is 0."""
    reversed_encoders: Wheels = 0
    """Encoders with the wrong sign: p instead of n, and n instead of p."""
    dead_wheels: Wheels = 0
    """Wheels whose commands become zero on the board; their encoders still work."""
    wheel_faults_at: float = 0.0
    """When encoders and wheels fail [s after the drive's start]; with 0 they fail before it,
    too."""

    board_reset_rate: float = 0.0
    """Resets of the board per second [1/s]."""
    board_reset_at: float | None = None
    """When the first reset of the board happens [s after the drive's start]."""
    reset_time: float = 2.0
    """For how long a board that resets doesn't run: motors off, no input, no output [s]."""
    brown_out_rate: float = 0.0
    """Dips of the supply per second [1/s]."""
    brown_out_at: float | None = None
    """When the first dip happens [s after the drive's start]."""
    brown_out_time: float = 0.3
    """For how long a board doesn't run in a dip: motors off, no input, no output [s]."""
    unplug_rate: float = 0.0
    """How often the cable is pulled [1/s]."""
    unplug_at: float | None = None
    """When the cable is pulled [s after the drive's start]."""
    replug_time: float = 1.0
    """Time until it is plugged in again, under another device's name [s]; inf: never."""

    def __post_init__(self) -> None:
        for name, (is_sound, allowed) in _RULES.items():
            value = getattr(self, name)
            if not _holds(is_sound, value):
                raise ConfigError(f"faults: {name} = {shown(value)}: must be {allowed}")

    @classmethod
    def of(cls, faults: Mapping[str, Any] | Faults | None) -> Faults:
        """Return the Faults that users mean by `faults=`.

        Args:
            faults: a mapping, Faults, or None for no faults.

        Raises:
            ConfigError: for an unknown key or a value out of range.
        """
        if isinstance(faults, Faults):
            return faults
        if faults is not None and not isinstance(faults, Mapping):
            raise ConfigError(
                f"faults = {shown(faults)}: must be a mapping such as dropped_lines: 0.01"
            )
        known = {field.name for field in fields(cls)}
        for key in faults or {}:
            if key not in known:
                raise ConfigError(
                    f"faults: unknown fault {shown(key)}{suggestion(str(key), known)}"
                )
        return cls(**dict(faults or {}))

    @property
    def lines_suffer(self) -> bool:
        """Whether any share of lines with a fault is above zero."""
        return any(getattr(self, name) for name in LINE_FAULTS)

    @property
    def possible(self) -> bool:
        """Whether any fault can occur."""
        wheels = any(getattr(self, name) for name in _WHEELS)
        rates = any(getattr(self, name) for name in _RATES)
        times = any(getattr(self, name) is not None for name in _WHEN)
        return self.episodes > 0.0 and (self.lines_suffer or wheels or rates or times)


@dataclass(frozen=True, slots=True)
class WheelFaults:
    """Which motors have which fault in an episode, as letters; "" for none."""

    stuck: str = ""
    reversed: str = ""
    dead: str = ""

    @classmethod
    def drawn(cls, faults: Faults, rng: np.random.Generator) -> Self:
        """Take the named wheels, and draw as many as are asked for by number."""
        return cls(
            _drawn(faults.stuck_encoders, rng),
            _drawn(faults.reversed_encoders, rng),
            _drawn(faults.dead_wheels, rng),
        )


def _drawn(wheels: Wheels, rng: np.random.Generator) -> str:
    """Letters of the motors that are named, or drawn."""
    if isinstance(wheels, str):
        return wheels
    return "".join(sorted(rng.choice(list(MOTORS), int(wheels), replace=False).tolist()))


class Lines:
    """Joins a stream of bytes to lines.

    Keeps an incomplete line, unless it is too long to be one.
    """

    def __init__(self) -> None:
        self.partial = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that `data` completes, with their line ends."""
        lines = (self.partial + data).splitlines(keepends=True)
        self.partial = b""
        if lines and not lines[-1].endswith((b"\r", b"\n")) and len(lines[-1]) <= MAX_LINE:
            self.partial = lines.pop()
        return lines


class WheelEditor:
    """Changes feedback and commands of one episode as failed encoders and motors would.

    Attributes: `at`, when they fail, on the link's clock [s]; may be set later.
    """

    def __init__(self, faults: WheelFaults, at: float) -> None:
        self.at = at
        self._dead, self._stuck, self._reversed = (
            letters.encode() for letters in (faults.dead, faults.stuck, faults.reversed)
        )
        self._readings: dict[bytes, bytes] = {}
        self._commands, self._feedback = Lines(), Lines()

    def cut_off(self) -> None:
        """Forget incomplete lines."""
        self._commands.partial = self._feedback.partial = b""

    def commanded(self, data: bytes, now: float) -> bytes:
        """Commands with zeros for dead wheels."""
        if not self._dead:
            return data
        lines = b"".join(self._commands.feed(data))
        return lines if now + EPSILON < self.at else _PART.sub(self._obeyed, lines)

    def _obeyed(self, part: re.Match[bytes]) -> bytes:
        """One motor's part of a command."""
        return part[1] + STOPPED if part[1] in self._dead else part[0]

    def felt(self, data: bytes, now: float) -> bytes:
        """Feedback with the readings of failed encoders."""
        if not (self._stuck or self._reversed):
            return data
        lines = b"".join(self._feedback.feed(data))
        if now + EPSILON < self.at:
            self._readings.update((part[1], part[0]) for part in _PART.finditer(lines))
            return lines
        return _PART.sub(self._read, lines)

    def _read(self, part: re.Match[bytes]) -> bytes:
        """One motor's part of a feedback line."""
        motor, direction, digits = part.groups()
        if motor in self._stuck:
            return self._readings.get(motor, motor + STOPPED)
        if motor in self._reversed and digits != b"00.00":
            return motor + (b"n" if direction == b"p" else b"p") + digits
        return part[0]


LINE_FAULTS = ("dropped_lines", "duplicated_lines", "cut_lines", "corrupted_lines", "late_lines")
"""In the order of their kinds, see `lots.lot`."""
DROPPED, LATE = LINE_FAULTS.index("dropped_lines"), LINE_FAULTS.index("late_lines")
_RATES = ("garbage_rate", "board_reset_rate", "brown_out_rate", "unplug_rate")
_WHEELS = ("stuck_encoders", "reversed_encoders", "dead_wheels")
_WHEN = ("board_reset_at", "brown_out_at", "unplug_at")
_TIMES = ("lateness", "reset_time", "brown_out_time")

Check = Callable[[Any], bool]


def _within(least: float, most: float, kind: Any = (int, float, np.number)) -> Check:
    """Make a check whether a value is a number in a range; True and False aren't numbers."""
    return lambda value: (
        isinstance(value, kind) and not isinstance(value, bool) and bool(least <= value <= most)
    )


_is_count = _within(0, len(MOTORS), (int, np.integer))
_is_time = _within(0.0, LONGEST)
_is_finite = _within(0.0, sys.float_info.max)


def _holds(is_sound: Check, value: Any) -> bool:
    """Whether a check passes; not for values that it can't compare."""
    try:
        return bool(is_sound(value))
    except (TypeError, ValueError, OverflowError):  # an array, or an int too long for a float
        return False


def _are_wheels(value: Any) -> bool:
    """Whether a value names motors, or is a number of them."""
    if isinstance(value, str):
        return set(value) <= set(MOTORS) and len(set(value)) == len(value)
    return _is_count(value)


_RULES: dict[str, tuple[Check, str]] = {
    "direction": (lambda value: value in get_args(Direction), "feedback, commands or both"),
    **dict.fromkeys(("episodes", *LINE_FAULTS), (_within(0.0, 1.0), "a share, 0 to 1")),
    **dict.fromkeys(_RATES, (_within(0.0, HIGHEST_RATE), f"0 to {HIGHEST_RATE:g} per second")),
    **dict.fromkeys(_TIMES, (_is_time, f"0 to {LONGEST:g} s")),
    **dict.fromkeys(_WHEN, (lambda value: value is None or _is_finite(value), "None, or 0 s on")),
    **dict.fromkeys(_WHEELS, (_are_wheels, f"letters of {MOTORS}, each once, or how many, 0 to 4")),
    "wheel_faults_at": (_is_finite, "0 s or more"),
    "replug_time": (lambda value: value == math.inf or _is_time(value), f"0 to {LONGEST:g} s, inf"),
    "garbage_bytes": (
        _within(1, LARGEST_BURST, (int, np.integer)),
        f"a whole number, 1 to {LARGEST_BURST}",
    ),
}
