"""Measures a board while it is commanded: what it sends, which wheel answers, how soon it stops.

`doctor` calls this, and `identify` takes the rate of lines from it; motors and delays are fitted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from statistics import fmean, median
from typing import NamedTuple

import numpy as np

from acsar_gym.config import BITS_PER_BYTE, RobotConfig, WheelsConfig
from acsar_gym.links.base import Link, LinkWrapper
from acsar_gym.links.handshake import silence_error, still_turning_error
from acsar_gym.protocol import (
    ECHO_PROBE,
    MOTORS,
    PRINTED_STEP,
    ZERO,
    Decoder,
    Speeds,
    encode_line,
    line_end,
)
from acsar_gym.wire import Wire

PROBE_POLL = 0.001
"""Resolution of the times [s]."""
COMMAND_INTERVAL = 0.05
"""A command is repeated so often, to prevent the firmware's time-out [s]."""
RESET_GAP, SILENCE_TIMEOUT = 0.5, 3.0
"""A board that was silent so long in between was reset; so long, and it doesn't come back [s]. One
that was reset takes 1 to 2 s."""
LONGEST_STALL = 0.05
"""Time that this program was held up counts as silence of the board only up to this [s]."""
CLEAR_TIME = 0.1
"""Time in which old lines may arrive [s]."""
ECHO_TIME = 0.5
"""Time that an echo may take [s]."""
LISTEN_TIME = 2.0
"""Time for which feedback is counted [s]."""
TAIL_BYTES = 400
"""Newest bytes that are kept as they came."""


class FeedbackLine(NamedTuple):
    """A line of feedback."""

    stamp: float
    """When its last byte had arrived [s]."""
    speeds: Speeds
    """Speeds of the letters a, b, c, d [rad/s], not yet those of the wheels."""


class _TailLink(LinkWrapper):
    """Keeps the newest bytes that arrived."""

    tail = b""

    def advance(self, period: float) -> bytes:
        data = super().advance(period)
        self.tail = (self.tail + data)[-TAIL_BYTES:]
        return data


class BoardProbe:
    """Sends commands to the letters of a board, and hears its lines.

    Attributes: `lines`, all that came; `gaps`, how long the board was silent each time that it was
    reset [s]; `sent`, when the last byte of the newest command had left [s]; `trailing_comma` and
    `upper_case`, of the commands; `rate`, the lines that it sends per second [Hz], once
    `measure_feedback` has found it; `line_time`, how long a line takes on the wire [s].
    """

    def __init__(self, link: Link, config: RobotConfig) -> None:
        self._link = _TailLink(link)
        letters = config.with_(wheels=WheelsConfig().model_dump(), feedback_timeout=SILENCE_TIMEOUT)
        self._wire = Wire(self._link, letters, PROBE_POLL)
        self._wire.reset()
        self._byte_time = BITS_PER_BYTE / config.baud_rate
        self.line_time = config.line_time
        self.lines: list[FeedbackLine] = []
        self.trailing_comma = True
        self.upper_case = False
        self.rate = 0.0
        self.gaps: list[float] = []
        self.sent = 0.0
        self._quiet = 0.0

    @property
    def decoder(self) -> Decoder:
        """Decodes the lines; with counters of refused input."""
        return self._wire.decoder

    @property
    def newest_line(self) -> bytes:
        """The newest whole line as it came."""
        return self._link.tail.rpartition(b"\n")[0].rpartition(b"\n")[2].strip()

    def command(self, speeds: Speeds, order: str = MOTORS) -> None:
        """Send one command line.

        Args:
            speeds: of the letters a, b, c, d [rad/s].
            order: order of the letters in the line.
        """
        parts = encode_line(*speeds, b"").split(b",")
        line = b",".join(parts[MOTORS.index(letter)] for letter in order)
        line += line_end(trailing_comma=self.trailing_comma)
        self.sent = self._link.now() + len(line) * self._byte_time
        self._link.write(line.upper() if self.upper_case else line)

    def poll(self) -> list[FeedbackLine]:
        """Let PROBE_POLL pass, and return the lines that have arrived.

        Raises:
            BoardSilentError: nothing valid has arrived for SILENCE_TIMEOUT.
            LinkError: the link is lost, or there was an emergency stop.
        """
        heard, lasted = self._wire.exchange(None)
        self._quiet += min(lasted, LONGEST_STALL)
        if heard:
            if self._quiet > RESET_GAP:
                self.gaps.append(self._quiet)
            self._quiet = 0.0
        lines = [FeedbackLine(self._wire.stamp, speeds) for speeds in heard]
        self.lines += lines
        return lines

    def hear(
        self,
        speeds: Speeds | None,
        enough: Callable[[list[FeedbackLine]], bool],
        patience: float,
        *,
        repeat: float = COMMAND_INTERVAL,
    ) -> list[FeedbackLine]:
        """Command speeds again and again, and listen until the lines are enough.

        Args:
            speeds: of the letters [rad/s]; None to send nothing.
            enough: called with all lines after each one.
            patience: longest time [s].
            repeat: time between commands [s].
        """
        begin = due = self._link.now()
        lines: list[FeedbackLine] = []
        while (now := self._link.now()) - begin < patience:
            if speeds is not None and now >= due:
                self.command(speeds)
                due = now + repeat
            for line in self.poll():
                lines.append(line)
                if enough(lines):
                    return lines
        return lines

    def listen(
        self, lasting: float, speeds: Speeds | None = None, repeat: float = COMMAND_INTERVAL
    ) -> list[FeedbackLine]:
        """Listen for a while [s], commanding speeds as `hear` does; returns the lines."""
        return self.hear(speeds, lambda _: False, lasting, repeat=repeat)

    def clear(self) -> None:
        """Take what has arrived before."""
        self.listen(CLEAR_TIME)

    def has_echo(self) -> bool:
        """Send zero commands that no feedback equals, and return whether they come back.

        This finds echoes that come later than a link waits for when it opens.
        """
        self.clear()
        end = self._link.now() + ECHO_TIME
        while self._link.now() < end:
            self._link.write(ECHO_PROBE + line_end(trailing_comma=self.trailing_comma))
            self.listen(COMMAND_INTERVAL)
            if ECHO_PROBE in self._link.tail:
                return True
        self.clear()
        return False

    def measure_feedback(self, period: float) -> list[FeedbackLine]:
        """Command zero at the control rate for a while; returns the lines, and sets `rate`.

        Raises:
            BoardSilentError: none came.
        """
        lines = self.listen(LISTEN_TIME, ZERO, repeat=period)
        self.rate = round_rate(measure_rate([line.stamp for line in lines], range(len(lines))))
        if not self.rate:
            raise silence_error(LISTEN_TIME, self.decoder)
        return lines


def since(lines: Sequence[FeedbackLine], begin: float) -> list[FeedbackLine]:
    """Return the lines that came after a time [s]."""
    return [line for line in lines if line.stamp > begin]


MOST_RATE_LINES = 400
"""Lines between which slopes are computed."""
BOARD_RATES = (5, 10, 20, 25, 30, 40, 50, 60, 80, 100, 125, 150, 200)
"""Rates that boards are set to [Hz]."""
RATE_ROUNDING = 0.03
"""A rate that is so close to one of these is that one."""


def round_rate(measured: float) -> float:
    """Return the rate that a board was probably set to [Hz]."""
    usual = min(BOARD_RATES, key=lambda rate: abs(measured - rate))
    return float(usual) if abs(measured - usual) < RATE_ROUNDING * usual else round(measured, 1)


def measure_rate(stamps: Sequence[float], numbers: Sequence[int]) -> float:
    """Return the rate of lines [Hz]; 0 for fewer than two times.

    It is the Theil-Sen slope of the lines' numbers over their times, whatever a few pauses, bursts
    or lost lines do to the intervals between them.

    Args:
        stamps: when lines came [s], ascending.
        numbers: of these lines among all that came.
    """
    if len(stamps) < 2:
        return 0.0
    chosen = np.unique(np.linspace(0, len(stamps) - 1, MOST_RATE_LINES).astype(int))
    times, places = (np.asarray(column, np.float64)[chosen] for column in (stamps, numbers))
    later, earlier = np.nonzero(times[:, None] > times[None, :])
    if not len(later):
        return 0.0
    return float(np.median((places[later] - places[earlier]) / (times[later] - times[earlier])))


# One wheel after the other

MOVING_SHARE, STANDING_SHARE = 0.4, 0.1
"""A wheel that has this share of the commanded speed moves; one that is slower stands."""
AGREEING_LINES = 3
"""Lines that must agree."""
START_TIMEOUT, SINGLE_COMMAND_TIMEOUT = 1.5, 0.7
"""Longest wait for a wheel to start [s]: motors, speed loops and delays take up to 0.5 s; and after
a single command, as many boards stop by themselves soon."""
STOP_TIMEOUT, SETTLING_TIMEOUT = 3.0, 1.5
"""Longest wait for wheels to stop, and for a steady speed [s]."""
FAINT_SHARE = 0.025
"""A letter that reports less than this share of the commanded speed reports nothing; one in m/s has
0.05 of it on a usual wheel."""
SPEED_WINDOW, STEADY_SHARE = 0.2, 0.03
"""A speed is steady where it changes by less than this share of the commanded speed, or of itself,
from one window [s] to the next."""
STALE_TIME, STALE_FACTOR, STALE_JUMP = 0.12, 2.2, 0.2
"""Lines were old ones if they were the same for so long [s], and the next one is further from them
than a wheel's usual largest change by this factor, and than this share of the commanded speed."""
FEWEST_CHANGES, STALE_CHANGE = 4, 0.5
"""Changes of a wheel's speed that are needed to know the usual one, each at least by this share of
the commanded speed."""
LINE_LOST = 1.8
"""Factor on the usual gap between lines where one was lost."""
ODD_SHARES, SET_POINT_TIME = (0.83, 0.97, 0.89, 0.79), 0.6
"""Commands of four wheels that no other feedback is like, as shares of the commanded speed, and how
long they are commanded [s]."""
LOWEST_RATIO, HIGHEST_RATIO = 0.7, 1.4
"""A wheel's measured speed is right between these shares of the commanded one."""
RATIO_TOLERANCE = 0.1
"""Ratios of speeds that differ by less than this share are the same."""


@dataclass(frozen=True)
class WheelAnswer:
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

    @classmethod
    def of(cls, letter: int, lines: Sequence[FeedbackLine], asked: float) -> WheelAnswer:
        """The answer that lines hold."""
        speeds = _mean_speeds(lines)
        least = max(FAINT_SHARE * asked, MOVING_SHARE * max(map(abs, speeds)))
        moving = [k for k in range(4) if abs(speeds[k]) > least]
        return cls(letter, asked, speeds, tuple(sorted(moving, key=lambda k: -abs(speeds[k]))))

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
        in_range = LOWEST_RATIO <= abs(self.ratio) <= HIGHEST_RATIO
        return not self.moving or (in_range and not self.stopped)


def _mean_speeds(lines: Sequence[FeedbackLine]) -> Speeds:
    """The mean speed of each letter [rad/s]."""
    a, b, c, d = (fmean(line.speeds[k] for line in lines) if lines else 0.0 for k in range(4))
    return a, b, c, d


def command_letters(letters: Collection[int], speed: float) -> Speeds:
    """Return a command for some letters, by their indices [rad/s]."""
    a, b, c, d = (speed if number in letters else 0.0 for number in range(4))
    return a, b, c, d


def _turns(share: float, speed: float, lines: Sequence[FeedbackLine]) -> bool:
    """Whether a wheel turned in the newest line, faster than this share of a speed [rad/s]."""
    return bool(lines) and max(map(abs, lines[-1].speeds)) > share * speed


def stop_wheels(probe: BoardProbe, speed: float) -> None:
    """Command zero until all wheels stand.

    Args:
        probe: hears the board.
        speed: at which wheels turn in these checks [rad/s].

    Raises:
        LinkError: a wheel keeps turning.
    """

    def stands(lines: list[FeedbackLine]) -> bool:
        newest = lines[-AGREEING_LINES:]
        fastest = max(max(map(abs, line.speeds)) for line in newest)
        return len(newest) == AGREEING_LINES and fastest < STANDING_SHARE * speed

    lines = probe.hear(ZERO, stands, STOP_TIMEOUT)
    if not lines or max(map(abs, lines[-1].speeds)) >= STANDING_SHARE * speed:
        raise still_turning_error(STOP_TIMEOUT, lines[-1].speeds if lines else ZERO)


def spin_wheel(probe: BoardProbe, letter: int, speed: float) -> WheelAnswer:
    """Turn the wheel of one letter until an encoder answers, and stop it.

    Args:
        probe: hears the board.
        letter: index of the letter.
        speed: to command [rad/s].
    """
    command = command_letters((letter,), speed)

    def moves(lines: list[FeedbackLine]) -> bool:
        newest = lines[-AGREEING_LINES:]
        return len(newest) == AGREEING_LINES and any(
            all(abs(line.speeds[k]) > MOVING_SHARE * speed for line in newest) for k in range(4)
        )

    def is_steady(lines: list[FeedbackLine]) -> bool:
        newest = since(lines, lines[-1].stamp - SPEED_WINDOW)
        older = lines[: -len(newest)]
        before = since(older, older[-1].stamp - SPEED_WINDOW) if older else []
        if not before or before[-1].stamp - lines[0].stamp < SPEED_WINDOW:
            return False
        return all(
            abs(now - then) < STEADY_SHARE * max(speed, abs(now))
            for now, then in zip(_mean_speeds(newest), _mean_speeds(before), strict=True)
        )

    first = probe.hear(command, moves, START_TIMEOUT)[-AGREEING_LINES:]
    lines = probe.hear(command, is_steady, SETTLING_TIMEOUT)
    stop_wheels(probe, speed)
    newest = since(lines, lines[-1].stamp - SPEED_WINDOW) if lines else first[-1:]
    answer = WheelAnswer.of(letter, newest, speed)
    before = WheelAnswer.of(letter, first, speed)
    if not answer.moving and max(map(abs, before.speeds)) > MOVING_SHARE * speed:
        return replace(before, stopped=True)
    return answer


def takes_last_value(probe: BoardProbe, letter: int, speed: float, *, comma: bool) -> bool:
    """Return whether the board takes the last value of a line with, or without, a trailing comma.

    It gets one such line only: some boards take a value at the first comma of the next line.

    Args:
        probe: hears the board; its `trailing_comma` is the same afterwards.
        letter: index of a letter whose wheel turns.
        speed: to command [rad/s].
        comma: whether the line has the trailing comma.
    """
    order = MOTORS.replace(MOTORS[letter], "") + MOTORS[letter]
    usual, probe.trailing_comma = probe.trailing_comma, comma
    probe.command(command_letters((letter,), speed), order)
    probe.trailing_comma = usual
    turns = partial(_turns, STANDING_SHARE, speed)
    lines = probe.hear(None, turns, SINGLE_COMMAND_TIMEOUT)
    stop_wheels(probe, speed)
    return turns(lines)


def takes_upper_case(probe: BoardProbe, speed: float) -> bool:
    """Return whether wheels turn that are commanded in upper-case letters [rad/s]."""
    turns = partial(_turns, MOVING_SHARE, speed)
    probe.upper_case = True
    lines = probe.hear(command_letters(range(4), speed), turns, START_TIMEOUT)
    stop_wheels(probe, speed)
    probe.upper_case = False
    return turns(lines)


def sends_set_points(probe: BoardProbe, speed: float) -> bool:
    """Return whether feedback is the command itself, at once and to the last digit.

    Args:
        probe: hears the board.
        speed: to command at most [rad/s].
    """
    a, b, c, d = (round(share * speed, 2) for share in ODD_SHARES)
    command = a, b, c, d
    lines = probe.listen(SET_POINT_TIME, command)
    stop_wheels(probe, speed)
    turning = [line for line in lines if _turns(STANDING_SHARE, speed, [line])]
    away = np.array([line.speeds for line in turning]).reshape(-1, 4) - command
    return bool(turning) and float(np.abs(away).max()) < 1.5 * PRINTED_STEP


def find_stale(lines: Sequence[FeedbackLine], speed: float) -> tuple[float, float] | None:
    """Find out whether a board repeated old lines while a wheel changed its speed.

    A wheel whose lines were the same for a while then jumps from one line to the next, further than
    it usually changes at most on its way to a speed.

    Args:
        lines: all that came.
        speed: that was commanded [rad/s].

    Returns:
        The largest such jump, and the wheel's usual one [rad/s]; None where there is none.
    """
    if len(lines) < AGREEING_LINES:
        return None
    gaps = np.diff([line.stamp for line in lines])
    for speeds in np.array([line.speeds for line in lines]).T:
        jumps = np.diff(speeds)
        changes = np.abs(jumps)
        places = np.flatnonzero(changes)
        begins = np.flatnonzero(np.diff(places, prepend=-2) > 1)
        if not len(begins):
            continue
        whole = np.abs(np.add.reduceat(jumps[places], begins)) > STALE_CHANGE * speed
        largest = np.maximum.reduceat(changes[places], begins)[whole]
        if len(largest) < FEWEST_CHANGES:
            continue
        usual = float(np.median(largest))
        least = max(STALE_FACTOR * usual, STALE_JUMP * speed)
        for before, place in pairwise(places.tolist()):
            repeated = gaps[before + 1 : place].sum() > STALE_TIME
            whole_gap = gaps[place] < LINE_LOST * float(np.median(gaps))
            if repeated and whole_gap and changes[place] > least:
                return float(changes[place]), usual
    return None


def likely_units(ratio: float, config: RobotConfig, *, fast: bool = False) -> str:
    """Say in which other unit a board may measure, or take its commands, or that a motor is weak.

    Args:
        ratio: of measured to commanded speed.
        config: of the robot.
        fast: whether the measured speed has more digits than a line holds.
    """
    units = [
        f"likely {unit} (x {factor:.3g})"
        for unit, factor in (
            ("feedback in rpm", 30.0 / math.pi),
            ("feedback in rev/s", 0.5 / math.pi),
            ("feedback in deg/s", 180.0 / math.pi),
            ("feedback in m/s", config.wheel_radius),
            ("commands taken as rpm", math.pi / 30.0),
        )
        if math.isclose(ratio, factor, rel_tol=RATIO_TOLERANCE)
    ]
    if fast:
        before_gears = "likely feedback in deg/s or counts, or that of the motor before its gears"
        units.insert(0, before_gears)
    weak = ", or a motor that is too weak" if ratio < 1.0 and not fast else ""
    if units:
        return f"{' or '.join(units)}: the wire carries rad/s of the wheel, both ways{weak}"
    return f"likely counts per turn or gear ratio in the board's program{weak}"


# All wheels together: from a command to its first effect, and the command time-out

RESPONSE_TRIALS = 9
"""Commands whose first effect is timed, at different phases of the board's clock."""
NOISE_SHARE = 0.05
"""Smallest speed that shows an effect, as a share of the commanded one."""
QUIET_TIME, ZERO_SPEED, CALM_TIMEOUT = 0.3, 0.005, 1.2
"""How long encoders must report zero before a command is timed [s], mean speeds that are zero
[rad/s], as lines have two decimals, and the longest wait for that [s]; some encoders never do."""
DELAY_JITTER = 0.005
"""How much delays differ apart from the phase of the feedback [s]."""
EFFECT_TIMEOUT = 1.0
"""Longest wait for an effect [s]."""
FALL_LEVEL = 0.75
"""Falling speeds are compared at this share of the steady speed."""
STEADY_MEAN, STEADY_TIMEOUT = 0.02, 3.0
"""A speed is steady where it changes by less than this share from one window to the next; longest
wait for that, or for a time-out [s]."""


def leave_out_early(delays: Sequence[float], period: float) -> list[float]:
    """Leave out delays of wheels that still crept from an earlier command; late ones stay.

    All others lie within one period of the feedback [s], unless they are late.

    Returns:
        The others, ascending [s].
    """
    least = median(delays) - period - DELAY_JITTER
    return sorted(delay for delay in delays if delay >= least)


class StepResponse:
    """Commands all letters that answer, and reads their mean speed.

    Args:
        probe: hears the board, whose `rate` is known.
        motors: indices of the letters to command.
        encoders: indices of the letters that answer.
        speed: to command [rad/s].
    """

    def __init__(
        self, probe: BoardProbe, motors: Collection[int], encoders: Collection[int], speed: float
    ) -> None:
        self._command = command_letters(motors, speed)
        self._encoders = encoders
        self._probe, self._speed = probe, speed

    def _mean(self, line: FeedbackLine) -> float:
        return fmean(abs(line.speeds[k]) for k in self._encoders)

    def _exceeds(self, level: float, lines: Sequence[FeedbackLine]) -> bool:
        return bool(lines) and self._mean(lines[-1]) > level

    def measure_delays(self) -> list[float]:
        """Time a few commands, the first one only to warm up.

        Returns:
            Times from a command's last byte to the first byte of the line that shows its effect,
            with more or less of the wait for the next line [s], ascending; none where a command had
        """
        probe, delays = self._probe, []

        def recent_noise(lines: list[FeedbackLine]) -> float:
            newest = since(lines, lines[-1].stamp - QUIET_TIME) if lines else []
            return max(map(self._mean, newest), default=0.0)

        def is_quiet(lines: list[FeedbackLine]) -> bool:
            lasted = lines[-1].stamp - lines[0].stamp
            return lasted > QUIET_TIME and recent_noise(lines) < ZERO_SPEED

        for trial in range(RESPONSE_TRIALS + 1):
            stop_wheels(probe, self._speed)
            noise = recent_noise(probe.hear(ZERO, is_quiet, CALM_TIMEOUT))
            probe.hear(None, lambda _: True, EFFECT_TIMEOUT)
            probe.listen(trial / (RESPONSE_TRIALS * probe.rate))
            probe.command(self._command)
            sent = probe.sent
            shows = partial(self._exceeds, max(ZERO_SPEED, 2.0 * noise))
            lines = probe.hear(None, shows, EFFECT_TIMEOUT)
            if not shows(lines):
                return []
            delays.append(max(lines[-1].stamp - probe.line_time - sent, 0.0))
        stop_wheels(probe, self._speed)
        return leave_out_early(delays[1:], 1.0 / probe.rate)

    def measure_timeout(self) -> tuple[float, float | None] | None:
        """Let the wheels turn steadily, stop commanding, and compare with a commanded stop.

        Both falls have the same delay and the same shape, so their difference is the time-out.

        Returns:
            The board's command time-out, and when the wheels stand, counted from the newest command
            [s], None if unseen; or None where the wheels keep turning.
        """
        probe = self._probe
        steady, newest = self._turn_steadily()
        probe.command(ZERO)
        stop = probe.sent
        commanded = self._find_fall(newest, ZERO, 0.5 * steady, FALL_LEVEL * steady)[0]
        stop_wheels(probe, self._speed)
        steady, newest = self._turn_steadily()
        last = probe.sent
        standing = STANDING_SHARE * self._speed
        by_itself, end = self._find_fall(newest, None, standing, FALL_LEVEL * steady)
        stop_wheels(probe, self._speed)
        if commanded is None or by_itself is None or end is None:
            return None
        after = (by_itself - last) - (commanded - stop)
        stood = self._mean(end) < standing
        return max(after, 0.0), end.stamp - last if stood else None

    def _turn_steadily(self) -> tuple[float, list[FeedbackLine]]:
        """Turn the wheels until their speed is steady; returns it [rad/s], and the newest line."""

        def window_mean(lines: list[FeedbackLine], end: float) -> float | None:
            window = [self._mean(x) for x in lines if end - SPEED_WINDOW < x.stamp <= end]
            return fmean(window) if window else None

        def is_steady(lines: list[FeedbackLine]) -> bool:
            end = lines[-1].stamp
            now, before = window_mean(lines, end), window_mean(lines, end - SPEED_WINDOW)
            if now is None or before is None or lines[0].stamp > end - 2.0 * SPEED_WINDOW:
                return False
            moves = now > NOISE_SHARE * self._speed
            return moves and abs(now - before) < STEADY_MEAN * self._speed

        lines = self._probe.hear(self._command, is_steady, STEADY_TIMEOUT)
        speed = window_mean(lines, lines[-1].stamp) if lines else None
        return speed or 0.0, lines[-1:]

    def _find_fall(
        self, newest: list[FeedbackLine], command: Speeds | None, end: float, level: float
    ) -> tuple[float | None, FeedbackLine | None]:
        """Listen until the mean speed is below `end` [rad/s]."""
        lines = newest + self._probe.hear(
            command, lambda heard: self._mean(heard[-1]) < end, STEADY_TIMEOUT
        )
        for before, after in pairwise(lines):
            high, low = self._mean(before), self._mean(after)
            if low < level <= high:
                share = (high - level) / (high - low)
                return before.stamp + share * (after.stamp - before.stamp), lines[-1]
        return None, lines[-1] if lines else None
