"""Faults of lines, encoders, wheels, the board, its supply and the cable, and a link that has them.

Bytes from driver to board pass these stages; bytes of the board pass them in the opposite order:

    driver -> cable (plugged in?) -> wire (lines, garbage) -> board (running?) -> wheels -> link
"""

from __future__ import annotations

import copy
import math
import re
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, LinkLostError, PortNotFoundError, show_value
from acsar_gym.hashing import hash_sample
from acsar_gym.jit import loop
from acsar_gym.links.base import WHILE_WAITING, Arrivals, ForwardingLink, Link
from acsar_gym.protocol import MAX_LINE, MOTORS, ZERO, Decoder, encode
from acsar_gym.worlds import Scene

MAX_EVENT_RATE = 1000.0  # highest rate of any event [1/s]
LONGEST_FAULT = 60.0  # longest duration of any fault [s]
LARGEST_BURST = 4096  # longest burst of garbage [bytes]
MAX_BURSTS = 16  # bursts of garbage in one period, at most
WIRE_BUFFER = 65536  # most bytes that wait behind a late line, as in a driver's buffer
TIME_TOLERANCE = 1e-9  # tolerance for comparing times that are sums of periods [s]
REPLUG_POLL = 0.01  # steps in which `open` waits for a cable to be plugged in again [s]
STOPPED_PART = b"p00.00"
STOP_COMMAND = b"\r\n" + encode(ZERO)
"""Command that stops the motors while the board isn't running; the line end ends a half command
that the board may have received before."""

LINE_FAULTS = ("dropped_lines", "duplicated_lines", "cut_lines", "corrupted_lines", "late_lines")
"""In the order of their kinds, see `line_hash`."""
DROPPED_LINE, LATE_LINE = LINE_FAULTS.index("dropped_lines"), LINE_FAULTS.index("late_lines")
OTHER_FAULTS = {
    **dict.fromkeys(("stuck_encoders", "reversed_encoders", "dead_wheels"), (0, "")),
    **dict.fromkeys(("garbage_rate", "board_reset_rate", "brown_out_rate", "unplug_rate"), (0,)),
    **dict.fromkeys(("board_reset_at", "brown_out_at", "unplug_at"), (None,)),
}
"""The other fields that cause faults, and their values without a fault."""

FEEDBACK_LINE, COMMAND_LINE, WHOLE_EPISODE = 0, 1, 2  # what a random number is for
FAULT_KINDS = 8  # largest number of kinds of faults per line


@loop
def line_hash(key: float, whose: int, number: float, kind: int) -> float:
    """Return a uniform random number in [0, 1) for one line and one kind of fault."""
    return hash_sample(key, (int(number) * 3 + whose) * FAULT_KINDS + kind)


def _check_number(value: Any) -> Any:
    """Refuse what pydantic would convert to a number, and convert NumPy's."""
    if isinstance(value, bool | str) or value is None:
        raise ValueError("be a number")
    return value.item() if isinstance(value, np.generic) else value


def _check_replug_time(value: float) -> float:
    if not (value <= LONGEST_FAULT or value == math.inf):
        raise ValueError(f"be 0 to {LONGEST_FAULT:g} s, or inf")
    return value


def _check_wheels(value: Any) -> str | int:
    if isinstance(value, str) and set(value) <= set(MOTORS) and len(set(value)) == len(value):
        return value
    if isinstance(value, int | np.integer) and not isinstance(value, bool) and 0 <= value <= 4:
        return int(value)
    raise ValueError(f"be letters of {MOTORS}, each once, or how many, 0 to 4")


Number = BeforeValidator(_check_number)
Share = Annotated[float, Field(ge=0.0, le=1.0), Number]
EventRate = Annotated[float, Field(ge=0.0, le=MAX_EVENT_RATE), Number]
FaultTime = Annotated[float, Field(ge=0.0, le=LONGEST_FAULT), Number]
ReplugTime = Annotated[
    float, Field(ge=0.0, allow_inf_nan=True), AfterValidator(_check_replug_time), Number
]
StartTime = Annotated[float, Field(ge=0.0), Number]
FaultyWheels = Annotated[str | int, BeforeValidator(_check_wheels)]


class Faults(Section):
    """Shares of lines, rates of events, and wheels that fail. By default there are no faults.

    An event with a rate comes at random, on average so many times a second; `*_at` is the time of
    the first one [s]. Faults of wheels, encoders, board, supply and cable begin with the drive:
    their clock starts anew after every reset, with the first command that turns wheels. Faults of
    lines and garbage occur at all times. Letters such as "ad" name wheels; a number is how many,
    drawn anew in every episode.

    A batch knows `dropped_lines`, `late_lines`, `lateness`, `episodes` and `direction`, and loses
    the same lines as the single env.

    Raises ConfigError for values out of range.
    """

    section = "faults"

    episodes: Share = 1.0
    """Share of episodes that have faults; the others have none."""
    direction: Literal["feedback", "commands", "both"] = "both"
    """Where lines have faults and garbage appears: "feedback", "commands" or "both"."""

    dropped_lines: Share = 0.0
    """Share of lines that never arrive."""
    duplicated_lines: Share = 0.0
    """Share of lines that arrive twice."""
    cut_lines: Share = 0.0
    """Share of lines that lose their tail, line end included, so that the next line is appended
    to them."""
    corrupted_lines: Share = 0.0
    """Share of lines in which one to three bytes arrive with one bit flipped."""
    late_lines: Share = 0.0
    """Share of lines that are delayed by `lateness`, and all lines behind them with them."""
    lateness: FaultTime = 0.05
    """Delay of a late line [s], rounded up to whole periods."""
    garbage_rate: EventRate = 0.0
    """Bursts of random bytes per second [1/s]."""
    garbage_bytes: Annotated[int, Field(ge=1, le=LARGEST_BURST, strict=True), Number] = 64
    """Length of a burst [bytes]."""

    stuck_encoders: FaultyWheels = 0
    """Encoders that repeat the reading they had at `wheel_faults_at`; at the start that is 0."""
    reversed_encoders: FaultyWheels = 0
    """Encoders with the wrong sign: p instead of n, and n instead of p."""
    dead_wheels: FaultyWheels = 0
    """Wheels whose commands become zero on the board; their encoders still work."""
    wheel_faults_at: StartTime = 0.0
    """When encoders and wheels fail [s after the drive's start]; with 0 they fail before it,
    too."""

    board_reset_rate: EventRate = 0.0
    """Resets of the board per second [1/s]."""
    board_reset_at: StartTime | None = None
    """When the first reset of the board happens [s after the drive's start]."""
    reset_time: FaultTime = 2.0
    """For how long a board that resets doesn't run: motors off, no input, no output [s]."""
    brown_out_rate: EventRate = 0.0
    """Dips of the supply per second [1/s]."""
    brown_out_at: StartTime | None = None
    """When the first dip happens [s after the drive's start]."""
    brown_out_time: FaultTime = 0.3
    """For how long a board doesn't run in a dip: motors off, no input, no output [s]."""
    unplug_rate: EventRate = 0.0
    """How often the cable is pulled [1/s]."""
    unplug_at: StartTime | None = None
    """When the cable is pulled [s after the drive's start]."""
    replug_time: ReplugTime = 1.0
    """Time until it is plugged in again, under another device's name [s]; inf: never."""

    @classmethod
    def of(cls, faults: Mapping[str, Any] | Faults | None) -> Faults:
        """Return the Faults that users mean by `faults=`; ConfigError for what they can't."""
        if isinstance(faults, Faults):
            return faults
        if faults is not None and not isinstance(faults, Mapping):
            raise ConfigError(
                f"faults = {show_value(faults)}: must be a mapping such as dropped_lines: 0.01"
            )
        return cls.model_validate({str(name): value for name, value in (faults or {}).items()})

    @property
    def lines_suffer(self) -> bool:
        """Whether any share of lines with a fault is above zero."""
        return any(getattr(self, name) for name in LINE_FAULTS)

    @property
    def possible(self) -> bool:
        """Whether any fault can occur."""
        others = any(getattr(self, name) not in none for name, none in OTHER_FAULTS.items())
        return self.episodes > 0.0 and (self.lines_suffer or others)


@dataclass(frozen=True, slots=True)
class WheelFaults:
    """Which motors have which fault in an episode, as letters; "" for none."""

    stuck: str = ""
    reversed: str = ""
    dead: str = ""

    @classmethod
    def draw(cls, faults: Faults, rng: np.random.Generator) -> Self:
        """Take the named wheels, and draw as many as are asked for by number."""

        def draw_letters(wheels: str | int) -> str:
            if isinstance(wheels, str):
                return wheels
            return "".join(sorted(rng.choice(list(MOTORS), wheels, replace=False).tolist()))

        return cls(
            draw_letters(faults.stuck_encoders),
            draw_letters(faults.reversed_encoders),
            draw_letters(faults.dead_wheels),
        )


class LineSplitter:
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


_LINE_PART = re.compile(rb"(?<![^,\r\n])([abcd])([pn])([0-9]{2}\.[0-9]{2})(?![^,\r\n])")


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
        self._commands, self._feedback = LineSplitter(), LineSplitter()

    def drop_partial(self) -> None:
        """Forget incomplete lines."""
        self._commands.partial = self._feedback.partial = b""

    def edit_commands(self, data: bytes, now: float) -> bytes:
        """Return commands with zeros for dead wheels."""
        if not self._dead:
            return data
        lines = b"".join(self._commands.feed(data))
        if now + TIME_TOLERANCE < self.at:
            return lines
        return _LINE_PART.sub(lambda p: p[1] + STOPPED_PART if p[1] in self._dead else p[0], lines)

    def edit_feedback(self, data: bytes, now: float) -> bytes:
        """Return feedback with the readings of failed encoders."""
        if not (self._stuck or self._reversed):
            return data
        lines = b"".join(self._feedback.feed(data))
        if now + TIME_TOLERANCE < self.at:
            self._readings.update((part[1], part[0]) for part in _LINE_PART.finditer(lines))
            return lines
        return _LINE_PART.sub(self._misread, lines)

    def _misread(self, part: re.Match[bytes]) -> bytes:
        motor, direction, digits = part.groups()
        if motor in self._stuck:
            return self._readings.get(motor, motor + STOPPED_PART)
        if motor in self._reversed and digits != b"00.00":
            return motor + (b"n" if direction == b"p" else b"p") + digits
        return part[0]


class FaultEvent:
    """An event that begins at a set time or at random at a rate [1/s], and has a duration [s].

    Times count from `start` on.
    """

    def __init__(
        self,
        name: str,
        lasting: float,
        faults: Faults,
        count: Counter[str],
        rng: np.random.Generator,
    ) -> None:
        self._name, self._lasting, self._rng, self._count = name, lasting, rng, count
        self._rate: float = getattr(faults, f"{name}_rate")
        after: float | None = getattr(faults, f"{name}_at")
        self._after = self._draw_pause() if after is None else after
        self._next = math.inf
        self._until = -math.inf

    def start(self, now: float) -> None:
        """Start the clock; before that the event can't begin."""
        self._next = now + self._after

    def _draw_pause(self) -> float:
        return float(self._rng.exponential(1.0 / self._rate)) if self._rate else math.inf

    def is_going(self, now: float) -> bool:
        """Whether the event is going on now; counts it when it begins."""
        if now + TIME_TOLERANCE >= max(self._next, self._until):
            self._count[self._name] += 1
            self._until = now + self._lasting
            self._next = self._until + self._draw_pause()
        return now + TIME_TOLERANCE < self._until


class FaultyWire:
    """One direction of the cable. Lines keep their order: none overtakes a late one."""

    def __init__(
        self,
        faults: Faults,
        direction: str,
        key: float,
        rng: np.random.Generator,
        count: Counter[str],
    ) -> None:
        here = faults.direction in (direction, "both")
        self._suffers = here and faults.lines_suffer
        shares = [(name, n, getattr(faults, name)) for n, name in enumerate(LINE_FAULTS)]
        self._shares = [(name, kind, share) for name, kind, share in shares if share]
        self._whose = FEEDBACK_LINE if direction == "feedback" else COMMAND_LINE
        self._key, self._number = key, 0
        self._lateness = faults.lateness
        self._burst_rate = faults.garbage_rate if here else 0.0
        self._burst = faults.garbage_bytes
        self._rng, self._count = rng, count
        self._lines = LineSplitter()
        self._queue: deque[tuple[float, bytes]] = deque()
        self._waiting = 0

    def drop_partial(self) -> None:
        """Forget an incomplete line."""
        self._lines.partial = b""

    def carry(self, data: bytes, now: float) -> bytes:
        """Put bytes in, and return those that come out at the other end now."""
        if not self._suffers:
            return data
        for line in self._lines.feed(data):
            self._send(line, now)
        out = b""
        while self._queue and self._queue[0][0] <= now + TIME_TOLERANCE:
            out += self._queue.popleft()[1]
        self._waiting -= len(out)
        return out

    def _send(self, line: bytes, now: float) -> None:
        hits: set[str] = set()
        if line.strip():  # the second half of a line end that was split isn't a line
            key, whose, number = self._key, self._whose, self._number
            hits = {name for name, n, p in self._shares if line_hash(key, whose, number, n) < p}
            self._number += 1
        if "dropped_lines" in hits:
            self._count["dropped_lines"] += 1
            return
        self._count.update(hits)
        if "cut_lines" in hits:
            line = line[: self._rng.integers(len(line))]
        if "corrupted_lines" in hits and line:
            bent = bytearray(line)
            most = min(3, len(line))
            places = self._rng.choice(len(line), self._rng.integers(1, most + 1), replace=False)
            for place in places:
                bent[place] ^= 1 << int(self._rng.integers(8))
            line = bytes(bent)
        line *= 1 + ("duplicated_lines" in hits)
        if line and (not self._queue or self._waiting + len(line) <= WIRE_BUFFER):
            self._queue.append((now + self._lateness * ("late_lines" in hits), line))
            self._waiting += len(line)

    def add_garbage(self, data: bytes, period: float) -> bytes:
        """Insert garbage into the bytes of a period [s]."""
        if not self._burst_rate:
            return data
        bursts = min(int(self._rng.poisson(self._burst_rate * period)), MAX_BURSTS)
        for _ in range(bursts):
            place = self._rng.integers(len(data) + 1)
            data = data[:place] + self._rng.bytes(self._burst) + data[place:]
            self._count["garbage"] += 1
        return data


FaultSeed = int | np.integer[Any] | np.random.Generator | None


class FaultyLink(ForwardingLink):
    """Passes bytes to and from another link, with faults; without faults it changes nothing.

    `reset` draws the faults of the episode; before the first reset there are none. The same seed,
    resets and input give the same bytes. Times are those of the link's own clock, so a simulation
    isn't slowed down.

    While the cable is out, `write` and `advance` raise LinkLostError until the link is opened
    again: `open` waits for the rest of `replug_time`, or raises PortNotFoundError where the cable
    stays out. The device then has another name.

    Attributes: `faults`; `injected`, how often each fault has happened since the last reset, by
    name; `wheels`, the wheels that fail in this episode; `device`; `link`, the link behind it.
    """

    def __init__(
        self,
        link: Link,
        faults: Mapping[str, Any] | Faults | None,
        seed: FaultSeed = None,
    ) -> None:
        super().__init__(link)
        self.faults = Faults.of(faults)
        self.injected: Counter[str] = Counter()
        self.wheels = WheelFaults()
        self._first_seed = copy.deepcopy(seed)  # a generator goes on
        self._replugs = 0
        self._back_at: float | None = None
        self._episode: _EpisodeFaults | None = None
        self.seed(seed)

    def seed(self, seed: FaultSeed) -> None:
        """Set what the next resets draw from; ConfigError for what is no seed."""
        if isinstance(seed, np.random.Generator):
            self._key = float(seed.random())
            self._rng = _make_generator(self._key)
            return
        if seed is not None and (not isinstance(seed, int | np.integer) or seed < 0):
            raise ConfigError(f"seed = {seed!r}: must be a whole number, 0 or more")
        self._rng = np.random.default_rng(seed)
        self._key = float(self._rng.random())

    @property
    def device(self) -> str:
        """Name of the device; links without one are called robot0, and after a replug robot1."""
        return str(getattr(self.link, "device", f"robot{self._replugs}"))

    def open(self) -> None:
        """Open the link; where the cable was pulled, wait until it is plugged in again.

        Raises:
            PortNotFoundError: the cable stays out.
        """
        if self._back_at is None:
            self.link.open()
            return
        wait = self._back_at - self.link.now()
        if wait == math.inf:
            raise PortNotFoundError(f"{self.device}: no such device", "plug the cable in again")
        try:
            self.link.open()
            for _ in range(math.ceil(wait / REPLUG_POLL - TIME_TOLERANCE)):
                WHILE_WAITING.get()()
                self.link.advance(REPLUG_POLL)
        except BaseException:
            self.link.close()
            raise
        self._back_at = None
        self._replugs += 1

    def reset(self, scene: Scene) -> None:
        """Reset the link, end the faults of the last episode and draw those of the new one."""
        self._check_cable()
        self.link.reset(scene)
        self.injected.clear()
        self.wheels, self._episode = WheelFaults(), None
        key, self._key = self._key, float(self._rng.random())
        if self.faults.possible and line_hash(key, WHOLE_EPISODE, 0.0, 0) < self.faults.episodes:
            generators = _make_generator(key).spawn(3)
            self.wheels = WheelFaults.draw(self.faults, generators[-1])
            self._episode = _EpisodeFaults(self, key, generators)

    def write(self, data: bytes) -> None:
        """Send bytes; faults may change or lose them."""
        if self._episode is not None:
            self._episode.watch(data, self.link.now())
        self._check_cable()
        if self._episode is not None:
            data = self._episode.pass_commands(data, self.link.now())
        if data or self._episode is None:
            self.link.write(data)

    def advance(self, period: float) -> bytes:
        """Let a period pass [s], and return the feedback bytes after all faults."""
        self._check_cable()
        episode = self._episode
        if episode is None:
            return self.link.advance(period)
        due = episode.release_commands(self.link.now(), period)
        if due:
            self.link.write(due)
        data = self.link.advance(period)
        return episode.pass_feedback(data, self.link.now(), period)

    def _check_cable(self) -> None:
        """Raise LinkLostError where the cable is out; when it is pulled, close the link behind."""
        if self._episode is not None and self._episode.unplug.is_going(self.link.now()):
            self._back_at = self.link.now() + self.faults.replug_time
            self.close()
        if self._back_at is not None:
            raise LinkLostError(
                f"{self.device}: lost while in use (unplugged)",
                "check the cable, then open the link again, or reset",
            )

    @property
    def arrivals(self) -> Arrivals:
        """Nothing: faults change the bytes that arrived."""
        return []

    def __reduce__(self) -> tuple[type[FaultyLink], tuple[object, ...]]:
        """Copies and pickles have a link of their own and begin with the first seed."""
        return FaultyLink, (self.link, self.faults, self._first_seed)

    def close(self) -> None:
        """Close the link. Faults end until the next reset, but a pulled cable stays out."""
        self._episode = None
        self.link.close()


def _make_generator(key: float) -> np.random.Generator:
    """The generator of all faults except those of `line_hash`; `key` is a number of [0, 1)."""
    return np.random.default_rng(int(key * 2**53))


class _EpisodeFaults:
    """The faults between two resets; feedback, commands and events have generators of their own."""

    def __init__(self, link: FaultyLink, key: float, generators: list[np.random.Generator]) -> None:
        faults, count = link.faults, link.injected
        feedback, commands, events = generators
        self._feedback = FaultyWire(faults, "feedback", key, feedback, count)
        self._commands = FaultyWire(faults, "commands", key, commands, count)
        self._wheels = WheelEditor(link.wheels, math.inf if faults.wheel_faults_at else -math.inf)
        self._wheels_fail_after = faults.wheel_faults_at
        self._outages = (
            FaultEvent("board_reset", faults.reset_time, faults, count, events),
            FaultEvent("brown_out", faults.brown_out_time, faults, count, events),
        )
        self.unplug = FaultEvent("unplug", math.inf, faults, count, events)
        self._waiting: Decoder | None = Decoder()

    def watch(self, data: bytes, now: float) -> None:
        """Start the clock of events with the first command of the driver that turns wheels."""
        if self._waiting is None or all(r.speeds == ZERO for r in self._waiting.feed(data)):
            return
        self._waiting = None
        self._wheels.at = now + self._wheels_fail_after
        for event in (*self._outages, self.unplug):
            event.start(now)

    def _is_down(self, now: float) -> bool:
        """Whether the board isn't running now, and so forgets incomplete lines."""
        reset, brown_out = (outage.is_going(now) for outage in self._outages)
        if reset or brown_out:
            for stream in (self._feedback, self._commands, self._wheels):
                stream.drop_partial()
        return reset or brown_out

    def pass_commands(self, data: bytes, now: float) -> bytes:
        """Return the bytes that reach the motors now, when the driver writes `data` now."""
        arrived = self._commands.carry(data, now)
        return b"" if self._is_down(now) else self._wheels.edit_commands(arrived, now)

    def release_commands(self, now: float, period: float) -> bytes:
        """Return other bytes that reach the motors in a period: late lines and garbage."""
        arrived = self._commands.add_garbage(self._commands.carry(b"", now), period)
        return STOP_COMMAND if self._is_down(now) else self._wheels.edit_commands(arrived, now)

    def pass_feedback(self, data: bytes, now: float, period: float) -> bytes:
        """Return what reaches the driver of `data`, sent in the period that ends now."""
        sent = b"" if self._is_down(now) else self._wheels.edit_feedback(data, now)
        return self._feedback.add_garbage(self._feedback.carry(sent, now), period)
