"""Bounds of one wheel's speed: the lowest and the highest that its commands can explain."""

from __future__ import annotations

import math
from collections.abc import Iterable

from acsar_gym.config import RobotConfig
from acsar_gym.protocol import MOTORS

SLOWER = 2.0
"""Lag, ramp and deadband may be worse than configured by this factor."""
LAG = 0.45
"""Longest lag of a wheel whose lag wasn't measured [s]; 0.3 s, and some room."""
RAMP = 7.0
"""Slowest ramp of a wheel whose ramp wasn't measured [rad/s^2]; 10 rad/s^2, and some room."""
DEADBAND = 1.8
"""Largest deadband of a wheel whose deadband wasn't measured [rad/s]; 1.5 rad/s, and some room."""
DELAY = 0.25
"""Longest delay of a board whose delay wasn't measured [s]; 0.2 s, and some room."""
SHARE = 0.5
"""A wheel must reach this share of the lowest speed that is expected."""
FASTER, FASTER_KNOWN = 1.4, 1.25
"""A wheel may be faster than the highest expected speed by this factor, and one whose gain was
measured."""
FLOOR, FINE = 0.5, 0.25
"""Tolerance of a slow wheel [rad/s], and of one whose deadband was measured; a wheel that is too
slow isn't found at commands up to twice this."""
NOISE = 0.1
"""Least excess over the highest expected speed that counts [rad/s]. From there to the tolerance it
counts in part, so that it must last the longer."""
DRAGGED = 0.5
"""A wheel may be dragged from its own speed towards that of the fastest one by this share; within
its deadband, all the way."""
STEADY, PROOF = 0.05, 0.3
"""Share by which a steady command may vary, and how long a wheel must turn at it as a proof [s]."""
LEAST = 0.5
"""A wheel moves towards its command at this share of the slowest ramp and lag, at least."""


class WheelBounds:
    """The lowest and the highest speed [rad/s] that the commands of one wheel can explain.

    Attributes: `low`, `high`; `gain` and `deadband`, as configured; `wrong`, for how long the wheel
    has contradicted its commands [s].

    Args:
        config: Of the robot.
        number: Of the wheel, 0 to 3.
    """

    def __init__(self, config: RobotConfig, number: int) -> None:
        motor = config.motor.of_wheel(number)
        known = [name for name in motor._fields if _is_measured(config, name, number)]
        self._top = config.motor.max_speed
        self.gain, self.deadband = motor.gain, motor.deadband
        self._lag = max(SLOWER * motor.time_constant, 0.0 if "time_constant" in known else LAG)
        slow = math.inf if "acceleration" in known else RAMP
        self._ramp = min(motor.acceleration / SLOWER, slow)
        self._dead = max(SLOWER * motor.deadband, 0.0 if "deadband" in known else DEADBAND)
        self._faster = FASTER_KNOWN if "gain" in known else FASTER
        self._floor = FLOOR
        if "deadband" in known:
            self._floor = min(FLOOR, max(FINE, config.encoder.quantum or 0.0))
        self.reset()

    def reset(self) -> None:
        """Expect a wheel that stands."""
        self._set_low = self._set_high = self.low = self.high = self.wrong = 0.0
        self._before = self._asked = self._constant = 0.0
        self._alive, self._proven = False, math.inf

    def follow(self, high: float, low: float, passed: float) -> None:
        """Update the bounds.

        Args:
            high: Highest command that can be in effect [rad/s].
            low: Lowest one.
            passed: Time since the last update [s].
        """
        self._asked = 0.5 * (high + low)
        steady = high - low <= STEADY * abs(self._asked)
        self._constant = self._constant + passed if steady else 0.0
        top, deadband, change = self._top, self._dead, self._ramp * passed
        high, low = self.gain * high, self.gain * low
        high, low = max(high, -top), min(low, top)
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

    def slowest(self, asked: float) -> float:
        """Return the speed of the slowest wheel on its way to a command [rad/s]."""
        return self.low if asked - self.low > self.high - asked else self.high

    def forgive(self, speed: float) -> None:
        """Also expect a wheel at this speed [rad/s], or one that stands, from now on."""
        self._set_high = self.high = max(self.high, speed, 0.0)
        self._set_low = self.low = min(self.low, speed, 0.0)
        self.wrong, self._before = 0.0, speed

    def may_stand(self, asked: float) -> bool:
        """Return whether a wheel that has turned before may stand at a command [rad/s].

        That is so within a deadband, below the weakest command that has been seen to turn it.
        """
        return self._alive and self.gain * asked <= self._dead and asked < self._proven

    def _learn(self, speed: float) -> None:
        """Note whether the wheel turns as commanded."""
        asked = self._asked
        if speed * asked > 0.0 and abs(speed) > max(FLOOR, SHARE * self.gain * abs(asked)):
            self._alive = True
            if self._constant >= PROOF:
                self._proven = min(self._proven, abs(asked))

    def explains(self, speed: float) -> bool:
        """Return whether the wheel's commands explain this speed [rad/s]."""
        margin = SHARE * SHARE * self.fastest + FLOOR
        return self.low - margin <= speed <= self.high + margin

    def lack(self, speed: float) -> float:
        """Return what a speed [rad/s] lacks to agree with the commands, with sign; 0 if it does.

        That it is too fast is `excess`'s affair.
        """
        if self.low > 0.0 and speed < SHARE * self.low - self._floor:
            return self.low - speed
        if self.high < 0.0 and speed > SHARE * self.high + self._floor:
            return self.high - speed
        away = self.low >= 0.0 > speed or self.high <= 0.0 < speed
        return -speed if away and self.fastest > 2.0 * FLOOR and not self.explains(speed) else 0.0

    def excess(self, speed: float, lowest: float, highest: float) -> float:
        """Return how much too fast a wheel is, as a share of its tolerance; 0 to 1.

        Args:
            speed: Measured [rad/s].
            lowest: Lowest speed that any wheel can have [rad/s].
            highest: Highest one.
        """
        own, other = (self.high, highest) if speed > 0.0 else (-self.low, -lowest)
        own += (DRAGGED if self.fastest > self._dead else 1.0) * (other - own)
        excess = abs(speed) - self._faster * own - NOISE
        return min(max(excess / (self._floor - NOISE), 0.0), 1.0)

    def judge(self, lack: float | None, speed: float, passed: float, share: float = 1.0) -> float:
        """Note what a speed lacks; a wheel that moves towards its command isn't wrong.

        Args:
            lack: What it lacks [rad/s], with sign; None where that isn't known now.
            speed: Measured [rad/s].
            passed: Time since the last call [s].
            share: Of this time that counts, 0 to 1.

        Returns:
            For how long the wheel has been wrong [s].
        """
        self._learn(speed)
        moved, self._before = speed - self._before, speed
        if lack is None:
            return self.wrong
        moved = math.copysign(moved, moved * lack)
        if lack and moved < LEAST * min(self._ramp, abs(lack) / (self._lag or passed)) * passed:
            self.wrong += share * passed
        elif self.wrong:
            self.wrong = max(0.0, self.wrong - passed)
        return self.wrong


def longest_delay(config: RobotConfig) -> float:
    """Return the longest time from a command to its effect that the board may add [s]."""
    board = config.firmware
    delay = board.command_delay + max(board.delay_samples, default=0.0)
    return delay if "firmware.command_delay" in config.measured else max(delay, DELAY)


def longest_lag(config: RobotConfig) -> float:
    """Return the longest lag of the four wheels [s]."""
    return max(_each(config, "time_constant"))


def _each(config: RobotConfig, name: str) -> Iterable[float]:
    """Return a motor value of all wheels."""
    return (getattr(config.motor.of_wheel(n), name) for n in range(len(MOTORS)))


def _is_measured(config: RobotConfig, name: str, number: int) -> bool:
    """Return whether a value of a wheel's motor was measured."""
    field = f"motor.{name}"
    return field in config.measured or f"{field}.{MOTORS[number]}" in config.measured
