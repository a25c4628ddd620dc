"""The driver's end of the wire: four wheel speeds to command lines, feedback lines to speeds."""

from __future__ import annotations

import logging
import math

from acsar_gym.config import RobotConfig
from acsar_gym.links.base import WHILE_WAITING, Link
from acsar_gym.links.handshake import silence_error, still_turning_error
from acsar_gym.links.lateness import STANDSTILL
from acsar_gym.protocol import ZERO, Decoder, Reading, Speeds, encode_line, line_end
from acsar_gym.safety import rules

STANDSTILL_TIMEOUT = 5.0  # longest wait of a reset for wheels at rest [s]
STANDSTILL_LINES = 2  # lines in a row that must show wheels at rest
LOG = logging.getLogger("acsar_gym.wire")
"""Logs what is sent and received, with the link's time, at level DEBUG."""


def round_stamp(seconds: float) -> float:
    """Round a time [s] to whole nanoseconds, as recordings and ROS have it."""
    return round(seconds * 1e9) / 1e9


class Wire:
    """Exchanges lines with the board behind a link, one command line in each control period.

    Attributes:
        decoder: Decoder, with the counters of refused input.
        speeds: Newest wheel speeds [rad/s]. Motors that a line doesn't contain keep theirs.
        age: Time since the newest valid line [s].
        stamp: The link's time at the end of the newest period [s].
        start: The link's time at the start of the first period after `settle` [s].
        written: The link's time when the last byte of the newest command left the port, at the
            baud rate [s]. 0 in simulation.
        measured: When the newest line was measured [s]. None if the link's lines have no stamps.

    Args:
        link: Link to the board.
        config: Robot configuration.
    """

    def __init__(self, link: Link, config: RobotConfig) -> None:
        self._link = link
        self._period = config.period
        self._rules = rules.make_rules(config)
        self._line_time = config.line_time
        self._line_end = line_end(trailing_comma=config.trailing_comma)
        self._motors = config.wheels.motors
        self._encoders = config.wheels.encoders
        self._encoded: Speeds = ZERO
        self._command = encode_line(*ZERO, self._line_end)
        self._logs = False

        self.decoder = Decoder()
        self.speeds: Speeds = ZERO
        self.age = 0.0
        self.stamp = self.start = self.written = 0.0
        self.measured: float | None = None
        self._is_settled = False
        self._is_timed = False
        self._is_stamped = False
        self._line_durations: list[float] = []

    def reset(self) -> None:
        """Forget what was received. The wheels count as being at rest."""
        self.decoder = Decoder()
        self.speeds = ZERO
        self.age = 0.0
        self.stamp = self.start = self._link.now()
        self.measured = None
        self._is_settled = False
        self._is_timed = self._link.lateness is not None  # a replay knows it from its reset on
        self._is_stamped = self._link.stamped
        self._logs = LOG.isEnabledFor(logging.DEBUG)

    def send(self, speeds: Speeds) -> None:
        """Send a command line. It is encoded again only if `speeds` is another object."""
        if speeds is not self._encoded:
            wired = speeds if self._motors is None else self._motors.to_wire(speeds)
            self._encoded = speeds
            self._command = encode_line(*wired, self._line_end)
        if self._logs:
            LOG.debug("%.4f sent %r", self._link.now(), self._command)
        self._link.write(self._command)

    def exchange(self, speeds: Speeds | None) -> tuple[list[Speeds], float]:
        """Send a command line, let one control period pass, and decode what arrived in it.

        Args:
            speeds: Wheel speeds [rad/s]. None to send nothing.

        Returns:
            The wheel speeds of each line that arrived, oldest first, and the duration of the
            period on the link's clock [s].

        Raises:
            LinkError: The link is lost, or the board was silent for `feedback_timeout`.
        """
        link = self._link
        if speeds is not None:
            self.send(speeds)
        if self._is_timed:
            self.written = link.now() + (0.0 if self._is_stamped else self._line_time)

        data = link.advance(self._period)
        lines = []
        for reading in self.decoder.feed(data):
            # From here on, speeds are those of wheels, not of letters.
            if self._encoders is not None:
                reading = Reading(self._encoders.to_wheels(reading.speeds))  # noqa: PLW2901
            self.speeds = reading.over(self.speeds)
            lines.append(self.speeds)
        if self._is_stamped:
            self._read_stamps()

        stamp = link.now()
        duration = stamp - self.stamp
        self.stamp = stamp
        if self._logs and data:
            LOG.debug("%.4f received %r", stamp, data)
        if self._is_settled:  # pauses between the reset and the first command don't count
            self._is_settled = False
            self.start = stamp - self._period

        # A silent board keeps its last speeds until the time-out.
        if lines:
            self.age = 0.0
        else:
            self.age += duration
            if rules.is_silent(self.age, self._rules):
                raise silence_error(self.age, self.decoder)
        return lines, duration

    def _read_stamps(self) -> None:
        """Find how long the speeds of each line held, from the times of their measurement."""
        self._line_durations = []
        for stamp, _ in self._link.arrivals:
            previous = stamp if self.measured is None else self.measured
            self._line_durations.append(max(stamp - previous, 0.0))
            self.measured = max(stamp, previous)

    def shares(self, lines: list[Speeds], duration: float) -> list[tuple[Speeds, float]]:
        """Return what odometry integrates after an exchange.

        Args:
            lines: Wheel speeds of each line [rad/s], as `exchange` returned them.
            duration: Duration of the period [s].

        Returns:
            Wheel speeds [rad/s], and how long they held [s].
        """
        if self._is_stamped and len(lines) == len(self._line_durations):
            return list(zip(lines, self._line_durations, strict=True))

        # After a pause, each line that waited in the buffer has its share of the time.
        if duration > 2.0 * self._period and len(lines) > 1:
            share = round_stamp(duration / len(lines))
            *earlier, newest = lines
            shares = [(speeds, share) for speeds in earlier]
            return [*shares, (newest, duration - share * len(earlier))]
        return [(self.speeds, duration)]

    def settle(self) -> None:
        """Command zero until the wheels are at rest. Periods are counted, since clocks may jump.

        Raises:
            LinkError: The link or the board fails, or the wheels keep turning.
        """
        # Several lines in a row, as a single zero may be a glitch.
        lines_at_rest = 0
        for _ in range(math.ceil(STANDSTILL_TIMEOUT / self._period)):
            WHILE_WAITING.get()()
            self.exchange(ZERO)
            if self.age == 0.0:
                is_at_rest = max(map(abs, self.speeds)) < STANDSTILL
                lines_at_rest = lines_at_rest + 1 if is_at_rest else 0
            if lines_at_rest == STANDSTILL_LINES:
                self.start = self.stamp
                self._is_settled = True
                return

        # Too few lines came for a decision, or they show wheels that turn.
        if max(map(abs, self.speeds)) < STANDSTILL:
            raise silence_error(self.age, self.decoder)
        raise still_turning_error(STANDSTILL_TIMEOUT, self.speeds)
