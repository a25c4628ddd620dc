"""Obstacles that move: circles, each with a motion that is a closed form of time.

A motion is a sequence of pieces. In each piece x and y are cubic polynomials of the time since the
piece began, which is exact for straight lines, pauses, and the splines through key frames that
Gazebo draws. So one robot and a batch, a replay and an emulator know where a mover is at any time.
`locate_mover` says it, written once; Python and compiled loops call it.

A mover that `reacts` is a person who walks towards where the motion is, and keeps a distance from
the robot and from others, see `crowd`.
"""

from __future__ import annotations

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
PERSON_RADIUS = 0.25  # of a person seen from above at the LiDAR's height [m]
WALKING_SPEED = 1.34
"""Mean speed at which people like to walk [m/s]: Helbing & Molnar, Physical Review E 51 (1995)."""
MAX_MOVERS = 200  # movers of a world, at most
MAX_PIECES = 10_000  # pieces of all motions of a world, at most
MAX_MOVER_SPEED = 20.0  # faster motions are refused, but for jumps [m/s]
LEAST_LINE_TIME = 1e-6  # a line that takes less is left out [s]
MAX_PLACE = 1e4  # motions beyond this are refused, as obstacles are [m]
SPEED_SAMPLES = 8  # parts of a piece between which its speed is computed
PIECE_NUMBERS = 9
"""Begin of a piece [s], four coefficients of x and four of y, the constant ones first [m, s]."""


class Repeat(IntEnum):
    """What follows when a motion has come to its end."""

    STOP = 0
    """The mover stays there."""
    BACK = 1
    """It goes back the same way, and so on."""
    LOOP = 2
    """It begins anew where it began: a closed way, or a jump."""


@dataclass(frozen=True, eq=False)
class Mover:
    """A circle that moves. Immutable; `walk` and `follow_keys` make one.

    Raises WorldError for shapes and numbers that can't be used.
    """

    pieces: Floats
    """(pieces, 9): begin [s], x0, x1, x2, x3, y0, y1, y2, y3 of each piece, the first one at 0: in
    the frame of the world x = x0 + x1 s + x2 s^2 + x3 s^3, s being the time since its begin."""
    duration: float
    """Of the whole motion [s]."""
    radius: float = PERSON_RADIUS
    """[m]."""
    repeat: Repeat = Repeat.BACK
    phase: float = 0.0
    """Time in the motion at which an episode begins [s]."""
    spread: float = 0.0
    """Up to so much is added to the phase, drawn for each episode [s]; 0: always the same."""
    reacts: bool = False
    """Whether this is a person who keeps a distance."""
    sees_robot: bool = True
    """Whether a person who reacts sees the robot."""
    name: str = ""
    """For pictures and messages."""

    def __post_init__(self) -> None:
        named = f"mover {show_value(self.name)}" if self.name else "mover"
        try:
            pieces = np.array(self.pieces, np.float64)
            numbers = np.array([self.duration, self.radius, self.phase, self.spread], np.float64)
        except (TypeError, ValueError) as error:
            raise WorldError(f"{named}: must be numbers") from error
        if pieces.ndim != 2 or pieces.shape[1] != PIECE_NUMBERS or not len(pieces):
            raise WorldError(f"{named}: pieces must be rows of {PIECE_NUMBERS} numbers")
        if not (np.isfinite(pieces).all() and np.isfinite(numbers).all()):
            raise WorldError(f"{named}: must be finite numbers")
        begins = pieces[:, 0]
        if begins[0] != 0.0 or (np.diff(begins) <= 0.0).any() or self.duration <= begins[-1]:
            raise WorldError(
                f"{named}: its times must grow from 0 on, and end at its duration "
                f"({self.duration:g} s)"
            )
        if self.radius <= 0.0 or self.spread < 0.0:
            raise WorldError(f"{named}: its radius must be above 0, its spread not negative")
        if np.abs(pieces[:, [1, 5]]).max() > MAX_PLACE:
            raise WorldError(f"{named}: its places must be at most {MAX_PLACE:g} m")
        try:
            repeat = Repeat(self.repeat)
        except ValueError as error:
            raise WorldError(
                f"{named}: repeat: {show_value(self.repeat)}: must be of Repeat"
            ) from error
        pieces.setflags(write=False)
        object.__setattr__(self, "pieces", pieces)
        object.__setattr__(self, "repeat", repeat)
        if not self.top_speed <= MAX_MOVER_SPEED:
            raise WorldError(
                f"{named}: moves at {self.top_speed:.1f} m/s, at most {MAX_MOVER_SPEED:g}"
            )

    @property
    def cycle(self) -> float:
        """Time after which the motion repeats itself [s]; inf where it stops."""
        return (math.inf, 2.0 * self.duration, self.duration)[self.repeat]

    @cached_property
    def top_speed(self) -> float:
        """An upper bound of its speed, but for jumps; exact on straight lines [m/s].

        Between two samples a velocity that is quadratic in time is at most
        |its second derivative| * spacing^2 / 8 from the line between them.
        """
        lengths = np.diff(np.append(self.pieces[:, 0], self.duration))
        shares = np.linspace(0.0, 1.0, SPEED_SAMPLES + 1) * lengths[:, None]
        with np.errstate(over="ignore", invalid="ignore"):
            vx, vy = (
                self.pieces[:, [k]]
                + 2.0 * shares * self.pieces[:, [k + 1]]
                + 3.0 * shares**2 * self.pieces[:, [k + 2]]
                for k in (2, 6)
            )
            bend = 6.0 * np.hypot(*self.pieces[:, [4, 8]].T)
            between = bend * (lengths / SPEED_SAMPLES) ** 2 / 8.0
            return float((np.hypot(vx, vy).max(axis=1) + between).max())

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """Least x and y, largest x and y of its disc in the whole motion [m]."""
        lengths = np.diff(np.append(self.pieces[:, 0], self.duration))
        least, most = [], []
        for x0, x1, x2, x3 in (self.pieces[:, 1:5].T, self.pieces[:, 5:].T):
            with np.errstate(all="ignore"):  # the two times at which the speed is 0
                q = -x2 - np.copysign(np.sqrt(np.maximum(x2**2 - 3.0 * x1 * x3, 0.0)), x2)
                turns = np.nan_to_num([q / (3.0 * x3), x1 / q])
            times = np.clip([0.0 * lengths, lengths, *turns], 0.0, lengths)
            places = x0 + times * (x1 + times * (x2 + times * x3))
            least.append(float(places.min()) - self.radius)
            most.append(float(places.max()) + self.radius)
        return least[0], least[1], most[0], most[1]

    def position(self, time: float, share: float = 0.0) -> tuple[float, float]:
        """Where the motion is [m] at a time since the episode's begin [s].

        `share` is the episode's draw, 0 to 1, of its `spread`.
        """
        x, y, _, _ = locate_alone(*_arrays_of(self), time, share)
        return x, y

    def velocity(self, time: float, share: float = 0.0) -> tuple[float, float]:
        """Its velocity [m/s], as `position`."""
        _, _, vx, vy = locate_alone(*_arrays_of(self), time, share)
        return vx, vy


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
        points: (n, 2), in the frame of the world [m]; one point alone is a mover that stands.
        speed: of all lines, or of each [m/s].
        pauses: how long it stands at each point, the first one included, or at each its own [s].
        repeat: what follows at the end; with LOOP it walks on to the first point.
        name: as in `Mover`.
        **options: other fields of `Mover`, such as radius=0.3, phase=2.0, reacts=True.

    Raises:
        WorldError: for numbers that can't be used.

    Example:
        >>> mover = walk([[0, 0], [4, 0]], speed=1.0)
        >>> mover.velocity(3.0), mover.position(6.0)
        ((1.0, 0.0), (2.0, 0.0))
    """
    try:
        ways = np.atleast_2d(np.array(points, np.float64))
        rests = np.broadcast_to(np.array(pauses, np.float64), len(ways))
        closed = repeat == Repeat.LOOP and len(ways) > 1
        line_count = len(ways) if closed else max(len(ways) - 1, 0)
        speeds = np.broadcast_to(np.array(speed, np.float64), line_count)
    except (TypeError, ValueError) as error:
        raise WorldError(
            f"mover {name!r}: needs points (x, y), a speed for all lines or one for each, and a "
            "pause for all points or one for each"
        ) from error
    finite = all(np.isfinite(numbers).all() for numbers in (ways, rests, speeds))
    if not (
        len(ways)
        and ways.shape[1:] == (2,)
        and finite
        and (speeds > 0.0).all()
        and (rests >= 0.0).all()
    ):
        raise WorldError(
            f"mover {name!r}: needs points (x, y), speeds above 0, and pauses that aren't "
            "negative; all of them finite"
        )
    times, places = [0.0], [ways[0]]
    for number, place in enumerate(ways):
        if rests[number] > 0.0:
            times.append(times[-1] + float(rests[number]))
            places.append(place)
        if number < line_count:
            target = ways[(number + 1) % len(ways)]
            arrival = times[-1] + math.dist(place, target) / float(speeds[number])
            if arrival > times[-1] + LEAST_LINE_TIME:
                times.append(arrival)
                places.append(target)
    if len(times) == 1:
        times.append(1.0)
        places.append(ways[0])
    return follow_keys(times, places, repeat=repeat, name=name, **options)


def follow_keys(
    times: ArrayLike,
    points: ArrayLike,
    *,
    smooth: bool = False,
    tension: float = 0.0,
    repeat: Repeat = Repeat.LOOP,
    name: str = "",
    **options: Any,
) -> Mover:
    """Make a mover that is at a point at each of some times, such as Gazebo's key frames.

    Args:
        times: (n,), growing, n being at least 2; the first one is the begin of the motion [s].
        points: (n, 2), in the frame of the world [m].
        smooth: whether the points lie on a spline, as Gazebo's animations do, or on straight lines.
            In each piece the spline is a cubic Hermite polynomial, whose tangents are
            (1 - tension) / 2 times the step between the neighbours of a point, also at the ends
            of a closed one, whose first and last points are the same (gz-math, src/Spline.cc).
        tension: of the spline, 0 to 1; 1 stands still at every point.
        repeat: what follows at the end; with LOOP it jumps to the first point.
        name: as in `Mover`.
        **options: other fields of `Mover`, such as radius=0.3, phase=2.0, reacts=True.

    Raises:
        WorldError: for numbers that can't be used.

    Example:
        >>> mover = follow_keys([0, 2, 3], [[0, 0], [4, 0], [4, 1]])
        >>> mover.position(1.0), mover.velocity(2.5)
        ((2.0, 0.0), (0.0, 1.0))
    """
    try:
        at = np.array(times, np.float64).ravel()
        places = np.array(points, np.float64)
        sound = len(at) >= 2 and places.shape == (len(at), 2) and bool((np.diff(at) > 0.0).all())
    except (TypeError, ValueError):
        sound = False
    if not sound:
        raise WorldError(f"mover {name!r}: needs two times or more, growing, and a point for each")
    steps, lengths = np.diff(places, axis=0), np.diff(at)[:, None]
    pieces = np.zeros((len(steps), PIECE_NUMBERS))
    pieces[:, 0] = at[:-1] - at[0]
    pieces[:, [1, 5]] = places[:-1]
    if smooth:
        closed = len(places) > 2 and bool((places[0] == places[-1]).all())
        ends = (places[-2:-1], places[1:2]) if closed else (places[:1], places[-1:])
        around = np.concatenate([ends[0], places, ends[1]])
        tangents = (1.0 - tension) / 2.0 * (around[2:] - around[:-2])
        leave, arrive = tangents[:-1], tangents[1:]
        pieces[:, [2, 6]] = leave / lengths
        pieces[:, [3, 7]] = (3.0 * steps - 2.0 * leave - arrive) / lengths**2
        pieces[:, [4, 8]] = (leave + arrive - 2.0 * steps) / lengths**3
    else:
        pieces[:, [2, 6]] = steps / lengths
    return Mover(pieces, float(at[-1] - at[0]), repeat=repeat, name=name, **options)


def check_movers(movers: Sequence[Mover]) -> None:
    """Raise WorldError where these aren't the movers of one world."""
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
    """(worlds, movers, MOVER_NUMBERS); unused rows have a radius of -1 and come last."""
    pieces: Floats
    """(worlds, pieces, 9): those of all movers of a world, one after the other."""
    reacting: NDArray[np.bool_]
    """(worlds,): whether anybody reacts."""


class MoverRow(NamedTuple):
    """The columns of `Motions.movers`."""

    radius: float
    repeat: float
    first_piece: float
    """Place of its first piece."""
    piece_count: float
    duration: float
    cycles: float
    """How often it repeats itself in a second; 0 where it stops."""
    phase: float
    spread: float
    reacts: float
    sees_robot: float
    speed: float
    """Its top speed [m/s]."""


RADIUS, REPEAT, FIRST, COUNT, DURATION, CYCLES, PHASE, SPREAD, REACTS, SEES_ROBOT, SPEED = range(
    len(MoverRow._fields)
)


def make_motions(crowds: Sequence[Sequence[Mover]]) -> Motions:
    """Make the arrays of the movers of each of some worlds."""
    most = max((len(movers) for movers in crowds), default=0)
    longest = max((sum(len(one.pieces) for one in movers) for movers in crowds), default=0)
    rows = np.full((max(len(crowds), 1), most, len(MoverRow._fields)), -1.0)
    pieces = np.zeros((max(len(crowds), 1), longest, PIECE_NUMBERS))
    for world, movers in enumerate(crowds):
        first = 0
        for number, mover in enumerate(movers):
            count = len(mover.pieces)
            pieces[world, first : first + count] = mover.pieces
            rows[world, number] = MoverRow(
                mover.radius,
                mover.repeat,
                first,
                count,
                mover.duration,
                1.0 / mover.cycle,
                mover.phase,
                mover.spread,
                mover.reacts,
                mover.sees_robot,
                mover.top_speed,
            )
            first += count
    return Motions(rows, pieces, np.any(rows[:, :, REACTS] > 0.0, axis=1))


def _arrays_of(mover: Mover) -> tuple[Floats, Floats]:
    motions = make_motions([[mover]])
    return motions.movers[0], motions.pieces[0]


@jit
def draw_offset(movers: Floats, m: int, key: float) -> float:
    """Time in the motion of mover m at which an episode of this key begins [s]."""
    offset: float = movers[m, PHASE] + movers[m, SPREAD] * hash_sample(key, m)
    return offset


@subroutine
def locate_mover(
    movers: Floats, m: int, pieces: Floats, clock: float
) -> tuple[float, float, float, float]:
    """Where a mover's motion is, and its velocity.

    Args:
        movers: of a world, as in `Motions`.
        m: which of them.
        pieces: of its world.
        clock: time since the episode's begin, and the offset of `draw_offset` [s].

    Returns:
        x, y [m] and their rates [m/s], in the frame of the world.
    """
    piece, s, direction = find_piece(movers, m, pieces, clock)
    x = pieces[piece, 1] + s * (pieces[piece, 2] + s * (pieces[piece, 3] + s * pieces[piece, 4]))
    y = pieces[piece, 5] + s * (pieces[piece, 6] + s * (pieces[piece, 7] + s * pieces[piece, 8]))
    vx = pieces[piece, 2] + s * (2.0 * pieces[piece, 3] + s * 3.0 * pieces[piece, 4])
    vy = pieces[piece, 6] + s * (2.0 * pieces[piece, 7] + s * 3.0 * pieces[piece, 8])
    return x, y, direction * vx, direction * vy


@jit
def find_piece(movers: Floats, m: int, pieces: Floats, clock: float) -> tuple[int, float, float]:
    """The piece that a mover is in, the time since its begin [s], and its direction: 1, -1, 0."""
    duration, direction = movers[m, DURATION], 1.0
    if movers[m, REPEAT] == 1.0:
        clock -= 2.0 * duration * np.floor(clock * movers[m, CYCLES])
        if clock > duration:
            clock, direction = 2.0 * duration - clock, -1.0
    elif movers[m, REPEAT] == 2.0:
        clock -= duration * np.floor(clock * movers[m, CYCLES])
    else:
        direction = 1.0 if 0.0 <= clock < duration else 0.0
        clock = min(max(clock, 0.0), duration)
    low = int(movers[m, FIRST])
    high = low + int(movers[m, COUNT]) - 1
    while low < high:
        middle = (low + high + 1) // 2
        if pieces[middle, 0] <= clock:
            low = middle
        else:
            high = middle - 1
    return low, clock - pieces[low, 0], direction


@subroutine
def goes_straight(movers: Floats, m: int, pieces: Floats, clock: float, ago: float) -> bool:
    """Whether a mover that doesn't react has kept its velocity for so long until a time [s]."""
    piece, s, direction = find_piece(movers, m, pieces, clock)
    for k in (3, 4, 7, 8):
        if pieces[piece, k] != 0.0:
            return False
    last = piece + 1 == int(movers[m, FIRST] + movers[m, COUNT])
    end = movers[m, DURATION] if last else pieces[piece + 1, 0]
    since = s if direction > 0.0 else end - pieces[piece, 0] - s
    return movers[m, REACTS] == 0.0 and direction != 0.0 and since >= ago


@jit
def may_jump(movers: Floats, m: int, clock: float, duration: float) -> bool:
    """Whether a motion that repeats itself begins anew within a duration from a time on [s]."""
    if movers[m, REPEAT] != 2.0:
        return False
    begun = np.floor(clock * movers[m, CYCLES])
    anew: bool = np.floor((clock + duration) * movers[m, CYCLES]) > begun
    return anew


@loop
def locate_alone(
    movers: Floats, pieces: Floats, time: float, share: float
) -> tuple[float, float, float, float]:
    """`locate_mover` of the only mover, for Python."""
    return locate_mover(movers, 0, pieces, time + movers[0, PHASE] + share * movers[0, SPREAD])
