"""Finds wheels whose measured speeds contradict the commanded ones: dead, reversed, swapped ones.

For each wheel the watch keeps the lowest and the highest speed that the commands of the last
moments can explain: a wheel follows its command at once, or as slowly as any board does whose lag,
ramp, deadband and delay weren't measured; where they were, at half the ramp and with twice the lag.
A wheel contradicts its commands where it turns at less than half of that speed, the other way, or
several times as fast.

Wheels are also compared, which needs no model: one that stands, or turns the other way, while
another turns at the same command is wrong, whatever the deadband. A wheel that moves towards its
command isn't wrong. And so are the sides: a robot that turns left at commands that all turn it
right has them swapped. Where a contradiction lasts, `WheelWatch.tick` raises WheelError.
"""

from __future__ import annotations

import math
from collections import deque

from acsar_gym.config import BITS_PER_BYTE, LINE_BYTES, RobotConfig
from acsar_gym.errors import WheelError
from acsar_gym.protocol import WHEELS, ZERO, Speeds
from acsar_gym.safety.wheel_bounds import FLOOR, WheelBounds, longest_delay, longest_lag

STILL = 0.2
"""A wheel slower than this stands still, for messages [rad/s]."""
MOVES = 0.4
"""A wheel that is faster than this proves that its command turns wheels [rad/s]."""
QUARTER = 0.25
"""A wheel is behind others where it has less than this share of their speed."""
ADAPTER = 0.03
"""Longest delay of a USB adapter in both directions [s]; FTDI's is 16 ms each by default."""
LOOK = 0.04
"""Interval of the checks [s]."""
GAP = 0.05
"""Longest time without a new line in which the board can't have stopped its wheels [s]."""
SHORTEST, LONGEST = 0.16, 0.2
"""Bounds of how long a contradiction must last [s]."""
UNEVEN = 0.125
"""Sides that answer at different rates turn a sound robot by up to this share of the speed by which
its wheels are still to change."""
MIRRORED = (1, 0, 3, 2)
"""Numbers of the wheels on the other side."""
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
        delay += longest_delay(config)
        self._patience = min(max(SHORTEST, longest_lag(config) + LOOK), LONGEST)
        self._wheels = [WheelBounds(config, n) for n in range(len(WHEELS))]
        self._turn = WheelBounds(config, 0)
        self._looks = max(2, math.ceil(delay / self._look))
        self.reset()

    def reset(self) -> None:
        """Begin anew, with wheels that stand."""
        still: tuple[float, ...] = *ZERO, 0.0  # of the wheels, and the turn
        self._last = ZERO
        self._most = self._least = still
        self._asked = deque([(still, still)] * self._looks, self._looks)
        self._since_look = self._since_line = 0.0
        self._paired = self._looks
        for bounds in (*self._wheels, self._turn):
            bounds.reset()

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
            asked = *sent, _turn_of(sent)
            self._most = tuple(map(max, self._most, asked))
            self._least = tuple(map(min, self._least, asked))
            if sent[0] != sent[3] or sent[1] != sent[2]:
                self._paired = -1
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
        self._most = tuple(max(asked, 0.0) for asked in self._most)
        self._least = tuple(min(asked, 0.0) for asked in self._least)
        for wheel, speed in zip(self._wheels, measured, strict=True):
            wheel.forgive(speed)
        self._turn.forgive(_turn_of(measured))

    def _check(self, measured: Speeds, passed: float) -> None:
        """Judge all wheels, `passed` [s] after the last time."""
        self._asked.append((self._most, self._least))
        right, left, rear_left, rear_right = self._last
        self._most = self._least = *self._last, _turn_of(self._last)
        self._paired = self._paired + 1 if right == rear_right and left == rear_left else 0
        highs, lows = zip(*self._asked, strict=True)
        wheels = self._wheels
        each = (*wheels, self._turn)
        for bounds, high, low in zip(each, map(max, *highs), map(min, *lows), strict=True):
            bounds.follow(high, low, passed)
        lowest, highest = min(wheel.low for wheel in wheels), max(wheel.high for wheel in wheels)
        crossed = self._is_crossed(measured)
        worst = 0.0
        for number, (wheel, speed) in enumerate(zip(wheels, measured, strict=True)):
            lack, share = wheel.lack(speed) or self._behind(number, measured), 1.0
            if crossed:
                lack = measured[MIRRORED[number]] - speed
            elif not lack and any(self._last) and (excess := wheel.excess(speed, lowest, highest)):
                lack, share = math.copysign(wheel.fastest, speed) - speed, excess
            worst = max(worst, wheel.judge(lack, speed, passed, share))
        if worst + SLACK >= self._patience:
            raise self._error(measured)

    def _is_crossed(self, measured: Speeds) -> bool:
        """Return whether the robot turns the other way than commands explain."""
        asked, turns = _turn_of(self._last), _turn_of(measured)
        change = max(max(wheel.high - wheel.low, wheel.fastest) for wheel in self._wheels)
        margin = 0.5 * FLOOR + UNEVEN * change
        if asked * turns >= 0.0 or abs(asked) < margin:
            return False
        a, b, c, d = map(WheelBounds.slowest, self._wheels, self._last)
        slow = _turn_of((a, b, c, d))
        return (
            not min(self._turn.low, slow) - margin <= turns <= max(self._turn.high, slow) + margin
        )

    def _behind(self, number: int, measured: Speeds) -> float | None:
        """Return what a wheel lacks of the speed of the other one on its side [rad/s], or 0.

        None where they can't be compared: they didn't have the same commands for a while, or the
        other one doesn't turn as commanded, either.
        """
        other, asked = len(WHEELS) - 1 - number, self._last[number]
        own, pair = self._wheels[number], self._wheels[other]
        if self._paired < self._looks or abs(asked) <= MOVES:
            return 0.0
        if asked * measured[other] <= 0.0:
            return None
        turns = min(abs(measured[other]) / pair.gain, abs(asked))
        if turns <= MOVES or (own.deadband > pair.deadband and turns <= 2.0 * own.deadband):
            return 0.0
        if own.may_stand(abs(asked)):
            return 0.0
        expected = own.gain * math.copysign(turns, asked)
        ahead = measured[number] * math.copysign(1.0, asked)
        return expected - measured[number] if ahead < QUARTER * abs(expected) else 0.0

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
            f"encoders, or identify this robot ('acsar-gym identify {self._device}')",
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


def _turn_of(speeds: Speeds) -> float:
    """Return half the difference of right and left wheel speeds [rad/s]."""
    right, left, rear_left, rear_right = speeds
    return 0.25 * (right + rear_right - left - rear_left)
