"""Finds wheels whose measured speeds contradict the commanded ones: dead, reversed, swapped ones.

For each wheel the watch keeps the lowest and the highest speed that the commands of the last
moments can explain: a wheel follows its command at once, or at half the ramp and with twice the lag
of the robot's configuration, after any delay up to the longest. A wheel contradicts them where it
turns at less than half of that speed, the other way, or several times as fast. Where that lasts
longer than the lag explains, `WheelWatch.tick` raises WheelError.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from acsar_gym.config import BITS_PER_BYTE, LINE_BYTES, RobotConfig
from acsar_gym.errors import WheelError
from acsar_gym.protocol import WHEELS, ZERO, Speeds

SLOWER = 2.0
"""Lag, ramp and deadband may be worse than configured by this factor."""
SHARE = 0.5
"""A wheel must reach this share of the lowest speed that is expected."""
FASTER = 2.0
"""A wheel may be faster than the highest expected speed by this factor."""
FLOOR = 0.5
"""Tolerance of a slow wheel [rad/s]; commands up to twice this aren't judged."""
DRAGGED = 2.0
"""Tolerance of a fast wheel [rad/s], beside the speed of the fastest one, which may drag it."""
STILL = 0.2
"""A wheel slower than this stands still, for messages [rad/s]."""
ADAPTER = 0.03
"""Longest delay of a USB adapter in both directions [s]; FTDI's is 16 ms each by default."""
LOOK = 0.03
"""Interval of the checks [s]."""
GAP = 0.05
"""Longest time without a new line in which the board can't have stopped its wheels [s]."""
SHORTEST, LONGEST = 0.1, 0.2
"""Bounds of how long a contradiction must last [s]."""
SLACK = 1e-9
"""Tolerance for comparing sums of periods [s]."""


class WheelWatch:
    """Watches the wheels of one robot.

    Args:
        config: Of the robot; `motor`, `firmware` and `encoder` say how wheels and board answer.
    """

    def __init__(self, config: RobotConfig) -> None:
        board, feedback = config.firmware, 1.0 / config.feedback_rate
        line = (LINE_BYTES + config.trailing_comma) * BITS_PER_BYTE / config.baud_rate
        delay = 2.0 * (line + board.processing_time) + config.encoder.window + ADAPTER
        delay += feedback + config.period
        self._look = max(LOOK, feedback)
        self._gap = max(GAP, 2.5 * feedback)
        delay += board.command_delay + max(board.delay_samples, default=0.0)
        lag = max(config.motor.of_wheel(n).time_constant for n in range(len(WHEELS)))
        self._patience = min(max(SHORTEST, lag + feedback + LOOK), LONGEST)
        self._wheels = [_Wheel(config, n) for n in range(len(WHEELS))]
        self._looks = 1 + math.ceil(delay / self._look)
        self.reset()

    def reset(self) -> None:
        """Begin anew, with wheels that stand."""
        self._asked = deque([(ZERO, ZERO)] * self._looks, self._looks)
        self._last = self._most = self._least = ZERO
        self._since_look = self._since_line = 0.0
        for wheel in self._wheels:
            wheel.reset()

    def tick(self, sent: Speeds, measured: Speeds, dt: float, *, fresh: bool) -> None:
        """Take command and feedback of one control period.

        Args:
            sent: Wheel speeds that were commanded [rad/s].
            measured: Newest wheel speeds [rad/s].
            dt: Duration of the period [s].
            fresh: Whether a line arrived in it.

        Raises:
            WheelError: A wheel has contradicted its commands for too long.
        """
        if sent is not self._last:
            self._last = sent
            self._most = _each(max, self._most, sent)
            self._least = _each(min, self._least, sent)
        self._since_look += dt
        self._since_line += dt
        if not fresh:
            return
        if self._since_line > self._gap + SLACK:
            self._forgive(measured)
        self._since_line = 0.0
        if self._since_look + SLACK >= self._look:
            self._check(measured, self._since_look)
            self._since_look = 0.0

    def _forgive(self, measured: Speeds) -> None:
        """After a gap, expect what is measured, and wheels that the board stopped meanwhile."""
        self._most, self._least = _each(max, self._most, ZERO), _each(min, self._least, ZERO)
        for wheel, speed in zip(self._wheels, measured, strict=True):
            wheel.forgive(speed)

    def _check(self, measured: Speeds, passed: float) -> None:
        """Judge all wheels, `passed` [s] after the last time."""
        self._asked.append((self._most, self._least))
        self._most = self._least = self._last
        highs, lows = zip(*self._asked, strict=True)
        fastest = 0.0
        for wheel, high, low in zip(self._wheels, map(max, *highs), map(min, *lows), strict=True):
            fastest = max(fastest, wheel.follow(high, low, passed))
        worst = 0.0
        for wheel, speed in zip(self._wheels, measured, strict=True):
            worst = max(worst, wheel.judge(speed, fastest, passed))
        if worst + SLACK >= self._patience:
            raise self._error(measured)

    def _error(self, measured: Speeds) -> WheelError:
        """Describe the wheel that has contradicted its commands for the longest time."""
        number = max(range(len(WHEELS)), key=lambda n: self._wheels[n].wrong)
        wheel, speed, asked = self._wheels[number], measured[number], self._last[number]
        what = "turns at a wrong speed"
        if abs(speed) < STILL:
            what = "stands still"
        elif (other := self._swapped(number, measured)) is not None:
            what = f"answers {WHEELS[other]}'s command"
        elif speed * (wheel.high + wheel.low) < 0.0:
            what = "turns backward"
        found = f"{WHEELS[number]} {what} ({asked:.2f} rad/s commanded, {speed:.2f} measured"
        return WheelError(
            f"{found} for {wheel.wrong:.2f} s)",
            "lift the robot and run 'acsar-gym doctor DEVICE --spin'; check motor and encoder",
            WHEELS[number],
        )

    def _swapped(self, number: int, measured: Speeds) -> int | None:
        """Return the wheel whose command this one answers while it answers this one's."""
        own = self._wheels[number]
        for other, wheel in enumerate(self._wheels):
            crossed = wheel.explains(measured[number]) and own.explains(measured[other])
            if other != number and crossed and not own.explains(measured[number]):
                return other
        return None


class _Wheel:
    """The lowest and the highest speed [rad/s] that the commands of one wheel can explain.

    Attributes: `low`, `high`; `wrong`, for how long the wheel has contradicted them [s].
    """

    def __init__(self, config: RobotConfig, number: int) -> None:
        motor = config.motor.of_wheel(number)
        self._top = config.motor.max_speed
        self._lag = SLOWER * motor.time_constant
        self._ramp = motor.acceleration / SLOWER
        self._deadband = SLOWER * motor.deadband
        self.reset()

    def reset(self) -> None:
        """Expect a wheel that stands."""
        self._set_low = self._set_high = self.low = self.high = self.wrong = 0.0

    def follow(self, high: float, low: float, passed: float) -> float:
        """Update the bounds.

        Args:
            high: Highest command that can be in effect [rad/s].
            low: Lowest one.
            passed: Time since the last update [s].

        Returns:
            The highest absolute speed that can be explained [rad/s].
        """
        high, low = self._obeyed(high, max), self._obeyed(low, min)
        change = self._ramp * passed
        self._set_high = max(high, self._set_high - change)
        self._set_low = min(low, self._set_low + change)
        kept = math.exp(-passed / self._lag) if self._lag else 0.0
        self.high = self._set_high + kept * max(self.high - self._set_high, 0.0)
        self.low = self._set_low + kept * min(self.low - self._set_low, 0.0)
        return max(self.high, -self.low)

    def _obeyed(self, command: float, extreme: Callable[[float, float], float]) -> float:
        """Return the speed that a command leads to; `extreme` chooses within the deadband."""
        speed = min(max(command, -self._top), self._top)
        return speed if abs(speed) > self._deadband else extreme(speed, 0.0)

    def forgive(self, speed: float) -> None:
        """Also expect a wheel at this speed [rad/s], or one that stands, from now on."""
        self._set_high = self.high = max(self.high, speed, 0.0)
        self._set_low = self.low = min(self.low, speed, 0.0)
        self.wrong = 0.0

    def explains(self, speed: float) -> bool:
        """Return whether commands explain this speed [rad/s]."""
        margin = SHARE * SHARE * max(self.high, -self.low) + FLOOR
        return self.low - margin <= speed <= self.high + margin

    def judge(self, speed: float, fastest: float, passed: float) -> float:
        """Count for how long the wheel contradicts its commands.

        Args:
            speed: Measured [rad/s].
            fastest: Highest absolute speed that any wheel can have [rad/s].
            passed: Time since the last call [s].

        Returns:
            For how long it has contradicted them [s].
        """
        forward = self.low > 0.0 and speed < SHARE * self.low - FLOOR
        backward = self.high < 0.0 and speed > SHARE * self.high + FLOOR
        most = FASTER * max(self.high, -self.low) + fastest + DRAGGED
        fast = fastest > 2.0 * FLOOR and abs(speed) > most
        wrong = forward or backward or fast
        self.wrong = max(0.0, self.wrong + passed if wrong else self.wrong - passed)
        return self.wrong


def _each(choose: Callable[[float, float], float], some: Speeds, others: Speeds) -> Speeds:
    """Combine two sets of wheel speeds, wheel by wheel."""
    a, b, c, d = map(choose, some, others)
    return a, b, c, d
