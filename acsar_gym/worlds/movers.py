"""Obstacles that move: circles, each with a motion that is a closed form of time.

A motion is a sequence of pieces. In each piece x and y are cubic polynomials of the time since the
piece began. This is exact for straight lines, pauses, and the splines through key frames that
Gazebo draws. So a single robot, a batch, a replay and an emulator agree on where a mover is at any
time. `locate_mover` computes it, for Python and for compiled loops.

A mover that `reacts` is a person who walks towards where the motion is, and keeps a distance from
the robot and from other people, see `crowd`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acsar_gym.errors import WorldError, show_value
from acsar_gym.hashing import hash_sample
from acsar_gym.jit import jit, loop, subroutine

Floats = NDArray[np.float64]
Point = tuple[float, float]
Quad = tuple[float, float, float, float]
PERSON_RADIUS = 0.25  # of a person seen from above at the LiDAR's height [m]
WALKING_SPEED = 1.34
"""Mean speed at which people like to walk [m/s]: Helbing & Molnar, Physical Review E 51 (1995)."""
MAX_MOVERS = 200  # movers of a world, at most
MAX_PIECES = 10_000  # pieces of all motions of a world, at most
MAX_MOVER_SPEED = 20.0  # faster motions are refused, but for jumps [m/s]
LEAST_LINE_TIME = 1e-6  # a line or pause that takes less is left out [s]
MAX_PLACE = 1e4  # motions beyond this are refused, as obstacles are [m]
SPEED_SAMPLES = 8  # parts of a piece between which its speed is computed
BEGIN, X0, X1, X2, X3, Y0, Y1, Y2, Y3 = range(9)
"""Columns of a piece: its begin [s], and the coefficients of x and y, constant ones first [m, s]"""
PIECE_NUMBERS = 9  # columns of a piece


class Repeat(IntEnum):
    """What follows when a motion has come to its end."""

    STOP = 0
    """The mover stays there."""
    BACK = 1
    """The mover goes back the same way, and so on."""
    LOOP = 2
    """The motion starts again: on a closed way, or with a jump to its start."""


@dataclass(frozen=True, eq=False)
class Mover:
    """A circle that moves. It is immutable. `walk` and `follow_keys` make movers.

    Raises:
        WorldError: A field has a wrong shape, numbers that can't be used, or `repeat` isn't a
            Repeat.

    Example:
        >>> mover = Mover([[0, 1, 0.5, 0, 0, 2, 0, 0, 0]], duration=4.0)
        >>> mover.position(2.0)
        (2.0, 2.0)
    """

    pieces: Floats
    """(pieces, 9): begin [s], x0, x1, x2, x3, y0, y1, y2, y3 of each piece, the first one at 0. In
    the frame of the world x = x0 + x1 s + x2 s^2 + x3 s^3, s being the time since its begin."""
    duration: float
    """Duration of the whole motion [s]."""
    radius: float = PERSON_RADIUS
    """Radius of the circle [m]."""
    repeat: Repeat = Repeat.BACK
    phase: float = 0.0
    """Time in the motion at which an episode starts [s]."""
    spread: float = 0.0
    """Largest addition to the phase, drawn for each episode [s]."""
    reacts: bool = False
    """Whether this is a person who keeps a distance."""
    sees_robot: bool = True
    """Whether a person who reacts sees the robot."""
    name: str = ""
    """For pictures and messages."""

    def __post_init__(self) -> None:
        try:
            object.__setattr__(self, "repeat", Repeat(self.repeat))
        except ValueError as error:
            raise WorldError(
                f"mover {show_value(self.name)}: repeat = {show_value(self.repeat)}: must be a "
                "Repeat, such as Repeat.LOOP"
            ) from error
        object.__setattr__(self, "pieces", _to_floats(self.pieces))
        self.pieces.setflags(write=False)
        problem = self._find_problem()
        if problem:
            raise WorldError(f"mover {show_value(self.name)}: {problem}")

    def _find_problem(self) -> str:
        """What can't be used, in words, or empty if everything can."""
        if self.pieces.shape[1:] != (PIECE_NUMBERS,) or not np.isfinite(self.pieces).all():
            return f"pieces must be rows of {PIECE_NUMBERS} finite numbers"
        # In this order, because the later checks need what the earlier ones make sure.
        numbers = _to_floats([self.duration, self.radius, self.phase, self.spread])
        if not np.isfinite(numbers).all() or self.radius <= 0.0 or self.spread < 0.0:
            return "duration and phase must be finite numbers, radius above 0, spread not negative"
        if self.pieces[:1, BEGIN].tolist() != [0.0] or (self._lengths <= 0.0).any():
            return f"its times must grow from 0 on, and end at its duration ({self.duration:g} s)"
        if np.abs(self.pieces[:, [X0, Y0]]).max() > MAX_PLACE:
            return f"its places must be at most {MAX_PLACE:g} m"
        is_slow = self.top_speed <= MAX_MOVER_SPEED
        return "" if is_slow else f"moves at {self.top_speed:.1f} m/s, at most {MAX_MOVER_SPEED:g}"

    @cached_property
    def _lengths(self) -> Floats:
        """Duration of each piece [s], (pieces, 1)."""
        return np.diff(self.pieces[:, BEGIN], append=self.duration)[:, None]

    @cached_property
    def _coefficients(self) -> Floats:
        """Those of x and y, the constant ones first, (4, pieces, 2)."""
        return np.moveaxis(self.pieces[:, X0:].reshape(-1, 2, 4), 2, 0)

    @property
    def cycle(self) -> float:
        """Time after which the motion repeats itself [s], or infinity if it stops."""
        return (math.inf, 2.0 * self.duration, self.duration)[self.repeat]

    @cached_property
    def top_speed(self) -> float:
        """An upper bound of its speed, but for jumps, which is exact on straight lines [m/s].

        Between two samples a velocity that is quadratic in time is at most
        |its second derivative| * spacing^2 / 8 from the line between them.
        """
        _, x1, x2, x3 = self._coefficients
        with np.errstate(over="ignore", invalid="ignore"):
            bend = 6.0 * np.hypot(*x3.T) * (self._lengths[:, 0] / SPEED_SAMPLES) ** 2 / 8.0
            # Times in each piece, (samples, pieces, 1).
            s = np.linspace(0.0, 1.0, SPEED_SAMPLES + 1)[:, None, None] * self._lengths
            speeds = np.hypot(*(x1 + 2.0 * s * x2 + 3.0 * s**2 * x3).T)
            return float((speeds.max(axis=1) + bend).max())

    @cached_property
    def bounds(self) -> Quad:
        """Least x and y, largest x and y of its disc in the whole motion [m]."""
        x0, x1, x2, x3 = self._coefficients
        # A coordinate is least and largest at the ends, or when its rate is 0.
        with np.errstate(all="ignore"):
            q = -x2 - np.copysign(np.sqrt(np.maximum(x2**2 - 3.0 * x1 * x3, 0.0)), x2)
            turns = np.nan_to_num([q / (3.0 * x3), x1 / q])
        ends = np.zeros_like(x0)
        # Turns outside of a piece count as its ends.
        times = np.clip([ends, ends + self._lengths, *turns], 0.0, self._lengths)
        places = x0 + times * (x1 + times * (x2 + times * x3))
        min_x, min_y = (places.min(axis=(0, 1)) - self.radius).tolist()
        max_x, max_y = (places.max(axis=(0, 1)) + self.radius).tolist()
        return min_x, min_y, max_x, max_y

    def position(self, time: float, share: float = 0.0) -> Point:
        """Compute where the motion is.

        Args:
            time: Time since the episode's start [s].
            share: The episode's draw, 0 to 1, of `spread`.

        Returns:
            Place x, y in the frame of the world [m].
        """
        return self._locate(time, share)[:2]

    def velocity(self, time: float, share: float = 0.0) -> Point:
        """Compute the velocity of the motion [m/s], with the arguments of `position`."""
        return self._locate(time, share)[2:]

    def _locate(self, time: float, share: float) -> Quad:
        ((row,),), (pieces,), _ = make_motions([[self]])
        return locate_alone(row, pieces, time, share)


def walk(
    points: ArrayLike,
    speed: float | Sequence[float] = WALKING_SPEED,
    *,
    pauses: float | Sequence[float] = 0.0,
    repeat: Repeat = Repeat.BACK,
    name: str = "",
    **options: Any,
) -> Mover:
    """Make a mover that walks straight from point to point.

    Args:
        points: (n, 2), in the frame of the world [m]. A mover with a single point doesn't move.
        speed: Speed on all lines, or a list with the speed on each line [m/s].
        pauses: Pause at all points, the first one included, or a list with the pause at each [s].
        repeat: What follows at the end. With LOOP the mover walks on to the first point.
        name: Name of the mover.
        **options: Other fields of `Mover`, such as radius=0.3, phase=2.0, reacts=True.

    Returns:
        The mover.

    Raises:
        WorldError: The numbers can't be used.

    Example:
        >>> mover = walk([[0, 0], [4, 0]], speed=1.0)
        >>> mover.velocity(3.0), mover.position(6.0)
        ((1.0, 0.0), (2.0, 0.0))
    """
    stops = np.atleast_2d(_to_floats(points))
    count = len(stops)
    if repeat == Repeat.LOOP and count > 1:
        stops = np.append(stops, stops[:1], axis=0)
    rests = _to_floats(pauses, count)
    speeds = _to_floats(speed, max(len(stops) - 1, 0))
    is_finite = stops.shape[1:] == (2,) and np.isfinite([*stops.ravel(), *speeds, *rests]).all()
    if not is_finite or (speeds <= 0.0).any() or (rests < 0.0).any():
        raise WorldError(
            f"mover {name!r}: needs points (x, y), a speed above 0 for all lines or one for each, "
            "and a pause for all points or one for each, not negative; all of them finite"
        )

    # A pause, a line to the next stop, a pause there, and so on. A closed way ends with a line.
    durations = np.zeros(2 * len(stops) - 1)
    durations[: 2 * count : 2] = rests
    durations[1::2] = list(map(math.dist, stops, stops[1:])) / speeds
    if (durations <= LEAST_LINE_TIME).all():
        durations[0] = 1.0
    used = durations > LEAST_LINE_TIME
    times = np.cumsum([0.0, *durations[used]])
    places = [stops[0], *np.repeat(stops, 2, axis=0)[1:][used]]
    return follow_keys(times, places, repeat=repeat, name=name, **options)


def follow_keys(
    times: ArrayLike,
    points: ArrayLike,
    *,
    smooth: bool = False,
    repeat: Repeat = Repeat.LOOP,
    name: str = "",
    **options: Any,
) -> Mover:
    """Make a mover that is at a point at each of some times, such as Gazebo's key frames.

    Until the first time the mover is at rest at the first point.

    Args:
        times: (n,), at least two, growing, the first one not negative [s].
        points: (n, 2), in the frame of the world [m].
        smooth: Whether the points lie on a spline, as Gazebo's animations do, or on straight lines.
            In each piece the spline is a cubic Hermite polynomial, whose tangents are half the
            step between the neighbours of a point, also at the ends of a closed one, whose first
            and last points are the same (gz-math, src/Spline.cc, without tension).
        repeat: What follows at the last time. With LOOP the mover jumps to the first point.
        name: Name of the mover.
        **options: Other fields of `Mover`, such as radius=0.3, phase=2.0, reacts=True.

    Returns:
        The mover.

    Raises:
        WorldError: The numbers can't be used.

    Example:
        >>> mover = follow_keys([0, 2, 3], [[0, 0], [4, 0], [4, 1]])
        >>> mover.position(1.0), mover.velocity(2.5)
        ((2.0, 0.0), (0.0, 1.0))
    """
    key_times = _to_floats(times).ravel()
    places = _to_floats(points)
    lengths = np.diff(key_times)[:, None]
    # A growing series of times has positive steps only.
    is_growing = len(lengths) > 0 and key_times[0] >= 0.0 and bool((lengths > 0.0).all())
    if not is_growing or places.shape != (len(key_times), 2):
        raise WorldError(
            f"mover {name!r}: needs two times or more, growing, none of them negative, and a point "
            "for each"
        )

    origins = places[:-1]
    steps = np.diff(places, axis=0)
    if smooth:
        is_closed = len(places) > 2 and bool((places[0] == places[-1]).all())
        previous = places[-2 if is_closed else 0]
        following = places[1 if is_closed else -1]
        around = np.array([previous, *places, following])
        tangents = 0.5 * (around[2:] - around[:-2])
        leave = tangents[:-1]
        arrive = tangents[1:]
        bends = (3.0 * steps - 2.0 * leave - arrive) / lengths**2
        twists = (leave + arrive - 2.0 * steps) / lengths**3
        coefficients = [origins, leave / lengths, bends, twists]
    else:
        still = np.zeros_like(steps)
        coefficients = [origins, steps / lengths, still, still]

    pieces = np.column_stack([key_times[:-1], np.stack(coefficients, axis=2).reshape(-1, 8)])
    if key_times[0] > 0.0:  # at rest until then
        pieces = np.concatenate([np.zeros((1, PIECE_NUMBERS)), pieces])
        pieces[0, [X0, Y0]] = places[0]
    return Mover(pieces, float(key_times[-1]), repeat=repeat, name=name, **options)


def _to_floats(values: Any, count: int | None = None) -> Floats:
    """A copy as an array, or broadcast to a number of elements, or NaN if that is impossible."""
    try:
        array = np.array(values, np.float64)
        return array if count is None else np.broadcast_to(array, count)
    except (TypeError, ValueError, OverflowError):
        return np.full(count or 1, np.nan)


def check_movers(movers: Sequence[Mover]) -> None:
    """Raise WorldError if these aren't the movers of a world."""
    if not all(isinstance(mover, Mover) for mover in movers):
        raise WorldError(f"movers: {show_value(list(movers))}: must be of Mover")
    if len(movers) > MAX_MOVERS or sum(len(mover.pieces) for mover in movers) > MAX_PIECES:
        raise WorldError(
            f"movers: {len(movers)} are too many: at most {MAX_MOVERS}, whose motions have "
            f"{MAX_PIECES:,} pieces together"
        )


class Motions(NamedTuple):
    """The movers of many worlds, for compiled loops."""

    movers: Floats
    """(worlds, movers, MOVER_NUMBERS). Unused rows have a radius of -1 and come last."""
    pieces: Floats
    """(worlds, pieces, 9): those of all movers of a world, one after the other."""
    reacting: NDArray[np.bool_]
    """(worlds,): whether any mover reacts."""


RADIUS, REPEAT, FIRST, COUNT, DURATION, CYCLES, PHASE, SPREAD, REACTS, SEES_ROBOT, SPEED = range(11)
"""Columns of `Motions.movers`. FIRST is the place of the first piece, COUNT the number of pieces,
CYCLES how often the motion repeats itself in a second (0 if it stops), SPEED the top speed."""
MOVER_NUMBERS = 11  # columns of a mover


def pad_rows(rows: Sequence[Floats], unused: Sequence[float]) -> Floats:
    """Stack arrays of different lengths to (arrays, longest, numbers), padded with `unused`."""
    longest = max(map(len, rows), default=0)
    padded = np.tile(np.array(unused), (max(len(rows), 1), longest, 1))
    for number, array in enumerate(rows):
        padded[number, : len(array)] = array
    return padded


def make_motions(crowds: Sequence[Sequence[Mover]]) -> Motions:
    """Make the arrays of the movers of each of some worlds."""
    worlds = []
    pieces = []
    for movers in crowds:
        # Pieces of all movers of a world lie one behind the other.
        ends = itertools.accumulate(len(mover.pieces) for mover in movers)
        rows = [
            [  # in the order of the columns
                mover.radius,
                mover.repeat,
                end - len(mover.pieces),
                len(mover.pieces),
                mover.duration,
                1.0 / mover.cycle,
                mover.phase,
                mover.spread,
                mover.reacts,
                mover.sees_robot,
                mover.top_speed,
            ]
            for mover, end in zip(movers, ends, strict=True)
        ]
        worlds.append(np.array(rows, np.float64).reshape(-1, MOVER_NUMBERS))
        pieces.append(np.concatenate([np.zeros((0, PIECE_NUMBERS)), *(m.pieces for m in movers)]))

    padded = pad_rows(worlds, [-1.0] * MOVER_NUMBERS)
    reacting = np.any(padded[:, :, REACTS] > 0.0, axis=1)
    return Motions(padded, pad_rows(pieces, [0.0] * PIECE_NUMBERS), reacting)


@jit
def draw_offset(mover: Floats, number: int, key: float) -> float:
    """Time in the motion of a mover of this number at which an episode of this key starts [s]."""
    offset: float = mover[PHASE] + mover[SPREAD] * hash_sample(key, number)
    return offset


@subroutine
def locate_mover(mover: Floats, pieces: Floats, clock: float) -> Quad:
    """Where a mover's motion is, and its velocity.

    Args:
        mover: Row of `Motions.movers`.
        pieces: Those of its world.
        clock: Time since the episode's start, plus the offset of `draw_offset` [s].

    Returns:
        Place x, y [m] and its rates [m/s], in the frame of the world.
    """
    # On the way back the motion is the same, but its velocity is the opposite.
    number, s, direction = find_piece(mover, pieces, clock)
    x, vx = _evaluate(pieces[number], X0, s)
    y, vy = _evaluate(pieces[number], Y0, s)
    return x, y, direction * vx, direction * vy


@jit
def _evaluate(piece: Floats, k: int, s: float) -> Point:
    """The value and the rate of the polynomial of a piece whose first column is k."""
    x1 = piece[k + 1]
    x2 = piece[k + 2]
    x3 = piece[k + 3]
    return piece[k] + s * (x1 + s * (x2 + s * x3)), x1 + s * (2.0 * x2 + s * 3.0 * x3)


@jit
def find_piece(mover: Floats, pieces: Floats, clock: float) -> tuple[int, float, float]:
    """The piece that a mover is in, the time since its begin [s], and its direction: 1, -1, 0."""
    duration = mover[DURATION]
    direction = 1.0
    if mover[REPEAT] == 1.0:
        clock -= 2.0 * duration * np.floor(clock * mover[CYCLES])
        if clock > duration:
            clock = 2.0 * duration - clock
            direction = -1.0
    elif mover[REPEAT] == 2.0:
        clock -= duration * np.floor(clock * mover[CYCLES])
    else:
        direction = 1.0 if 0.0 <= clock < duration else 0.0
        clock = min(max(clock, 0.0), duration)

    # Bisect for the last piece that has begun.
    low = int(mover[FIRST])
    high = low + int(mover[COUNT]) - 1
    while low < high:
        middle = (low + high + 1) // 2
        if pieces[middle, BEGIN] <= clock:
            low = middle
        else:
            high = middle - 1
    return low, clock - pieces[low, BEGIN], direction


@subroutine
def goes_straight(mover: Floats, pieces: Floats, clock: float, ago: float) -> bool:
    """Whether a mover that doesn't react has kept its velocity for `ago` seconds until a time."""
    number, s, direction = find_piece(mover, pieces, clock)
    for k in (X2, X3, Y2, Y3):
        if pieces[number, k] != 0.0:
            return False

    # Towards the end of a piece counts backwards on the way back.
    is_last = number + 1 == int(mover[FIRST] + mover[COUNT])
    end = mover[DURATION] if is_last else pieces[number + 1, BEGIN]
    since = s if direction > 0.0 else end - pieces[number, BEGIN] - s
    return mover[REACTS] == 0.0 and direction != 0.0 and since >= ago


@jit
def may_jump(mover: Floats, clock: float, duration: float) -> bool:
    """Whether a motion that loops starts again within a duration from a time on [s]."""
    cycles = mover[CYCLES]
    starts_again: bool = np.floor((clock + duration) * cycles) > np.floor(clock * cycles)
    return mover[REPEAT] == 2.0 and starts_again


@loop
def locate_alone(mover: Floats, pieces: Floats, time: float, share: float) -> Quad:
    """`locate_mover`, for Python."""
    return locate_mover(mover, pieces, time + mover[PHASE] + share * mover[SPREAD])
