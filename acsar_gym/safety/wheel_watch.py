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

from acsar_gym.config import RobotConfig
from acsar_gym.errors import WheelError
from acsar_gym.protocol import MOTORS, WHEELS, ZERO, Speeds

SLOWER_FACTOR = 2.0  # lag, ramp and deadband may be worse than configured by this factor
UNKNOWN_LAG = 0.45  # longest lag of a wheel whose lag wasn't measured [s]; 0.3 s, and some room
UNKNOWN_RAMP = 7.0  # where it wasn't measured: 10 rad/s^2, and some room [rad/s^2]
UNKNOWN_DEADBAND = 1.8  # where it wasn't measured: 1.5 rad/s, and some room [rad/s]
UNKNOWN_DELAY = 0.25  # where it wasn't measured: 0.2 s, and some room [s]
REACHED_SHARE = 0.5  # a wheel must reach this share of the lowest speed that is expected
FASTER_FACTOR, FASTER_KNOWN = 1.4, 1.25  # over the highest expected speed; with a measured gain
SPEED_TOLERANCE, FINE_TOLERANCE = 0.5, 0.25
"""Tolerance of a slow wheel [rad/s], and of one whose deadband was measured; a wheel that is too
slow isn't found at commands up to twice this."""
LEAST_EXCESS = 0.1
"""Least excess over the highest expected speed that counts [rad/s]. From there to the tolerance it
counts in part, so that it must last the longer."""
DRAGGED_SHARE = 0.5  # towards the fastest wheel's speed; within its deadband all the way
STEADY_SHARE, PROOF_TIME = 0.05, 0.3
"""Share by which a steady command may vary, and how long a wheel must turn at it as a proof [s]."""
LEAST_PROGRESS = 0.5  # of the slowest ramp and lag: a wheel that moves towards its command


class WheelBounds:
    """The lowest and the highest speed [rad/s] that the commands of one wheel can explain.

    Attributes: `low`, `high`; `gain` and `deadband`, as configured; `wrong`, for how long the wheel
    has contradicted its commands [s].
    """

    def __init__(self, config: RobotConfig, number: int) -> None:
        motor = config.motor.of_wheel(number)
        measured = [
            name
            for name in motor._fields
            if f"motor.{name}" in config.measured
            or f"motor.{name}.{MOTORS[number]}" in config.measured
        ]
        self._top = config.motor.max_speed
        self.gain, self.deadband = motor.gain, motor.deadband
        self._lag = max(
            SLOWER_FACTOR * motor.time_constant, 0.0 if "time_constant" in measured else UNKNOWN_LAG
        )
        slow = math.inf if "acceleration" in measured else UNKNOWN_RAMP
        self._ramp = min(motor.acceleration / SLOWER_FACTOR, slow)
        self._dead = max(
            SLOWER_FACTOR * motor.deadband, 0.0 if "deadband" in measured else UNKNOWN_DEADBAND
        )
        self._faster = FASTER_KNOWN if "gain" in measured else FASTER_FACTOR
        self._floor = SPEED_TOLERANCE
        if "deadband" in measured:
            self._floor = min(SPEED_TOLERANCE, max(FINE_TOLERANCE, config.encoder.quantum or 0.0))
        self.reset()

    def reset(self) -> None:
        """Expect a wheel that stands."""
        self._set_low = self._set_high = self.low = self.high = self.wrong = 0.0
        self._before = self._asked = self._constant = 0.0
        self._alive, self._proven = False, math.inf

    def follow(self, high: float, low: float, passed: float) -> None:
        """Update the bounds."""
        self._asked = 0.5 * (high + low)
        steady = high - low <= STEADY_SHARE * abs(self._asked)
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

    def explains(self, speed: float) -> bool:
        """Return whether the wheel's commands explain this speed [rad/s]."""
        margin = REACHED_SHARE * REACHED_SHARE * self.fastest + SPEED_TOLERANCE
        return self.low - margin <= speed <= self.high + margin

    def lack(self, speed: float) -> float:
        """Return what a speed [rad/s] lacks to agree with the commands, with sign; 0 if it does.

        That it is too fast is `excess`'s affair.
        """
        if self.low > 0.0 and speed < REACHED_SHARE * self.low - self._floor:
            return self.low - speed
        if self.high < 0.0 and speed > REACHED_SHARE * self.high + self._floor:
            return self.high - speed
        away = self.low >= 0.0 > speed or self.high <= 0.0 < speed
        return (
            -speed
            if away and self.fastest > 2.0 * SPEED_TOLERANCE and not self.explains(speed)
            else 0.0
        )

    def excess(self, speed: float, lowest: float, highest: float) -> float:
        """Return how much too fast a wheel is, as a share of its tolerance; 0 to 1."""
        fastest, other = (self.high, highest) if speed > 0.0 else (-self.low, -lowest)
        fastest += (DRAGGED_SHARE if self.fastest > self._dead else 1.0) * (other - fastest)
        excess = abs(speed) - self._faster * fastest - LEAST_EXCESS
        return min(max(excess / (self._floor - LEAST_EXCESS), 0.0), 1.0)

    def judge(self, lack: float | None, speed: float, passed: float, share: float = 1.0) -> float:
        """Note what a speed lacks; a wheel that moves towards its command isn't wrong.

        Returns:
            For how long the wheel has been wrong [s].
        """
        command = self._asked
        reached = max(SPEED_TOLERANCE, REACHED_SHARE * self.gain * abs(command))
        if speed * command > 0.0 and abs(speed) > reached:
            self._alive = True
            if self._constant >= PROOF_TIME:
                self._proven = min(self._proven, abs(command))
        moved, self._before = speed - self._before, speed
        if lack is None:
            return self.wrong
        moved = math.copysign(moved, moved * lack)
        if (
            lack
            and moved < LEAST_PROGRESS * min(self._ramp, abs(lack) / (self._lag or passed)) * passed
        ):
            self.wrong += share * passed
        elif self.wrong:
            self.wrong = max(0.0, self.wrong - passed)
        return self.wrong


STILL_SPEED = 0.2  # a wheel slower than this stands still, for messages [rad/s]
MOVING_SPEED = 0.4  # a wheel that is faster than this proves that its command turns wheels [rad/s]
BEHIND_SHARE = 0.25  # a wheel is behind others where it has less than this share of their speed
ADAPTER_DELAY = 0.03  # longest of a USB adapter, both ways [s]; FTDI's is 16 ms each by default
CHECK_INTERVAL = 0.04  # interval of the checks [s]
FEEDBACK_GAP = 0.05  # longest without a line in which the board can't have stopped its wheels [s]
MIN_PATIENCE, MAX_PATIENCE = 0.16, 0.2  # bounds of how long a contradiction must last [s]
UNEVEN_SHARE = 0.125
"""Sides that answer at different rates turn a sound robot by up to this share of the speed by which
its wheels are still to change."""
MIRRORED_WHEELS = (1, 0, 3, 2)  # numbers of the wheels on the other side
WATCH_SLACK = 1e-9  # tolerance for comparing sums of periods [s]


class WheelWatch:
    """Watches the wheels of one robot."""

    def __init__(self, config: RobotConfig, device: str = "DEVICE") -> None:
        self._device = device
        board, feedback = config.firmware, 1.0 / config.feedback_rate
        measured = "firmware.command_delay" in config.measured
        slow = board.command_delay + max(board.delay_samples, default=0.0)
        delay = slow if measured else max(slow, UNKNOWN_DELAY)
        delay += 2.0 * config.wire_time + config.encoder.window + ADAPTER_DELAY + feedback
        lag = max(config.motor.of_wheel(wheel).time_constant for wheel in range(4))
        self._look = max(CHECK_INTERVAL, feedback)
        self._gap = max(FEEDBACK_GAP, 2.5 * feedback)
        self._patience = min(max(MIN_PATIENCE, lag + CHECK_INTERVAL), MAX_PATIENCE)
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
        if self._since_line > self._gap + WATCH_SLACK:
            # The board may have stopped its wheels meanwhile.
            self._most = tuple(max(asked, 0.0) for asked in self._most)
            self._least = tuple(min(asked, 0.0) for asked in self._least)
            for wheel, speed in zip(self._wheels, measured, strict=True):
                wheel.forgive(speed)
            self._turn.forgive(_turn_of(measured))
        self._since_line = 0.0
        if self._since_look + WATCH_SLACK >= self._look:
            self._check_wheels(measured, self._since_look)
            self._since_look = 0.0

    def _check_wheels(self, measured: Speeds, passed: float) -> None:
        """Judge all wheels, `passed` [s] after the last time."""
        self._asked.append((self._most, self._least))
        right, left, rear_left, rear_right = self._last
        self._most = self._least = *self._last, _turn_of(self._last)
        self._paired = self._paired + 1 if right == rear_right and left == rear_left else 0
        highs, lows = zip(*self._asked, strict=True)
        wheels = self._wheels
        watched = (*wheels, self._turn)
        for bounds, high, low in zip(watched, map(max, *highs), map(min, *lows), strict=True):
            bounds.follow(high, low, passed)
        lowest, highest = min(wheel.low for wheel in wheels), max(wheel.high for wheel in wheels)
        crossed = self._is_crossed(measured)
        worst = 0.0
        for number, (wheel, speed) in enumerate(zip(wheels, measured, strict=True)):
            lack, share = wheel.lack(speed) or self._compare_pair(number, measured), 1.0
            if crossed:
                lack = measured[MIRRORED_WHEELS[number]] - speed
            elif not lack and any(self._last) and (excess := wheel.excess(speed, lowest, highest)):
                lack, share = math.copysign(wheel.fastest, speed) - speed, excess
            worst = max(worst, wheel.judge(lack, speed, passed, share))
        if worst + WATCH_SLACK >= self._patience:
            raise self._describe_fault(measured)

    def _is_crossed(self, measured: Speeds) -> bool:
        """Return whether the robot turns the other way than commands explain."""
        asked, turns = _turn_of(self._last), _turn_of(measured)
        change = max(max(wheel.high - wheel.low, wheel.fastest) for wheel in self._wheels)
        margin = 0.5 * SPEED_TOLERANCE + UNEVEN_SHARE * change
        if asked * turns >= 0.0 or abs(asked) < margin:
            return False
        a, b, c, d = map(WheelBounds.slowest, self._wheels, self._last)
        slow = _turn_of((a, b, c, d))
        return (
            not min(self._turn.low, slow) - margin <= turns <= max(self._turn.high, slow) + margin
        )

    def _compare_pair(self, number: int, measured: Speeds) -> float | None:
        """Return what a wheel lacks of the speed of the other one on its side [rad/s], or 0.

        None where they can't be compared: they didn't have the same commands for a while, or the
        other one doesn't turn as commanded, either.
        """
        other, command = len(WHEELS) - 1 - number, self._last[number]
        wheel, pair = self._wheels[number], self._wheels[other]
        if self._paired < self._looks or abs(command) <= MOVING_SPEED:
            return 0.0
        if command * measured[other] <= 0.0:
            return None
        turns = min(abs(measured[other]) / pair.gain, abs(command))
        if turns <= MOVING_SPEED or (
            wheel.deadband > pair.deadband and turns <= 2.0 * wheel.deadband
        ):
            return 0.0
        if wheel.may_stand(abs(command)):
            return 0.0
        expected = wheel.gain * math.copysign(turns, command)
        ahead = measured[number] * math.copysign(1.0, command)
        return expected - measured[number] if ahead < BEHIND_SHARE * abs(expected) else 0.0

    def _describe_fault(self, measured: Speeds) -> WheelError:
        number = max(range(len(WHEELS)), key=lambda n: self._wheels[n].wrong)
        wheel, speed, command = self._wheels[number], measured[number], self._last[number]
        crossed = [  # wheels whose command this one answers, while they answer this one's
            WHEELS[n]
            for n, other in enumerate(self._wheels)
            if n != number and other.explains(speed) and wheel.explains(measured[n])
        ]
        which = WHEELS[number]
        if max(map(abs, measured)) < STILL_SPEED:
            which = "all wheels stand still"
        elif abs(speed) < STILL_SPEED:
            which += " stands still"
        elif crossed and not wheel.explains(speed):
            which += f" answers {crossed[0]}'s command"
        elif speed * (wheel.high + wheel.low) < 0.0:
            which += " turns backward"
        else:
            which += " turns too fast" if abs(speed) > wheel.fastest else " turns too slowly"
        wiring = f"lift the robot and run 'acsar-gym doctor {self._device} --spin'"
        if self._device.startswith("ros2"):
            wiring = "check ros2.joints in the robot's file"
        return WheelError(
            f"{which} ({command:.2f} rad/s commanded, {speed:.2f} measured for "
            f"{wheel.wrong:.2f} s)",
            f"{wiring}; check motors and encoders, or identify this robot "
            f"('acsar-gym identify {self._device}')",
            WHEELS[number],
        )


def _turn_of(speeds: Speeds) -> float:
    """Return half the difference of right and left wheel speeds [rad/s]."""
    right, left, rear_left, rear_right = speeds
    return 0.25 * (right + rear_right - left - rear_left)
