"""Measures a board while its wheels are off the ground: feedback rate, delay, command time-out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median
from typing import NamedTuple

import numpy as np

from acsar_gym.config import BITS_PER_BYTE, RobotConfig
from acsar_gym.links.base import Link
from acsar_gym.links.handshake import silence_error, still_turning_error
from acsar_gym.protocol import MOTORS, ZERO, Decoder, Speeds, encode_line, line_end
from acsar_gym.recording.types import Floats

SPIN_SPEED = 3.0
"""Wheel speed while a board is measured [rad/s]: 0.15 m/s at the rim of a usual wheel."""
SPIN_TIME = 2.0
"""Time in which wheels reach a steady speed [s]. Delay, ramp and lag take up to 1.5 s."""
STOP_TIME = 0.5
"""Wheels are commanded to stop in parts of this duration [s]."""
STOP_TIMEOUT = 3.0
"""Longest wait for wheels to stop when zero is commanded [s]."""
LISTEN_TIME = 2.0
"""Time for which lines are counted [s]."""
SPEED_WINDOW = 0.25
"""Window of a mean speed [s]."""
STANDING_SHARE = 0.1
"""A wheel with less than this share of the commanded speed is at rest."""

PROBE_POLL = 0.001
"""Resolution of the measured times [s]."""
COMMAND_INTERVAL = 0.05
"""Interval in which a command is repeated, so that no board times out [s]."""
RESET_GAP = 0.5
"""A board that was silent for longer than this was reset [s]. Boards take 1 to 2 s to start."""
SILENCE_TIMEOUT = 3.0
"""A board that is silent for this long doesn't come back [s]."""
LONGEST_STALL = 0.05
"""A period in which this program was held up counts as silence only up to this [s]."""
TAIL_BYTES = 400
"""Newest bytes that are kept for messages."""

DELAY_TRIALS = 7
"""Commands whose first effect is timed, at different phases of the board's lines."""
EFFECT_TIME = 1.0
"""Longest wait for the effect of a command [s]: longer than the delay of any usual board."""
REST_TIME = 0.8
"""Time that wheels come to rest before a command is timed [s]."""
QUIET_SPEED = 0.005
"""A mean speed that is zero with two decimals [rad/s]."""
FALL_LEVEL = 0.75
"""Falling speeds are timed at this share of the steady speed."""
FALL_TIME = 1.5
"""Time in which speeds fall to it after a commanded stop [s]."""
LONGEST_TIMEOUT = 3.0
"""Wheels that turn for longer without a command don't stop by themselves [s]."""
TIMEOUT_TRIALS = 4
"""Most measurements of a time-out, of which two must agree."""
TRIAL_SHIFT = 0.73
"""Further wait before each next measurement [s]: an odd number, so that nothing stays in phase."""
SAME_TIMEOUT = 0.06
"""Two time-outs that differ by less than this agree [s]."""

LOWEST_RATIO = 0.7
"""Smallest share of the commanded speed that a wheel should have."""
HIGHEST_RATIO = 1.4
"""Largest share of the commanded speed that a wheel should have."""
UNIT_TOLERANCE = 0.1
"""A unit explains a ratio of speeds within this share."""

BOARD_RATES = (5, 10, 20, 25, 30, 40, 50, 60, 80, 100, 125, 150, 200)
"""Feedback rates to which programs set their boards [Hz]."""
RATE_ROUNDING = 0.03
"""A measured rate is rounded to one of them within this share."""
MOST_RATE_LINES = 400
"""Most lines of which all pairs are compared."""


class BoardTimes(NamedTuple):
    """How soon a board answers, and how soon it stops by itself."""

    feedback_rate: float
    """Lines per second [Hz], rounded to a usual rate if it is close to it."""
    delays: tuple[float, ...]
    """Times from a command's last byte to the first byte of the line that shows its effect [s], in
    ascending order. They include the wait for that line. Empty if a command had no effect."""
    command_timeout: float
    """Time from the newest command to the moment in which the board stops its motors [s]. Infinite
    if the wheels keep turning, NaN if no two measurements agree."""
    standstill: float
    """Time from the newest command to the moment in which the wheels are at rest by themselves [s].
    NaN if that wasn't seen."""

    @property
    def delay(self) -> float:
        """Median of `delays` [s]. NaN if there are none."""
        return median(self.delays) if self.delays else math.nan


class Lines(NamedTuple):
    """The n lines that a board sent while something was commanded."""

    sent: float
    """Time at which the last byte of the newest command before them left the port [s]."""
    stamps: Floats
    """Times at which their last bytes had arrived [s], (n,)."""
    speeds: Floats
    """Speeds of the letters a, b, c, d [rad/s], (n, 4). A robot's wiring isn't applied."""

    @property
    def newest(self) -> Floats:
        """Speeds in the newest `SPEED_WINDOW` [rad/s], (m, 4)."""
        since = self.stamps.max(initial=0.0) - SPEED_WINDOW
        return np.asarray(self.speeds[self.stamps > since])


class BoardProbe:
    """Commands the letters of a board, and reads its lines.

    Attributes:
        rate: Lines that the board sends per second [Hz]. 0 before `measure_rate`.
        gaps: Silence of each reset of the board [s].
        tail: The newest bytes that arrived.
        decoder: Decoder, with counters of refused input.
        line_time: Duration of a line on the wire [s].
        trailing_comma: Whether commands end with a comma.
        upper_case: Whether commands have upper-case letters.

    Args:
        link: Open link to the board.
        config: Robot configuration.
    """

    def __init__(self, link: Link, config: RobotConfig) -> None:
        self.rate = 0.0
        self.gaps: list[float] = []
        self.tail = b""
        self.decoder = Decoder()
        self.line_time = config.line_time
        self.trailing_comma = True
        self.upper_case = False

        self._link = link
        self._byte_time = BITS_PER_BYTE / config.baud_rate
        self._sent = link.now()
        self._polled = link.now()
        self._silence = 0.0
        self._speeds: Speeds = ZERO

    def drive(
        self,
        command: Speeds | bytes | None,
        duration: float,
        *,
        interval: float = COMMAND_INTERVAL,
        above: float = math.inf,
        below: float = -math.inf,
    ) -> Lines:
        """Repeat a command for a while, and return the lines that arrive meanwhile.

        Args:
            command: Speeds of the letters [rad/s], or a line without its end. None sends nothing.
            duration: Duration on the board's clock [s], which its lines show. It takes longer if
                this computer or an emulator is held up.
            interval: Interval of the commands [s].
            above: A line with a mean wheel speed above this ends it [rad/s].
            below: A line with a mean wheel speed below this ends it [rad/s].

        Raises:
            BoardSilentError: No valid line has arrived for `SILENCE_TIMEOUT`.
            LinkError: The link is lost, or there was an emergency stop.
        """
        # The first command is due at once.
        start = due = self._link.now()
        sent = self._sent
        stamps: list[float] = []
        speeds: list[Speeds] = []
        is_over = False

        while not is_over:
            now = self._link.now()

            # The lines are the board's clock. Before its rate is known, this computer's counts.
            if len(stamps) >= int(self.rate * duration) and now - start >= duration:
                break

            # Boards stop their wheels without commands, so that each is repeated.
            if command is not None and now >= due:
                self._send(command)
                sent = self._sent if due == start else sent
                due = now + interval
            for line in self._poll():
                stamps.append(self._polled)
                speeds.append(line)
                is_over |= not below <= np.abs(line).mean() <= above
        return Lines(sent, np.array(stamps), np.array(speeds).reshape(-1, len(MOTORS)))

    def _send(self, command: Speeds | bytes) -> None:
        line = command if isinstance(command, bytes) else encode_line(*command, b"")
        line += line_end(trailing_comma=self.trailing_comma)
        # Times are measured from the moment when a command's last byte is on the wire.
        self._sent = self._link.now() + len(line) * self._byte_time
        self._link.write(line.upper() if self.upper_case else line)

    def _poll(self) -> list[Speeds]:
        """Let `PROBE_POLL` pass, and return the lines that have arrived."""
        data = self._link.advance(PROBE_POLL)
        # Messages show what arrived, also if it was no line.
        self.tail = (self.tail + data)[-TAIL_BYTES:]
        now = self._link.now()

        # A pause of this program isn't a pause of the board.
        self._silence += min(now - self._polled, LONGEST_STALL)
        self._polled = now

        lines = []
        # A wheel that a line doesn't name keeps its speed.
        for reading in self.decoder.feed(data):
            self._speeds = reading.over(self._speeds)
            lines.append(self._speeds)

        # A board that starts again after a reset is silent for 1 to 2 s.
        if self._silence > SILENCE_TIMEOUT:
            raise silence_error(self._silence, self.decoder)
        if lines:
            if self._silence > RESET_GAP:
                self.gaps.append(self._silence)
            self._silence = 0.0
        return lines

    def measure_rate(self, period: float = COMMAND_INTERVAL) -> Lines:
        """Command zero in every period [s] for `LISTEN_TIME`. Sets `rate`, and returns the lines.

        Raises:
            BoardSilentError: No line arrived.
        """
        # A rate from before would end the drive early.
        self.rate = 0.0
        lines = self.drive(ZERO, LISTEN_TIME, interval=period)
        self.rate = round_rate(measure_rate(lines.stamps.tolist(), range(len(lines.stamps))))
        if not self.rate:
            raise silence_error(LISTEN_TIME, self.decoder)
        return lines

    def stop_wheels(self, speed: float) -> None:
        """Command zero until all wheels are at rest.

        Args:
            speed: Speed at which wheels turn in this measurement [rad/s].

        Raises:
            LinkError: A wheel keeps turning.
        """
        # Slow wheels roll on after the board has taken the command.
        for _ in range(round(STOP_TIMEOUT / STOP_TIME)):
            newest = self.drive(ZERO, STOP_TIME).newest
            if np.abs(newest).max(initial=0.0) < STANDING_SHARE * speed:
                return
        raise still_turning_error(STOP_TIMEOUT, self._speeds)


def round_rate(measured: float) -> float:
    """Return the rate to which a board was probably set [Hz]."""
    usual = min(BOARD_RATES, key=lambda rate: abs(measured - rate))

    # Clocks differ a little, and the robot's file has the number that the program has.
    is_close = abs(measured - usual) < RATE_ROUNDING * usual
    return float(usual) if is_close else round(measured, 1)


def measure_rate(stamps: Sequence[float], numbers: Sequence[int]) -> float:
    """Return the rate of lines [Hz]. 0 for fewer than two times.

    It is the Theil-Sen slope of the lines' numbers over their times. A few pauses, bursts or lost
    lines don't change it.

    Args:
        stamps: Times at which lines arrived [s], in ascending order.
        numbers: Their numbers among all lines that arrived.
    """
    if len(stamps) < 2:
        return 0.0
    chosen = np.unique(np.linspace(0, len(stamps) - 1, MOST_RATE_LINES).astype(int))
    times = np.asarray(stamps, np.float64)[chosen]
    places = np.asarray(numbers, np.float64)[chosen]

    # The median slope of all pairs of lines ignores outliers.
    later, earlier = np.nonzero(times[:, None] > times[None, :])
    if not len(later):
        return 0.0
    return float(np.median((places[later] - places[earlier]) / (times[later] - times[earlier])))


def measure_board(probe: BoardProbe, speed: float = SPIN_SPEED) -> BoardTimes:
    """Turn all wheels together, and measure how soon the board answers and how soon it stops.

    The wheels must be off the ground. They are at rest when it returns. After an error the caller
    must close the link, which commands zero.

    Args:
        probe: Probe of the board. Its rate is measured if that wasn't done before.
        speed: Wheel speed [rad/s].

    Raises:
        LinkError: The board is lost or silent, or its wheels keep turning.

    Example:
        >>> from acsar_gym import RobotConfig, open_link
        >>> from acsar_gym.worlds import Scene
        >>> link = open_link("planar")
        >>> link.open()
        >>> link.reset(Scene())
        >>> times = measure_board(BoardProbe(link, RobotConfig()))
        >>> times.feedback_rate, round(times.command_timeout, 1)
        (100.0, 0.5)
    """
    # The rate is the clock of all other measurements.
    if not probe.rate:
        probe.measure_rate()

    # All wheels turn together, so that the mean speed shows small changes.
    command = (speed, speed, speed, speed)
    delays = _measure_delays(probe, command)
    timeout, standstill = _measure_timeout(probe, command)
    return BoardTimes(probe.rate, tuple(sorted(delays)), timeout, standstill)


def _mean(speeds: Floats) -> Floats:
    """Return the mean wheel speed of each line [rad/s], (n,)."""
    return np.asarray(np.abs(speeds).mean(axis=1))


def _measure_delays(probe: BoardProbe, command: Speeds) -> list[float]:
    """Time the first effect of a few commands [s]. Empty if a command had none."""
    delays = []
    for trial in range(DELAY_TRIALS):
        probe.stop_wheels(max(command))
        noise = _mean(probe.drive(ZERO, REST_TIME).newest).max(initial=0.0)

        # Send the command at another phase of the board's lines each time.
        probe.drive(None, trial / DELAY_TRIALS / probe.rate)

        # A dead wheel or a noisy encoder doesn't hide the first change of the mean.
        visible = max(QUIET_SPEED, 2.0 * noise)
        step = probe.drive(command, EFFECT_TIME, above=visible)
        shows = _mean(step.speeds) > visible
        if not shows.any():
            return []

        # The first byte of a line left the board a line's duration before its last byte arrived.
        delay = step.stamps[shows.argmax()] - probe.line_time - step.sent
        delays.append(max(float(delay), 0.0))
    return delays


def _measure_timeout(probe: BoardProbe, command: Speeds) -> tuple[float, float]:
    """Return the time-out and the time to standstill [s], as `BoardTimes` has them.

    Wheels that stop by themselves are compared with a commanded stop. Both falls have the same
    delay and shape, so their difference is the time-out. A line that the board repeats or a busy
    computer spoils a measurement, so two must agree.
    """
    timeouts: list[float] = []

    for trial in range(TIMEOUT_TRIALS):
        # A board that repeats a line at intervals must not spoil each trial alike.
        probe.drive(ZERO, trial * TRIAL_SHIFT)
        commanded, _ = _time_fall(probe, command, ZERO)
        by_itself, standstill = _time_fall(probe, command, None)

        # Wheels that turn for `LONGEST_TIMEOUT` don't stop by themselves.
        if math.isinf(by_itself):
            return math.inf, math.nan
        timeout = max(by_itself - commanded, 0.0)

        # Two that agree weren't spoilt.
        for earlier in timeouts:
            if abs(timeout - earlier) < SAME_TIMEOUT:
                return (timeout + earlier) / 2.0, standstill
        timeouts.append(timeout)
    return math.nan, math.nan


def _time_fall(probe: BoardProbe, command: Speeds, stop: Speeds | None) -> tuple[float, float]:
    """Turn the wheels steadily, then command a stop or nothing.

    Returns:
        Time from the newest command until the speed has fallen to `FALL_LEVEL` [s], which is
        infinite if it doesn't, and until the wheels are at rest, NaN if that wasn't seen.
    """
    # Levels are relative, so a wrong scale of the feedback doesn't matter.
    steady = probe.drive(command, SPIN_TIME)
    level = FALL_LEVEL * float(_mean(steady.newest).mean())
    longest = LONGEST_TIMEOUT if stop is None else FALL_TIME

    # Only wheels that stop by themselves are watched to their end.
    end = STANDING_SHARE * max(command) if stop is None else level
    falling = probe.drive(stop, longest, below=end)
    probe.stop_wheels(max(command))

    # Interpolate the time of the level between the lines around it.
    stamps = np.append(steady.stamps[-1], falling.stamps)
    speeds = np.append(_mean(steady.speeds)[-1], _mean(falling.speeds))
    fallen = np.flatnonzero(speeds < level)
    if not len(fallen) or not fallen[0]:
        return math.inf, math.nan
    crossing = [fallen[0], fallen[0] - 1]
    fall = float(np.interp(level, speeds[crossing], stamps[crossing])) - falling.sent
    is_at_rest = stop is None and speeds[-1] < end
    return fall, float(stamps[-1]) - falling.sent if is_at_rest else math.nan


def likely_units(ratio: float, config: RobotConfig) -> str:
    """Explain a wheel that isn't as fast as commanded: another unit, or a wrong scale.

    Args:
        ratio: Measured by commanded speed.
        config: Robot configuration.
    """
    # The wire carries rad/s, and most foreign programs print another unit.
    units = {
        "feedback in rpm": 30.0 / math.pi,
        "feedback in rev/s": 0.5 / math.pi,
        "feedback in deg/s": 180.0 / math.pi,
        "feedback in m/s": config.wheel_radius,
        "commands taken as rpm": math.pi / 30.0,
    }
    for unit, factor in units.items():
        if math.isclose(ratio, factor, rel_tol=UNIT_TOLERANCE):
            return f"likely {unit} (x {factor:.3g}): the wire carries rad/s of the wheel, both ways"

    # A slow wheel may have no scale that is wrong.
    weak = ", or the motor is too weak" if ratio < 1.0 else ""
    return f"check the scale of speeds in the board's program{weak}"
