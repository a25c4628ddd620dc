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
LOOK = 0.04
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
        device: Of the robot, for messages.
    """

    def __init__(self, config: RobotConfig, device: str = "DEVICE") -> None:
        self._device = device
        board, feedback = config.firmware, 1.0 / config.feedback_rate
        line = (LINE_BYTES + config.trailing_comma) * BITS_PER_BYTE / config.baud_rate
        delay = 2.0 * (line + board.processing_time) + config.encoder.window + ADAPTER + feedback
        self._look = max(LOOK, feedback)
        self._gap = max(GAP, 2.5 * feedback)
        delay += board.command_delay + max(board.delay_samples, default=0.0)
        lag = max(config.motor.of_wheel(n).time_constant for n in range(len(WHEELS)))
        self._patience = min(max(SHORTEST, lag + LOOK), LONGEST)
        self._wheels = [_Wheel(config, n) for n in range(len(WHEELS))]
        self._looks = max(2, math.ceil(delay / self._look))
        self.reset()

    def reset(self) -> None:
        """Begin anew, with wheels that stand."""
        self._asked = deque([(ZERO, ZERO)] * self._looks, self._looks)
        self._last = self._most = self._least = ZERO
        self._since_look = self._since_line = self._fastest = 0.0
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
        fastest, self._fastest, worst = self._fastest, 0.0, 0.0
        commands = zip(self._wheels, map(max, *highs), map(min, *lows), measured, strict=True)
        for wheel, high, low, speed in commands:
            wheel.follow(high, low, passed)
            if wheel.contradicts(speed, fastest):
                wheel.wrong += passed
                worst = max(worst, wheel.wrong)
            elif wheel.wrong:
                wheel.wrong = max(0.0, wheel.wrong - passed)
            self._fastest = max(self._fastest, wheel.fastest)
        if worst + SLACK >= self._patience:
            raise self._error(measured)

    def _error(self, measured: Speeds) -> WheelError:
        """Describe the wheel that has contradicted its commands for the longest time."""
        number = max(range(len(WHEELS)), key=lambda n: self._wheels[n].wrong)
        speed, asked = measured[number], self._last[number]
        which = f"{WHEELS[number]} {self._kind(number, measured)}"
        if max(map(abs, measured)) < STILL:
            which = "all wheels stand still"
        lasted = self._wheels[number].wrong
        return WheelError(
            f"{which} ({asked:.2f} rad/s commanded, {speed:.2f} measured for {lasted:.2f} s)",
            f"lift the robot and run 'acsar-gym doctor {self._device} --spin'; check motors and "
            "encoders",
            WHEELS[number],
        )

    def _kind(self, number: int, measured: Speeds) -> str:
        """Say what is wrong with a wheel."""
        wheel, speed = self._wheels[number], measured[number]
        if abs(speed) < STILL:
            return "stands still"
        if (other := self._swapped(number, measured)) is not None:
            return f"answers {WHEELS[other]}'s command"
        if speed * (wheel.high + wheel.low) < 0.0:
            return "turns backward"
        return "turns too fast" if abs(speed) > wheel.fastest else "turns too slowly"

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

    Args:
        config: Of the robot.
        number: Of the wheel, 0 to 3.
    """

    def __init__(self, config: RobotConfig, number: int) -> None:
        motor = config.motor.of_wheel(number)
        self._top = config.motor.max_speed
        self._gain = motor.gain
        self._lag = SLOWER * motor.time_constant
        self._ramp = motor.acceleration / SLOWER
        self._deadband = SLOWER * motor.deadband
        self.reset()

    def reset(self) -> None:
        """Expect a wheel that stands."""
        self._set_low = self._set_high = self.low = self.high = self.wrong = 0.0

    def follow(self, high: float, low: float, passed: float) -> None:
        """Update the bounds.

        Args:
            high: Highest command that can be in effect [rad/s].
            low: Lowest one.
            passed: Time since the last update [s].
        """
        top, deadband, change = self._top, self._deadband, self._ramp * passed
        high, low = self._gain * high, self._gain * low
        if high > top or high < -top or low > top or low < -top:
            high, low = min(max(high, -top), top), min(max(low, -top), top)
        if -deadband <= high < 0.0:
            high = 0.0
        if 0.0 < low <= deadband:
            low = 0.0
        kept = math.exp(-passed / self._lag) if self._lag else 0.0
        falls, rises = self._set_high - change, self._set_low + change
        self._set_high = high = high if high > falls else falls
        self._set_low = low = low if low < rises else rises
        self.high = high if high > self.high else high + kept * (self.high - high)
        self.low = low if low < self.low else low + kept * (self.low - low)

    @property
    def fastest(self) -> float:
        """Highest absolute speed that the commands can explain [rad/s]."""
        return self.high if self.high > -self.low else -self.low

    def forgive(self, speed: float) -> None:
        """Also expect a wheel at this speed [rad/s], or one that stands, from now on."""
        self._set_high = self.high = max(self.high, speed, 0.0)
        self._set_low = self.low = min(self.low, speed, 0.0)
        self.wrong = 0.0

    def explains(self, speed: float) -> bool:
        """Return whether the wheel's commands explain this speed [rad/s]."""
        margin = SHARE * SHARE * self.fastest + FLOOR
        return self.low - margin <= speed <= self.high + margin

    def contradicts(self, speed: float, fastest: float) -> bool:
        """Return whether a speed contradicts the commands.

        Args:
            speed: Measured [rad/s].
            fastest: Highest absolute speed that any wheel can have [rad/s].
        """
        if self.low > 0.0 and speed < SHARE * self.low - FLOOR:
            return True
        if self.high < 0.0 and speed > SHARE * self.high + FLOOR:
            return True
        most = FASTER * self.fastest + fastest + DRAGGED
        return fastest > 2.0 * FLOOR and not -most <= speed <= most


def _each(choose: Callable[[float, float], float], some: Speeds, others: Speeds) -> Speeds:
    """Combine two sets of wheel speeds, wheel by wheel."""
    a, b, c, d = map(choose, some, others)
    return a, b, c, d
