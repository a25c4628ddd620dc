"""Listens to a board while it is commanded.

Its feedback, which wheel answers to which letter, and how soon.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import fmean, median, median_low
from typing import NamedTuple

from acsar_gym.config import BITS_PER_BYTE, RobotConfig
from acsar_gym.links.base import Link
from acsar_gym.links.handshake import shown_bytes, silence_error, still_turning_error
from acsar_gym.protocol import MOTORS, ZERO, Decoder, Speeds, encode_line, line_end
from acsar_gym.tools.doctor.checks import Check

PROBE_POLL = 0.001
"""Resolution of the times [s]."""
COMMAND_INTERVAL = 0.05
"""A command is repeated so often, to prevent the firmware's time-out [s]."""
RESET_GAP = 0.5
"""A board that was silent so long in between was reset [s]."""
SILENCE_TIMEOUT = 3.0
"""A board that is silent so long doesn't come back [s]; one that was reset takes 1 to 2 s."""
LONGEST_STALL = 0.05
"""Time that this program was held up counts as silence of the board only up to this [s]."""
CLEAR_TIME = 0.1
"""How long old lines may come [s]."""
MAX_RAW_LINES = 400
"""Newest raw lines that are kept."""


class FeedbackLine(NamedTuple):
    """A line of feedback."""

    stamp: float
    """When its last byte had arrived [s]."""
    begin: float
    """When its first byte began to arrive [s]."""
    speeds: Speeds
    """Speeds of the letters a, b, c, d [rad/s], not yet those of the wheels."""


class BoardProbe:
    """Sends commands to the letters of a board, and hears its lines.

    Attributes: `decoder`; `gaps`, how long the board was silent each time that it was reset [s];
    `raw`, the newest lines as they came; `sent`, when the last byte of the newest command had left
    [s]; `trailing_comma`, of the commands.

    Args:
        link: to the board, open.
        config: of the robot.
    """

    def __init__(self, link: Link, config: RobotConfig) -> None:
        self._link = link
        self._byte_time = BITS_PER_BYTE / config.baud_rate
        self.decoder = Decoder()
        self.trailing_comma = True
        self.gaps: list[float] = []
        self.raw: deque[bytes] = deque(maxlen=MAX_RAW_LINES)
        self.sent = 0.0
        self._speeds: Speeds = ZERO
        self._partial = b""
        self._begin: float | None = None
        self._polled = link.now()
        self._quiet = 0.0
        self._counted = 0
        self._since = self._until = self._polled

    def now(self) -> float:
        """Return the link's time [s]."""
        return self._link.now()

    def command(self, speeds: Speeds, order: str = MOTORS) -> None:
        """Send one command line.

        Args:
            speeds: of the letters a, b, c, d [rad/s].
            order: order of the letters in the line.
        """
        line = encode_line(*speeds, b"")
        parts = line.split(b",")
        ordered = b",".join(parts[MOTORS.index(letter)] for letter in order)
        ordered += line_end(trailing_comma=self.trailing_comma)
        self.sent = self.now() + len(ordered) * self._byte_time
        self._link.write(ordered)

    def poll(self) -> list[FeedbackLine]:
        """Let POLL pass, and return the lines that have arrived.

        Raises:
            BoardSilentError: nothing valid has arrived for SILENT.
            LinkError: the link is lost, or there was an emergency stop.
        """
        data = self._link.advance(PROBE_POLL)
        now = self.now()
        self._quiet += min(now - self._polled, LONGEST_STALL)
        self._polled = now
        if data and self._begin is None:
            self._begin = now
        lines = [self._line(reading.over(self._speeds), now) for reading in self.decoder.feed(data)]
        self._keep(data)
        if lines:
            self._count(len(lines), now)
        elif self._quiet > SILENCE_TIMEOUT:
            raise silence_error(self._quiet, self.decoder)
        return lines

    def _count(self, lines: int, now: float) -> None:
        """Count lines; after a reset of the board anew."""
        if self._quiet > RESET_GAP:
            self.gaps.append(self._quiet)
            self._counted = 0
        if not self._counted:
            self._since, lines = now, 1
        self._quiet, self._until = 0.0, now
        self._counted += lines

    @property
    def rate(self) -> float:
        """Lines that the board sends per second [Hz]; 0 where too few have come."""
        lasted = self._until - self._since
        return (self._counted - 1) / lasted if self._counted > 1 and lasted > 0.0 else 0.0

    def _line(self, speeds: Speeds, now: float) -> FeedbackLine:
        """Return a line that ends now."""
        self._speeds = speeds
        lasted = len(self.raw[-1] if self.raw else b"") * self._byte_time
        begin = min(now - lasted, now if self._begin is None else self._begin)
        return FeedbackLine(now, begin, speeds)

    def _keep(self, data: bytes) -> None:
        """Keep complete lines as they came, and when the first byte of the next one came."""
        if not data:
            return
        *lines, self._partial = (self._partial + data).split(b"\n")
        self.raw.extend(line[:200] for line in lines)
        self._partial = self._partial[:200]
        if lines:
            self._begin = self.now() if self._partial else None

    def hear(
        self,
        speeds: Speeds | None,
        enough: Callable[[FeedbackLine], bool],
        patience: float,
        *,
        repeat: float = COMMAND_INTERVAL,
        order: str = MOTORS,
    ) -> list[FeedbackLine]:
        """Command speeds again and again, and listen until a line is enough.

        Args:
            speeds: of the letters [rad/s]; None to send nothing.
            enough: called with every line.
            patience: longest time [s].
            repeat: time between commands [s].
            order: order of the letters in the line.

        Returns:
            The lines; the last one was enough, unless patience ended.
        """
        begin = due = self.now()
        lines: list[FeedbackLine] = []
        while (now := self.now()) - begin < patience:
            if speeds is not None and now >= due:
                self.command(speeds, order)
                due = now + repeat
            for line in self.poll():
                lines.append(line)
                if enough(line):
                    return lines
        return lines

    def clear(self) -> None:
        """Take what has arrived before; nothing of it counts."""
        self.pause(CLEAR_TIME)
        self._counted = 0

    def pause(self, lasting: float) -> None:
        """Listen to nothing in particular for a while [s]."""
        self.hear(None, lambda _: False, lasting)


LISTEN_TIME = 2.0
"""Time during which feedback is counted [s]."""
BOARD_RATES = (5, 10, 20, 25, 30, 40, 50, 60, 80, 100, 125, 150, 200)
"""Rates that boards are set to [Hz]."""
RATE_ROUNDING = 0.03
"""A rate that is so close to one of these is that one."""
PADDED_LINE = re.compile(rb"(?:[abcd][pn][0-9]{2}\.[0-9]{2},?){1,4}\r?")


def listen_standing(ear: BoardProbe, config: RobotConfig) -> list[FeedbackLine]:
    """Command zero at the control rate for a while, and return what the board says meanwhile."""
    ear.clear()
    return ear.hear(ZERO, lambda _: False, LISTEN_TIME, repeat=config.period)


def round_rate(measured: float) -> float:
    """Return the rate that a board was probably set to [Hz]."""
    usual = min(BOARD_RATES, key=lambda rate: abs(measured - rate))
    return float(usual) if abs(measured - usual) < RATE_ROUNDING * usual else round(measured, 1)


def check_feedback(
    ear: BoardProbe, lines: Sequence[FeedbackLine], config: RobotConfig
) -> Iterator[Check]:
    """Say what was found.

    Args:
        ear: has heard the board.
        lines: of `listen`.
        config: of the robot.
    """
    found, expected = ear.rate, config.feedback_rate
    slow = found < 0.9 * expected
    yield Check(
        "feedback rate",
        "warn" if slow else "ok",
        f"{found:.1f} lines/s, {expected:g} expected",
        "set firmware.feedback_rate to what the board sends, or speed the board up" if slow else "",
    )
    yield _format(ear)
    refused = sum(ear.decoder.refused.values())
    sample = f", such as in {shown_bytes(ear.decoder.sample)}" if refused else ""
    yield Check(
        "line quality",
        "warn" if refused else "ok",
        f"{refused} bad parts in {ear.decoder.lines} lines{sample}",
        "check the cable, ground and baud rate" if refused else "",
    )
    turning = [k for k in range(4) if lines and abs(median(x.speeds[k] for x in lines)) > 0.5]
    if turning:
        letters = ", ".join("abcd"[k] for k in turning)
        yield Check(
            "standing",
            "warn",
            f"{letters}: feedback isn't zero while zero is commanded",
            "if that wheel stands, check its encoder; if it turns, what else commands the board",
        )
    if ear.gaps:
        yield report_resets(ear.gaps)


def _format(ear: BoardProbe) -> Check:
    """Say how the board writes its numbers."""
    newest = ear.raw[-1] if ear.raw else b""
    padded = PADDED_LINE.fullmatch(newest) is not None
    comma = "with" if newest.rstrip().endswith(b",") else "without"
    numbers = "two digits and two decimals" if padded else "unpadded numbers, which are read"
    return Check(
        "line format", "ok", f"{numbers}, {comma} a trailing comma: {shown_bytes(newest.rstrip())}"
    )


def report_resets(gaps: Sequence[float]) -> Check:
    """Say that the board was reset."""
    silent = ", ".join(f"{gap:.1f} s" for gap in gaps)
    return Check(
        "resets",
        "fail",
        f"the board was reset: silent for {silent}",
        "check its power supply, which motors may draw down, and its watchdog",
    )


MOVING_SHARE = 0.4
"""A wheel that has this share of the commanded speed moves."""
STANDING_SHARE = 0.1
"""A wheel that is slower than this share of the commanded speed stands."""
AGREEING_LINES = 3
"""Lines that must agree."""
START_TIMEOUT = 1.5
"""Longest wait for a wheel to start [s]; motors, speed loops and delays take up to 0.5 s."""
SINGLE_COMMAND_TIMEOUT = 0.7
"""Longest wait for the effect of a single command [s]; many boards stop by themselves soon."""
STOP_TIMEOUT = 3.0
"""Longest wait for wheels to stop [s]."""
FAINT_SHARE = 0.025
"""A letter that reports less than this share of the commanded speed reports nothing; one in m/s has
0.05 of it on a usual wheel."""
SPEED_WINDOW = 0.2
"""Length of the windows in which the wheel's speed is measured, once it moves [s]."""
STEADY_SHARE = 0.03
"""A speed is steady where it changes by less than this share of the commanded speed, or of itself,
from one window to the next."""
SETTLING_TIMEOUT = 1.5
"""Longest wait for a steady speed [s]."""
LOWEST_RATIO, HIGHEST_RATIO = 0.7, 1.4
"""A wheel's measured speed is right between these shares of the commanded one."""


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
        return not self.moving or (
            LOWEST_RATIO <= abs(self.ratio) <= HIGHEST_RATIO and not self.stopped
        )


def command_alone(letter: int, speed: float) -> Speeds:
    """Return a command for one letter [rad/s]."""
    a, b, c, d = (speed if number == letter else 0.0 for number in range(4))
    return a, b, c, d


def stop_wheels(ear: BoardProbe, speed: float) -> None:
    """Command zero until all wheels stand.

    Args:
        ear: hears the board.
        speed: at which wheels turn in these checks [rad/s].

    Raises:
        LinkError: a wheel keeps turning.
    """
    lines: list[FeedbackLine] = []

    def standing(line: FeedbackLine) -> bool:
        lines.append(line)
        newest = lines[-AGREEING_LINES:]
        return len(newest) == AGREEING_LINES and all(
            max(map(abs, one.speeds)) < STANDING_SHARE * speed for one in newest
        )

    heard = ear.hear(ZERO, standing, STOP_TIMEOUT)
    if not heard or max(map(abs, heard[-1].speeds)) >= STANDING_SHARE * speed:
        raise still_turning_error(STOP_TIMEOUT, heard[-1].speeds if heard else ZERO)


def spin_wheel(ear: BoardProbe, letter: int, speed: float, order: str = MOTORS) -> WheelAnswer:
    """Turn the wheel of one letter until an encoder answers, and stop it.

    Args:
        ear: hears the board.
        letter: index of the letter.
        speed: to command [rad/s].
        order: order of the letters in the command line.
    """
    command = command_alone(letter, speed)
    lines: list[FeedbackLine] = []

    def moves(line: FeedbackLine) -> bool:
        lines.append(line)
        newest = lines[-AGREEING_LINES:]
        return len(newest) == AGREEING_LINES and any(
            all(abs(one.speeds[k]) > MOVING_SHARE * speed for one in newest) for k in range(4)
        )

    begun = ear.hear(command, moves, START_TIMEOUT, order=order)[-AGREEING_LINES:]
    heard = ear.hear(command, _Steady(speed), SETTLING_TIMEOUT, order=order)
    stop_wheels(ear, speed)
    answer = _answer(letter, _newest(heard, SPEED_WINDOW) or lines[-1:], speed)
    before = _answer(letter, begun, speed)
    if not answer.moving and max(map(abs, before.speeds)) > MOVING_SHARE * speed:
        return replace(before, stopped=True)
    return answer


class _Steady:
    """Is true of the line from which on all speeds are steady."""

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self._lines: list[FeedbackLine] = []

    def __call__(self, line: FeedbackLine) -> bool:
        lines = self._lines
        lines.append(line)
        newest = _newest(lines, SPEED_WINDOW)
        before = _newest(lines[: -len(newest)], SPEED_WINDOW)
        if not before or before[-1].stamp - lines[0].stamp < SPEED_WINDOW:
            return False
        return all(
            abs(now - then) < STEADY_SHARE * max(self._speed, abs(now))
            for now, then in zip(_means(newest), _means(before), strict=True)
        )


def _newest(lines: Sequence[FeedbackLine], lasting: float) -> Sequence[FeedbackLine]:
    """Return the lines of the last moments [s], at least one if there is one."""
    return [line for line in lines if line.stamp > lines[-1].stamp - lasting]


def _means(lines: Sequence[FeedbackLine]) -> Speeds:
    """Return the mean speed of each letter [rad/s]."""
    a, b, c, d = (fmean(line.speeds[k] for line in lines) if lines else 0.0 for k in range(4))
    return a, b, c, d


def _answer(letter: int, lines: Sequence[FeedbackLine], asked: float) -> WheelAnswer:
    """Return the answer that lines of feedback hold."""
    speeds = _means(lines)
    least = max(FAINT_SHARE * asked, MOVING_SHARE * max(map(abs, speeds)))
    moving = [k for k in range(4) if abs(speeds[k]) > least]
    return WheelAnswer(letter, asked, speeds, tuple(sorted(moving, key=lambda k: -abs(speeds[k]))))


def takes_last_value(ear: BoardProbe, letter: int, speed: float, *, comma: bool) -> bool:
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
    ear.command(command_alone(letter, speed), order)
    ear.trailing_comma = usual
    lines = ear.hear(None, lambda line: _turns(line, speed), SINGLE_COMMAND_TIMEOUT)
    stop_wheels(ear, speed)
    return bool(lines) and _turns(lines[-1], speed)


def _turns(line: FeedbackLine, speed: float) -> bool:
    return max(map(abs, line.speeds)) > STANDING_SHARE * speed


RESPONSE_TRIALS = 5
"""Commands whose first effect is timed, at different phases of the board's clock."""
NOISE_SHARE = 0.05
"""Smallest speed that shows an effect, as a share of the commanded one."""
QUIET_TIME = 0.3
"""How long encoders must report zero before a command is timed [s]."""
ZERO_SPEED = 0.005
"""Mean speeds below this are zero [rad/s]; lines have two decimals."""
CALM_TIMEOUT = 1.2
"""Longest wait for that [s]; some encoders never do."""
DELAY_JITTER = 0.005
"""How much delays differ apart from the phase of the feedback [s]."""
EFFECT_TIMEOUT = 1.0
"""Longest wait for an effect [s]."""
FALL_LEVEL = 0.75
"""Falling speeds are compared at this share of the steady speed."""
STEADY_MEAN = 0.02
"""A speed is steady where it changes by less than this share from one window to the next."""
STEADY_WINDOW = 0.2
"""Length of those windows [s]."""
STEADY_TIMEOUT = 3.0
"""Longest wait for a steady speed, or for a time-out [s]."""


@dataclass(frozen=True)
class ResponseDelays:
    """Times from a command's last byte to the first byte of the line that shows its effect [s].

    Attributes:
        shortest: without the wait for the next line.
        longest: with all of it.
    """

    shortest: float
    longest: float


@dataclass(frozen=True)
class CommandTimeout:
    """How the wheels stop when commands stop.

    Attributes:
        after: the board's command time-out [s].
        standing: when the wheels stand, counted from the newest command [s]; None if unseen.
    """

    after: float
    standing: float | None


class StepResponse:
    """Commands all letters that answer, and reads their mean speed.

    Args:
        ear: hears the board.
        motors: indices of the letters to command.
        encoders: indices of the letters that answer.
        speed: to command [rad/s].
    """

    def __init__(
        self, ear: BoardProbe, motors: Iterable[int], encoders: Iterable[int], speed: float
    ) -> None:
        letters = set(motors)
        a, b, c, d = (speed if number in letters else 0.0 for number in range(4))
        self._command: Speeds = (a, b, c, d)
        self._encoders = tuple(encoders)
        self._ear, self._speed = ear, speed

    def _mean(self, line: FeedbackLine) -> float:
        return fmean(abs(line.speeds[k]) for k in self._encoders)

    def delays(self, rate: float) -> ResponseDelays | None:
        """Time a few commands, the first one only to warm up.

        Args:
            rate: lines that the board sends per second [Hz].

        Returns:
            The delays; None where a command had no effect.
        """
        ear, found = self._ear, []
        for trial in range(RESPONSE_TRIALS + 1):
            noise = self._quiet()
            ear.hear(None, lambda _: True, EFFECT_TIMEOUT)
            ear.pause(trial / (RESPONSE_TRIALS * rate))
            delay = self._effect(max(ZERO_SPEED, 2.0 * noise))
            if delay is None:
                return None
            found.append(delay)
        stop_wheels(ear, self._speed)
        return _select_delays(found[1:], 1.0 / rate)

    def _quiet(self) -> float:
        """Wait until the encoders report nothing; returns the mean speed that remains [rad/s]."""
        stop_wheels(self._ear, self._speed)
        lines: list[FeedbackLine] = []

        def quiet(line: FeedbackLine) -> bool:
            lines.append(line)
            newest = self._since(lines, line.stamp - QUIET_TIME)
            return lines[0].stamp < line.stamp - QUIET_TIME and max(newest) < ZERO_SPEED

        self._ear.hear(ZERO, quiet, CALM_TIMEOUT)
        return max(self._since(lines, lines[-1].stamp - QUIET_TIME)) if lines else 0.0

    def _effect(self, level: float) -> float | None:
        """Send one command; return the time until the mean speed exceeds a level [s]."""
        ear = self._ear
        ear.command(self._command)
        sent = ear.sent
        lines = ear.hear(None, lambda line: self._mean(line) > level, EFFECT_TIMEOUT)
        if not lines or self._mean(lines[-1]) <= level:
            return None
        return max(lines[-1].begin - sent, 0.0)

    def time_out(self) -> CommandTimeout | None:
        """Let the wheels turn steadily, stop commanding, and compare with a commanded stop.

        Both falls have the same delay and the same shape, so their difference is the time-out.

        Returns:
            The time-out; None where the wheels keep turning.
        """
        ear = self._ear
        steady, newest = self._steady()
        ear.command(ZERO)
        stop = ear.sent
        lines = ear.hear(ZERO, self._below(0.5 * steady), STEADY_TIMEOUT)
        commanded = self._crossing([*newest, *lines], FALL_LEVEL * steady)
        stop_wheels(ear, self._speed)
        steady, newest = self._steady()
        last = ear.sent
        lines = ear.hear(None, self._below(STANDING_SHARE * self._speed), STEADY_TIMEOUT)
        by_itself = self._crossing([*newest, *lines], FALL_LEVEL * steady)
        stop_wheels(ear, self._speed)
        if commanded is None or by_itself is None:
            return None
        stood = self._mean(lines[-1]) < STANDING_SHARE * self._speed
        after = (by_itself - last) - (commanded - stop)
        return CommandTimeout(max(after, 0.0), lines[-1].stamp - last if stood else None)

    def _below(self, level: float) -> Callable[[FeedbackLine], bool]:
        """Return a condition on lines [rad/s]."""
        return lambda line: self._mean(line) < level

    def _steady(self) -> tuple[float, list[FeedbackLine]]:
        """Turn the wheels until their speed is steady; returns it [rad/s], and the newest line."""
        lines: list[FeedbackLine] = []

        def steady(line: FeedbackLine) -> bool:
            lines.append(line)
            newest = self._window(lines, line.stamp)
            before = self._window(lines, line.stamp - STEADY_WINDOW)
            if not newest or not before or lines[0].stamp > line.stamp - 2.0 * STEADY_WINDOW:
                return False
            change = fmean(newest) - fmean(before)
            return (
                fmean(newest) > NOISE_SHARE * self._speed
                and abs(change) < STEADY_MEAN * self._speed
            )

        self._ear.hear(self._command, steady, STEADY_TIMEOUT)
        speed = fmean(self._window(lines, lines[-1].stamp)) if lines else 0.0
        return speed, lines[-1:]

    def _since(self, lines: Sequence[FeedbackLine], begin: float) -> list[float]:
        """Return the mean speeds of the lines since then [rad/s]."""
        return [self._mean(line) for line in lines if line.stamp > begin]

    def _window(self, lines: Sequence[FeedbackLine], end: float) -> list[float]:
        """Return the mean speeds of the lines in a window that ends then [rad/s]."""
        return [self._mean(one) for one in lines if end - STEADY_WINDOW < one.stamp <= end]

    def _crossing(self, lines: Sequence[FeedbackLine], level: float) -> float | None:
        """Return when the mean speed fell below a level, between two lines [s]."""
        for before, after in pairwise(lines):
            high, low = self._mean(before), self._mean(after)
            if low < level <= high:
                share = (high - level) / (high - low)
                return before.stamp + share * (after.stamp - before.stamp)
        return None


def _select_delays(found: Sequence[float], period: float) -> ResponseDelays:
    """Leave out wheels that still crept from an earlier command: all others lie in one period."""
    usual = median_low(found)  # one of them, so that it is near itself
    near = [delay for delay in found if abs(delay - usual) <= period + DELAY_JITTER]
    return ResponseDelays(min(near), max(near))
