"""The robot's end of the wire: four wheel speeds to command lines, feedback lines to speeds."""

from __future__ import annotations

import math

from acsar_gym.config import RobotConfig
from acsar_gym.links.base import WHILE_WAITING, Link, arrivals_of, echoes_of, is_stamped
from acsar_gym.links.handshake import silence_error, still_turning_error
from acsar_gym.links.lateness import STANDSTILL
from acsar_gym.protocol import (
    ZERO,
    Decoder,
    EchoDecoder,
    Reading,
    Speeds,
    encode,
    encode_line,
    line_end,
)
from acsar_gym.safety import rules
from acsar_gym.safety.set_points import SetPointWatch

STANDSTILL_TIMEOUT = 5.0  # how long a reset waits for the wheels to stand still [s]
ECHO_SHARE = 0.5  # a board that sends echoes alone for this share of `feedback_timeout` is silent
STANDSTILL_TICKS = 2  # how many fresh readings in a row must show standstill


class Wire:
    """Exchanges lines with the board behind a link, one command line in each control period.

    Attributes: `decoder`, with the counters of refused input; `speeds`, the newest wheel speeds
    [rad/s], old ones for motors that a line doesn't name; `age`, the time since the newest valid
    line [s]; `stamp`, the link's time at the end of the newest period [s]; `began`, its time at
    the beginning of the first period after `settle` [s]; `written`, its time when the last byte of
    the newest command has left the port, at the baud rate [s]; 0 in simulation; `measured`, when
    the newest line was measured, where the link's lines say so [s], else None. Where the link's
    board echoes, `decoder` is one that leaves the echoes out.

    Args:
        link: To the board.
        config: Of the robot.
        period: Of an exchange [s]; None for the control period.
    """

    def __init__(self, link: Link, config: RobotConfig, period: float | None = None) -> None:
        self.decoder = Decoder()
        self._link = link
        self._period = period or config.period
        self._rules = rules.make_rules(config)
        self._end = line_end(trailing_comma=config.trailing_comma)
        self._motors, self._encoders = config.wheels.motors, config.wheels.encoders
        self._encoded: Speeds = ZERO
        self._command = encode_line(*ZERO, self._end)
        self.speeds: Speeds = ZERO
        self.age = 0.0
        self.stamp = self.began = self.written = 0.0
        self._settled = self._timed = False
        self._echoes: EchoDecoder | None = None
        self._set_points: SetPointWatch | None = None
        self._line_time = config.line_time
        self._stamped = False
        self.measured: float | None = None
        self._shares: list[float] = []

    def reset(self) -> None:
        """Forget what was received; the wheels count as standing."""
        echoes = echoes_of(self._link)
        self._echoes = EchoDecoder(encode(ZERO)) if echoes else None  # a reset stops the board
        self.decoder = self._echoes or Decoder()
        self._set_points = None if echoes is None else SetPointWatch(echoes=echoes)
        self.speeds = ZERO
        self.age = 0.0
        self.stamp = self.began = self._link.now()
        self._settled = False
        self._timed = self._link.lateness is not None  # a replay knows it from its reset on
        self._stamped, self.measured = is_stamped(self._link), None

    def send(self, speeds: Speeds) -> None:
        """Send a command line; it is encoded again only where `speeds` is another object."""
        if speeds is not self._encoded:
            wired = speeds if self._motors is None else self._motors.to_wire(speeds)
            self._encoded, self._command = speeds, encode_line(*wired, self._end)
            if self._set_points is not None:
                self._set_points.note(wired)
        self.send_line(self._command)

    def send_line(self, line: bytes) -> None:
        """Send a line as it is; where the board echoes, so that its echo is unlike feedback."""
        self._link.write(line if self._echoes is None else self._echoes.mark(line))

    def leave_out_echoes(self, *sent: bytes) -> None:
        """Leave out echoes from now on, and those of lines that were sent before."""
        self.decoder = self._echoes = EchoDecoder(*sent)

    def exchange(self, speeds: Speeds | None) -> tuple[list[Speeds], float]:
        """Send a command line, let one control period pass, and decode what arrived in it.

        Returns:
            The wheel speeds of each line that arrived, oldest first, and how long the period was
            by the link's clock [s].

        Raises:
            LinkError: The link is lost, the board was silent for `feedback_timeout`, or sends back
                what was commanded instead of what it measures.
        """
        if speeds is not None:
            self.send(speeds)
        link = self._link
        if self._timed:
            self.written = link.now() + (0.0 if self._stamped else self._line_time)
        heard = []
        for reading in self.decoder.feed(link.advance(self._period)):
            if self._set_points is not None:
                self._set_points.check(reading)
            if self._encoders is not None:
                reading = Reading(self._encoders.to_wheels(reading.speeds))  # noqa: PLW2901
            self.speeds = reading.over(self.speeds)
            heard.append(self.speeds)
        if self._stamped:
            self._take_stamps()
        stamp = link.now()
        lasted = stamp - self.stamp
        self.stamp = stamp
        if self._settled:  # pauses between the reset and the first command don't count
            self.began, self._settled = stamp - self._period, False
        self.age = 0.0 if heard else self.age + lasted
        if rules.is_silent(self.age, self._rules) or self._hears_only_echoes():
            raise silence_error(self.age, self.decoder)
        return heard, lasted

    def _hears_only_echoes(self) -> bool:
        """Whether only echoes come; before the robot stops for it, as it would then drive again."""
        echoes = self._echoes
        age = self.age / ECHO_SHARE
        return echoes is not None and echoes.only_echoes and rules.is_silent(age, self._rules)

    def _take_stamps(self) -> None:
        """Note for how long the speeds of each line held, by the times at which it was measured."""
        self._shares = []
        for stamp, _ in arrivals_of(self._link):
            before = stamp if self.measured is None else self.measured
            self._shares.append(max(stamp - before, 0.0))
            self.measured = max(stamp, before)

    def shares(self, heard: list[Speeds], lasted: float) -> list[tuple[Speeds, float]]:
        """What odometry integrates: wheel speeds [rad/s], and for how long they held [s]."""
        if self._stamped and len(heard) == len(self._shares):
            return list(zip(heard, self._shares, strict=True))
        if lasted > 2.0 * self._period and len(heard) > 1:
            share = round(lasted / len(heard) * 1e9) / 1e9  # as stamps of ROS tell it
            *earlier, last = heard
            return [(one, share) for one in earlier] + [(last, lasted - share * len(earlier))]
        return [(self.speeds, lasted)]

    def settle(self) -> None:
        """Command zero until the wheels stand still; counts periods, as clocks may jump.

        Raises:
            LinkError: As for `exchange`, or the wheels keep turning.
        """
        standing = 0
        for _ in range(math.ceil(STANDSTILL_TIMEOUT / self._period)):
            WHILE_WAITING.get()()
            self.exchange(ZERO)
            if self.age == 0.0:
                still = max(map(abs, self.speeds)) < STANDSTILL
                standing = standing + 1 if still else 0
            if standing == STANDSTILL_TICKS:
                self.began, self._settled = self.stamp, True
                return
        if max(map(abs, self.speeds)) < STANDSTILL:
            raise silence_error(self.age, self.decoder)
        raise still_turning_error(STANDSTILL_TIMEOUT, self.speeds)
